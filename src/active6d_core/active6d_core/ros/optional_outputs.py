"""Results as ``Detection3DArray`` and ``/tf``, where vision_msgs and tf2_msgs are installed (as with apt's ROS 2).

Without them nothing else is missing: the graph itself needs neither.
"""

from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovariance, Quaternion, Transform, TransformStamped, Vector3

from active6d_core.hypotheses import SceneObjects
from active6d_core.object_model import ObjectModel
from active6d_core.ros.conversions import make_header, transform_to_pose
from active6d_core.ros.node import GraphNode
from active6d_core.ros.topics import DETECTIONS, TRANSFORMS


def import_optional(package: str) -> Any:
    """The ``msg`` module of a message package, None where it is not installed."""
    try:
        return import_module(f"{package}.msg")
    except ImportError:
        return None


class TransformOutput:
    """Publishes poses on ``/tf`` where tf2_msgs is installed, else does nothing."""

    def __init__(self, node: GraphNode) -> None:
        self._messages = import_optional("tf2_msgs")
        self._publisher = node.output(TRANSFORMS) if self._messages else None

    def publish(self, T_parent_children: dict[str, np.ndarray], stamp: int, parent: str) -> None:
        """Send (4, 4) poses of child frames, by name, in the frame ``parent``."""
        if self._publisher is not None:
            self._publisher.publish(transforms_message(self._messages, T_parent_children, stamp, parent))


class DetectionOutput:
    """Publishes accumulated objects as a Detection3DArray where vision_msgs is installed, else does nothing."""

    def __init__(self, node: GraphNode) -> None:
        self._messages = import_optional("vision_msgs")
        self._publisher = node.output(DETECTIONS) if self._messages else None

    def publish(self, objects: SceneObjects, model: ObjectModel, stamp: int, frame: str) -> None:
        """Send objects whose poses are in ``frame``; the score of a detection is its probability of being right."""
        if self._publisher is not None:
            self._publisher.publish(detections_message(self._messages, objects, model, stamp, frame))


def transforms_message(messages: Any, T_parent_children: dict[str, np.ndarray], stamp: int, parent: str) -> Any:
    """A ``messages.TFMessage`` with one transform per child frame."""
    transforms = []
    for child, T in T_parent_children.items():
        pose = transform_to_pose(T)
        p, q = pose.position, pose.orientation
        transform = Transform(translation=Vector3(x=p.x, y=p.y, z=p.z), rotation=Quaternion(x=q.x, y=q.y, z=q.z, w=q.w))
        transforms.append(
            TransformStamped(header=make_header(stamp, parent), child_frame_id=child, transform=transform)
        )
    return messages.TFMessage(transforms=transforms)


def detections_message(messages: Any, objects: SceneObjects, model: ObjectModel, stamp: int, frame: str) -> Any:
    """A ``messages.Detection3DArray`` of vision_msgs 4: one detection with one hypothesis and a box per object.

    The box is the mesh's, in the object's own axes; its centre is the box's, which need not be the object's origin.
    """
    low, high = np.asarray(model.mesh.bounds)
    size = Vector3(**dict(zip("xyz", map(float, high - low), strict=True)))
    T_object_box = np.eye(4)
    T_object_box[:3, 3] = (low + high) / 2
    detections = []
    for index, (T, probability) in enumerate(zip(objects.T_world_object, objects.probability, strict=True)):
        hypothesis = messages.ObjectHypothesis(class_id=model.name, score=float(probability))
        pose = PoseWithCovariance(pose=transform_to_pose(T))
        result = messages.ObjectHypothesisWithPose(hypothesis=hypothesis, pose=pose)
        box = messages.BoundingBox3D(center=transform_to_pose(T @ T_object_box), size=size)
        detections.append(
            messages.Detection3D(header=make_header(stamp, frame), results=[result], bbox=box, id=str(index))
        )
    return messages.Detection3DArray(header=make_header(stamp, frame), detections=detections)
