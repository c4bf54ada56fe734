"""What each view measured where a pose puts the object's surface, counted in pixels by case.

A case has two parts. *What* was measured at a pixel: the surface itself, something in front of it (the surface is
hidden), or something behind it (the camera looked through it). *Whose* the pixel is: it belongs to the instance at
this place, to another one or to none.
"""

import numpy as np

from active6d_perception.compiled import compiled
from active6d_perception.model.visible_samples import VisibleSamples, direction_of
from active6d_perception.scene.measured_view import NORMAL, MeasuredView

#: Rows: looked through, measured a little behind, there but facing elsewhere, a little before, hidden, not measured,
#: there and facing alike.
WHAT = 7
#: Columns: of the own instance, of another, of none.
WHOSE = 3
CASES = WHAT * WHOSE
LOOKED_THROUGH, LITTLE_BEHIND, FACING_ELSEWHERE, LITTLE_BEFORE, HIDDEN, NOT_MEASURED, FITTING = range(WHAT)

_FAR, _NEAR = 0.012, 0.006  # metres along the ray
_ALIKE = 0.6  # cosine between normals
#: Counts are whole numbers of this part of a pixel, so that sums do not depend on their order.
PER_PIXEL = 16


@compiled
def count_cases(
    T_world_object: np.ndarray,
    rotations: np.ndarray,
    middle: np.ndarray,
    same_place: float,
    samples: VisibleSamples,
    view: MeasuredView,
    scale: float,
) -> np.ndarray:
    """Count the pixels that the visible samples of each pose and rotation cover, by case.

    Args:
        T_world_object: (k, 4, 4) poses of bodies, metres.
        rotations: (r, 4, 4) ``T_object_rotated``.
        middle: (3,) of the body, object frame, metres.
        same_place: an instance whose body's middle is nearer than this to the pose's is the pose's own, metres.
        samples: of the part of the surface to look at.
        view: what was measured.
        scale: factor on the distances at which the surface counts as measured.

    Returns:
        (k, r, :data:`CASES`) int32 sixteenths of a pixel; the case is ``what * WHOSE + whose``.
    """
    counts = np.zeros((len(T_world_object), len(rotations), CASES), np.int32)
    own = np.zeros(len(view.middles), np.bool_)
    for k in range(len(T_world_object)):
        T = T_world_object[k]
        for index in range(len(own)):
            square = 0.0
            for axis in range(3):
                there = T[axis, 0] * middle[0] + T[axis, 1] * middle[1] + T[axis, 2] * middle[2] + T[axis, 3]
                square += (view.middles[index, axis] - there) ** 2
            own[index] = square < same_place * same_place
        _count_body(view.T_camera_world @ T, rotations, own, samples, view, scale, counts[k])
    return counts


@compiled
def _count_body(
    T_camera_object: np.ndarray,
    rotations: np.ndarray,
    own: np.ndarray,
    samples: VisibleSamples,
    view: MeasuredView,
    scale: float,
    counts: np.ndarray,
) -> None:
    """Add one body's pixels to (r, :data:`CASES`) ``counts``; (i,) ``own`` marks its instances."""
    height, width = view.depth.shape
    for r in range(len(rotations)):
        P = T_camera_object @ rotations[r]
        direction = direction_of(P, samples.nearest)
        area = PER_PIXEL * samples.area[direction] * view.fx * view.fy
        for place in range(samples.number[direction]):
            s = samples.chosen[direction, place]
            a, b, c = samples.points[s, 0], samples.points[s, 1], samples.points[s, 2]
            z = P[2, 0] * a + P[2, 1] * b + P[2, 2] * c + P[2, 3]
            if z < 1e-3:
                continue
            x = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c + P[0, 3]
            y = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c + P[1, 3]
            d, e, f = samples.normals[s, 0], samples.normals[s, 1], samples.normals[s, 2]
            nx = P[0, 0] * d + P[0, 1] * e + P[0, 2] * f
            ny = P[1, 0] * d + P[1, 1] * e + P[1, 2] * f
            nz = P[2, 0] * d + P[2, 1] * e + P[2, 2] * f
            u, v = int(np.rint(x / z * view.fx + view.cx)), int(np.rint(y / z * view.fy + view.cy))
            # Outside of the image, a sample beside the camera would count without limit by its depth alone.
            what, whose, distance = NOT_MEASURED, 2, np.sqrt(x * x + y * y + z * z)
            squared = distance * distance
            if 0 <= u < width and 0 <= v < height:
                squared = z * z
                behind = z - view.depth[v, u]
                if abs(behind) <= scale * _NEAR:
                    normal = view.normals[v, u]
                    alike = normal[0] * nx + normal[1] * ny + normal[2] * nz > _ALIKE * NORMAL
                    what = FITTING if alike else FACING_ELSEWHERE
                elif not np.isnan(behind):
                    little = abs(behind) <= scale * _FAR
                    before, after = LITTLE_BEFORE if little else HIDDEN, LITTLE_BEHIND if little else LOOKED_THROUGH
                    what = before if behind > 0 else after
                index = view.instance[v, u]
                if index >= 0:
                    whose = 0 if own[index] else 1
            # A sample that is seen at a slant covers fewer pixels.
            slant = abs(nx * x + ny * y + nz * z) / distance
            counts[r, what * WHOSE + whose] += int(np.rint(area * slant / squared))
