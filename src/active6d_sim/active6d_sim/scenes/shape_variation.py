"""Random deviations of a part's shape from its mesh.

A real part is never its mesh: lids, tolerances and other editions of a product change it by some millimetres. An
estimator that has only seen exact meshes takes such a part for something else, or for the same part upside down.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.special import expit

from active6d_core.object_model import ObjectModel

_EDGES_PER_DIAMETER = 16
_MODES = 3


@dataclass(frozen=True)
class ShapeVariation:
    """Sizes of the deviations.

    Attributes:
        scale: standard deviation of the two scale factors, along and across the main axis.
        waves: standard deviation of the smooth displacement along the normals, in diameters.
        step: largest displacement of an end, such as another lid or base, in diameters.
        step_probability: probability that an end is displaced.
    """

    scale: float = 0.025
    waves: float = 0.008
    step: float = 0.04
    step_probability: float = 0.6


def vary_shape(
    model: ObjectModel, rng: np.random.Generator, variation: ShapeVariation = ShapeVariation()
) -> trimesh.Trimesh:
    """A random variant of a mesh: scaled, with smooth waves, and with ends that are wider or narrower.

    An object with a continuous symmetry keeps it.

    Args:
        model: the object; its axis of symmetry is the main axis, or a random direction if it has none.
        rng: random generator.
        variation: sizes of the deviations.

    Returns:
        A finer mesh in the object frame, metres.
    """
    axis = model.symmetry.axis
    symmetric = axis is not None
    main = np.array(axis if axis is not None else _direction(rng), float)
    edge = model.diameter / _EDGES_PER_DIAMETER
    fine = trimesh.remesh.subdivide_to_size(model.mesh.vertices, model.mesh.faces, edge)  # type: ignore[no-untyped-call]
    mesh = trimesh.Trimesh(*fine)
    vertices = np.asarray(mesh.vertices)
    height = vertices @ main
    moved = np.zeros(len(vertices))
    for _ in range(_MODES):
        wave = (main if symmetric else _direction(rng)) * 2 * np.pi / rng.uniform(0.5, 2.0)
        phase = rng.uniform(0, 2 * np.pi)
        moved += rng.normal(0, variation.waves) * np.cos(vertices @ wave / model.diameter + phase)
    for end in (height.min(), height.max()):
        if rng.random() < variation.step_probability:
            inward = np.abs(height - end) / np.ptp(height)
            moved += rng.uniform(-1, 1) * variation.step * expit((rng.uniform(0.03, 0.25) - inward) / 0.01)
    moved_vertices = vertices + moved[:, None] * model.diameter * mesh.vertex_normals
    along, across = 1 + np.clip(rng.normal(0, variation.scale, 2), -2 * variation.scale, 2 * variation.scale)
    on_axis = (moved_vertices @ main)[:, None] * main
    return trimesh.Trimesh(along * on_axis + across * (moved_vertices - on_axis), mesh.faces, process=False)


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
