"""A recorded episode's camera through live perception, and whether what comes out equals what was recorded."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.node import Node

from active6d_bringup.bags.camera_topics import CameraOptions
from active6d_bringup.bags.index import BagIndex, read_bag
from active6d_bringup.bags.reader import read_episodes
from active6d_bringup.bags.source import BagError
from active6d_bringup.bags.writer import TYPESTORE, refuse_existing, stamp_of
from active6d_bringup.graph.composition import (
    GraphDescription,
    OnEvent,
    running,
)
from active6d_bringup.graph.episode import EpisodeError, EpisodeInterrupted, interruptible, make_graph
from active6d_bringup.graph.params_file import default_params_file
from active6d_core.camera import View
from active6d_core.hypotheses import SceneObjects
from active6d_core.ros.conversions import objects_from_cloud, own_statuses, read_table, status_values
from active6d_core.ros.node import qos_of
from active6d_core.ros.topics import DIAGNOSTICS, HYPOTHESES, OBJECTS, PERCEPTION_TOPICS, Topic
from active6d_perception.scene.fusion_parameters import FusionParameters

#: What perception makes of a view, by topic name.
COMPARED = {topic.name: topic for topic in PERCEPTION_TOPICS}


@dataclass(frozen=True)
class ReplaySettings:
    """What to replay, and how.

    Attributes:
        bag: folder of the bag.
        rate: speed against the recording's; 0 sends a view when the objects of the last one have arrived.
        object: name of the object, None for the one that the bag names.
        estimator: name of the estimator, None for the recorded one.
        processes: every node in a process of its own.
        params_file: ROS parameters; None takes those of this package.
        overrides: node name to parameters; they win over the file and over what was recorded.
        camera: what the user says of the camera of a foreign recording.
        domain: ROS domain, see ``GraphDescription``.
        patience: seconds without an answer after which the replay counts as stuck.
        record: folder to create for a recording of the replay, None for no recording.
    """

    bag: Path
    rate: float = 0.0
    object: str | None = None
    estimator: str | None = None
    processes: bool = False
    params_file: Path | None = None
    overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    camera: CameraOptions = CameraOptions()
    domain: int | None = None
    patience: float = 120.0
    record: Path | None = None


@dataclass(frozen=True, eq=False)
class ReplayStep:
    """What perception made of one view.

    Attributes:
        index: from 0.
        stamp: nanoseconds.
        T_world_camera: (4, 4), recorded.
        hypotheses: how many the estimator had for this view alone.
        objects: everything accumulated up to this view, in the frame ``ReplayResult.world_frame``.
    """

    index: int
    stamp: int
    T_world_camera: np.ndarray
    hypotheses: int
    objects: SceneObjects


@dataclass(frozen=True, eq=False)
class PreparedReplay:
    """A bag that can be replayed, and the graph that will do it.

    Attributes:
        settings: what to replay.
        index: of the bag.
        views: of all its episodes.
        description: of the graph.
    """

    settings: ReplaySettings
    index: BagIndex
    views: list[View]
    description: GraphDescription

    @property
    def object(self) -> str:
        """Name of the object."""
        return str(self.description.nodes["hypothesis_fusion"]["object"])

    @property
    def confirmed(self) -> float:
        """Probability from which fusion counts an object, as when recording."""
        parameters = self.description.nodes["hypothesis_fusion"]
        return float(parameters.get("confirmed", FusionParameters.confirmed))

    @property
    def stamps(self) -> list[int]:
        """Of the views, in order."""
        return [view.stamp for view in self.views]


@dataclass(frozen=True)
class Comparison:
    """One message against the recorded one of the same view.

    Attributes:
        stamp: of the view, nanoseconds.
        topic: in ``COMPARED``.
        recorded: rows (of a table) or pixels (of an image) in the bag, None where the bag has no such message.
        live: the same of the live message.
        equal: whether every byte agrees (CDR's padding aside, which has no meaning), or every recorded column where the
            bag has fewer of them.
        differences: column to the largest absolute difference, or to the share of pixels for an image; NaN where the
            sizes differ.
    """

    stamp: int
    topic: str
    recorded: int | None
    live: int
    equal: bool
    differences: dict[str, float]


@dataclass(frozen=True)
class ReplayResult:
    """What a replay gave.

    Attributes:
        views: number of views replayed.
        comparisons: one per view and topic of ``COMPARED``.
        seconds: of wall-clock time from the first view to the last objects.
        left_out: reason to the number of views that were not replayed.
        notes: what is doubtful in the recording, in words.
        object: name of the object.
        world_frame: of the objects' poses.
        steps: one per view, in order.
    """

    views: int
    comparisons: list[Comparison]
    seconds: float
    left_out: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    object: str = ""
    world_frame: str = ""
    steps: list[ReplayStep] = field(default_factory=list)

    @property
    def equal(self) -> bool:
        """Whether every message equals the recorded one."""
        return bool(self.comparisons) and all(comparison.equal for comparison in self.comparisons)

    def largest_differences(self) -> dict[str, float]:
        """``topic.column`` to the largest difference over all views, of those that differ."""
        largest: dict[str, float] = {}
        for comparison in self.comparisons:
            for column, difference in comparison.differences.items():
                name = f"{comparison.topic}.{column}"
                largest[name] = float(np.maximum(difference, largest.get(name, 0.0)))
        return largest


def replay(
    settings: ReplaySettings,
    on_view: Callable[[int, int], None] = lambda done, total: None,
    on_event: OnEvent = lambda text: None,
) -> ReplayResult:
    """Send a bag's camera through live perception and compare: ``prepare``, then ``play``."""
    return play(prepare(settings, on_event), on_view, on_event)


def prepare(settings: ReplaySettings, on_event: OnEvent = lambda text: None) -> PreparedReplay:
    """Read a bag and check that it can be replayed; no node is started.

    Args:
        settings: what to replay.
        on_event: called with what is damaged in the bag, in words.

    Raises:
        BagError: the bag cannot be read, or does not name its object.
        ValueError: a setting is wrong, or the folder to record into exists; the message names it.
    """
    if settings.record is not None:
        refuse_existing(settings.record)
    index = read_bag(settings.bag, settings.camera)
    for line in index.damage:
        on_event(f"{settings.bag}: {line}")
    episodes = read_episodes(index)
    description = describe(settings, episodes[0].object, index.settings, index.frames)
    description.name_unused(on_event)
    return PreparedReplay(settings, index, [step.view for each in episodes for step in each.steps], description)


def play(
    prepared: PreparedReplay,
    on_view: Callable[[int, int], None] = lambda done, total: None,
    on_event: OnEvent = lambda text: None,
    on_step: Callable[[ReplayStep], None] = lambda step: None,
) -> ReplayResult:
    """Run a replay to its end.

    Args:
        prepared: what to replay.
        on_view: called with the number of views answered so far, and of all.
        on_event: called with what happens to the nodes, in words.
        on_step: called with every view as soon as its objects are known.

    Raises:
        ValueError: a parameter is wrong; the message names it.
        EpisodeError: perception does not answer.
        EpisodeInterrupted: by Ctrl-C or SIGTERM.
    """
    settings, index, stamps, description = prepared.settings, prepared.index, prepared.stamps, prepared.description
    world, steps, seconds = index.frames["world_frame"], list[ReplayStep](), 0.0
    with interruptible() as interrupted, running(make_graph(settings, description, on_event, interrupted)) as graph:
        listener = _Listener(graph.context, on_event)
        graph.add(listener)
        started = time.monotonic()
        graph.start()
        on_view(0, len(stamps))
        named = description.name_others(listener, on_event)
        deadline = time.monotonic() + settings.patience
        while (answered := len(steps)) < len(stamps) or graph.missing(stamps[-1]):
            if interrupted.is_set():
                raise EpisodeInterrupted
            while len(steps) < len(stamps) and listener.has_answered(stamps[len(steps)]):
                steps.append(listener.step(len(steps), prepared.views[len(steps)], world))
                on_step(steps[-1])
            if len(steps) > answered:
                seconds, deadline = time.monotonic() - started, time.monotonic() + settings.patience
                on_view(len(steps), len(stamps))
                # Again with every view: nodes are not discovered at once.
                named = named or description.name_others(listener, on_event)
            elif time.monotonic() > deadline:
                raise EpisodeError("; ".join([_silence(prepared, answered), *listener.causes.values()]))
            graph.spin_once(0.1)
    comparisons = [
        compare(stamp, topic, index.payloads.get(topic, {}).get(stamp), listener.payloads[topic, stamp])
        for stamp in stamps
        for topic in COMPARED
    ]
    rest = index.left_out, index.notes, prepared.object, world
    return ReplayResult(len(stamps), comparisons, seconds, *rest, steps)


def _silence(prepared: PreparedReplay, answered: int) -> str:
    """Which view the replay waits for in vain, or that its recording is not complete."""
    settings, total = prepared.settings, len(prepared.views)
    if answered == total:
        return f"{settings.record} is not complete after {settings.patience:.0f} s"
    return f"no objects of view {answered + 1} of {total} in {settings.patience:.0f} s"


def describe(
    settings: ReplaySettings,
    recorded_object: str | None,
    recorded: dict[str, dict[str, Any]],
    frames: dict[str, str],
) -> GraphDescription:
    """The graph of a replay: a player in the camera's place, perception with its recorded parameters, and a recorder.

    Raises:
        BagError: neither the settings nor the bag name the object.
    """
    name = settings.object or recorded_object
    if name is None:
        raise BagError(f"{settings.bag}: does not name its object; say which it is with --object")
    estimator = {**recorded.get("pose_estimator", {}), "object": name}
    if settings.estimator is not None:
        estimator["estimator"] = settings.estimator
    nodes: dict[str, dict[str, Any]] = {
        "bag_player": {"bag": str(settings.bag), "rate": float(settings.rate), **settings.camera.parameters},
        "pose_estimator": estimator,
        "hypothesis_fusion": {**recorded.get("hypothesis_fusion", {}), "object": name},
    }
    if settings.record is not None:
        nodes["episode_recorder"] = {"bag": str(settings.record)}
    nodes = {name: {**frames, **parameters, **settings.overrides.get(name, {})} for name, parameters in nodes.items()}
    if settings.record is not None:
        nodes["episode_recorder"]["settings"] = json.dumps(nodes)
    return GraphDescription(nodes, settings.params_file or default_params_file(), domain=settings.domain)


def compare(stamp: int, topic: str, recorded: bytes | None, live: bytes) -> Comparison:
    """Compare the serialized messages of one view and topic.

    A bag of an earlier version may lack columns of a table: its own columns are compared then.
    """
    message_type = COMPARED[topic].type
    found: Any = TYPESTORE.deserialize_cdr(live, message_type)
    size = found.width * found.height
    if recorded is None:
        return Comparison(stamp, topic, None, size, False, {})
    expected: Any = TYPESTORE.deserialize_cdr(recorded, message_type)
    equal = TYPESTORE.serialize_cdr(found, message_type) == TYPESTORE.serialize_cdr(expected, message_type)
    differences = {} if equal else _differences(expected, found)
    if not differences and hasattr(expected, "fields"):
        equal |= expected.header == found.header and len(expected.fields) < len(found.fields)
    return Comparison(stamp, topic, expected.width * expected.height, size, equal, differences)


def _differences(expected: Any, found: Any) -> dict[str, float]:
    is_image = hasattr(expected, "encoding")
    if (expected.width, expected.height) != (found.width, found.height) or (
        is_image and len(expected.data) != len(found.data)
    ):
        return {"size": float("nan")}
    if is_image:
        wrong = (expected.data != found.data).reshape(expected.height * expected.width, -1).any(axis=1)
        return {"pixels": float(wrong.mean())}
    tables = [read_table(message) for message in (expected, found)]
    names = (tables[0].dtype.fields or {}).keys()
    if not names <= (tables[1].dtype.fields or {}).keys():
        return {"columns": float("nan")}
    largest = {name: np.abs(tables[0][name].astype(float) - tables[1][name]).max(initial=0.0) for name in names}
    return {name: float(difference) for name, difference in largest.items() if difference != 0}


class _Listener(Node):
    """Keeps what perception says, serialized, and which nodes wait in vain; the latter are reported once."""

    def __init__(self, context: Context, on_event: OnEvent) -> None:
        super().__init__("replay_listener", context=context, start_parameter_services=False, enable_rosout=False)
        self._on_event, self._reported = on_event, set[str]()
        self.payloads: dict[tuple[str, int], bytes] = {}
        self.causes: dict[str, str] = {}
        self.create_subscription(DIAGNOSTICS.message_type, DIAGNOSTICS.name, self._on_diagnostics, DIAGNOSTICS.depth)
        for topic in PERCEPTION_TOPICS:

            def keep(payload: bytes, topic: Topic = topic) -> None:
                self.payloads[topic.name, stamp_of(topic.type, payload)] = payload

            self.create_subscription(topic.message_type, topic.name, keep, qos_of(topic, 100), raw=True)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in own_statuses(message):
            if "state" in status_values(status):
                self.causes.pop(status.name, None)
                if status.level == DiagnosticStatus.WARN:
                    self.causes[status.name] = text = f"{status.name.rpartition('/')[2]} is {status.message}"
                    if status.name not in self._reported:
                        self._reported.add(status.name)
                        self._on_event(text)

    def has_answered(self, stamp: int) -> bool:
        """Whether everything that is compared has arrived for a view."""
        return all((topic, stamp) in self.payloads for topic in COMPARED)

    def step(self, index: int, view: View, world_frame: str) -> ReplayStep:
        """What perception made of a view that it has answered."""
        hypotheses: Any = TYPESTORE.deserialize_cdr(self.payloads[HYPOTHESES.name, view.stamp], HYPOTHESES.type)
        objects = TYPESTORE.deserialize_cdr(self.payloads[OBJECTS.name, view.stamp], OBJECTS.type)
        count = hypotheses.width * hypotheses.height
        return ReplayStep(index, view.stamp, view.T_world_camera, count, objects_from_cloud(objects, world_frame))
