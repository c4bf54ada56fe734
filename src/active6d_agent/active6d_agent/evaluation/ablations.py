"""The paper's ablations on scene banks: each part is left out or varied, and the policies are evaluated without it.

Every ablation yields rows for a table: ``variant`` says what was varied, the other keys are those of
:func:`~active6d_agent.evaluation.policy_evaluation.describe`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from active6d_agent.bank.best_view_lookup import BestViewLookup
from active6d_agent.bank.scene_bank import SceneBank
from active6d_agent.bank.scene_lookup import SceneLookup
from active6d_agent.environment.episodes import RewardParameters
from active6d_agent.evaluation.policy_evaluation import Intervals, describe, run_named
from active6d_agent.policies.attention.network import ATTENTION_RULES
from active6d_agent.policies.attention.ppo import PpoParameters, train_ppo
from active6d_core.metrics import score_errors
from active6d_perception.scene.fusion_parameters import RANKINGS, FusionParameters

ALPHAS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
#: T of the paper's figure, from the single shot to all views.
STEPS = (0, 1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 99)
#: Parameters of ``view-attention`` at run time and what they are set to, one at a time.
PLANNING = {
    "lookahead": (0.0, 0.5, 1.0),
    "error_weight": (0.0, 0.25, 0.5, 1.0, 2.0),
    "metres_weight": (0.0, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0),
    "stop_below": (0.0, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0),
}


def ablate_steps(
    lookup: SceneLookup,
    names: Sequence[str],
    starts: np.ndarray,
    steps: Sequence[int] = STEPS,
    *,
    seed: int = 0,
    parameters: dict[str, dict[str, Any]] | None = None,
) -> Iterator[dict[str, Any]]:
    """Policies with budgets from the single view to all views; ``budget`` is T.

    Args:
        lookup: of the bank.
        names: of policies.
        starts: (E, 2) scenes and first views.
        steps: budgets T; those beyond the grid are left out.
        seed: of the policies' randomness.
        parameters: name of a policy to its parameters.
    """
    intervals = Intervals(starts[:, 0], seed)
    for name in names:
        for budget in steps:
            if budget < len(lookup.sphere):
                own = (parameters or {}).get(name)
                results = run_named(lookup, name, starts, budget, seed=seed, parameters=own)
                yield {"variant": name, "budget": budget, **describe(results.measures, intervals)}


def ablate_planning(
    lookup: SceneLookup, starts: np.ndarray, steps: int, *, seed: int = 0, parameters: dict[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """``view-attention`` as it is, then with one parameter of :data:`PLANNING` set, then Random; nothing is trained.

    ``parameter`` is the parameter's name, "as shipped" or "random", ``value`` its value or None, ``moves`` the mean
    number of moves. Every row is compared with the first one.

    Args:
        lookup: of the bank.
        starts: (E, 2) scenes and first views.
        steps: budget T.
        seed: of Random.
        parameters: of the policy in all rows.
    """
    intervals, first = Intervals(starts[:, 0], seed), None
    runs = [("as shipped", None), *((name, value) for name, values in PLANNING.items() for value in values)]
    for name, value in [*runs, ("random", None)]:
        if name == "random":
            results = run_named(lookup, name, starts, steps, seed=seed)
        else:
            changed = {**(parameters or {}), **({} if value is None else {name: value})}
            results = run_named(lookup, "view-attention", starts, steps, seed=seed, parameters=changed)
        measures = {**results.measures, "moves": (results.views >= 0).sum(axis=1) - 1.0}
        variant = name if value is None else f"{name} {value:g}"
        yield {"variant": variant, "parameter": name, "value": value, **describe(measures, intervals, first)}
        first = first or measures


def ablate_fusion(
    bank: SceneBank, policy: str, starts: np.ndarray, steps: int, *, seed: int = 0, scores: bool = False
) -> Iterator[dict[str, Any]]:
    """The deployed fusion, and without one of its parts.

    The views are the same for all variants, those that ``policy`` takes with the deployed fusion, so that only fusion
    differs. ``detection_rate_at_n`` counts only as many hypotheses as there are objects, the best scored ones;
    ``reported`` is how many there are for each object. Without clustering every hypothesis is reported, so that some
    one of them is right more often, and most are repetitions.

    Args:
        bank: the scenes.
        policy: whose views.
        starts: (E, 2) scenes and first views.
        steps: budget T.
        seed: of the policy's randomness.
        scores: compare what hypotheses are ranked by (``rank_by``); otherwise clustering with none.
    """
    deployed = BestViewLookup(bank)
    views = run_named(deployed, policy, starts, steps, seed=seed).views
    if scores:
        variants = tuple((each, BestViewLookup(bank, FusionParameters(rank_by=each))) for each in RANKINGS)
    else:
        alone = FusionParameters(cut=deployed.parameters.cut, exclusion=0.0)
        separate = FusionParameters(cut=1e-9, exclusion=0.0)
        variants = (
            ("clustering and exclusion", deployed),
            ("clustering alone", BestViewLookup(bank, alone)),
            ("no clustering", BestViewLookup(bank, separate)),
        )
    intervals, first = Intervals(starts[:, 0], seed), None
    for name, lookup in variants:
        measures = _score_views(lookup, starts[:, 0], views)
        yield {"variant": name, **describe(measures, intervals, first)}
        first = first or measures


def _score_views(lookup: SceneLookup, scene: np.ndarray, views: np.ndarray) -> dict[str, np.ndarray]:
    """What (E, v) views amount to under a look-up's fusion, episode by episode."""
    fused = lookup.fuse(scene, views, views[np.arange(len(views)), (views >= 0).sum(axis=1) - 1])
    counts = lookup.object_count[scene]
    columns: dict[str, list[float]] = {"detection_rate": [], "e_add_mm": [], "detection_rate_at_n": [], "reported": []}
    for rows, count, whole in zip(fused.objects, counts, lookup.evaluate(fused, scene), strict=True):
        rows = rows[rows >= 0]
        first = score_errors(lookup.errors[rows[:count], :count], lookup.model.diameter)
        measured = (whole.detection_rate, whole.mean_e_add_mm, first.detection_rate, len(rows) / count)
        for column, value in zip(columns.values(), measured, strict=True):
            column.append(value)
    return {name: np.array(column) for name, column in columns.items()}


