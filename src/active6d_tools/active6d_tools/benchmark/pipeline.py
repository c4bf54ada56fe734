"""Times of verification, fusion and policy by direct calls.

Views of a pile are rendered beforehand. Hypotheses near the true poses replace an estimator. Times are medians over
repetitions unless stated otherwise.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from active6d_agent.policies.registry import Observation, Policy, create_policy, weights_path
from active6d_agent.policies.view_attention.network import ViewAttention, save_network
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_core.view_sphere import ViewSphere
from active6d_perception.scene.all_views_fusion import AllViewsFusion
from active6d_perception.scene.observed_surface import ObservedSurface
from active6d_perception.scene.verification import Verifier
from active6d_tools.benchmark.graph_overhead import PreparedViews, disturbances, prepare_views

VIEWS = 6
OBJECTS = 15
#: Numbers of hypotheses accumulated over all views, for times over hypotheses.
COUNTS = (10, 20, 50, 100, 200, 500, 1000)
OnProgress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class LastViewTimes:
    """Seconds spent on the last view in each repetition.

    Attributes:
        verification: (r,) of its hypotheses.
        fusion: (r,) of fusion with the earlier ones and of the unexplained surface.
        policy: (r,) of the decision.
        objects: number of fused objects.
    """

    verification: np.ndarray
    fusion: np.ndarray
    policy: np.ndarray
    objects: int


def measure_pipeline(
    object_name: str = "mug",
    *,
    policy: str = "view-attention",
    seed: int = 0,
    repeats: int = 50,
    counts: Sequence[int] = COUNTS,
    on_progress: OnProgress = lambda what, done, total: None,
) -> dict[str, Any]:
    """Time the last of six views of 15 objects, and the same for growing numbers of hypotheses.

    Args:
        object_name: of the objects in the bin.
        policy: to time. If ``view-attention`` has no trained weights, untrained ones are timed, which take as long.
        seed: of pile, views and hypotheses.
        repeats: of every measurement; ten times as many for the last view, for the 99th percentile.
        counts: numbers of accumulated hypotheses for the curve.
        on_progress: called with a description, the number of steps done and the number of all steps.

    Returns:
        ``fusion_hz`` of verification and fusion, ``policy_ms_p99`` of the decision, ``hz_total`` of all, their times,
        and ``cost`` with a row for each of ``counts``.
    """
    on_progress("rendering views", 0, 1)
    prepared = prepare_views(object_name, seed, VIEWS, OBJECTS, objects=OBJECTS)
    decider, trained = _make_policy(policy, prepared.model)
    verifier, rng = Verifier(prepared.model), np.random.default_rng(seed)
    found = list(prepared.hypotheses.values())
    on_progress("last view", 0, 1)
    # A 99th percentile of few times is the slowest one.
    times = time_last_view(prepared, found, verifier, decider, max(10 * repeats, 100))
    cost = []
    for done, count in enumerate(counts):
        on_progress(f"{count} hypotheses", done, len(counts))
        shares = np.diff(np.round(np.linspace(0, count, VIEWS + 1)).astype(int))
        resized = [resize(one, share, rng) for one, share in zip(found, shares, strict=True)]
        row = time_last_view(prepared, resized, verifier, decider, max(3, repeats // 5))
        cost.append({"hypotheses": count, "objects": row.objects, **_milliseconds(row)})
    fusing = float(np.median(times.verification + times.fusion))
    return {
        "object": object_name,
        "policy": policy,
        "trained": trained,
        "objects": times.objects,
        "views": VIEWS,
        "fusion_hz": 1.0 / fusing,
        "policy_ms_p99": 1e3 * float(np.quantile(times.policy, 0.99)),
        "hz_total": float(1.0 / np.median(times.verification + times.fusion + times.policy)),
        **_milliseconds(times),
        "cost": cost,
    }


def _milliseconds(times: LastViewTimes) -> dict[str, float]:
    names = ("verification", "fusion", "policy")
    return {f"{name}_ms": 1e3 * float(np.median(getattr(times, name))) for name in names}


def _make_policy(name: str, model: ObjectModel) -> tuple[Policy, bool]:
    """The policy, and whether its weights are trained."""
    if name != "view-attention" or weights_path(name, model.name).is_file():
        return create_policy(name, model), True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "untrained.safetensors"
        save_network(ViewAttention(), path, model.name)
        return create_policy(name, model, weights=str(path)), False


def time_last_view(
    prepared: PreparedViews, found: list[Hypotheses], verifier: Verifier, policy: Policy, repeats: int
) -> LastViewTimes:
    """Verify, fuse and decide on the last view ``repeats`` times; the earlier views are fused before."""
    model, sphere = prepared.model, ViewSphere()
    fusion, surface = AllViewsFusion(model), ObservedSurface(model)
    *earlier, (last, hypotheses) = zip(prepared.views, found, strict=True)
    known = [(view, one, verifier.score(view.depth, view.camera, one)) for view, one in earlier]
    positions = np.array([view.T_world_camera[:3, 3] for view in prepared.views])
    policy.reset(np.random.default_rng(0))
    # The first repetition is slower, because libraries initialise lazily; it is left out.
    seconds = np.zeros((repeats + 1, 3))
    for row in seconds:
        fusion.reset()
        surface.reset()
        for view, one, scores in known:
            fusion.add_view(view.stamp, view.T_world_camera, one, scores, view.depth, view.camera)
            fusion.objects(view.stamp, view.T_world_camera, view.camera)
            surface.add_view(view.stamp, view.depth, view.camera, view.T_world_camera)
        began = time.perf_counter()
        scores = verifier.score(last.depth, last.camera, hypotheses)
        verified = time.perf_counter()
        fusion.add_view(last.stamp, last.T_world_camera, hypotheses, scores, last.depth, last.camera)
        surface.add_view(last.stamp, last.depth, last.camera, last.T_world_camera)
        objects = fusion.objects(last.stamp, last.T_world_camera, last.camera)
        unexplained = surface.unexplained(objects.T_world_object)
        fused = time.perf_counter()
        allowed = np.ones(len(sphere), bool)
        policy.decide(Observation(objects, positions, sphere, allowed, 5, unexplained=unexplained))
        row[:] = verified - began, fused - verified, time.perf_counter() - fused
    verification, fusing, deciding = seconds[1:].T
    return LastViewTimes(verification, fusing, deciding, len(objects))


def resize(hypotheses: Hypotheses, count: int, rng: np.random.Generator) -> Hypotheses:
    """``count`` copies of the hypotheses in turn, each shifted and rotated by a few millimetres and degrees."""
    copies = hypotheses.take(np.arange(count) % len(hypotheses))
    return replace(copies, T_camera_object=copies.T_camera_object @ disturbances(count, rng))
