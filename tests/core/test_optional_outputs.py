"""Detection3DArray and /tf, tried on message classes made from the definitions, since neither package is on PyPI."""

from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from active6d_core.hypotheses import SceneObjects
from active6d_core.ros.node import GraphNode
from active6d_core.ros.optional_outputs import DetectionOutput, TransformOutput, detections_message, transforms_message
from active6d_core.se3 import make_transform, transform_from_quaternion, transform_points

# The fields of vision_msgs 4, the version of ROS 2 Jazzy.
VISION_MSGS = {
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}


@pytest.fixture(scope="module")
def typestore():
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in VISION_MSGS.items():
        store.register(get_types_from_msg(definition, f"vision_msgs/msg/{name}"))
    return store


def through_the_wire(typestore, message, name):
    return typestore.deserialize_cdr(bytes(typestore.serialize_cdr(message, name)), name)


def test_detections_carry_pose_score_and_the_box_of_the_mesh(typestore, models):
    messages = SimpleNamespace(**{name: typestore.types[f"vision_msgs/msg/{name}"] for name in VISION_MSGS})
    model = models["wedge"]
    T = make_transform(Rotation.random(2, rng=np.random.default_rng(0)).as_matrix(), np.eye(3)[:2])
    ones = np.ones(2)
    probability = np.array([0.25, 0.75])
    objects = SceneObjects(T, ones, ones, np.zeros((2, 4)), ones, np.ones(2, int), ones, probability, ones)
    sent = detections_message(messages, objects, model, 3_000_000_001, "world")
    got = through_the_wire(typestore, sent, "vision_msgs/msg/Detection3DArray")
    assert (got.header.frame_id, got.header.stamp.sec, got.header.stamp.nanosec) == ("world", 3, 1)
    assert [detection.results[0].hypothesis.score for detection in got.detections] == [0.25, 0.75]
    assert {detection.results[0].hypothesis.class_id for detection in got.detections} == {"wedge"}
    for detection, T_world_object in zip(got.detections, T, strict=True):
        box, size = detection.bbox, np.array([detection.bbox.size.x, detection.bbox.size.y, detection.bbox.size.z])
        q, p = box.center.orientation, box.center.position
        T_world_box = transform_from_quaternion(np.array([q.x, q.y, q.z, q.w]), np.array([p.x, p.y, p.z]))
        corners = transform_points(np.linalg.inv(T_world_box) @ T_world_object, np.asarray(model.mesh.vertices))
        np.testing.assert_allclose(corners.max(0), size / 2, atol=1e-9)
        np.testing.assert_allclose(corners.min(0), -size / 2, atol=1e-9)


def test_transforms_name_parent_and_children(typestore):
    messages = SimpleNamespace(TFMessage=typestore.types["tf2_msgs/msg/TFMessage"])
    T = make_transform(Rotation.from_euler("z", 90, degrees=True).as_matrix(), (1, 2, 3))
    sent = transforms_message(messages, {"camera": T, "mug_0": np.eye(4)}, 5, "world")
    first, second = through_the_wire(typestore, sent, "tf2_msgs/msg/TFMessage").transforms
    assert (first.header.frame_id, first.child_frame_id, second.child_frame_id) == ("world", "camera", "mug_0")
    assert (first.transform.translation.x, first.transform.translation.y, first.transform.translation.z) == (1, 2, 3)
    assert (first.transform.rotation.z, first.transform.rotation.w) == pytest.approx((0.5**0.5, 0.5**0.5))


def test_without_the_packages_nothing_is_published(graph, models):
    node = graph.add(GraphNode("plain", context=graph.context))
    before = {name for name, _ in node.get_topic_names_and_types()}
    TransformOutput(node).publish({"camera": np.eye(4)}, 1, "world")
    DetectionOutput(node).publish(SceneObjects.empty(), models["wedge"], 1, "world")
    installed = {name for name, _ in node.get_topic_names_and_types()} - before
    assert installed <= {"/tf", "/objects/detections"}
