"""Node ``hypothesis_fusion``: verifies each view's hypotheses against its depth image and fuses them across views.

It also publishes the surface in the depth images that the fused objects do not explain.
"""

from dataclasses import fields, replace
from typing import Any

import numpy as np
from sensor_msgs.msg import Image, PointCloud2

from active6d_core.bounds import check_in_front
from active6d_core.camera import PinholeCamera
from active6d_core.files import atomic_file, cache_folder
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.ros import topics
from active6d_core.ros.conversions import (
    hypotheses_from_cloud,
    image_to_segmentation,
    objects_to_cloud,
    objects_to_markers,
    points_to_cloud,
    poses_to_array,
    refusing,
    require_frame,
    stamp_to_ns,
)
from active6d_core.ros.episode_messages import EpisodeStart
from active6d_core.ros.heartbeat import Awaited
from active6d_core.ros.node import GraphNode
from active6d_core.ros.optional_outputs import DetectionOutput
from active6d_core.ros.runner import run_node
from active6d_core.ros.view_inputs import ViewInputs
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.best_view_fusion import BestViewFusion
from active6d_perception.scene.camera_alignment import CameraAlignment
from active6d_perception.scene.expected_visibility import Tray
from active6d_perception.scene.fusion_parameters import METHODS, RANKINGS, FusionParameters
from active6d_perception.scene.observed_surface import ObservedSurface, WorkspaceGrid
from active6d_perception.scene.verification import Verifier

#: What belongs to a view beside the camera's topics, part to topic.
_OTHERS = {"hypotheses": "hypotheses", "segmentation": "hypotheses/segmentation"}


