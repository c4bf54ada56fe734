"""What a bank says is unexplained is what the fusion node publishes for the same views of the same scene."""

import numpy as np
import pytest
from hand_made_scenes import three_mugs
from sensor_msgs.msg import PointCloud2
from synthetic_bank import synthetic_bank

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.bank.observation import observe_scene
from active6d_agent.bank.scene_bank import SceneBank, load_bank
from active6d_agent.environment.rollout import observe
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import load_object
from active6d_core.ros.conversions import (
    camera_to_info,
    depth_to_image,
    hypotheses_to_cloud,
    points_from_cloud,
    segmentation_to_image,
    transform_to_pose_stamped,
)
from active6d_core.se3 import invert
from active6d_core.view_sphere import ViewSphere
from active6d_perception.nodes.hypothesis_fusion import HypothesisFusionNode
from active6d_perception.scene.observed_surface import Explainer, WorkspaceGrid
from active6d_perception.scene.verification import Verifier
from active6d_sim.rendering.simulator import Simulator

SPHERE = ViewSphere(0.8, (20.0, 60.0), 3)
FRAME = "camera_optical_frame"


class TwoOfThree:
    """Finds the first object in every view and the second in the lower ones, exactly; never the third."""

    def __init__(self, simulator):
        self.simulator = simulator

    def estimate(self, view):
        found = [0, 1] if view.T_world_camera[2, 3] < 0.4 else [0]
        instance = self.simulator.renderer.render(view.T_world_camera, view.camera).instance
        found = [index for index in found if (instance == index).any()]
        masks = np.where(np.isin(instance, found), instance + 1, 0).astype(np.uint16)
        T = invert(view.T_world_camera) @ self.simulator.scene.T_world_object[found]
        return Hypotheses.from_masks(T, np.full(len(T), 0.9), np.array(found) + 1, masks, view.depth)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(three_mugs())


@pytest.fixture(scope="module")
def lookup(simulator, tmp_path_factory):
    """Of a bank that was written and read."""
    model, scene = load_object("mug"), simulator.scene
    grid = WorkspaceGrid.for_model(model)
    estimator, verifier = TwoOfThree(simulator), Verifier(model)
    seen = observe_scene(scene.name, scene.T_world_object, simulator.capture, estimator, verifier, model, SPHERE, grid)
    path = tmp_path_factory.mktemp("bank") / "bank.npz"
    SceneBank("mug", SPHERE, grid, [seen], {}).save(path)
    return BestViewLookup(load_bank(path))


def unexplained(lookup, views):
    scene, taken = np.zeros(1, int), np.array([views])
    return lookup.unexplained(lookup.fuse(scene, taken, taken[:, -1]), scene, taken)[0]


def test_the_missed_object_is_what_is_unexplained(lookup, simulator):
    explainer, T = Explainer(lookup.model, 0.1), simulator.scene.T_world_object
    all_views = unexplained(lookup, [*range(6)])
    assert len(all_views) > 50
    assert explainer.explains(all_views, T[2:]).all()
    from_above = unexplained(lookup, [3, 4])
    assert explainer.explains(from_above, T[1:]).any(axis=1).all(), "the second mug is not found from there"


def test_the_node_publishes_what_the_bank_says(graph, tmp_path, monkeypatch, lookup, simulator):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    clouds = graph.mailbox(PointCloud2, "objects/unexplained", latched=True)
    graph.add(HypothesisFusionNode(context=graph.context))
    estimator, taken = TwoOfThree(simulator), []
    for view in (4, 2, 0, 5):
        stamp, T_world_camera = (view + 1) * 1_000_000_000, SPHERE.pose(SPHERE.positions[view])
        taken.append(view)
        captured = simulator.capture(T_world_camera, stamp)
        found = estimator.estimate(captured)
        stamp = len(taken) * 10_000_000_000  # stamps rise along the episode; the noise was drawn by the bank's
        messages = {
            "camera/depth/image_raw": depth_to_image(captured.depth, stamp, FRAME),
            "camera/color/camera_info": camera_to_info(captured.camera, stamp, FRAME),
            "camera/pose": transform_to_pose_stamped(T_world_camera, stamp, "world"),
            "hypotheses/segmentation": segmentation_to_image(found.segmentation, stamp, FRAME),
            "hypotheses": hypotheses_to_cloud(found, stamp, FRAME),
        }
        for topic, message in messages.items():
            graph.publish(topic, message, latched=True)
        graph.spin_until_filled([clouds], len(taken))
        published = points_from_cloud(clouds[-1], "world")
        np.testing.assert_array_equal(published, unexplained(lookup, taken))
        assert len(published) > 0


def test_observations_hold_what_each_episode_has_seen():
    """Side by side, with episodes of different lengths, as cell by cell."""
    lookup = BestViewLookup(synthetic_bank("coffee_cup", scenes=2, objects=6))
    rng = np.random.default_rng(0)
    scene = np.array([0, 1, 1, 0, 1])
    views = np.stack([rng.choice(100, 4, replace=False) for _ in scene])
    views[1, 2:] = views[3, 1:] = -1
    explainer, grid = Explainer(lookup.model, lookup.parameters.explained_within), lookup.bank.grid
    for _ in range(2):  # what was worked out once is looked up then
        observations = observe(lookup, scene, views, np.full(5, 2))
        for index, taken, observation in zip(scene, views, observations, strict=True):
            bits = [np.unpackbits(lookup.bank.scenes[index].surface[view]) for view in taken[taken >= 0]]
            shown = grid.centres[np.any(bits, axis=0)[: len(grid)]]
            near = explainer.explains(shown, observation.objects.T_world_object).any(axis=0)
            np.testing.assert_array_equal(observation.unexplained, shown[~near])
    assert any(len(observation.unexplained) for observation in observations)
