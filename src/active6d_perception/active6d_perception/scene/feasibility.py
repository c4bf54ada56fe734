"""Whether a pose can be: solid objects do not overlap, nor cut the floor or the walls of their container."""

import numpy as np

from active6d_perception.compiled import compiled
from active6d_perception.model.solid import Solid, signed_distances
from active6d_perception.scene.expected_visibility import Tray

# Poses are some millimetres off, so that points this deep inside still count as touching; metres.
_INTO_CONTAINER, _INTO_NEIGHBOUR = 0.003, 0.0015
#: Columns of :func:`against_container`.
CONTAINER_COLUMNS = ("share below the floor", "lowest height", "share beyond a wall", "farthest beyond", "mean height")
# Points farther than this from a solid neither touch it nor overlap with it, metres.
_NEAR = 0.005
#: Columns of :func:`against_neighbour`.
NEIGHBOUR_COLUMNS = ("share inside", "least distance")
#: Distance to a neighbour that is not near, metres.
FREE = 0.05


@compiled
def against_container(
    T_world_object: np.ndarray, rotations: np.ndarray, points: np.ndarray, tray: Tray, scale: float
) -> np.ndarray:
    """Compare points of an object with the floor and the walls around it.

    Args:
        T_world_object: (k, 4, 4) metres.
        rotations: (r, 4, 4) ``T_object_rotated``.
        points: (p, 3) object frame, metres.
        tray: the walls, none of height 0; the floor is at z = 0.
        scale: factor on lengths, see :func:`.fusion_scale`.

    Returns:
        (k, r, 5) of :data:`CONTAINER_COLUMNS`, metres divided by ``scale``. A point is below or beyond by more than
        3 mm of these; the farthest is negative inside. All are 0 without points.
    """
    result = np.zeros((len(T_world_object), len(rotations), 5))
    half_x, half_y, count, has_walls = 0.5 * tray.width, 0.5 * tray.depth, len(points), tray.wall_height > 0
    for k in range(len(T_world_object)):
        for r in range(len(rotations)):
            T, row = T_world_object[k] @ rotations[r], result[k, r]
            row[1], row[3] = (np.inf, -np.inf) if count else (0.0, 0.0)
            for p in range(count):
                a, b, c = points[p, 0], points[p, 1], points[p, 2]
                x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
                y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
                z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
                beyond = max(abs(x) - half_x, abs(y) - half_y) if z < tray.wall_height and has_walls else -1.0
                row[0] += z < -scale * _INTO_CONTAINER
                row[1] = min(row[1], z / scale)
                row[2] += beyond > scale * _INTO_CONTAINER
                row[3] = max(row[3], beyond / scale)
                row[4] += z / scale
            for column in (0, 2, 4):
                row[column] /= max(count, 1)
    return result


@compiled
def against_neighbour(
    T_world_object: np.ndarray,
    T_world_neighbour: np.ndarray,
    rotations: np.ndarray,
    points: np.ndarray,
    solid: Solid,
    scale: float,
) -> np.ndarray:
    """Compare points of each object with the solid of one neighbour.

    Args:
        T_world_object: (k, 4, 4) metres.
        T_world_neighbour: (k, 4, 4) metres.
        rotations: (r, 4, 4) ``T_object_rotated`` of the object.
        points: (p, 3) object frame, metres.
        solid: of the neighbour.
        scale: factor on lengths, see :func:`.fusion_scale`.

    Returns:
        (k, r, 2): the share of the points more than 1.5 mm inside of the neighbour, and the least signed distance from
        it; those farther than 5 mm may be given as 50 mm. These are metres divided by ``scale``.
    """
    result = np.zeros((len(T_world_object), len(rotations), 2))
    result[:, :, 1] = FREE
    reach = solid.reach + scale * _NEAR
    middle, radius = _ball_around(points)
    local = np.empty(points.shape)
    for k in range(len(T_world_object)):
        T_neighbour_object = _relative(T_world_neighbour[k], T_world_object[k])
        for r in range(len(rotations)):
            T = T_neighbour_object @ rotations[r]
            apart = 0.0
            for axis in range(3):
                there = T[axis, 0] * middle[0] + T[axis, 1] * middle[1] + T[axis, 2] * middle[2] + T[axis, 3]
                apart += there * there
            if apart > (reach + radius) ** 2:
                continue
            for p in range(len(points)):
                a, b, c = points[p, 0], points[p, 1], points[p, 2]
                for axis in range(3):
                    local[p, axis] = T[axis, 0] * a + T[axis, 1] * b + T[axis, 2] * c + T[axis, 3]
            distances = signed_distances(local, solid)
            for p in range(len(points)):
                result[k, r, 0] += distances[p] < -scale * _INTO_NEIGHBOUR
                result[k, r, 1] = min(result[k, r, 1], distances[p] / scale)
            result[k, r, 0] /= max(len(points), 1)
    return result


@compiled
def _relative(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """(4, 4) pose B in the frame of A, both (4, 4) poses in one frame."""
    result = np.eye(4)
    for i in range(3):
        for j in range(4):
            result[i, j] = 0.0
            for axis in range(3):
                result[i, j] += A[axis, i] * (B[axis, j] - (A[axis, 3] if j == 3 else 0.0))
    return result


@compiled
def combine_neighbours(pairs: np.ndarray, own: np.ndarray, count: int) -> np.ndarray:
    """Combine what :func:`against_neighbour` found for pairs of an object and one of its neighbours.

    Args:
        pairs: (m, r, 2).
        own: (m,) index of each pair's object.
        count: number of objects.

    Returns:
        (count, r, 2): the sum of the shares, at most 1, and the least distance, metres.
    """
    result = np.zeros((count, pairs.shape[1], 2))
    result[:, :, 1] = FREE
    for m in range(len(pairs)):
        for r in range(pairs.shape[1]):
            row = result[own[m], r]
            row[0] = min(row[0] + pairs[m, r, 0], 1.0)
            row[1] = min(row[1], pairs[m, r, 1])
    return result


@compiled
def _ball_around(points: np.ndarray) -> tuple[tuple[float, float, float], float]:
    """Centre and radius of a ball with all (p, 3) points."""
    x, y, z = 0.0, 0.0, 0.0
    for p in range(len(points)):
        x, y, z = x + points[p, 0] / len(points), y + points[p, 1] / len(points), z + points[p, 2] / len(points)
    square = 0.0
    for p in range(len(points)):
        square = max(square, (points[p, 0] - x) ** 2 + (points[p, 1] - y) ** 2 + (points[p, 2] - z) ** 2)
    return (x, y, z), np.sqrt(square)
