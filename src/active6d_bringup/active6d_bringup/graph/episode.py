"""One episode from its settings to its result: bring up the graph, watch it, end it when all is on record."""

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2

from active6d_bringup.bags.writer import refuse_existing
from active6d_bringup.graph.composition import (
    UNANSWERED,
    ComposedGraph,
    Graph,
    GraphDescription,
    OnEvent,
    running,
)
from active6d_bringup.graph.composition import EpisodeInterrupted as EpisodeInterrupted
from active6d_bringup.graph.params_file import (
    check_parameters,
    default_params_file,
    parameters_of,
    read_params_file,
)
from active6d_core.hypotheses import SceneObjects
from active6d_core.nearest_name import did_you_mean
from active6d_core.ros import topics
from active6d_core.ros.conversions import (
    MessageError,
    latencies_from_diagnostics,
    objects_from_cloud,
    pose_stamped_to_transform,
    poses_from_array,
    stamp_to_ns,
)
from active6d_core.ros.episode_messages import (
    EpisodeEnd,
    EpisodeStart,
    GoalState,
    GoalStatus,
    check_episode,
    episode_info,
)
from active6d_core.ros.node import qos_of
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.fusion_parameters import FusionParameters

#: The nodes of every episode, each with the settings that are parameters of it.
_PARAMETERS = {
    "camera_simulator": ("object", "seed", "scene", "sensor", "carrier"),
    "pose_estimator": ("object", "estimator"),
    "hypothesis_fusion": ("object",),
    "attention_policy": ("object", "seed", "policy", "steps", "metres", "seconds"),
}
#: How long a recorder may lag behind the end of an episode in which a node died.
_SETTLE_SECONDS = 5.0


class EpisodeError(RuntimeError):
    """An episode that did not come to its end; the text says which node has not answered."""


@dataclass(frozen=True)
class EpisodeSettings:
    """What to run. A setting that is None is as in the params file, else at the nodes' default.

    Attributes:
        object: name of the object that fills the bin; the file must not give the nodes different ones.
        seed: of the heap, the sensor noise and the policy.
        scene: a stored scene such as ``mug/test/3`` in place of a heap dropped by ``seed``.
        policy: name of the policy.
        steps: budget of moves T.
        metres: budget of metres along the hemisphere, 0 for none.
        seconds: budget of seconds of motion, 0 for none.
        estimator: name of the estimator.
        sensor: name of the simulated camera's sensor model; auto for the default one, or a random one in a wild scene.
        carrier: what carries the simulated camera: ``flying`` for nothing, or ``arm`` for a simulated arm.
        bag: folder to create for the recording, None for no recording.
        processes: every node in a process of its own.
        params_file: ROS parameters; None takes those of this package.
        overrides: node name to parameters; they win over the file and over the settings above.
        namespace: of all topics and nodes.
        domain: ROS domain, see ``GraphDescription``.
        patience: seconds without progress after which the episode counts as stuck. It decides no result.
    """

    object: str | None = None
    seed: int | None = None
    scene: str | None = None
    policy: str | None = None
    steps: int | None = None
    metres: float | None = None
    seconds: float | None = None
    estimator: str | None = None
    sensor: str | None = None
    carrier: str | None = None
    bag: Path | None = None
    processes: bool = False
    params_file: Path | None = None
    overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    namespace: str = ""
    domain: int | None = None
    patience: float = 120.0


@dataclass(frozen=True)
class ResolvedSettings(EpisodeSettings):
    """Settings with what the nodes really get; by default the nodes' own.

    Attributes:
        object: of all nodes.
        steps: of the policy.
        confirmed: probability from which fusion counts an object.
    """

    object: str = "mug"
    steps: int = 5
    confirmed: float = FusionParameters.confirmed


