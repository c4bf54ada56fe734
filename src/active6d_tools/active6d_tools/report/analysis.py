"""Numbers of a recorded episode: detection and errors if the bag has ground truth, distances, times."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from active6d_bringup.bags.reader import EpisodeRecord, RecordedStep
from active6d_core.hypotheses import SceneObjects
from active6d_core.metrics import DETECTION_FRACTION, SceneScore, evaluate_scene
from active6d_core.object_model import ObjectModel, list_objects, load_object
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.fusion_parameters import FusionParameters


@dataclass(frozen=True)
class ObjectRow:
    """One accumulated object at one step; attention and error are None if they are unknown."""

    index: int
    verification: float
    score: float
    probability: float
    support: int
    spread_mm: float
    attention: float | None
    attended: bool
    e_add_mm: float | None
    detected: bool


@dataclass(frozen=True, eq=False)
class StepAnalysis:
    """One view of the episode.

    Attributes:
        number: from 0, the view before the first move.
        record: the messages of this view in the bag.
        objects: the fused objects after this view; empty if the bag has none.
        rows: one per object, in their order.
        truth: detection and errors of all true objects, None without ground truth.
        azimuth: degrees of the camera, in [0, 360).
        elevation: degrees of the camera above the horizon.
        moved_m: metres of arc since the last view.
        total_m: metres of arc since the first view.
        confirmed_from: probability from which an object is confirmed, as when recording.
    """

    number: int
    record: RecordedStep
    objects: SceneObjects
    rows: list[ObjectRow]
    truth: SceneScore | None
    azimuth: float
    elevation: float
    moved_m: float
    total_m: float
    confirmed_from: float

    @property
    def hypothesis_count(self) -> int:
        """Number of hypotheses of the estimator in this view."""
        return len(self.record.hypotheses) if self.record.hypotheses is not None else 0

    @property
    def confirmed(self) -> list[ObjectRow]:
        """The objects that are probable enough to count."""
        return [row for row in self.rows if row.probability >= self.confirmed_from]

    @property
    def wrong(self) -> int | None:
        """How many confirmed objects are no true object's detection, None without ground truth."""
        return count_confirmed(self.objects, self.truth, self.confirmed_from)[1]

    @property
    def attended(self) -> ObjectRow | None:
        """The object that the policy attended to, or None."""
        return next((row for row in self.rows if row.attended), None)


@dataclass(frozen=True)
class NodeTime:
    """Processing time of a node per view in milliseconds, from its diagnostics."""

    node: str
    views: int
    median_ms: float
    longest_ms: float


@dataclass(frozen=True, eq=False)
class EpisodeAnalysis:
    """An episode in numbers.

    Attributes:
        model: of the objects in the bin.
        record: the episode itself.
        sphere: the hemisphere that the camera moved on.
        steps: one per view, in order.
        node_times: slowest node first.
    """

    model: ObjectModel
    record: EpisodeRecord
    sphere: ViewSphere
    steps: list[StepAnalysis]
    node_times: list[NodeTime]

    @property
    def distance_m(self) -> float:
        """Metres along the hemisphere (the paper's d)."""
        return self.steps[-1].total_m

    @property
    def without_results(self) -> bool:
        """Whether the bag holds images only: neither hypotheses nor objects of any view."""
        return all(step.record.hypotheses is None and step.record.objects is None for step in self.steps)

    @property
    def replay_command(self) -> str:
        """The command that records what perception makes of the bag's images."""
        folder = self.record.folder
        return f"active6d replay {folder} --object {self.model.name} --as-fast --bag {folder.stem}_replayed"

    @property
    def threshold_mm(self) -> float:
        """An object is detected below this ADD."""
        return 1e3 * DETECTION_FRACTION * self.model.diameter

    def summary(self) -> dict[str, Any]:
        """The numbers for JSON."""
        truth = self.record.ground_truth
        return {
            "object": self.model.name,
            "scene": self.record.scene,
            "seed": self.record.seed,
            "policy": self.record.policy,
            "end_reason": self.record.end_reason,
            "objects_true": None if truth is None else len(truth),
            "distance_m": self.distance_m,
            "steps": [
                {
                    "stamp": step.record.stamp,
                    "azimuth_degrees": step.azimuth,
                    "elevation_degrees": step.elevation,
                    "moved_m": step.moved_m,
                    "hypotheses": step.hypothesis_count,
                    "objects": len(step.rows),
                    "confirmed": len(step.confirmed),
                    "wrong": step.wrong,
                    "detection_rate": step.truth.detection_rate if step.truth else None,
                    "e_add_mm": step.truth.mean_e_add_mm if step.truth else None,
                }
                for step in self.steps
            ],
            "node_times": {
                time.node: {"median_ms": time.median_ms, "longest_ms": time.longest_ms} for time in self.node_times
            },
        }


