"""Runs estimators on the same views of stored scenes, and measures what fusion of several views adds."""

import resource
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from active6d_core.files import sha256_of
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.registry import AUTOMATIC
from active6d_core.view_sphere import ViewSphere
from active6d_perception.estimators.registry import Estimator, create_estimator, weights_path
from active6d_perception.estimators.single_view_evaluation import EstimatorResult, detection_over_views, evaluate_view
from active6d_perception.scene.verification import Verifier
from active6d_sim.scenes.scene_store import SPLITS, load_scene
from active6d_tools.benchmark.estimator_summary import headline, summarise
from active6d_tools.benchmark.grid_views import GridViews
from active6d_tools.benchmark.peers import PEERS
from active6d_tools.benchmark.records import Records

OnProgress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Contender:
    """An estimator to compare.

    Attributes:
        name: of the estimator or of the peer.
        identity: the name, and a hash of the weights of a learned one.
        estimator: ready to run.
    """

    name: str
    identity: str
    estimator: Estimator


@dataclass(frozen=True, eq=False)
class Measurement:
    """What was measured.

    Attributes:
        document: what ``active6d benchmark estimator --json`` writes.
        results: of all views by (noise, name of the estimator).
    """

    document: dict[str, Any]
    results: dict[tuple[float, str], EstimatorResult]


def enlist(
    model: ObjectModel, estimators: Sequence[str], *, weights: Sequence[Path] = (), peers: bool = False
) -> list[Contender]:
    """Create the estimators to compare.

    Args:
        model: of the object.
        estimators: names of registered ones.
        weights: of ``dense``; the shipped ones if empty. Further ones are contenders named after their file.
        peers: whether to add those of :mod:`~active6d_tools.benchmark.peers`.

    Raises:
        ValueError: a name is unknown, weights are missing, or the library of a peer is not installed.
    """
    contenders = []
    for name in dict.fromkeys(estimators):
        if name == "dense":
            for number, path in enumerate(weights or [weights_path(model.name)]):
                estimator = create_estimator(name, model, weights=str(path))
                label = f"{name} {path.stem}" if number else name
                contenders.append(Contender(label, f"{name} {sha256_of(path)[:12]}", estimator))
        else:
            contenders.append(Contender(name, name, create_estimator(name, model)))
    if peers:
        contenders += [Contender(name, name, factory(model)) for name, factory in PEERS.items()]
    return contenders


def measure_estimators(
    object_name: str,
    split: str,
    contenders: Sequence[Contender],
    *,
    sample: int | None = None,
    moves: int = 0,
    seed: int = 0,
    noises: Sequence[float] = (1.0,),
    sensor: str = AUTOMATIC,
    records: Path | None = None,
    on_progress: OnProgress = lambda what, done, total: None,
) -> Measurement:
    """Run estimators on the same views of stored scenes, each view rendered once.

    Args:
        object_name: of the objects in the bins.
        split: of the stored scenes.
        contenders: as from :func:`enlist`.
        sample: number of (scene, view) pairs drawn with ``seed``; None takes every view of every scene.
        moves: number of moves of a random walk in each scene, whose views are fused with the first of ``noises``; 0
            for no walks. Peers have no walks.
        seed: of the sample, the walks and the sensor noise.
        noises: factors on the sensor noise; 0 switches it off.
        sensor: name of the sensor; ``auto`` is the default one, or in wild scenes a random one in each view.
        records: file of results of single views; existing results are used, new ones are appended.
        on_progress: called with a description, the number of steps done and the number of all steps.

    Raises:
        ValueError: an unknown object or split, or records of other measurements.
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split '{split}'; known: {', '.join(SPLITS)}")
    model = load_object(object_name)
    scenes = [load_scene(object_name, split, index) for index in range(SPLITS[split])]
    header = {"object": object_name, "split": split, "seed": seed}
    store = Records(records, header if sensor == AUTOMATIC else {**header, "sensor": sensor})
    rng = np.random.default_rng(seed)
    pairs = _draw_views(rng, len(scenes), sample)
    walks = [[int(view) for view in rng.permutation(len(ViewSphere()))[: moves + 1]] for _ in scenes]
    views = GridViews(model, scenes, seed, sensor)
    results = _measure_views(contenders, views, pairs, noises, store, on_progress)
    rows = _summarise_all(model, results, [scene for scene, _ in pairs])
    done = len(pairs) * len(results)
    for contender in contenders:
        if moves and contender.name not in PEERS:
            on_progress(f"{contender.name}, fused", done, done)
            fused = _fuse_walks(contender, views, walks, noises[0])
            rows[f"{noises[0]:g}"][contender.name]["fused"] = fused
    summaries = {
        contender.name: {"identity": contender.identity, **headline(rows[f"{noises[0]:g}"][contender.name])}
        for contender in contenders
    }
    settings = {"object": object_name, "split": split, "views": len(pairs), "seed": seed, "sensor": sensor}
    measured = {"estimators": summaries, "peak_memory_mib": _peak_memory_mib(), "noise": rows}
    return Measurement({**settings, **measured}, results)


def _measure_views(
    contenders: Sequence[Contender],
    views: GridViews,
    pairs: Sequence[tuple[int, int]],
    noises: Sequence[float],
    store: Records,
    on_progress: OnProgress,
) -> dict[tuple[float, str], EstimatorResult]:
    """Results by noise and estimator; estimators run on the views that ``store`` has no result of."""
    verifier = Verifier(views.model)
    tasks = [(*pair, noise, contender) for pair in pairs for noise in noises for contender in contenders]
    for done, (scene, view, noise, contender) in enumerate(tasks):
        on_progress(f"{contender.name}, {views.scenes[scene].name}, view {view}", done, len(tasks))
        key = (contender.identity, noise, scene, view)
        if key not in store:
            labelled = views.capture(scene, view, noise)
            store.add(key, evaluate_view(contender.estimator, verifier, views.model, labelled))
    on_progress("views", len(tasks), len(tasks))
    return {
        (noise, contender.name): EstimatorResult(
            views.model.diameter, tuple(store[contender.identity, noise, scene, view] for scene, view in pairs)
        )
        for noise in noises
        for contender in contenders
    }


def _summarise_all(
    model: ObjectModel, results: dict[tuple[float, str], EstimatorResult], scenes: Sequence[int]
) -> dict[str, dict[str, Any]]:
    """Summaries by noise and estimator."""
    rows: dict[str, dict[str, Any]] = {}
    for (noise, name), result in results.items():
        rows.setdefault(f"{noise:g}", {})[name] = summarise(model, result, scenes)
    return rows


def _fuse_walks(contender: Contender, views: GridViews, walks: Sequence[Sequence[int]], noise: float) -> list[float]:
    """Detection rate after each view of a walk, averaged over the walks, one walk for each scene."""
    episodes = ([views.capture(scene, view, noise) for view in walk] for scene, walk in enumerate(walks))
    return detection_over_views(contender.estimator, views.model, episodes).mean(axis=0).tolist()


def _draw_views(rng: np.random.Generator, scenes: int, sample: int | None) -> list[tuple[int, int]]:
    """(scene, view) pairs in order."""
    pairs = [(scene, view) for scene in range(scenes) for view in range(len(ViewSphere()))]
    if sample is None or sample >= len(pairs):
        return pairs
    return [pairs[i] for i in sorted(rng.choice(len(pairs), sample, replace=False))]


def _peak_memory_mib() -> float:
    """Of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024 if sys.platform.startswith("linux") else peak / 1024**2
