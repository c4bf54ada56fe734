"""What a depth image says for and against poses: surface, free space, occlusion, and the edges at the outline."""

from typing import NamedTuple

import numpy as np

from active6d_perception.compiled import compiled
from active6d_perception.estimators.measured_image import MeasuredImage
from active6d_perception.model.outline import Outline
from active6d_perception.model.surface_grid import SurfaceGrid, nearest_sample
from active6d_perception.model.visible_samples import VisibleSamples, direction_of

#: Columns of :func:`weigh_poses`.
EVIDENCE = ("fitting", "violated", "occluded", "near", "unmeasured", "outside", "confirmed", "continued")
FITTING, VIOLATED, OCCLUDED, NEAR, UNMEASURED, OUTSIDE, CONFIRMED, CONTINUED = range(len(EVIDENCE))
_LEAST_COMPARABLE = 0.1


class Judge(NamedTuple):
    """What poses of one object are judged by."""

    samples: VisibleSamples
    outline: Outline
    tolerance: float
    """metres along the ray within which a sample fits; from twice that on it is looked through or occluded"""
    alike: float
    """least cosine between normals of a fitting sample"""
    beyond: float
    """metres from the outline to the place where the edge is looked for"""


@compiled
def weigh_poses(T: np.ndarray, judge: Judge, image: MeasuredImage, outlined: bool = True) -> np.ndarray:
    """The evidence of a depth image for poses.

    A sample fits by degrees: fully where depth and normal agree, less towards the tolerance. With a plain count, wrong
    orientations of a smooth object fit as well as the right one.

    Args:
        T: (k, 4, 4) ``T_camera_object``, metres.
        judge: samples and outline of the object, and tolerances.
        image: what was measured.
        outlined: whether to look beyond the outline; if not, its shares are 0.

    Returns:
        (k, 7) with the columns :data:`EVIDENCE`. Of the visible samples, the shares that fit, that the camera looked
        through, that something hides, that fit in depth whatever the normal, and that are not measured. Of the outline,
        the share beyond which something farther away was measured, and the share beyond which the surface continues.
    """
    result = np.zeros((len(T), CONTINUED + 1))
    for k in range(len(T)):
        direction = direction_of(T[k], judge.samples.nearest)
        _weigh_surface(T[k], direction, judge, image, result[k])
        if outlined:
            _weigh_outline(T[k], direction, judge, image, result[k])
    return result


@compiled
def _weigh_surface(P: np.ndarray, direction: int, judge: Judge, image: MeasuredImage, result: np.ndarray) -> None:
    height, width = image.points.shape[:2]
    samples, tolerance, alike = judge.samples, judge.tolerance, judge.alike
    number = samples.number[direction]
    for place in range(number):
        s = samples.chosen[direction, place]
        a, b, c = samples.points[s, 0], samples.points[s, 1], samples.points[s, 2]
        z = P[2, 0] * a + P[2, 1] * b + P[2, 2] * c + P[2, 3]
        u, v = -1, -1
        if z > 1e-3:
            x = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c + P[0, 3]
            y = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c + P[1, 3]
            u, v = int(np.rint(x / z * image.fx + image.cx)), int(np.rint(y / z * image.fy + image.cy))
        if u < 0 or v < 0 or u >= width or v >= height:
            result[OUTSIDE] += 1
            continue
        if np.isnan(image.points[v, u, 2]):
            result[UNMEASURED] += 1
            continue
        behind = z - image.points[v, u, 2]
        if behind < -2 * tolerance:
            result[VIOLATED] += 1
        elif behind > 2 * tolerance:
            result[OCCLUDED] += 1
        elif abs(behind) < tolerance:
            d, e, f = samples.normals[s, 0], samples.normals[s, 1], samples.normals[s, 2]
            cosine = (
                (P[0, 0] * d + P[0, 1] * e + P[0, 2] * f) * image.normals[v, u, 0]
                + (P[1, 0] * d + P[1, 1] * e + P[1, 2] * f) * image.normals[v, u, 1]
                + (P[2, 0] * d + P[2, 1] * e + P[2, 2] * f) * image.normals[v, u, 2]
            )
            off = behind / tolerance
            near = 1.0 - off * off
            result[NEAR] += near
            if cosine > alike:
                result[FITTING] += near * min(1.0, (cosine - alike) / (0.95 - alike))
    for column in range(OUTSIDE + 1):
        result[column] /= max(number, 1)