@dataclass(frozen=True, eq=False)
class EpisodeStep:
    """One view as the graph reported it.

    Attributes:
        index: 0 for the view before any move.
        stamp: nanoseconds.
        T_world_camera: (4, 4).
        distance: metres of arc since the first view.
        hypotheses: how many the estimator had for this view alone.
        objects: everything accumulated up to this view.
        ground_truth: (n, 4, 4) ``T_world_object`` if the camera has published it, for scoring.
        goal: ``T_world_camera`` (4, 4) that the policy asked for next; None for the last view.
        latency_ms: node name to the milliseconds it worked on this view.
    """

    index: int
    stamp: int
    T_world_camera: np.ndarray
    distance: float
    hypotheses: int
    objects: SceneObjects
    ground_truth: np.ndarray | None
    goal: np.ndarray | None
    latency_ms: dict[str, float]


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """An episode that came to its end.

    Attributes:
        settings: what was asked for, with the object and the steps that were used.
        info: what the camera and the policy said of the episode (object, scene, seed, policy, ...).
        steps: one per view.
        ground_truth: (n, 4, 4) ``T_world_object`` if the camera knows it.
        reason: why the policy stopped.
        distance: metres of arc that the camera travelled.
        seconds: of wall-clock time from the first view to the end.
        refused: why the camera refused goals, in order.
        events: what happened to the nodes, such as a restart.
    """

    settings: ResolvedSettings
    info: dict[str, str]
    steps: list[EpisodeStep]
    ground_truth: np.ndarray | None
    reason: str
    distance: float
    seconds: float
    refused: list[str]
    events: list[str]

    @property
    def motion_seconds(self) -> float:
        """From the first view to the last by their stamps: the time of a simulated camera's motions."""
        return (self.steps[-1].stamp - self.steps[0].stamp) * 1e-9

    @property
    def objects(self) -> SceneObjects:
        """What was found in the end."""
        return self.steps[-1].objects


OnStep = Callable[[EpisodeStep], None]


def run_episode(
    settings: EpisodeSettings, on_step: OnStep = lambda step: None, on_event: OnEvent = lambda text: None
) -> EpisodeResult:
    """Run one episode and record it if the settings name a bag.

    Args:
        settings: what to run.
        on_step: called with every view as soon as its objects are known (its goal is not, yet).
        on_event: called with what happens to the nodes, in words.

    Raises:
        ValueError: a setting or a parameter is wrong; the message names it.
        EpisodeError: a node does not answer.
        EpisodeInterrupted: by Ctrl-C or SIGTERM.
    """
    # The recorder would find out too, but only after the other nodes' heavy start.
    if settings.bag is not None:
        refuse_existing(settings.bag)
    events: list[str] = []

    def note(text: str) -> None:
        events.append(text)
        on_event(text)

    resolved = resolve(settings)
    description = describe(resolved)
    description.name_unused(note)
    with interruptible() as interrupted, running(make_graph(settings, description, note, interrupted)) as graph:
        monitor = EpisodeMonitor(graph.context, settings.namespace, on_step)
        graph.add(monitor)
        graph.start()
        description.name_others(monitor, note)
        _spin_to_end(graph, monitor, settings.patience, interrupted, note)
        return monitor.result(resolved, events)


def resolve(settings: EpisodeSettings) -> ResolvedSettings:
    """Look up in params file and overrides what the settings leave open; overrides have the last word.

    Raises:
        ValueError: params file and overrides give two nodes different objects, or a value is wrong.
    """
    sections = read_params_file(settings.params_file) if settings.params_file else []
    elsewhere = {
        name: {**parameters_of(sections, name, settings.namespace), **settings.overrides.get(name, {})}
        for name in _PARAMETERS
    }
    steps = settings.overrides.get("attention_policy", {}).get("steps", settings.steps)
    if steps is None:
        steps = elsewhere["attention_policy"].get("steps", ResolvedSettings.steps)
    confirmed = elsewhere["hypothesis_fusion"].get("confirmed", ResolvedSettings.confirmed)
    check_parameters({"attention_policy": {"steps": steps}, "hypothesis_fusion": {"confirmed": confirmed}})
    name = settings.object or _common_object(elsewhere, settings.params_file)
    return ResolvedSettings(**{**vars(settings), "object": name, "steps": steps, "confirmed": confirmed})


def _common_object(parameters: dict[str, dict[str, Any]], params_file: Path | None) -> str:
    """The one object of all nodes that are given one."""
    objects = {name: own["object"] for name, own in parameters.items() if "object" in own}
    check_parameters({name: {"object": value} for name, value in objects.items()})
    first = next(iter(objects), "")
    for name, value in objects.items():
        if value != objects[first]:
            where = f"params file {params_file}: " if params_file else ""
            raise ValueError(
                f"{where}{first} has the object '{objects[first]}', but {name} has '{value}'; an episode has one "
                "object, so give both the same, or name it with --object"
            )
    return objects.get(first, ResolvedSettings.object)


