"""What is ambiguous about an object's pose, and which part of its surface shows it.

Fusion separates a pose into a *body* and a rotation. The body is what near symmetries leave as it is: a mug without its
handle. Rotations about the axis of near symmetry are alternatives of one body. Discrete twins, such as upside down, are
bodies of their own, because they differ in more of the surface and are refined each to its own pose.
"""

from functools import cached_property, lru_cache

import numpy as np

from active6d_core.object_model import ObjectModel, Symmetry
from active6d_core.se3 import transform_points
from active6d_perception.model.length_scale import fusion_scale, spacing
from active6d_perception.model.model_views import model_views
from active6d_perception.model.near_symmetry import near_symmetries, telling_surface
from active6d_perception.model.solid import Solid, solid_of
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.model.visible_samples import VisibleSamples, visible_samples

# Rotations about an axis of near symmetry, a full turn; 10 degrees apart.
_ROTATIONS = 36
# A point tells rotations apart if at least this share of them puts no surface there.
_TELLING = 0.5
_TELLING_SAMPLES, _BODY_SAMPLES, _ALL_SAMPLES = 64, 96, 384


@lru_cache(maxsize=16)
def ambiguity_of(model: ObjectModel) -> "Ambiguity":
    """The ambiguity of ``model``, computed once per process in about two seconds."""
    return Ambiguity(model)


