"""A scene recorded in BOP's format as a camera: each goal selects the nearest view (paper, real experiment)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from active6d_core.camera import PinholeCamera, View, backproject
from active6d_core.metrics import match
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, look_at, make_transform, transform_points
from active6d_core.view_sphere import ViewSphere
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_sim.datasets.bop import BopScene, ImageTruth
from active6d_sim.physics.heap import VISIBILITY_THRESHOLD
from active6d_sim.rendering.simulator import NANOSECONDS, GoalError
from active6d_tools.direct_episode import PerceivedView, Perception

#: A goal is in reach if a recorded view is at most this far from it, radians.
_REACH = np.radians(20.0)
#: Labels of different images can be one object if their middles are closer than this fraction of the diameter. They
#: disagree if their surfaces are farther apart than that.
_SAME_OBJECT = 0.25
#: Optical axes that differ less than this do not tell where they cross, radians.
_PARALLEL = np.radians(10.0)
#: What is below z = 0 by more than this fraction of the diameter shows that the floor is lower.
_BELOW_FLOOR = 0.1
#: Within so many metres, a floor has so many times more points than as much height above it. Under 12 simulated piles,
#: the floor had .019 to .074 of all points, and heights between the objects .004 to .009.
_FLOOR_RATIO, _FLAT = 1.5, 0.005


@dataclass(frozen=True, eq=False)
class TrueObjects:
    """The n labelled objects of a scene.

    Attributes:
        T_bin_object: (n, 4, 4) true poses in the bin's frame, metres.
        visible: (n,) bool, whether an image shows a tenth of the object, or does not tell how much it shows.
    """

    T_bin_object: np.ndarray
    visible: np.ndarray


class RecordedScene:
    """m recorded views of a scene, each estimated when it is first needed.

    Args:
        scene: the recording.
        model: of the objects.
        object_id: BOP's number of the model; None if all objects are of it.
        perception: of the object.
        T_bin_camera: (m, 4, 4) camera poses in the frame of the bin: origin at the middle of its floor, z up.
        estimated: what the estimator found in each of the m views, where that is known already.

    Attributes:
        sphere: the grid of views around the bin, of the cameras' median distance.
        nearest: (M,) number of the recorded view nearest to each view of the grid.
        allowed: (M,) bool, views of the grid that a recorded view is near to.

    Raises:
        ValueError: no recorded view is above the bin.
    """

    def __init__(
        self,
        scene: BopScene,
        model: ObjectModel,
        object_id: int | None,
        perception: Perception,
        T_bin_camera: np.ndarray,
        estimated: Sequence[PerceivedView] | None = None,
    ) -> None:
        self.recording, self.model, self.T_bin_camera = scene, model, T_bin_camera
        self._object_id, self._perception, self._estimated = object_id, perception, estimated
        positions = T_bin_camera[:, :3, 3]
        distance = np.linalg.norm(positions, axis=1)
        self.sphere = ViewSphere(float(np.median(distance)))
        cosine = (self.sphere.positions / self.sphere.radius) @ (positions / distance[:, None]).T
        self.nearest, self.allowed = cosine.argmax(axis=1), cosine.max(axis=1) > np.cos(_REACH)
        if not self.allowed.any():
            raise ValueError(f"{scene.folder}: no view is above the bin; is the world's z axis up?")
        self._known: dict[int, PerceivedView] = {}

    def perceive(self, index: int) -> PerceivedView:
        """What the estimator finds in the recorded view of this number, boxes turned upright."""
        if index not in self._known:
            T = self.T_bin_camera[index]
            if self._estimated is None:
                seen = self._perception(replace(self.recording.view(index, index + 1), T_world_camera=T))
            else:
                seen = self._estimated[index]
                seen = replace(seen, view=replace(seen.view, stamp=index + 1, T_world_camera=T))
            upright = look_at(T[:3, 3], T[:3, 3] + T[:3, 2])
            turn = (invert(upright) @ T)[:2, :2]
            boxes = turn_boxes(seen.hypotheses.box, turn, seen.view.camera)
            self._known[index] = replace(seen, hypotheses=replace(seen.hypotheses, box=boxes), T_world_shown=upright)
        return self._known[index]

    def truth(self, warn: Callable[[str], None] = lambda text: None) -> TrueObjects:
        """The labelled objects of all images, each once.

        Objects of an image are matched one to one with those of the images before it, by the distance of their middles:
        solids cannot share a middle, but nested ones come close. Objects of one image are never taken for one.

        Args:
            warn: called where labels of the images disagree.

        Raises:
            ValueError: the recording has no ground truth of the object, or no image shows enough of one.
        """
        apart, limit = SymmetricDistance(self.model).between, _SAME_OBJECT * self.model.diameter
        found, visible, most, turned = np.zeros((0, 4, 4)), np.zeros(0, bool), 0, 0
        for index, image in enumerate(self.recording.truth or ()):
            chosen = of_object(image, self._object_id)
            poses = self.T_bin_camera[index] @ self.model.T_camera_object(image.T_camera_object[chosen])
            # Without a record of it, every object counts as visible.
            shown = ~(image.visible_fraction[chosen] < VISIBILITY_THRESHOLD)
            known = match(cdist(found[:, :3, 3], poses[:, :3, 3]), limit)
            again = known >= 0
            turned += int((apart(found, poses)[known[again], again] > limit).sum())
            visible[known[again]] |= shown[again]
            found, visible = np.concatenate([found, poses[~again]]), np.concatenate([visible, shown[~again]])
            most = max(most, len(poses))
        if not visible.any():
            what = f"object {self._object_id or self.model.name} that is visible by a tenth in an image that is used"
            raise ValueError(f"{self.recording.folder}: no ground truth of {what}")
        name = self.recording.folder.name
        if turned:
            warn(f"{name}: {turned} labels are where an earlier image has an object in another pose; the first counts")
        if len(found) > most:
            why = "labels are partial, or camera poses disagree"
            warn(f"{name}: {len(found)} objects in all, but no image lists more than {most}: {why}")
        return TrueObjects(found, visible)


class RecordedCamera:
    """Moves from view to view of a recorded scene.

    Args:
        scene: the recording.
        start: number of the first view.

    Attributes:
        taken: numbers of the views taken, in order.
    """

    def __init__(self, scene: RecordedScene, start: int) -> None:
        self._scene, self.taken = scene, [start]

    def begin(self) -> PerceivedView:
        """The first view."""
        return self._last()

    def go_to(self, T_world_goal: np.ndarray) -> PerceivedView:
        """The recorded view nearest in direction.

        Raises:
            GoalError: it has been taken already.
        """
        index = int(self._scene.nearest[self._scene.sphere.nearest(T_world_goal[:3, 3])])
        if index in self.taken:
            raise GoalError("the nearest recorded view has been taken already")
        self.taken.append(index)
        return self._last()

    def _last(self) -> PerceivedView:
        return self._scene.perceive(self.taken[-1]).at(len(self.taken) * NANOSECONDS)


def of_object(image: ImageTruth, object_id: int | None) -> np.ndarray:
    """(n,) bool, which of n labels are of an object by BOP's number; all if it is None."""
    return np.full(len(image.object_id), True) if object_id is None else image.object_id == object_id


