"""Node ``dataset_camera``: a goal selects the nearest view of a scene recorded in BOP's format."""

from typing import Any

import numpy as np

from active6d_core.camera import View
from active6d_core.object_model import load_object
from active6d_core.ros.conversions import MessageError
from active6d_core.ros.runner import run_node
from active6d_sim.datasets.bop import BopScene
from active6d_sim.nodes.moving_camera import MovingCameraNode
from active6d_sim.rendering.simulator import admit_goal


class DatasetCameraNode(MovingCameraNode):
    """A moving camera restricted to the recorded views; it publishes images and poses as they were recorded.

    The recording's world origin should be the bin's centre with z up.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("dataset_camera", **options)
        self.declare("scene", "", "folder of the recorded scene: scene_camera.json, rgb/ and depth/")
        self.declare("object_id", 0, "number of the object in the recorded ground truth, 0: all objects", minimum=0)

    def setup(self) -> None:
        """Read the recording's files, without its images."""
        super().setup()
        self._folder = self.value("scene")
        if not self._folder:
            raise ValueError(f"{self.get_name()}: parameter 'scene' must name the folder of a recorded scene")
        self._scene = BopScene.load(self._folder)
        self.check_start_view(len(self._scene))

    @property
    def scene_name(self) -> str:
        """The folder, as it was given."""
        return self._folder

    def draw_start(self) -> int:
        """Any recorded view."""
        return int(np.random.default_rng(self.seed).integers(len(self._scene)))

    def start_pose(self, view: int) -> np.ndarray:
        """Where the numbered image was taken, counting from 0."""
        return self._scene.T_world_camera[view]

    def truth(self, view: int) -> np.ndarray | None:
        """The objects' poses in that image's ground truth, if the recording has any, in the frame of the object."""
        if self._scene.truth is None:
            return None
        T_world_mesh = self._scene.T_world_object(view, self.value("object_id") or None)
        return load_object(self.object_name).T_camera_object(T_world_mesh)

    def destination(self, T_world_goal: np.ndarray) -> np.ndarray:
        """The recorded view nearest in direction to the goal."""
        admitted = admit_goal(T_world_goal, self.sphere, snap=False, tolerance=self.tolerance)
        return self._scene.T_world_camera[self._scene.nearest(admitted[:3, 3])]

    def capture(self, T_world_camera: np.ndarray, stamp: int) -> View:
        """The images that were recorded there."""
        index = np.abs(self._scene.T_world_camera - T_world_camera).max(axis=(1, 2)).argmin()
        try:
            return self._scene.view(int(index), stamp)
        except ValueError as error:
            raise MessageError(str(error)) from error


def main() -> None:
    """Entry point of ``ros2 run active6d_sim dataset_camera``."""
    run_node(DatasetCameraNode)


if __name__ == "__main__":
    main()
