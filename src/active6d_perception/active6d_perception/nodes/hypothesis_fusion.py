"""Verifies every view's hypotheses against its depth image and fuses them with those of earlier views.

Also tells what of the surface in the depth images the fused objects do not explain.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from active6d_core.camera import PinholeCamera
from active6d_core.files import atomic_file, cache_folder
from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.ros.conversions import (
    MessageError,
    hypotheses_from_cloud,
    image_to_segmentation,
    objects_to_cloud,
    objects_to_markers,
    points_to_cloud,
    poses_to_array,
    require_frame,
    stamp_to_ns,
)
from active6d_core.ros.node import GraphNode, run_node
from active6d_core.ros.optional_outputs import DetectionOutput
from active6d_core.ros.view_inputs import ViewInputs
from active6d_perception.scene.fusion import RANKINGS, FusionParameters, SceneFusion
from active6d_perception.scene.observed_surface import ObservedSurface, SurfaceGrid
from active6d_perception.scene.verification import Verifier


class HypothesisFusionNode(GraphNode):
    """Hypotheses with masks, depth and camera pose in; ``objects``, ``objects/poses``, ``objects/markers`` and
    ``objects/unexplained`` out.

    Where vision_msgs is installed, the objects also go out as ``objects/detections``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("hypothesis_fusion", **options)
        self._object = self.declare("object", "mug", "name of the object that the hypotheses are of")
        self._epsilon = self.declare("epsilon", 0.010, "threshold of the verification score, metres", minimum=1e-4)
        self._samples = self.declare("samples", 128, "most scene points verified per hypothesis", minimum=1)
        self._fusion_parameters = FusionParameters(
            cut=self.declare(
                "cut", FusionParameters.cut, "clusters are cut at this fraction of the diameter", minimum=1e-3
            ),
            exclusion=self.declare(
                "exclusion",
                FusionParameters.exclusion,
                "two objects are at least this fraction of the diameter apart",
                minimum=0.0,
            ),
            min_verification=self.declare(
                "min_verification",
                FusionParameters.min_verification,
                "hypotheses verified worse are ignored",
                minimum=-1.0,
                maximum=1.0,
            ),
            rank_by=self.declare(
                "rank_by",
                FusionParameters.rank_by,
                "what makes hypotheses and clusters the best: equation 1, the estimator's score, both, or their sum",
                choices=RANKINGS,
            ),
            explained_within=self.declare(
                "explained_within",
                FusionParameters.explained_within,
                "surface this near to an object is that object's, as a fraction of the diameter; with less, poses that "
                "are a little off leave surface of found objects unexplained",
                minimum=1e-3,
                maximum=1.0,
            ),
        )
        self._workspace = {
            "width": self.declare(
                "workspace_width",
                [0.0, 0.0],
                "sides, along world x and y about the origin, of the box in which unexplained surface is looked for, "
                "metres; walls should be outside; 0 for those of the object's usual bin less a margin",
            ),
            "floor": self.declare(
                "workspace_floor",
                0.0,
                "lower end of the box in which unexplained surface is looked for, world z in metres; the bin's floor "
                "should be below; 0 for 5 % of the diameter",
            ),
            "height": self.declare(
                "workspace_height",
                0.0,
                "upper end of that box, world z in metres; 0 for one and a half diameters",
                minimum=0.0,
            ),
        }
        self._objects = self.output(PointCloud2, "objects", latched=True)
        self._poses = self.output(PoseArray, "objects/poses", latched=True)
        self._markers = self.output(MarkerArray, "objects/markers", latched=True)
        self._unexplained = self.output(PointCloud2, "objects/unexplained", latched=True)
        self._detections = DetectionOutput(self, "objects/detections")
        # First, for the executor calls back in this order: a new episode is known before its first view.
        self.input(DiagnosticArray, "episode/start", self._on_episode_start, latched=True)
        self.input(PointCloud2, "hypotheses", self._on_hypotheses, latched=True)
        self.input(Image, "hypotheses/segmentation", self._on_segmentation, latched=True)
        self._inputs = ViewInputs(self, ("depth", "camera", "pose"), self._on_view, ("hypotheses", "segmentation"))

    def setup(self) -> None:
        """Load the object and precompute its views; nothing is known of any view."""
        self._latest: tuple[int, np.ndarray, PinholeCamera] | None = None
        self._episode_start = 0
        self._inputs.reset()
        self._model = load_object(self._object)
        self._verifier = Verifier(self._model, self._epsilon, self._samples)
        self._fusion = SceneFusion(self._model, self._fusion_parameters)
        self._surface = ObservedSurface(self._model, self._make_grid(), self._fusion_parameters.explained_within)
        try:
            self._mesh_uri = export_mesh(self._model)
        except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
            self._mesh_uri = None
            self.get_logger().warning(f"objects/markers stays empty, the mesh cannot be written for viewers: {error}")

    def _make_grid(self) -> SurfaceGrid:
        usual = SurfaceGrid.for_model(self._model)
        sides = zip(self._workspace["width"], usual.width, strict=False)
        given = {name: value for name, value in self._workspace.items() if name != "width" and value != 0}
        try:
            return replace(usual, width=tuple(side or own for side, own in sides), **given)
        except ValueError as error:
            raise ValueError(f"{self.get_name()}: parameters 'workspace_*': {error}") from error

    def _on_hypotheses(self, message: PointCloud2) -> None:
        stamp = stamp_to_ns(message.header.stamp)
        if self._is_latest(stamp):
            self._publish()  # a restarted estimator repeats its last view; whoever awaits the result gets it again
        else:
            self._inputs.add("hypotheses", stamp, message)

    def _on_segmentation(self, message: Image) -> None:
        require_frame(message.header, self.camera_frame)
        stamp = stamp_to_ns(message.header.stamp)
        if not self._is_latest(stamp):
            self._inputs.add("segmentation", stamp, image_to_segmentation(message))

    def _on_episode_start(self, message: DiagnosticArray) -> None:
        start = self._episode_start = stamp_to_ns(message.header.stamp)
        self._fusion.forget_before(start)
        self._surface.forget_before(start)
        if self._latest is not None and self._latest[0] >= start:
            self._publish()  # the first view overtook the announcement of its episode

    def _on_view(self, stamp: int, values: dict[str, Any]) -> None:
        if stamp < self._episode_start:  # the estimator was still at it when the scene changed
            raise MessageError(f"view of {stamp * 1e-9:.3f} s is older than the episode")
        hypotheses = hypotheses_from_cloud(values["hypotheses"], values["segmentation"], self.camera_frame)
        with self.measure(stamp):
            verification = self._verifier.score(values["depth"], values["camera"], hypotheses)
            self._fusion.add_view(stamp, values["pose"], hypotheses, verification)
            self._surface.add_view(stamp, values["depth"], values["camera"], values["pose"])
            self._latest = stamp, values["pose"], values["camera"]
            self._publish()

    def _is_latest(self, stamp: int) -> bool:
        return self._latest is not None and stamp == self._latest[0]

    def _publish(self) -> None:
        stamp = self._latest[0]
        objects = self._fusion.objects(*self._latest)
        self._objects.publish(objects_to_cloud(objects, stamp, self.world_frame))
        self._poses.publish(poses_to_array(objects.T_world_object, stamp, self.world_frame))
        shown = objects if self._mesh_uri else SceneObjects.empty()
        self._markers.publish(objects_to_markers(shown, self._mesh_uri or "", stamp, self.world_frame))
        unexplained = self._surface.unexplained(objects.T_world_object)
        self._unexplained.publish(points_to_cloud(unexplained, stamp, self.world_frame))
        self._detections.publish(objects, self._model, stamp, self.world_frame)


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
