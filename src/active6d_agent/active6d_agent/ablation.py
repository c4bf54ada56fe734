"""The paper's ablations on scene banks: what each part is worth, measured by leaving it out or turning it up."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from active6d_agent.bank import SceneBank
from active6d_agent.environment import RewardParameters
from active6d_agent.evaluation import EpisodeResults, bootstrap_interval, run_named
from active6d_agent.lookup import BankLookup
from active6d_agent.train import TrainingParameters, train_policy
from active6d_core.metrics import score_errors
from active6d_perception.fusion import RANKINGS, FusionParameters

ALPHAS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
#: T of the paper's figure, from the single shot to all views.
STEPS = (0, 1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 99)
_MEASURED = ("detection_rate", "e_add_mm", "distance_m")


def describe(results: EpisodeResults, seed: int = 0) -> dict:
    """Means with 95 % intervals."""
    row: dict = {}
    for name in _MEASURED:
        values = getattr(results, name)
        row[name] = float(values.mean())
        row[f"{name}_ci95"] = bootstrap_interval(values, np.random.default_rng(seed))
    return row


def ablate_steps(
    lookup: BankLookup, names: Sequence[str], starts: np.ndarray, steps: Sequence[int] = STEPS, *, seed: int = 0
) -> Iterator[tuple[str, int, dict]]:
    """Policies with budgets from the single view to all views; yields name, T and what it achieved.

    Args:
        lookup: of the bank.
        names: of policies.
        starts: (E, 2) scenes and first views.
        steps: budgets T; those beyond the grid are left out.
        seed: of the policies' randomness.
    """
    for name in names:
        for budget in steps:
            if budget < len(lookup.sphere):
                yield name, budget, describe(run_named(lookup, name, starts, budget, seed=seed), seed)


def ablate_fusion(
    bank: SceneBank, policy: str, starts: np.ndarray, steps: int, *, seed: int = 0, scores: bool = False
) -> Iterator[tuple[str, dict]]:
    """The deployed fusion, and without one of its parts; yields the variant's name and what it achieved.

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
        scores: compare what hypotheses are ranked by; otherwise clustering with none.
    """
    deployed = BankLookup(bank)
    views = run_named(deployed, policy, starts, steps, seed=seed).views
    if scores:
        names = {"confidence": "both", "verification": "verification score", "score": "estimator's score"}
        variants = tuple((names[each], BankLookup(bank, FusionParameters(rank_by=each))) for each in RANKINGS)
    else:
        alone = FusionParameters(cut=deployed.parameters.cut, exclusion=0.0)
        separate = FusionParameters(cut=1e-9, exclusion=0.0)
        variants = (
            ("clustering and exclusion", deployed),
            ("clustering alone", BankLookup(bank, alone)),
            ("no clustering", BankLookup(bank, separate)),
        )
    for name, lookup in variants:
        yield name, _score_views(lookup, starts[:, 0], views, seed)


def _score_views(lookup: BankLookup, scene: np.ndarray, views: np.ndarray, seed: int) -> dict:
    """What (E, v) views amount to under a look-up's fusion."""
    fused = lookup.fuse(scene, views, views[np.arange(len(views)), (views >= 0).sum(axis=1) - 1])
    counts = lookup.object_count[scene]
    columns: dict[str, list[float]] = {"detection_rate": [], "e_add_mm": [], "detection_rate_at_n": [], "reported": []}
    for rows, count, whole in zip(fused.objects, counts, lookup.evaluate(fused, scene), strict=True):
        rows = rows[rows >= 0]
        first = score_errors(lookup.errors[rows[:count], :count], lookup.model.diameter)
        measured = (whole.detection_rate, whole.mean_e_add_mm, first.detection_rate, len(rows) / count)
        for column, value in zip(columns.values(), measured, strict=True):
            column.append(value)
    row: dict = {}
    for name, column in columns.items():
        row[name] = float(np.mean(column))
        row[f"{name}_ci95"] = bootstrap_interval(np.array(column), np.random.default_rng(seed))
    return row


def ablate_training(
    banks: dict[str, BankLookup],
    variants: dict[str, tuple[TrainingParameters, RewardParameters]],
    folder: Path,
    starts: np.ndarray,
    *,
    seed: int = 0,
    on_progress: Callable[[str, int], None] = lambda name, steps: None,
) -> Iterator[tuple[str, dict]]:
    """Train the paper's policy in several variants and evaluate each; yields the variant's name and what it achieved.

    A variant that an earlier call has trained to the same length is not trained again.

    Args:
        banks: look-ups of ``train``, ``val`` and ``test``.
        variants: name to how it is trained and rewarded.
        folder: of the trainings, one folder each.
        starts: (E, 2) test scenes and first views.
        seed: of the evaluation.
        on_progress: called with the variant and its environment steps so far.
    """
    for name, (parameters, reward) in variants.items():
        own = folder / name
        resume = (own / "latest.json").is_file()
        for progress in train_policy(banks["train"], banks["val"], own, parameters, reward, resume=resume):
            on_progress(name, progress.steps)
        weights = {"weights": str(own / "best.safetensors")}
        yield name, describe(run_named(banks["test"], "attention", starts, parameters.steps, parameters=weights), seed)