def describe(settings: EpisodeSettings) -> GraphDescription:
    """The graph of an episode, each node with the parameters that the settings give it."""
    nodes: dict[str, dict[str, Any]] = {
        name: {parameter: value for parameter in parameters if (value := getattr(settings, parameter)) is not None}
        for name, parameters in _PARAMETERS.items()
    }
    policy = nodes["attention_policy"]
    policy.update({budget: float(policy[budget]) for budget in ("metres", "seconds") if budget in policy})
    if settings.bag is not None:
        nodes["episode_recorder"] = {"bag": str(settings.bag)}
    unknown = settings.overrides.keys() - nodes.keys()
    if unknown:
        hint = did_you_mean(min(unknown), nodes)
        raise ValueError(f"no node '{min(unknown)}' in an episode{hint}; there are {', '.join(nodes)}")
    nodes = {name: {**parameters, **settings.overrides.get(name, {})} for name, parameters in nodes.items()}
    if settings.bag is not None:
        nodes["episode_recorder"]["settings"] = json.dumps(nodes)
    return GraphDescription(nodes, settings.params_file or default_params_file(), settings.namespace, settings.domain)


def make_graph(settings: Any, description: GraphDescription, on_event: OnEvent, interrupted: threading.Event) -> Graph:
    """The described graph, in this process or in one process a node as the settings say; not started yet.

    Args:
        settings: of an episode or a replay.
        description: of the graph.
        on_event: called with what happens to the nodes, in words.
        interrupted: once it is set, the graph gives up starting.
    """
    if settings.processes:
        from active6d_bringup.graph.processes import ProcessGraph

        return ProcessGraph(description, on_event, settings.patience, interrupted)
    return ComposedGraph(description, on_event, interrupted)


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, so that neither breaks into a write; a second Ctrl-C does.

    In a thread other than the main one, signals stay as they are.
    """
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    def interrupt(number: int, frame: Any) -> None:
        if interrupted.is_set():
            raise EpisodeInterrupted
        interrupted.set()

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _spin_to_end(
    graph: Graph, monitor: "EpisodeMonitor", patience: float, interrupted: threading.Event, note: OnEvent
) -> None:
    progress, since = None, 0.0
    while True:
        if interrupted.is_set():
            raise EpisodeInterrupted
        awaited = monitor.missing()
        unrecorded = [] if awaited else graph.missing(monitor.end_stamp or 0)
        if not awaited and not unrecorded:
            return
        # A recorder that starts again has not received the transient local messages yet.
        starting = UNANSWERED in unrecorded
        if progress != (monitor.received, monitor.end_stamp, starting):
            progress, since = (monitor.received, monitor.end_stamp, starting), time.monotonic()
        idle = time.monotonic() - since
        if not awaited and graph.restarted and not starting and idle > _SETTLE_SECONDS:
            # A publisher that dies while publishing does not reach every subscriber: the recorder may lack a message.
            note(f"the bag is not complete: no answer from {topics.describe_missing(unrecorded)}")
            return
        if idle > patience:
            silent = (
                f"no progress for {patience:.0f} s: no answer from {topics.describe_missing(awaited or unrecorded)}"
            )
            raise EpisodeError("; ".join([silent, *monitor.last_refusal]))
        graph.spin_once(0.1)


class EpisodeMonitor(Node):
    """Listens to an episode and keeps what its result needs."""

    def __init__(self, context: Context, namespace: str, on_step: OnStep) -> None:
        super().__init__(
            "episode_monitor", context=context, namespace=namespace, start_parameter_services=False, enable_rosout=False
        )
        self.end_stamp: int | None = None
        #: What a node last refused and why, in words; empty if none did.
        self.last_refusal: list[str] = []
        self._on_step = on_step
        self._heard: set[tuple[str, bytes]] = set()
        self._reported: set[int] = set()
        self._poses: dict[int, np.ndarray] = {}
        self._objects: dict[int, SceneObjects] = {}
        self._goals: dict[int, np.ndarray] = {}
        self._hypotheses: dict[int, int] = {}
        self._latencies: dict[int, dict[str, float]] = {}
        self._ground_truth: np.ndarray | None = None
        self._starts: list[EpisodeStart] = []
        self._ends: list[EpisodeEnd] = []
        self._refused: list[str] = []
        self._reason = ""
        self._began = self._ended = 0.0
        self._listen(topics.CAMERA_POSE, self._on_pose)
        self._listen(topics.HYPOTHESES, self._on_hypotheses)
        self._listen(topics.OBJECTS, self._on_objects)
        self._listen(topics.VIEW_GOAL, self._on_goal)
        self._listen(topics.GOAL_STATUS, self._on_goal_status)
        self._listen(topics.GROUND_TRUTH, self._on_ground_truth)
        self._listen(topics.EPISODE_START, self._on_start)
        self._listen(topics.EPISODE_END, self._on_end)
        self._listen(topics.DIAGNOSTICS, self._on_diagnostics)

    @property
    def received(self) -> int:
        """How many different messages came: a goal that is published again without an answer is no progress."""
        return len(self._heard)

    @property
    def last(self) -> int:
        """Stamp in nanoseconds of the view that came last, 0 before the first."""
        return next(reversed(self._poses), 0)

    def missing(self) -> list[str]:
        """The topic that the episode waits for next; nothing when it has ended."""
        view = self.last
        if self.end_stamp in self._poses and self.end_stamp in self._objects:
            return []
        # A goal whose view does not come was refused or is under way: either way it is the camera's turn.
        if not view or view in self._goals:
            return [topics.CAMERA_POSE.name]
        if view not in self._hypotheses:
            return [topics.HYPOTHESES.name]
        return [(topics.VIEW_GOAL if view in self._objects else topics.OBJECTS).name]

    def result(self, settings: ResolvedSettings, events: list[str]) -> EpisodeResult:
        """The result of the episode, which must have ended."""
        steps = [self._step(index, stamp) for index, stamp in enumerate(sorted(self._poses.keys() & self._objects))]
        return EpisodeResult(
            settings=settings,
            info=episode_info(self._starts, self._ends),
            steps=steps,
            ground_truth=self._ground_truth,
            reason=self._reason,
            distance=steps[-1].distance,
            seconds=self._ended - self._began,
            refused=self._refused,
            events=events,
        )

    def _listen(self, topic: topics.Topic, callback: Callable[[Any], None]) -> None:
        def heard(message: Any) -> None:
            try:
                callback(message)
            except MessageError as error:
                self.last_refusal = [f"the command refused {topic.name}: {error}"]
                return
            if topic is not topics.DIAGNOSTICS:
                self._heard.add((topic.name, serialize_message(message)))
            self._report_steps()

        self.create_subscription(topic.message_type, topic.name, heard, qos_of(topic, 100))

    def _report_steps(self) -> None:
        for index, stamp in enumerate(sorted(self._poses.keys() & self._objects)):
            if stamp not in self._reported:
                self._reported.add(stamp)
                self._on_step(self._step(index, stamp))

    def _step(self, index: int, stamp: int) -> EpisodeStep:
        return EpisodeStep(
            index,
            stamp,
            self._poses[stamp],
            self._distance(stamp),
            self._hypotheses.get(stamp, 0),
            self._objects[stamp],
            self._ground_truth,
            self._goals.get(stamp),
            self._latencies.get(stamp, {}),
        )

    def _distance(self, stamp: int) -> float:
        positions = np.array([T[:3, 3] for at, T in sorted(self._poses.items()) if at <= stamp])
        return ViewSphere(radius=float(np.linalg.norm(positions[0]))).path_length(positions)

    def _on_pose(self, message: PoseStamped) -> None:
        if not self._poses:
            self._began = time.monotonic()
        self._poses[stamp_to_ns(message.header.stamp)] = pose_stamped_to_transform(message, message.header.frame_id)

    def _on_hypotheses(self, message: PointCloud2) -> None:
        self._hypotheses[stamp_to_ns(message.header.stamp)] = message.width * message.height

    def _on_objects(self, message: PointCloud2) -> None:
        self._objects[stamp_to_ns(message.header.stamp)] = objects_from_cloud(message, message.header.frame_id)

    def _on_goal(self, message: PoseStamped) -> None:
        self._goals[stamp_to_ns(message.header.stamp)] = pose_stamped_to_transform(message, message.header.frame_id)

    def _on_goal_status(self, message: DiagnosticArray) -> None:
        status = GoalStatus.from_message(message)
        if status.state is GoalState.REFUSED:
            self._refused.append(status.reason)

    def _on_ground_truth(self, message: PoseArray) -> None:
        self._ground_truth = poses_from_array(message, message.header.frame_id)

    def _on_start(self, message: DiagnosticArray) -> None:
        self._starts.append(EpisodeStart.from_message(message))

    def _on_end(self, message: DiagnosticArray) -> None:
        end = EpisodeEnd.from_message(message)
        try:
            check_episode(end.episode, self._starts[-1].id if self._starts else "")
        except MessageError as error:
            self.last_refusal = [f"{topics.EPISODE_END.name}: {error}"]
            return
        self._ends.append(end)
        self.end_stamp, self._reason = end.stamp, end.reason
        self._ended = time.monotonic()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.level == DiagnosticStatus.ERROR:
                self.last_refusal = [f"{status.name} refused {status.message}"]
        latencies = latencies_from_diagnostics(message)
        self._latencies.setdefault(stamp_to_ns(message.header.stamp), {}).update(latencies)
