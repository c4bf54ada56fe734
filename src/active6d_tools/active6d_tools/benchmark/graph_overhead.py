"""Overhead of the node graph over direct calls of the core functions.

The outputs of camera and estimator are computed beforehand: full-size images of a pile of 18 mugs, and 20 hypotheses
per view near the true poses. The times contain conversions, transport, callbacks, verification, fusion and policy, and
no rendering or estimation.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from scipy.spatial.transform import Rotation

from active6d_bringup.graph.composition import ComposedGraph, GraphDescription, running
from active6d_bringup.graph.episode import EpisodeMonitor
from active6d_core.camera import DEFAULT_CAMERA, View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.ros import topics
from active6d_core.ros.conversions import (
    camera_to_info,
    color_to_image,
    depth_to_image,
    make_header,
    transform_to_pose_stamped,
)
from active6d_core.ros.node import GraphNode
from active6d_core.se3 import make_transform
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import register_estimator

_SECOND = 1_000_000_000
OnProgress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class PreparedViews:
    """Views of one pile, and the hypotheses that replace an estimator, by stamp."""

    model: ObjectModel
    views: list[View]
    hypotheses: dict[int, Hypotheses]


#: Results of the estimator named "prepared"; set by :func:`measure_graph`.
_prepared: dict[int, Hypotheses] = {}


@register_estimator("prepared")
class PreparedEstimator:
    """Returns prepared hypotheses without any computation."""

    def __init__(self, model: ObjectModel) -> None:
        self._model = model

    def estimate(self, view: View) -> Hypotheses:
        """The prepared hypotheses of this view."""
        return _prepared[view.stamp]


class PreparedCamera(GraphNode):
    """Publishes the next prepared view at every goal, and stores the time of the goal."""

    def __init__(self, views: list[View], **arguments: Any) -> None:
        super().__init__("camera_simulator", **arguments)
        self._views = iter(views)
        self.times: list[float] = []
        self._color = self.output(topics.CAMERA_COLOR)
        self._depth = self.output(topics.CAMERA_DEPTH)
        self._info = self.output(topics.CAMERA_INFO)
        self._pose = self.output(topics.CAMERA_POSE)
        self._start = self.output(topics.EPISODE_START)
        self.input(topics.VIEW_GOAL, self._on_goal)
        self.input(topics.EPISODE_END, self._on_goal)

    def begin(self) -> None:
        """Announce the episode and publish the first view."""
        self._start.publish(DiagnosticArray(header=make_header(_SECOND, self.world_frame)))
        self._on_goal(None)

    def _on_goal(self, message: Any) -> None:
        self.times.append(time.perf_counter())
        view = next(self._views, None)
        if view is None:
            return
        self._color.publish(color_to_image(view.color, view.stamp, self.camera_frame))
        self._depth.publish(depth_to_image(view.depth, view.stamp, self.camera_frame))
        self._info.publish(camera_to_info(view.camera, view.stamp, self.camera_frame))
        self._pose.publish(transform_to_pose_stamped(view.T_world_camera, view.stamp, self.world_frame))


def prepare_views(
    object_name: str, seed: int, count: int, hypotheses: int, *, objects: int | None = None
) -> PreparedViews:
    """Render ``count`` random views of a pile, with ``hypotheses`` hypotheses per view near the true poses.

    The pile has ``objects`` instances, by default two fewer than the maximum of the object.
    """
    from active6d_sim.physics.heap import simulate_heap
    from active6d_sim.rendering.renderer import SceneRenderer

    model, sphere, rng = load_object(object_name), ViewSphere(), np.random.default_rng(seed)
    scene = simulate_heap(model, seed, count=objects or model.instances[1] - 2)
    renderer = SceneRenderer(scene)
    views, found = [], {}
    for index, position in enumerate(rng.permutation(len(sphere))[:count]):
        T_world_camera = sphere.pose(sphere.positions[position])
        image = renderer.render(T_world_camera)
        assert image.color is not None, "shaded by default"
        stamp = (index + 1) * _SECOND
        noise = rng.normal(0.0, 0.001, image.depth.shape).astype(np.float32)
        views.append(View(stamp, image.color, image.depth + noise, DEFAULT_CAMERA, T_world_camera))
        T_camera_object = np.linalg.inv(T_world_camera) @ scene.T_world_all
        found[stamp] = _near_the_truth(T_camera_object, image.instance, views[-1].depth, hypotheses, rng)
    return PreparedViews(model, views, found)


def _near_the_truth(
    T_camera_object: np.ndarray, instance: np.ndarray, depth: np.ndarray, count: int, rng: np.random.Generator
) -> Hypotheses:
    """``count`` hypotheses of the objects with the most visible pixels, a few millimetres and degrees off."""
    pixels = np.bincount(instance[instance >= 0], minlength=len(T_camera_object))
    ranked = np.argsort(-pixels)[: np.count_nonzero(pixels)]
    label = np.arange(count) % len(ranked)
    off = disturbances(count, rng)
    label_of = np.zeros(len(T_camera_object) + 1, np.uint16)
    label_of[ranked] = np.arange(1, len(ranked) + 1)
    return Hypotheses.from_masks(
        T_camera_object[ranked[label]] @ off, rng.random(count), label + 1, label_of[instance], depth
    )


def disturbances(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 4, 4) random transforms of a few degrees and millimetres."""
    rotation = Rotation.from_rotvec(rng.normal(0.0, 0.03, (count, 3))).as_matrix()
    return make_transform(rotation, rng.normal(0.0, 0.002, (count, 3)))