class HypothesisFusionNode(GraphNode):
    """Subscribes to hypotheses with label images, depth and the camera's pose; publishes ``objects``,
    ``objects/poses``, ``objects/markers`` and ``objects/unexplained``.

    Where vision_msgs is installed, it also publishes the objects as ``objects/detections``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("hypothesis_fusion", **options)
        self.declare("object", "mug", "name of the object that the hypotheses are of")
        self.declare("epsilon", 0.010, "depth threshold of the verification score in metres", minimum=1e-4)
        self.declare("samples", 128, "largest number of scene points verified per hypothesis", minimum=1)
        self._declare_fusion()
        self._declare_bin()
        self._declare_workspace()
        self._objects = self.output(topics.OBJECTS)
        self._poses = self.output(topics.OBJECTS_POSES)
        self._markers = self.output(topics.OBJECTS_MARKERS)
        self._unexplained = self.output(topics.UNEXPLAINED)
        self._camera_poses = self.output(topics.CAMERA_POSES)
        self._detections = DetectionOutput(self)
        self.input(topics.HYPOTHESES, self._on_hypotheses)
        self.input(topics.SEGMENTATION, self._on_segmentation)
        self._inputs = ViewInputs(self, ("depth", "camera", "pose"), self._on_view, _OTHERS, self._on_start)

    def _declare_fusion(self) -> None:
        usual = FusionParameters()
        self.declare(
            "method",
            METHODS[0],
            "what an object's pose follows from: the depth images of all views, or the best hypothesis of one view",
            choices=METHODS,
        )
        self.declare(
            "confirmed",
            usual.confirmed,
            "objects with at least this probability count; the others are drawn transparent",
            minimum=0.0,
            maximum=1.0,
        )
        self.declare(
            "least_probability",
            usual.least_probability,
            "less probable objects are withdrawn; only by the method all-views",
            minimum=0.0,
            maximum=1.0,
        )
        self.declare(
            "align_views",
            True,
            "correct the camera's poses by aligning the depth images of the views; only by the method all-views",
        )
        self.declare(
            "cut",
            usual.cut,
            "distance at which clusters are cut, as a fraction of the object's diameter; less for slim objects",
            minimum=1e-3,
        )
        self.declare(
            "exclusion",
            usual.exclusion,
            "least distance between two objects, as a fraction of the diameter; less for slim objects",
            minimum=0.0,
        )
        self.declare(
            "min_verification",
            usual.min_verification,
            "hypotheses with a lower verification score are ignored",
            minimum=-1.0,
            maximum=1.0,
        )
        self.declare(
            "rank_by",
            usual.rank_by,
            "how hypotheses and clusters are ranked: verification score, estimator score, product, summed evidence",
            choices=RANKINGS,
        )
        self.declare(
            "explained_within",
            usual.explained_within,
            "observed surface this near to an object is explained by it, as a fraction of the diameter; a smaller "
            "value leaves surface of found objects unexplained where poses are slightly off",
            minimum=1e-3,
            maximum=1.0,
        )

    def _declare_bin(self) -> None:
        self.declare(
            "bin_width",
            0.0,
            "bin between its walls, world x, metres; what stands in them is withdrawn; 0: usual bin",
            minimum=0.0,
        )
        self.declare("bin_depth", 0.0, "bin between its walls, world y, metres; 0: as bin_width", minimum=0.0)
        self.declare(
            "wall_height",
            -1.0,
            "of the bin's walls above its floor at z = 0, metres; 0: an open table, -1: that of the usual bin",
            minimum=-1.0,
        )

    def _declare_workspace(self) -> None:
        self.declare(
            "workspace_width",
            [0.0, 0.0],
            "sides along world x and y, in metres, of the box in which unexplained surface is looked for; it is "
            "centred on the origin and walls should be outside; 0: the object's usual bin less a margin",
        )
        self.declare(
            "workspace_floor",
            0.0,
            "lower end of that box, world z in metres; the bin's floor should be below; 0: 5 % of the diameter",
        )
        self.declare(
            "workspace_height",
            0.0,
            "upper end of that box, world z in metres; 0: one and a half diameters",
            minimum=0.0,
        )

    def setup(self) -> None:
        """Load the object and precompute its views; nothing is known of any view."""
        self._latest: tuple[int, np.ndarray, PinholeCamera] | None = None
        self._inputs.reset()
        self._model = load_object(self.value("object"))
        parameters = FusionParameters(**{each.name: self.value(each.name) for each in fields(FusionParameters)})
        self._verifier = Verifier(self._model, self.value("epsilon"), self.value("samples"))
        self._settings, self._fusion = parameters, self._make_fusion(parameters)
        self._cameras = self._fusion.cameras if isinstance(self._fusion, AllViewsFusion) else CameraAlignment()
        self._surface = ObservedSurface(self._model, self._make_grid(), parameters.explained_within)
        self._mesh_uri = ""
        try:
            self._mesh_uri = export_mesh(self._model)
        except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
            self.get_logger().warning(f"objects/markers stays empty, the mesh cannot be written for viewers: {error}")

    def _make_fusion(self, parameters: FusionParameters) -> BestViewFusion | AllViewsFusion:
        if self.value("method") == "best-view":
            return BestViewFusion(self._model, parameters)
        usual, height = Tray.for_model(self._model), self.value("wall_height")
        width = self.value("bin_width") or usual.width
        tray = Tray(width, self.value("bin_depth") or width, usual.wall_height if height < 0 else height)
        walled = self.value("bin_width") > 0
        return AllViewsFusion(self._model, parameters, tray=tray, walled=walled, align=self.value("align_views"))

    def _make_grid(self) -> WorkspaceGrid:
        usual = WorkspaceGrid.for_model(self._model)
        sides, floor, height = (self.value(f"workspace_{name}") for name in ("width", "floor", "height"))
        width: Any = tuple(side or own for side, own in zip(sides, usual.width, strict=False))  # the grid checks it
        try:
            return replace(usual, width=width, floor=floor or usual.floor, height=height or usual.height)
        except ValueError as error:
            raise ValueError(f"{self.get_name()}: parameters 'workspace_*': {error}") from error

    def awaited(self) -> Awaited:
        """The estimator's and the camera's topics."""
        return self._inputs.awaited()

    def _on_hypotheses(self, message: PointCloud2) -> None:
        stamp = stamp_to_ns(message.header.stamp)
        if self._latest is not None and stamp == self._latest[0]:
            self._publish(*self._latest)  # a restarted estimator repeats its last view: repeat the result
        else:
            self._inputs.add("hypotheses", stamp, message)

    def _on_segmentation(self, message: Image) -> None:
        require_frame(message.header, self.camera_frame)
        stamp = stamp_to_ns(message.header.stamp)
        if self._latest is None or stamp != self._latest[0]:
            self._inputs.add("segmentation", stamp, image_to_segmentation(message))

    def _on_start(self, start: EpisodeStart, new: bool) -> None:
        if new:
            self._fusion.reset()
            self._surface.reset()
            self._latest = None
            return
        self._fusion.forget_before(start.stamp)
        self._surface.forget_before(start.stamp)
        if self._latest is not None:
            self._publish(*self._latest)  # the first view overtook the announcement of its episode

    def _on_view(self, stamp: int, values: dict[str, Any]) -> None:
        hypotheses = hypotheses_from_cloud(values["hypotheses"], values["segmentation"], self.camera_frame)
        with refusing("hypotheses: "):
            check_in_front(hypotheses.T_camera_object)
        with self.measure(stamp) as summary:
            verification = self._verifier.score(values["depth"], values["camera"], hypotheses)
            measured = values["depth"], values["camera"]
            self._fusion.add_view(stamp, values["pose"], hypotheses, verification, *measured)
            aligned = self._cameras.alignment(stamp)
            self._surface.add_view(stamp, *measured, aligned.correction @ values["pose"])
            self._latest = stamp, values["pose"], values["camera"]
            objects = self._publish(*self._latest)
            confirmed = np.count_nonzero(objects.probability >= self._settings.confirmed)
            summary.append(f"{len(hypotheses)} hypotheses, {len(objects)} objects, {confirmed} of them confirmed")
            if aligned.shift:
                summary.append(f"the camera's pose was corrected by {1e3 * aligned.shift:.1f} mm at the scene")
            if isinstance(self._fusion, AllViewsFusion):
                self._report_container(self._fusion)
            if not aligned.aligned:
                summary.append("the depth image could not be aligned with the others, the camera's pose is as given")

    def _report_container(self, fusion: AllViewsFusion) -> None:
        """Say what is probably wrong where many objects are outside of the container."""
        if fusion.in_walls:
            self.say_once(
                f"{fusion.in_walls} objects stand in the bin's walls and are withdrawn; if they are right, "
                "correct bin_width, bin_depth, wall_height or the world's origin"
            )
        if fusion.below_floor:
            self.say_once(
                f"{fusion.below_floor} objects reach below the bin's floor and so are improbable; "
                "is the floor at z = 0 of the world?"
            )

    def _publish(self, stamp: int, T_world_camera: np.ndarray, camera: PinholeCamera) -> SceneObjects:
        """Publish the objects after the latest view, and return them."""
        objects = self._fusion.objects(stamp, T_world_camera, camera)
        self._objects.publish(objects_to_cloud(objects, stamp, self.world_frame))
        self._poses.publish(poses_to_array(objects.T_world_object, stamp, self.world_frame))
        confirmed = self._settings.confirmed
        shown = objects if self._mesh_uri else SceneObjects.empty()
        self._markers.publish(objects_to_markers(shown, self._mesh_uri, stamp, self.world_frame, confirmed))
        unexplained = self._surface.unexplained(objects.T_world_object, self._cameras.T_world_anchor)
        self._unexplained.publish(points_to_cloud(unexplained, stamp, self.world_frame))
        self._camera_poses.publish(poses_to_array(self._cameras.T_world_cameras(), stamp, self.world_frame))
        self._detections.publish(objects, self._model, stamp, self.world_frame)
        return objects


def export_mesh(model: ObjectModel) -> str:
    """Write the model's mesh, in its own frame and metres, where viewers can read it; the file's URI.

    The path depends on the object only, so that recorded markers are the same every time.
    """
    path = cache_folder("meshes") / f"{model.name}.stl"
    with atomic_file(path) as unfinished:
        model.mesh.export(unfinished)
    return path.as_uri()


def main() -> None:
    """Entry point of ``ros2 run active6d_perception hypothesis_fusion``."""
    run_node(HypothesisFusionNode)


if __name__ == "__main__":
    main()