@compiled
def _weigh_outline(P: np.ndarray, direction: int, judge: Judge, image: MeasuredImage, result: np.ndarray) -> None:
    height, width = image.points.shape[:2]
    outline, tolerance = judge.outline, judge.tolerance
    number = outline.number[direction]
    for place in range(number):
        a, b, c = outline.points[direction, place]
        d, e, f = outline.outward[direction, place]
        x = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c + P[0, 3]
        y = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c + P[1, 3]
        z = P[2, 0] * a + P[2, 1] * b + P[2, 2] * c + P[2, 3]
        if z < 1e-3:
            continue
        ox = P[0, 0] * d + P[0, 1] * e + P[0, 2] * f
        oy = P[1, 0] * d + P[1, 1] * e + P[1, 2] * f
        # At least two pixels, or the edge's own blur would be looked at.
        reach = max(judge.beyond, 2.5 * z / image.fx)
        u = int(np.rint((x + reach * ox) / z * image.fx + image.cx))
        v = int(np.rint((y + reach * oy) / z * image.fy + image.cy))
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        behind = z - image.points[v, u, 2]
        if behind < -2 * tolerance:
            result[CONFIRMED] += 1.0 / number
        elif abs(behind) <= 2 * tolerance:
            result[CONTINUED] += 1.0 / number


def comparable_share(evidence: np.ndarray) -> np.ndarray:
    """(...,) share of the surface that is neither occluded nor unmeasured nor outside, at least 0.1, to divide by.

    Args:
        evidence: (..., 8) of :func:`weigh_poses`.
    """
    return np.maximum(1.0 - evidence[..., [OCCLUDED, UNMEASURED, OUTSIDE]].sum(axis=-1), _LEAST_COMPARABLE)


@compiled
def explained_shares(
    T: np.ndarray, points: np.ndarray, normals: np.ndarray, number: np.ndarray, grid: SurfaceGrid, tolerance: float
) -> np.ndarray:
    """How much of each instance its poses explain: the mean fit of its measured points to the model's surface.

    Args:
        T: (n, c, 4, 4) ``T_camera_object``, c for each instance, metres.
        points: (n, p, 3) measured points of each instance, optical frame, metres.
        normals: (n, p, 3) their unit normals.
        number: (n,) how many of the p points are used.
        grid: of the object.
        tolerance: metres across the surface within which a point fits.

    Returns:
        (n, c) in [0, 1].
    """
    result = np.zeros(T.shape[:2])
    for n in range(len(T)):
        for c in range(T.shape[1]):
            P = T[n, c]
            for index in range(number[n]):
                x, y, z = points[n, index, 0] - P[0, 3], points[n, index, 1] - P[1, 3], points[n, index, 2] - P[2, 3]
                a = P[0, 0] * x + P[1, 0] * y + P[2, 0] * z
                b = P[0, 1] * x + P[1, 1] * y + P[2, 1] * z
                d = P[0, 2] * x + P[1, 2] * y + P[2, 2] * z
                sample = nearest_sample(a, b, d, grid)
                if sample < 0:
                    continue
                u, v, w = grid.normals[sample]
                q = grid.points[sample]
                off = ((a - q[0]) * u + (b - q[1]) * v + (d - q[2]) * w) / tolerance
                if abs(off) < 1:
                    x, y, z = normals[n, index]
                    # Of a thin wall, the sample may lie on the other side.
                    alike = abs(
                        u * (P[0, 0] * x + P[1, 0] * y + P[2, 0] * z)
                        + v * (P[0, 1] * x + P[1, 1] * y + P[2, 1] * z)
                        + w * (P[0, 2] * x + P[1, 2] * y + P[2, 2] * z)
                    )
                    result[n, c] += (1 - off * off) * alike
            result[n, c] /= max(number[n], 1)
    return result