def measure_graph(
    object_name: str = "mug",
    *,
    seed: int = 0,
    views: int = 11,
    hypotheses: int = 20,
    repeats: int = 8,
    on_progress: OnProgress = lambda what, done, total: None,
) -> dict[str, Any]:
    """Compare the composed graph with direct calls, view by view.

    The time of each view is the median of the repetitions.

    Args:
        object_name: of the objects in the bin.
        seed: of pile, views and hypotheses.
        views: number of views of one episode; T = views - 1.
        hypotheses: number per view.
        repeats: number of episodes of each kind.
        on_progress: called with a description, the number of steps done and the number of all steps.

    Returns:
        ``overhead_ms``: graph minus direct in milliseconds per view, mean over the views, without a recorder;
        ``overhead_recorded_ms``: the same with a recorder, which compresses and writes all messages;
        ``graph_ms``, ``recorded_ms``, ``direct_ms``: the times per view; ``fusion_ms`` and ``fusion_hz``: verification
        and fusion of the last view by direct call; ``image_bytes``: size of the images of one view.
    """
    on_progress("rendering views", 0, 1)
    prepared = prepare_views(object_name, seed, views, hypotheses)
    _prepared.clear()
    _prepared.update(prepared.hypotheses)
    times: dict[str, list[np.ndarray]] = {"direct": [], "fusion": [], "graph": [], "recorded": []}
    for repeat in range(repeats):
        on_progress("episodes", repeat, repeats)
        direct, fusion = _direct(prepared)
        times["direct"].append(direct)
        times["fusion"].append(fusion)
        times["graph"].append(_through_graph(prepared, None))
        with tempfile.TemporaryDirectory() as folder:
            times["recorded"].append(_through_graph(prepared, Path(folder) / "bag"))
    on_progress("episodes", repeats, repeats)
    first = prepared.views[0]
    return {
        "object": object_name,
        "views": views,
        "hypotheses": hypotheses,
        "repeats": repeats,
        "image_bytes": first.color.nbytes + first.depth.nbytes + first.depth.size * 2,
        **_summary(times),
    }


def _summary(times: dict[str, list[np.ndarray]]) -> dict[str, float]:
    """Milliseconds per view by kind of episode, from the median of the repetitions of each view."""
    per_view = {kind: 1e3 * np.median(samples, axis=0) for kind, samples in times.items()}
    return {
        "overhead_ms": float((per_view["graph"] - per_view["direct"]).mean()),
        "overhead_recorded_ms": float((per_view["recorded"] - per_view["direct"]).mean()),
        **{f"{kind}_ms": float(per_view[kind].mean()) for kind in ("graph", "recorded", "direct")},
        "fusion_ms": float(per_view["fusion"][-1]),
        "fusion_hz": float(1e3 / per_view["fusion"][-1]),
    }


def _direct(prepared: PreparedViews) -> tuple[np.ndarray, np.ndarray]:
    """Seconds per view of the core functions, and the part of verification and fusion."""
    from active6d_agent.policies.registry import Observation, create_policy
    from active6d_perception.scene.all_views_fusion import AllViewsFusion
    from active6d_perception.scene.observed_surface import ObservedSurface
    from active6d_perception.scene.verification import Verifier

    verifier, fusion, surface = (
        Verifier(prepared.model),
        AllViewsFusion(prepared.model),
        ObservedSurface(prepared.model),
    )
    policy, sphere = create_policy("lowest-score", prepared.model), ViewSphere()
    policy.reset(np.random.default_rng(0))
    allowed, positions = np.ones(len(sphere), bool), []
    total, fusing = [], []
    for left, view in zip(range(len(prepared.views), 0, -1), prepared.views, strict=True):
        began = time.perf_counter()
        found = prepared.hypotheses[view.stamp]
        scores = verifier.score(view.depth, view.camera, found)
        fusion.add_view(view.stamp, view.T_world_camera, found, scores, view.depth, view.camera)
        surface.add_view(view.stamp, view.depth, view.camera, view.T_world_camera)
        objects = fusion.objects(view.stamp, view.T_world_camera, view.camera)
        unexplained = surface.unexplained(objects.T_world_object)
        fused = time.perf_counter()
        positions.append(view.T_world_camera[:3, 3])
        policy.decide(Observation(objects, np.array(positions), sphere, allowed, left, unexplained=unexplained))
        total.append(time.perf_counter() - began)
        fusing.append(fused - began)
    return np.array(total), np.array(fusing)


def _through_graph(prepared: PreparedViews, bag: Path | None) -> np.ndarray:
    """Seconds per view from its goal to the next goal or the end of the episode."""
    name = prepared.model.name
    nodes: dict[str, dict[str, Any]] = {
        "pose_estimator": {"object": name, "estimator": "prepared"},
        "hypothesis_fusion": {"object": name},
        "attention_policy": {"object": name, "policy": "lowest-score", "steps": len(prepared.views)},
    }
    if bag is not None:
        nodes["episode_recorder"] = {"bag": str(bag)}
    with running(ComposedGraph(GraphDescription(nodes))) as graph:
        monitor = EpisodeMonitor(graph.context, "", lambda step: None)
        graph.add(monitor)
        graph.start()
        camera = PreparedCamera(prepared.views, context=graph.context)
        graph.add(camera)
        camera.start()
        while len(camera.times) <= len(prepared.views):
            graph.spin_once(1.0)
        return np.diff(camera.times)
