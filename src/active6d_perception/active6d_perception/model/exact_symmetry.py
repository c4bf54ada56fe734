"""Symmetries of a mesh: turns about its centroid after which it looks the same from everywhere.

A turn holds if 98 % of the turned surface lie within 1 % of the diameter from the surface. So details may differ, but
not the handle of a mug, which is 5 % of its surface. Axes are tried where symmetric parts have them: those of the
mesh's frame, those of inertia, and for half turns also across an axis that was found.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel
from active6d_core.rotation_group import rotation_group
from active6d_perception.model.model_views import ray_caster

#: Share of the diameter by which a turned surface may leave the surface. For a hexagonal nut it is .04 after turns that
#: are not multiples of a sixth, for a box whose sides differ by a twentieth .011 after a quarter.
TOLERANCE = 0.01
#: The rest of the surface may be details, such as the drinking hole of a lid.
SHARE = 0.98
#: The golden angle: no number of teeth or corners turns onto itself each time.
GOLDEN_TURNS = np.radians(137.508) * np.arange(1, 25)
_FOLDS = np.arange(2, 31)
_LARGEST_GROUP = 60
_POINTS, _FEW_POINTS = 2048, 512
# With few points the share is known less well.
_FEW_TOLERANCE = 2 * TOLERANCE
_ACROSS_STEPS = 24
_SAME_AXIS = np.cos(np.radians(2.0))


@dataclass(frozen=True, eq=False)
class Turn:
    """Symmetry under every multiple of a part of a turn.

    Attributes:
        axis: (3,) unit vector in the object frame.
        fold: 6 for a sixth of a turn; at least 2.
    """

    axis: np.ndarray
    fold: int

    @property
    def rotations(self) -> np.ndarray:
        """(fold - 1, 3, 3) its rotations but the identity, the smallest first."""
        angles = 2 * np.pi * np.arange(1, self.fold) / self.fold
        return Rotation.from_rotvec(angles[:, None] * self.axis).as_matrix()


@dataclass(frozen=True, eq=False)
class ExactSymmetries:
    """What :func:`exact_symmetries` finds.

    Attributes:
        axis: (3,) unit axis about which any turn looks the same, None without one.
        turns: generate the discrete symmetries, those of most folds first; empty without any.
    """

    axis: np.ndarray | None
    turns: tuple[Turn, ...]


class TurnedSurface:
    """How far an object's surface leaves itself when it is turned about the centroid."""

    def __init__(self, model: ObjectModel) -> None:
        self._points = model.surface[0][:_POINTS].astype(np.float32)
        self._scene = ray_caster(model.mesh, threads=1)

    def distances(self, R: np.ndarray, count: int = _POINTS) -> np.ndarray:
        """(k, count) metres between the surface and ``count`` of its points, turned by (k, 3, 3) rotations."""
        moved = np.einsum("kij,nj->kni", R.astype(np.float32), self._points[:count])
        return np.asarray(self._scene.compute_distance(moved, nthreads=1).numpy())

    def deviations(self, R: np.ndarray, count: int = _POINTS) -> np.ndarray:
        """(k,) metres from the surface that ``SHARE`` of the turned surface do not exceed; ``R`` is (k, 3, 3)."""
        return np.quantile(self.distances(R, count), SHARE, axis=1)

    def deviation_about(self, axis: np.ndarray) -> float:
        """The same over turns of all angles about (3,) a unit ``axis``."""
        turns = Rotation.from_rotvec(GOLDEN_TURNS[:, None] * axis).as_matrix()
        return float(np.quantile(self.distances(turns), SHARE))


def exact_symmetries(model: ObjectModel) -> ExactSymmetries:
    """Symmetries of a mesh, whatever the object's description declares.

    Args:
        model: the object; symmetries are about its centroid.

    Returns:
        Turns by up to a thirtieth of a turn that make up at most 60 rotations. A cube or another body with equal
        moments of inertia must stand along the axes of its frame to be found. With an axis of any turn, the only
        discrete one is half a turn across it.
    """
    surface, allowed = TurnedSurface(model), TOLERANCE * model.diameter
    candidates = _candidate_axes(model)
    axis = next((each for each in candidates if surface.deviation_about(each) <= allowed), None)
    if axis is not None:
        turn = Turn(_across(axis)[0], 2)
        return ExactSymmetries(axis, (turn,) if surface.deviations(turn.rotations).max() <= allowed else ())
    finest = [_finest_turn(surface, each, model.diameter) for each in candidates]
    turns = [turn for turn in finest if turn is not None]
    if turns:
        most = max(turns, key=lambda turn: turn.fold)
        if all(abs(turn.axis @ most.axis) > 1 - _SAME_AXIS for turn in turns):
            across = _finest_turn(surface, _half_turn_across(surface, most), model.diameter)
            turns += [] if across is None else [across]
    return ExactSymmetries(None, _generators(turns, surface, allowed))


def _candidate_axes(model: ObjectModel) -> list[np.ndarray]:
    """Unit axes of the mesh's frame, z first, and of inertia where they are others."""
    axes: list[np.ndarray] = []
    for axis in [*np.eye(3)[[2, 0, 1]], *np.asarray(model.mesh.principal_inertia_vectors)]:
        if all(abs(axis @ other) < _SAME_AXIS for other in axes):
            axes.append(axis * np.sign(axis[np.abs(axis).argmax()]))
    return axes


def _across(axis: np.ndarray) -> np.ndarray:
    """(2, 3) orthonormal vectors across a unit ``axis``; the first is x where that is across."""
    first = np.eye(3)[np.abs(axis).argmin()]
    first = first - (first @ axis) * axis
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


def _finest_turn(surface: TurnedSurface, axis: np.ndarray, diameter: float) -> Turn | None:
    """The turn of most folds about an axis; None without any."""
    once = Rotation.from_rotvec((2 * np.pi / _FOLDS)[:, None] * axis).as_matrix()
    likely = _FOLDS[surface.deviations(once, _FEW_POINTS) <= _FEW_TOLERANCE * diameter]
    turns = (Turn(axis, int(fold)) for fold in likely[::-1])
    return next((turn for turn in turns if surface.deviations(turn.rotations).max() <= TOLERANCE * diameter), None)


def _half_turn_across(surface: TurnedSurface, turn: Turn) -> np.ndarray:
    """(3,) the axis across that of ``turn`` whose half turn fits the surface best."""
    frame, step = _across(turn.axis), np.pi / turn.fold / _ACROSS_STEPS

    def axis(angle: float) -> np.ndarray:
        return np.array([np.cos(angle), np.sin(angle)]) @ frame

    def misfit(angle: float) -> float:
        return float(surface.distances(Turn(axis(angle), 2).rotations, _FEW_POINTS).mean())

    # A half turn and a symmetry about the first axis make half turns about axes that are half a fold apart.
    start = min(step * np.arange(_ACROSS_STEPS), key=misfit)
    return axis(minimize_scalar(misfit, bounds=(start - step, start + step), method="bounded").x)


def _generators(turns: list[Turn], surface: TurnedSurface, allowed: float) -> tuple[Turn, ...]:
    """Those of ``turns`` that are no products of others, and with which every product fits the surface."""
    kept: list[Turn] = []
    group = np.eye(3)[None]
    for turn in sorted(turns, key=lambda turn: -turn.fold):
        try:
            larger = rotation_group(np.stack([each.rotations[0] for each in [*kept, turn]]))
        except ValueError:  # they only nearly fit together
            continue
        if len(group) < len(larger) <= _LARGEST_GROUP and surface.deviations(larger).max() <= allowed:
            kept, group = [*kept, turn], larger
    return tuple(kept)
