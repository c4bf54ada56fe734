"""Node ``camera_simulator``: an RGB-D camera above a simulated pile of objects."""

from dataclasses import replace
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from active6d_core.camera import PinholeCamera, View
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.ros.conversions import joints_to_state
from active6d_core.ros.runner import run_node
from active6d_core.ros.topics import JOINT_STATES
from active6d_core.se3 import quaternion_from_transform
from active6d_sim.nodes.moving_camera import MovingCameraNode
from active6d_sim.rendering.pose_error import PoseError
from active6d_sim.rendering.random_sensor import sensor_of
from active6d_sim.rendering.sensor_registry import list_sensors
from active6d_sim.rendering.simulator import GoalError, Simulator, admit_goal
from active6d_sim.robot.arm import CARRIERS, ArmSettings, CameraArm, Motion, hand_eye_error
from active6d_sim.scenes.scene_store import SPLITS, find_scene


class CameraSimulatorNode(MovingCameraNode):
    """A moving camera in a stored scene or in a simulated pile; ``~/next_scene`` goes on to the next one."""

    def __init__(self, **options: Any) -> None:
        super().__init__("camera_simulator", **options)
        self.declare("scene", "", "name of a stored scene such as mug/test/3; empty: a new pile simulated by the seed")
        self.declare("snap_to_grid", True, "go to the grid's view nearest to a goal instead of exactly to the goal")
        sensors = [AUTOMATIC, *list_sensors()]
        self.declare("sensor", AUTOMATIC, "sensor model; auto: active_stereo, in wild scenes random", choices=sensors)
        self.declare("noise_scale", 1.0, "factor on the sensor noise; 0: no noise", minimum=0.0)
        self.declare("pose_error_mm", 0.0, "error of each view's pose, root mean square in millimetres", minimum=0.0)
        self.declare("pose_error_degrees", 0.0, "error of each view's pose, root mean square in degrees", minimum=0.0)
        self.declare("width", 640, "image width in pixels", minimum=16, maximum=4096)
        self.declare("height", 480, "image height in pixels", minimum=16, maximum=4096)
        self.declare("field_of_view", 60.0, "horizontal field of view in degrees", minimum=5.0, maximum=150.0)
        self._declare_arm()
        self._joint_states = self.output(JOINT_STATES)
        self.create_service(Trigger, "~/next_scene", self._on_next_scene)

    def _declare_arm(self) -> None:
        usual = ArmSettings()
        base = [*usual.T_world_base[:3, 3].tolist(), *quaternion_from_transform(usual.T_world_base).tolist()]
        self.declare(
            "carrier", CARRIERS[0], "what carries the camera: flying for nothing, or a simulated arm", choices=CARRIERS
        )
        self.declare("arm_base", base, "x y z qx qy qz qw of the arm's base in the world, metres")
        self.declare("arm_speed", usual.speed, "fraction of the arm's largest joint speeds", minimum=0.01, maximum=1.0)
        self.declare("hand_eye_mm", 1.0, "error of the arm's hand-eye calibration in millimetres", minimum=0.0)
        self.declare("hand_eye_degrees", 0.2, "error of the arm's hand-eye calibration in degrees", minimum=0.0)

    def setup(self) -> None:
        """Simulate or load the scene."""
        super().setup()
        self.check_start_view(len(self.sphere))
        self._T_calibrated_true = np.eye(4)
        self._pose_error = PoseError(self.value("pose_error_mm"), self.value("pose_error_degrees"))
        self._arm: CameraArm | None = None
        self._motion: Motion | None = None
        if self.value("carrier") == "arm":
            self._T_calibrated_true = hand_eye_error(
                self.value("hand_eye_mm"), self.value("hand_eye_degrees"), self.seed
            )
        self._camera = PinholeCamera.from_field_of_view(
            self.value("width"), self.value("height"), self.value("field_of_view")
        )
        self._load(self.value("scene"), self.seed)

    def _load(self, scene_name: str, seed: int) -> None:
        scene = find_scene(self.object_name, scene_name, seed)
        sensor = sensor_of(self.value("sensor"), load_object(self.object_name), scene)
        self._simulator = Simulator(scene, self._camera, sensor.scaled(self.value("noise_scale")), self.seed)
        if self.value("carrier") == "arm":
            self._arm = CameraArm(scene, ArmSettings(self.rigid_transform("arm_base"), speed=self.value("arm_speed")))
            if self.value("start_view") >= 0:
                self._arm.place(self._grid_pose(self.value("start_view")))

    @property
    def scene_name(self) -> str:
        """``mug/test/3`` or ``mug/seed/7``."""
        return self._simulator.scene.name

    def draw_start(self) -> int:
        """Any view of the grid; with an arm, any that it reaches."""
        rng = np.random.default_rng([self.seed, self._simulator.scene.seed])
        if self._arm is None:
            return int(rng.integers(len(self.sphere)))
        for view in rng.permutation(len(self.sphere)):
            if self._arm.reaches(self._grid_pose(view)):
                return int(view)
        raise GoalError("the arm reaches no view of the grid; check arm_base and radius")

    def start_pose(self, view: int) -> np.ndarray:
        """At the grid's view, facing the bin's centre."""
        return self._grid_pose(view) if self._arm is None else self._arm.place(self._grid_pose(view))

    def _grid_pose(self, view: int) -> np.ndarray:
        return self.sphere.pose(self.sphere.positions[view])

    def truth(self, view: int) -> np.ndarray:
        """The scene's objects that are visible in some view."""
        return self._simulator.scene.T_world_object

    def destination(self, T_world_goal: np.ndarray) -> np.ndarray:
        """The goal, or the grid's view nearest to it."""
        admitted = admit_goal(T_world_goal, self.sphere, snap=self.value("snap_to_grid"), tolerance=self.tolerance)
        if self._arm is None:
            return admitted
        self._motion = self._arm.plan(admitted)
        return self._motion.T_world_camera

    def travel(self, T_world_camera: np.ndarray) -> float:
        """A camera without an arm moves along the hemisphere."""
        if self._arm is None or self._motion is None:
            return super().travel(T_world_camera)
        self._arm.follow(self._motion)
        return self._motion.seconds

    def capture(self, T_world_camera: np.ndarray, stamp: int) -> View:
        """What the sensor sees from there, or from beside it by the errors of the pose and of an arm's calibration."""
        rng = np.random.default_rng([self.seed, self._simulator.scene.seed, stamp])
        T_said_true = self._T_calibrated_true @ self._pose_error.draw(rng)
        view = self._simulator.capture(T_world_camera @ T_said_true, stamp)
        if self._arm is not None:
            self._joint_states.publish(joints_to_state(self._arm.arm.names, self._arm.joints, stamp))
        return replace(view, T_world_camera=T_world_camera)

    def _on_next_scene(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """A new episode in the next stored scene of the split, or in a pile simulated by the next seed."""
        return self.restart(response, self._load_next)

    def _load_next(self) -> None:
        scene = self._simulator.scene
        if not self.value("scene"):
            self.seed = scene.seed + 1  # all is as in an episode of that seed
            self._load("", self.seed)
            return
        split, index = scene.name.split("/")[-2:]
        self._load(f"{split}/{(int(index) + 1) % SPLITS[split]}", self.seed)


def main() -> None:
    """Entry point of ``ros2 run active6d_sim camera_simulator``."""
    run_node(CameraSimulatorNode)


if __name__ == "__main__":
    main()