def training_variants(
    part: str, steps: int, total: int, seed: int
) -> dict[str, tuple[PpoParameters, RewardParameters]]:
    """What :func:`ablate_training` takes, for each of the ablations of the paper's training.

    Args:
        part: "alpha", the weight of getting closer in the reward; "attention", learned or by a rule; or "signs", the
            reward's signs, inverted or as the paper prints them.
        steps: moves T of an episode.
        total: environment steps of each training.
        seed: of the trainings.
    """
    parameters = PpoParameters(steps=steps, total=total, rollout=4 * steps, seed=seed)
    if part == "alpha":
        return {str(alpha): (parameters, RewardParameters(alpha=alpha)) for alpha in ALPHAS}
    if part == "signs":
        signs = {"inverted": False, "as printed": True}
        return {name: (parameters, RewardParameters(as_printed=printed)) for name, printed in signs.items()}
    return {rule: (replace(parameters, attend=rule), RewardParameters()) for rule in ATTENTION_RULES}


def ablate_training(
    banks: dict[str, SceneLookup],
    variants: dict[str, tuple[PpoParameters, RewardParameters]],
    folder: Path,
    starts: np.ndarray,
    *,
    seed: int = 0,
    on_progress: Callable[[str, int], None] = lambda name, steps: None,
) -> Iterator[dict[str, Any]]:
    """Train the paper's policy in several variants and evaluate each; every row is compared with the first one.

    A training is known by what is varied, not by its name: one that an earlier call, perhaps of another ablation, has
    taken to the same length is not repeated.

    Args:
        banks: look-ups of ``train``, ``val`` and ``test``.
        variants: name to how it is trained and rewarded.
        folder: of the trainings, one folder each.
        starts: (E, 2) test scenes and first views.
        seed: of the evaluation.
        on_progress: called with the variant and its environment steps so far.
    """
    intervals, first = Intervals(starts[:, 0], seed), None
    for name, (parameters, reward) in variants.items():
        own = folder / f"{parameters.attend}_alpha{reward.alpha:g}{'_as_printed' * reward.as_printed}"
        resume = (own / "latest.json").is_file()
        for progress in train_ppo(banks["train"], banks["val"], own, parameters, reward, resume=resume):
            on_progress(name, progress.steps)
        weights = {"weights": str(own / "best.safetensors")}
        results = run_named(banks["test"], "attention", starts, parameters.steps, parameters=weights)
        yield {"variant": name, **describe(results.measures, intervals, first)}
        first = first or results.measures
