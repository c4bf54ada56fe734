"""Observes a scene for a bank: estimator and verification in every view, and the evidence of all views together.

What a view gave can be kept in a file, so that an interrupted observation goes on with the next view.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from active6d_agent.bank.scene_bank import BankScene, world_poses
from active6d_core.array_archive import read_archive
from active6d_core.camera import View
from active6d_core.files import atomic_file
from active6d_core.hypotheses import Hypotheses
from active6d_core.metrics import MISSED_E_ADD, e_add
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import quaternion_from_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import Estimator
from active6d_perception.model.ambiguity import Ambiguity
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.belief_weights import BeliefWeights
from active6d_perception.scene.evidence_tables import tabulate
from active6d_perception.scene.measured_view import MeasuredView, measure_view
from active6d_perception.scene.observed_surface import WorkspaceGrid
from active6d_perception.scene.verification import Verifier


@dataclass(frozen=True, eq=False)
class ObservedView:
    """What a bank needs of one view: k hypotheses, and what its depth image measured.

    Attributes:
        T_camera_object: (k, 4, 4) metres.
        verification: (k,) verification scores.
        score: (k,) the estimator's scores.
        box: (k, 4) normalised boxes of the masks.
        mask_depth: (k,) metres.
        label: (k,) of the masks.
        entropy: () of the masks, nats.
        surface: (ceil(cells / 8),) uint8, packed bits of the bank's grid.
        depth: (h, w) and the rest as in :class:`.MeasuredView`.
    """

    T_camera_object: np.ndarray
    verification: np.ndarray
    score: np.ndarray
    box: np.ndarray
    mask_depth: np.ndarray
    label: np.ndarray
    entropy: np.ndarray
    surface: np.ndarray
    depth: np.ndarray
    normals: np.ndarray
    instance: np.ndarray
    middles: np.ndarray
    T_camera_world: np.ndarray
    intrinsics: np.ndarray

    @classmethod
    def load(cls, path: Path) -> "ObservedView | None":
        """Read what :meth:`save` wrote; None if there is no such file, or it is damaged or of another version."""
        try:
            return cls(**read_archive(path))
        except (OSError, ValueError, TypeError):
            return None

    def save(self, path: Path) -> None:
        """Write one ``.npz``; it appears under its name only when it is complete."""
        with atomic_file(path) as unfinished:
            np.savez_compressed(unfinished, **{field.name: getattr(self, field.name) for field in fields(self)})

    def hypotheses(self) -> Hypotheses:
        """The hypotheses without their masks."""
        unmasked = np.zeros((1, 1), np.uint16)
        return Hypotheses(self.T_camera_object, self.score, self.box, self.mask_depth, self.label, unmasked)

    def measured(self) -> MeasuredView:
        """What fusion keeps of the depth image."""
        intrinsics = [float(value) for value in self.intrinsics]
        return MeasuredView(self.depth, self.normals, self.instance, self.middles, self.T_camera_world, *intrinsics)

    def rows(self) -> np.ndarray:
        """(k, 14) float32 rows of a bank's table."""
        T = self.T_camera_object
        columns = [
            T[:, :3, 3],
            quaternion_from_transform(T),
            self.verification,
            self.score,
            self.box,
            self.mask_depth,
        ]
        return np.column_stack(columns).astype(np.float32)


def observe_view(
    view: View, estimator: Estimator, verifier: Verifier, grid: WorkspaceGrid, ambiguity: Ambiguity
) -> ObservedView:
    """Run estimator and verification on one view; the arguments are as for :func:`observe_scene`."""
    hypotheses = estimator.estimate(view)
    measured = measure_view(view.depth, view.camera, view.T_world_camera, hypotheses, ambiguity)
    return ObservedView(
        hypotheses.T_camera_object,
        verifier.score(view.depth, view.camera, hypotheses),
        hypotheses.score,
        hypotheses.box,
        hypotheses.depth,
        hypotheses.label,
        np.array(view_entropy(hypotheses.segmentation)),
        np.packbits(grid.observe(view.depth, view.camera, view.T_world_camera)),
        *measured[:5],
        np.array(measured[5:]),
    )


def observe_scene(
    name: str,
    T_world_object: np.ndarray,
    capture: Callable[[np.ndarray, int], View],
    estimator: Estimator,
    verifier: Verifier,
    model: ObjectModel,
    sphere: ViewSphere,
    grid: WorkspaceGrid,
    *,
    views: Path | None = None,
) -> BankScene:
    """Run estimator and verification on every view of the grid.

    Args:
        name: of the scene.
        T_world_object: (n, 4, 4) true poses.
        capture: ``T_world_camera`` and a stamp in nanoseconds to the view there.
        estimator: the deployed one.
        verifier: the deployed one.
        model: the object.
        sphere: the views.
        grid: of the surface.
        views: folder in which each view is kept, so that only missing ones are observed; None keeps nothing.
    """
    observed = []
    fusion = AllViewsFusion(model, weights=BeliefWeights.indifferent(), align=False)
    for index, position in enumerate(sphere.positions):
        T_world_camera, stamp = sphere.pose(position), (index + 1) * 1_000_000_000
        file = None if views is None else views / f"{index}.npz"
        seen = None if file is None else ObservedView.load(file)
        if seen is None:
            seen = observe_view(capture(T_world_camera, stamp), estimator, verifier, grid, fusion.ambiguity)
            if file is not None:
                seen.save(file)
        fusion.add_measured(stamp, T_world_camera, seen.hypotheses(), seen.verification, seen.measured())
        observed.append(seen)
    of_view = np.repeat(np.arange(len(observed)), [len(seen.score) for seen in observed])
    table = np.concatenate([seen.rows() for seen in observed])
    errors = e_add(model, world_poses(table, of_view, sphere)[:, None], T_world_object[None], cutoff=MISSED_E_ADD)
    errors[errors >= MISSED_E_ADD] = np.inf
    entropy = np.array([float(seen.entropy) for seen in observed])
    surface = np.stack([seen.surface for seen in observed])
    errors = errors.astype(np.float32)
    return BankScene(name, T_world_object, of_view, table, errors, entropy, surface, tabulate(fusion))


def view_entropy(segmentation: np.ndarray) -> float:
    """Shannon entropy in nats of the relative areas of the predicted masks, the background among them.

    Vazquez's viewpoint entropy, as in the entropy-based baseline's source.

    Args:
        segmentation: (H, W) label per pixel.
    """
    areas = np.unique(segmentation, return_counts=True)[1] / segmentation.size
    return float(-(areas * np.log(areas)).sum())