def analyse(record: EpisodeRecord, object_name: str | None = None) -> EpisodeAnalysis:
    """Score and measure a recorded episode.

    Args:
        record: the episode. The ground truth may be missing, and of each step everything but the view.
        object_name: the object, if the bag does not name it or names another one.

    Raises:
        ValueError: an unknown object.
    """
    name = object_name or record.object
    if name is None:
        raise ValueError(f"{record.folder}: the bag does not name the object; give it with --object")
    # A name in a bag must not choose a file, so only listed objects are loaded.
    if name not in list_objects():
        known = ", ".join(list_objects())
        raise ValueError(f"{record.folder}: object '{name}' is not among {known}; give one with --object")
    model = load_object(name)
    truth = record.ground_truth
    positions = record.positions
    sphere = ViewSphere(radius=float(np.linalg.norm(positions, axis=1).mean()))
    moved = np.concatenate([[0.0], sphere.arc(positions[:-1], positions[1:])])
    azimuth, elevation = np.degrees(sphere.angles(positions)).T
    steps, confirmed_from = [], _confirmed_from(record)
    for number, step in enumerate(record.steps):
        objects = step.objects if step.objects is not None else SceneObjects.empty()
        score = evaluate_scene(model, objects.T_world_object, truth) if truth is not None and len(truth) else None
        steps.append(
            StepAnalysis(
                number=number,
                record=step,
                objects=objects,
                rows=_rows(step, objects, score),
                truth=score,
                azimuth=float(azimuth[number] % 360.0),
                elevation=float(elevation[number]),
                moved_m=float(moved[number]),
                total_m=float(moved[: number + 1].sum()),
                confirmed_from=confirmed_from,
            )
        )
    return EpisodeAnalysis(model, record, sphere, steps, _node_times(record))


def _confirmed_from(record: EpisodeRecord) -> float:
    value = record.settings.get("hypothesis_fusion", {}).get("confirmed")
    return value if isinstance(value, float) else FusionParameters.confirmed


def count_confirmed(objects: SceneObjects, truth: SceneScore | None, confirmed_from: float) -> tuple[int, int | None]:
    """How many objects have at least the probability ``confirmed_from``, and how many of these are no true object's
    detection.

    The second number is None without ground truth.
    """
    confirmed = objects.probability >= confirmed_from
    if truth is None:
        return int(confirmed.sum()), None
    confirmed_and_right = confirmed[truth.matched[truth.detected]]
    return int(confirmed.sum()), int(confirmed.sum() - confirmed_and_right.sum())


def _rows(step: RecordedStep, objects: SceneObjects, truth: SceneScore | None) -> list[ObjectRow]:
    attention = step.attention if step.attention is not None and len(step.attention) == len(objects) else None
    errors, detected = {}, {}
    if truth is not None:
        for k, error, found in zip(truth.matched.tolist(), truth.e_add_mm, truth.detected, strict=True):
            errors[k], detected[k] = float(error), bool(found)
    return [
        ObjectRow(
            index=i,
            verification=float(objects.verification[i]),
            score=float(objects.score[i]),
            probability=float(objects.probability[i]),
            support=int(objects.support[i]),
            spread_mm=1e3 * float(objects.spread[i]),
            attention=None if attention is None else float(attention[i]),
            attended=step.attended == i,
            e_add_mm=errors.get(i),
            detected=detected.get(i, False),
        )
        for i in range(len(objects))
    ]


def _node_times(record: EpisodeRecord) -> list[NodeTime]:
    nodes = sorted({node for step in record.steps for node in step.latency_ms})
    times = []
    for node in nodes:
        latencies = np.array([step.latency_ms[node] for step in record.steps if node in step.latency_ms])
        times.append(NodeTime(node, len(latencies), float(np.median(latencies)), float(latencies.max())))
    return sorted(times, key=lambda time: -time.median_ms)
