#!/usr/bin/env python3
"""Draw the simulated arm at a view, on the way to the next one, and there, above a stored test scene.

Example: python -m active6d_tools.studies.draw_arm mug --png docs/img/arm.png
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from active6d_core.object_model import load_object
from active6d_core.se3 import invert, make_transform, quaternion_from_transform
from active6d_core.view_sphere import ViewSphere
from active6d_sim.physics.bullet import BulletClient, connect, pybullet
from active6d_sim.robot.arm import ARM_MODEL, CameraArm
from active6d_sim.robot.motion import sample_way
from active6d_sim.scenes.scene import Scene
from active6d_sim.scenes.scene_store import load_scene
from active6d_tools.studies.arguments import study_parser

#: Numbers of two views that the arm reaches.
VIEWS = (55, 41)
WIDTH, HEIGHT = 480, 420
WOOD, GREY = (0.76, 0.66, 0.53, 1.0), (0.35, 0.4, 0.47, 1.0)
DARK, RED = (0.1, 0.1, 0.12, 1.0), (0.9, 0.1, 0.1, 1.0)
#: Length of the optical axis that is drawn, metres.
SIGHT = 0.6


class Stage:
    """Table, bin, objects, arm and camera with visual shapes.

    Args:
        scene: to draw.
        arm: its settings and joint angles are drawn.
    """

    def __init__(self, scene: Scene, arm: CameraArm) -> None:
        self._client: BulletClient = connect()
        self._arm, bin = arm, scene.bin
        base = arm.settings.T_world_base
        self._robot = self._client.loadURDF(
            str(ARM_MODEL),
            base[:3, 3].tolist(),
            quaternion_from_transform(base).tolist(),
            useFixedBase=True,
        )
        self._box((0, 0, -bin.wall_thickness - 0.02), (0.6, 0.5, 0.02), WOOD)
        x, y, thick = bin.inner_width / 2, bin.inner_depth / 2, bin.wall_thickness / 2
        self._box((0, 0, -thick), (x, y, thick), GREY)
        for sign in (-1, 1):
            middle, height = bin.wall_height / 2, bin.wall_height / 2
            self._box((sign * (x + thick), 0, middle), (thick, y + 2 * thick, height), GREY)
            self._box((0, sign * (y + thick), middle), (x + 2 * thick, thick, height), GREY)
        model = load_object(scene.object_name)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "object.obj"
            model.mesh.export(path)
            shape = self._client.createVisualShape(
                pybullet.GEOM_MESH, fileName=str(path), rgbaColor=[*model.color.tolist(), 1.0]
            )
            for T in scene.T_world_all:
                self._place(self._client.createMultiBody(0, -1, shape), T)
        self._camera = self._box((0, 0, 0), (0.045, 0.0125, 0.0125), DARK)
        reach = float(np.linalg.norm(arm.settings.T_flange_camera[:3, 3])) / 2
        self._bracket = self._box((0, 0, 0), (0.012, 0.012, reach), DARK)
        self._sight = self._box((0, 0, 0), (0.003, 0.003, SIGHT / 2), RED)

    def _box(self, centre: Sequence[float], half: Sequence[float], color: Sequence[float]) -> int:
        shape = self._client.createVisualShape(pybullet.GEOM_BOX, halfExtents=half, rgbaColor=color)
        return int(self._client.createMultiBody(0, -1, shape, basePosition=centre))

    def _place(self, body: int, T: np.ndarray) -> None:
        self._client.resetBasePositionAndOrientation(body, T[:3, 3].tolist(), quaternion_from_transform(T).tolist())

    def draw(self, joints: np.ndarray) -> np.ndarray:
        """(HEIGHT, WIDTH, 3) uint8 picture of the arm at (n,) joint angles in radians."""
        for link, angle in enumerate(joints):
            self._client.resetJointState(self._robot, link, angle)
        T_camera = self._arm.pose(joints)
        self._place(self._camera, T_camera)
        self._place(self._sight, T_camera @ make_transform(np.eye(3), np.array([0.0, 0.0, SIGHT / 2])))
        T_flange = T_camera @ invert(self._arm.settings.T_flange_camera)
        middle, along = (T_camera[:3, 3] + T_flange[:3, 3]) / 2, T_camera[:3, 3] - T_flange[:3, 3]
        turn = Rotation.align_vectors([along], [[0.0, 0.0, 1.0]])[0].as_matrix()
        self._place(self._bracket, make_transform(turn, middle))
        view = self._client.computeViewMatrix((1.35, -1.35, 0.95), (0.0, 0.0, 0.52), (0, 0, 1))
        projection = self._client.computeProjectionMatrixFOV(42.0, WIDTH / HEIGHT, 0.1, 5.0)
        light = {"lightDirection": (0.6, -1.0, 2.0), "shadow": 1, "renderer": pybullet.ER_TINY_RENDERER}
        image = self._client.getCameraImage(WIDTH, HEIGHT, view, projection, **light)
        return np.reshape(np.array(image[2], np.uint8), (HEIGHT, WIDTH, 4))[..., :3]


def main() -> None:
    """Draw three pictures side by side."""
    parser = study_parser(__doc__)
    parser.add_argument("--png", type=Path, required=True, help="file to write")
    arguments = parser.parse_args()
    scene, sphere = load_scene(load_object(arguments.object).name, "test", 0), ViewSphere()
    arm = CameraArm(scene)
    arm.place(sphere.pose(sphere.positions[VIEWS[0]]))
    motion = arm.plan(sphere.pose(sphere.positions[VIEWS[1]]))
    way, stage = sample_way(motion.way), Stage(scene, arm)
    pictures = [stage.draw(way[index]) for index in (0, len(way) // 2, -1)]
    picture = Image.fromarray(np.hstack(pictures)).quantize(128)
    picture.save(arguments.png, optimize=True)
    print(f"wrote {arguments.png}: {motion.seconds:.1f} s from the first to the last")


if __name__ == "__main__":
    main()