class Ambiguity:
    """Twins, rotations and the parts of one object's surface.

    Attributes:
        model: the object.
        views: its precomputed views.
        twins: (t, 4, 4) ``T_object_twin``, the identity first: discrete near symmetries.
        rotations: (r, 4, 4) ``T_object_rotated`` about the axis of near symmetry, the identity first and alone without
            such an axis. They are evenly spaced over a full turn: 36. If declared symmetries turn about the axis, they
            are over the sector that these leave, and r is the smallest divisor of 36 with steps of at most 10
            degrees: 6 over the 60 degrees of a hexagonal nut.
        telling: (s,) bool, which samples of ``views`` tell the rotations apart.
        telling_twins: (s,) bool, which of the others tell the twins apart.
        middle: (3,) middle of the body, which rotations leave in place; object frame, metres.
        diameter: of the object, metres.
        spacing: metres, see :func:`.spacing`.
        scale: factor on lengths, see :func:`.fusion_scale`.
    """

    def __init__(self, model: ObjectModel) -> None:
        self.model, self.views, self.diameter = model, model_views(model), model.diameter
        self.scale, self.spacing = fusion_scale(model), spacing(model)
        near = self._near = near_symmetries(model)
        self.twins = near.T_object_twin
        self.rotations, self.telling = np.eye(4)[None], np.zeros(len(self.views.points), bool)
        # (order * r, 4, 4): the rotations, then the same after each declared one about the axis.
        self._turn = self.rotations
        if near.T_object_axis is not None:
            count = next(r for r in range(1, _ROTATIONS + 1) if _ROTATIONS % r == 0 and r * near.order >= _ROTATIONS)
            steps = count * near.order
            self._turn = near.rotations_about_axis(np.arange(steps) * 2 * np.pi / steps)
            self.rotations = self._turn[:count]
        if len(self.rotations) > 1:
            tells = telling_surface(model, self.rotations[1:], self.views.points, self.views.normals)
            self.telling = tells.mean(axis=0) > _TELLING
        self.telling_twins = np.zeros(len(self.telling), bool)
        if len(self.twins) > 1:
            tells = telling_surface(model, self.twins[1:], self.views.points, self.views.normals)
            self.telling_twins = tells.any(axis=0) & ~self.telling
        body = self.views.points[~self.telling].astype(float)
        # Averaged over the rotations: the body's samples are not spread exactly evenly about the axis.
        self.middle = transform_points(self._turn, 0.5 * (body.min(axis=0) + body.max(axis=0))[None]).mean(axis=(0, 1))

    @cached_property
    def rotation_errors(self) -> np.ndarray:
        """(r, r) ADD between two rotations of one body, metres; least over the declared symmetries about the axis."""
        points = transform_points(self._turn, self.model.error_points[:: max(1, len(self.model.error_points) // 400)])
        count = len(self.rotations)
        errors = np.stack([np.linalg.norm(points - own, axis=-1).mean(axis=1) for own in points[:count]])
        return errors.reshape(count, -1, count).min(axis=1)

    def mean_rotation(self, weight: np.ndarray) -> np.ndarray:
        """(n, 4, 4) ``T_object_rotated``: the means of the rotations, weighted by (n, r) of similar ones."""
        if len(self.rotations) == 1:
            return np.tile(np.eye(4), (len(weight), 1, 1))
        # The sector is stretched to a full turn, since its ends are alike.
        angles = np.arange(len(self.rotations)) * 2 * np.pi / len(self.rotations)
        stretched = np.arctan2(weight @ np.sin(angles), weight @ np.cos(angles))
        return self._near.rotations_about_axis(stretched / self._near.order)

    @cached_property
    def body_distance(self) -> "BodyDistance":
        """Distance between bodies."""
        return BodyDistance(self.model, self._near.T_object_axis)

    @cached_property
    def solid(self) -> Solid:
        """What is solid at every rotation."""
        return solid_of(self.model, self.rotations[:: max(1, len(self.rotations) // 12)])

    @cached_property
    def telling_points(self) -> np.ndarray:
        """(p, 3) points of the surface that distinguishes rotations, evenly spaced, object frame, metres."""
        return self._spread(self.telling, _TELLING_SAMPLES)

    @cached_property
    def body_points(self) -> np.ndarray:
        """(p, 3) points of the surface that does not, evenly spaced, object frame, metres."""
        return self._spread(~self.telling, _BODY_SAMPLES)

    def _spread(self, part: np.ndarray, count: int) -> np.ndarray:
        among = np.flatnonzero(part)
        chosen = among[np.linspace(0, len(among) - 1, min(count, len(among))).astype(np.intp)]
        return self.views.points[chosen].astype(float)

    @cached_property
    def body_samples(self) -> VisibleSamples:
        """Of the surface that does not tell rotations apart."""
        return visible_samples(self.views, ~self.telling, _BODY_SAMPLES, self.model.mesh.area)

    @cached_property
    def telling_samples(self) -> VisibleSamples:
        """Of the surface that distinguishes rotations."""
        return visible_samples(self.views, self.telling, _TELLING_SAMPLES, self.model.mesh.area)

    @cached_property
    def twin_samples(self) -> VisibleSamples:
        """Of the surface that distinguishes twins."""
        return visible_samples(self.views, self.telling_twins, _TELLING_SAMPLES, self.model.mesh.area)

    @cached_property
    def all_samples(self) -> VisibleSamples:
        """Of the whole surface."""
        return visible_samples(self.views, np.ones(len(self.telling), bool), _ALL_SAMPLES, self.model.mesh.area)


class BodyDistance:
    """:class:`.SymmetricDistance` between poses, least over the rotations about the axis of near symmetry.

    It is also the least over the declared symmetries, such as the flip of a hexagonal nut.

    Args:
        model: the object.
        T_object_axis: as :attr:`.NearSymmetries.T_object_axis`, which the declared symmetries keep or reverse.
    """

    def __init__(self, model: ObjectModel, T_object_axis: np.ndarray | None) -> None:
        self._T_object_axis = np.eye(4) if T_object_axis is None else T_object_axis
        symmetry = model.symmetry
        if T_object_axis is not None:
            # Declared symmetries turn about the object's origin. The frame's is as near to it as the axis comes, so
            # they keep that, too. All that keep the axis are rotations about it, and all that reverse it one flip more.
            R = T_object_axis[:3, :3]
            flips = R.T @ symmetry.discrete[symmetry.discrete @ R[:, 2] @ R[:, 2] < 0] @ R
            symmetry = Symmetry(np.array([0.0, 0.0, 1.0]), np.concatenate([np.eye(3)[None], flips[:1]]))
        points = transform_points(np.linalg.inv(self._T_object_axis), model.surface[0])
        self._distance = SymmetricDistance.of_points(points, symmetry)

    def between(self, T_a: np.ndarray, T_b: np.ndarray) -> np.ndarray:
        """(n, m) distances in metres between (n, 4, 4) and (m, 4, 4) object poses in one frame."""
        return self._distance.between(T_a @ self._T_object_axis, T_b @ self._T_object_axis)
