"""The views of a stored scene as fusion receives them, for what fits and measures fusion."""

from dataclasses import dataclass, replace

import numpy as np

from active6d_core.camera import PinholeCamera
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import create_estimator
from active6d_perception.model.ambiguity import ambiguity_of
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.best_view_fusion import BestViewFusion
from active6d_perception.scene.measured_view import MeasuredView, measure_view, move_view
from active6d_perception.scene.verification import Verifier
from active6d_sim.rendering.pose_error import PoseError
from active6d_sim.rendering.random_sensor import sensor_of
from active6d_sim.rendering.simulator import NANOSECONDS, Simulator
from active6d_sim.scenes.scene_store import find_scene
from active6d_sim.scenes.shape_variation import vary_shape

#: Views that a pool has on its ring.
RING_VIEWS = 6
_RING, _SAME = np.radians(45.0), np.radians(1.0)
# Streams of the random numbers that draw the pool of a scene and the shape of its objects.
_POOL_STREAM, _SHAPE_STREAM = 5, 6


@dataclass(frozen=True, eq=False)
class ProcessedView:
    """A view after estimator and verification, without its images.

    Attributes:
        stamp: nanoseconds.
        T_world_camera: (4, 4) metres.
        camera: intrinsics.
        hypotheses: k of the estimator.
        verification: (k,) their verification scores.
        measured: what fusion of all views keeps of the depth image.
    """

    stamp: int
    T_world_camera: np.ndarray
    camera: PinholeCamera
    hypotheses: Hypotheses
    verification: np.ndarray
    measured: MeasuredView


def disturb(view: ProcessedView, error: PoseError, rng: np.random.Generator) -> ProcessedView:
    """The view with a wrong pose of its camera; what is in the camera's frame stays."""
    if error == PoseError():
        return view
    T_world_wrong = view.T_world_camera @ error.draw(rng)
    return replace(view, T_world_camera=T_world_wrong, measured=move_view(view.measured, T_world_wrong))


class ProcessedScene:
    """The views of the grid in one scene; each is rendered and estimated when it is first asked for.

    Args:
        name: of the scene, such as ``mug/val/0``.
        estimator: name of the deployed one.
        pool: number of views that episodes share.
        seed: of the sensor's noise and of the pool.
        vary_shapes: whether the objects, all alike, deviate from the mesh.

    Attributes:
        model: the object.
        sphere: the grid of views.
        scene: the scene with its true poses.
        pool: the views that episodes share.
    """

    def __init__(
        self, name: str, estimator: str = AUTOMATIC, *, pool: int = 30, seed: int = 0, vary_shapes: bool = False
    ) -> None:
        self.model, self.sphere = load_object(name.split("/")[0]), ViewSphere()
        index = int(name.split("/")[-1])
        self.pool = ViewPool(self.sphere, pool, np.random.default_rng([_POOL_STREAM + seed, index]))
        self.scene = find_scene(self.model.name, name, 0)
        seen = self.model
        if vary_shapes:
            seen = replace(seen, mesh=vary_shape(seen, np.random.default_rng([_SHAPE_STREAM + seed, self.scene.seed])))
        sensor = sensor_of(AUTOMATIC, self.model, self.scene)
        self._simulator = Simulator(self.scene, noise=sensor, seed=seed, model=seen)
        self._estimator, self._verifier = create_estimator(estimator, self.model), Verifier(self.model)
        self._views: dict[int, ProcessedView] = {}

    def view(self, index: int) -> ProcessedView:
        """The view at ``index`` of the grid."""
        if index not in self._views:
            view = self._simulator.capture(self.sphere.pose(self.sphere.positions[index]), (index + 1) * NANOSECONDS)
            hypotheses = self._estimator.estimate(view)
            verification = self._verifier.score(view.depth, view.camera, hypotheses)
            measured = measure_view(view.depth, view.camera, view.T_world_camera, hypotheses, ambiguity_of(self.model))
            self._views[index] = ProcessedView(
                view.stamp, view.T_world_camera, view.camera, hypotheses, verification, measured
            )
        return self._views[index]


def add_view(fusion: AllViewsFusion | BestViewFusion, view: ProcessedView) -> None:
    """Add a view to a fusion of either kind."""
    known = view.stamp, view.T_world_camera, view.hypotheses, view.verification
    if isinstance(fusion, AllViewsFusion):
        fusion.add_measured(*known, view.measured)
    else:
        fusion.add_view(*known)


class ViewPool:
    """Some views of the grid that episodes share, because rendering and estimating every view of it takes long.

    Args:
        sphere: the grid.
        count: number of views in the pool; all of the grid if it has no more.
        rng: draws the pool.

    Raises:
        ValueError: there are fewer views than on the ring.
    """

    def __init__(self, sphere: ViewSphere, count: int, rng: np.random.Generator) -> None:
        if count < RING_VIEWS:
            raise ValueError(f"a pool must have at least the {RING_VIEWS} views of a ring, got {count}")
        elevation = sphere.angles(sphere.positions)[:, 1]
        ring = np.flatnonzero(np.abs(elevation - _RING) < _SAME)
        spread = np.rint(np.arange(RING_VIEWS) * len(ring) / RING_VIEWS).astype(int)
        self.ring = np.roll(ring, rng.integers(len(ring)))[spread]
        rest = rng.permutation(np.setdiff1d(np.arange(len(sphere)), self.ring))
        self.views = np.sort(np.concatenate([self.ring, rest[: count - RING_VIEWS]]))

    def draw(self, count: int, *, ring: bool, rng: np.random.Generator) -> list[int]:
        """Draw different views: at random, or evenly spaced on the ring at 45 degrees if it has as many."""
        if ring and count <= RING_VIEWS:
            spread = np.rint(np.arange(count) * RING_VIEWS / count).astype(int)
            return np.roll(self.ring, rng.integers(RING_VIEWS))[spread].tolist()
        return rng.choice(self.views, min(count, len(self.views)), replace=False).tolist()