def turn_boxes(boxes: np.ndarray, turn: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Boxes in the image of the same camera turned about its optical axis.

    Args:
        boxes: (k, 4) x_min, y_min, x_max, y_max over width and height.
        turn: (2, 2) rotation of x and y from this camera to the turned one.
        camera: intrinsics.

    Returns:
        (k, 4) boxes around the turned corners, clipped to the image.
    """
    size, focal = np.array([camera.width, camera.height]), np.array([camera.fx, camera.fy])
    centre = np.array([camera.cx, camera.cy]) + 0.5
    corners = boxes[:, [[0, 1], [2, 1], [0, 3], [2, 3]]]
    turned = ((corners * size - centre) / focal) @ turn.T * focal + centre
    return np.clip(np.concatenate([turned.min(axis=1), turned.max(axis=1)], axis=1) / np.tile(size, 2), 0.0, 1.0)


def looks_down(T_world_camera: np.ndarray) -> bool:
    """Whether most of the cameras (m, 4, 4) look down, as they do where the world's z axis is up."""
    return bool(np.median(T_world_camera[:, 2, 2]) <= -0.05)


def find_bin(scene: BopScene, model: ObjectModel, warn: Callable[[str], None] = lambda text: None) -> np.ndarray:
    """(m, 4, 4) ``T_bin_camera`` of a recording with camera poses: the world is moved to where the cameras look.

    A world whose origin the cameras look at, as this project writes it, stays as it is if nothing is below its floor.
    Where no floor can be seen under the objects, z = 0 is a diameter below what is seen, so that no object is cut.

    Raises:
        ValueError: most cameras look up, so that the world's z axis is not up.
    """
    T = scene.T_world_camera
    if not looks_down(T):
        raise ValueError(f"{scene.folder}: the cameras do not look down, so the world's z axis is not up")
    # Evenly spaced.
    views = [scene.view(index, 0) for index in np.unique(np.linspace(0, len(scene) - 1, 5).astype(int)).tolist()]
    middle = _looked_at(T, views)
    in_place = np.linalg.norm(middle) < model.diameter
    if in_place:
        middle = np.zeros(3)
    height = _heights(views, middle, model.bin_width / 2)
    if not len(height):
        raise ValueError(f"{scene.folder}: no depth where the cameras look, at {np.round(middle, 3).tolist()} m")
    floor, is_seen = _floor(height)
    if in_place and floor > -_BELOW_FLOOR * model.diameter:
        return T
    if not is_seen:
        floor -= model.diameter
    place, taken = np.round(middle, 3).tolist(), "the bin's floor is" if is_seen else "no floor is seen; it is"
    warn(f"{scene.folder.name}: the cameras look at {place} m, and {taken} taken to be at {floor:.3f} m")
    return make_transform(np.eye(3), -np.array([middle[0], middle[1], floor])) @ T


def _looked_at(T: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """(3,) the point nearest to all optical axes of (m, 4, 4) camera poses; along nearly parallel axes, the depth in
    the middle of some views decides."""
    seen = []
    for view in views:
        rows, columns = (slice(size // 3, -(-2 * size // 3)) for size in view.depth.shape)
        depth = view.depth[rows, columns]
        if np.isfinite(depth).any():
            seen.append(transform_points(view.T_world_camera, np.array([[0.0, 0.0, np.nanmedian(depth)]]))[0])
    near = np.median(seen, axis=0) if seen else np.zeros(3)
    # Projections onto the planes across the axes.
    across = np.eye(3) - T[:, :3, 2, None] * T[:, None, :3, 2]
    off = np.einsum("nij,nj->i", across, T[:, :3, 3] - near)
    strength, direction = np.linalg.eigh(across.sum(axis=0))
    known = strength > len(T) * np.sin(_PARALLEL) ** 2
    return near + direction[:, known] @ ((direction[:, known].T @ off) / strength[known])


def _heights(views: Sequence[View], middle: np.ndarray, radius: float) -> np.ndarray:
    """(n,) heights of what views measured within ``radius`` of the vertical line through (3,) ``middle``, metres."""
    heights = []
    for view in views:
        points = transform_points(view.T_world_camera, backproject(view.depth, view.camera)[np.isfinite(view.depth)])
        heights.append(points[np.linalg.norm(points[:, :2] - middle[:2], axis=1) < radius, 2])
    return np.concatenate(heights)


def _floor(height: np.ndarray) -> tuple[float, bool]:
    """Height of what lies under the objects, of (n,) heights in metres, and whether it is a surface of one height.

    It is near a low quantile of the heights. Little of the floor is seen between the objects of a pile, but more than
    of the heights just above it. Where the floor is hidden, it is the other way round.
    """
    off = height - np.quantile(height, 0.01)
    above = np.count_nonzero((off > _FLAT) & (off < 3 * _FLAT))
    near = height[np.abs(off) < _FLAT]
    return float(np.median(near)), bool(len(near) > _FLOOR_RATIO * above)
