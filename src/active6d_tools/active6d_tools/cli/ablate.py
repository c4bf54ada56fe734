"""``active6d ablate PART``: the paper's ablations, and ablations of the default policy."""

from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_tools.cli.options import (
    LEARNED,
    PAPER,
    Banks,
    Imports,
    JsonFile,
    ObjectName,
    PolicyParameters,
    Sample,
    Seed,
    parse_overrides,
    usable_policies,
)
from active6d_tools.cli.output import write_json
from active6d_tools.cli.progress import collect_rows, follow_training
from active6d_tools.cli.terminal import messages, print_table, progress_bar

if TYPE_CHECKING:
    import numpy as np

    from active6d_agent.bank.scene_lookup import SceneLookup


class Part(StrEnum):
    """What is varied."""

    ALPHA = "alpha"
    STEPS = "steps"
    ATTENTION = "attention"
    VERIFICATION = "verification"
    FUSION = "fusion"
    SIGNS = "signs"
    PLANNING = "planning"
    NOISE_RESAMPLING = "noise-resampling"
    SEEDS = "seeds"
    PAPER = "paper"


_TRAINED = (Part.ALPHA, Part.ATTENTION, Part.SIGNS)
#: Seed of the noise in the second bank of ``noise-resampling``.
_AGAIN = 1
_OUT = "Folder of the trainings; by default in the cache folder."
_POLICIES = "Policies that choose the views: {policies}; verification and fusion use only the first one."


def ablate(
    part: Annotated[Part, typer.Argument(help="What is varied or left out.")],
    object_name: ObjectName = "mug",
    policies: Annotated[str, typer.Option(help=_POLICIES)] = "random,max-distance,unidirectional,lowest-score",
    steps: Annotated[int, typer.Option(min=1, help="Budget of moves T, where it is not varied.")] = 5,
    length: Annotated[
        int, typer.Option(min=1, help="Environment steps of each training (alpha, attention, signs).")
    ] = 200_000,
    seeds: Annotated[int, typer.Option(min=1, help="Number of trainings of each policy (seeds, paper).")] = 3,
    sample: Sample = 200,
    override: PolicyParameters = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help=_OUT)] = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the figure to this PNG file.")] = None,
    imports: Imports = None,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Vary one part of the method or leave it out, and evaluate the policies, as in the paper's figures.

    [bold]alpha[/bold]: weight of getting closer in the reward. [bold]steps[/bold]: number of moves.
    [bold]attention[/bold]: learned attention against the lowest score. [bold]verification[/bold]: ranking by
    verification score against the estimator's score. [bold]fusion[/bold]: with clustering and without.
    [bold]signs[/bold]: signs of the reward, inverted and as the paper prints them. [bold]planning[/bold]: parameters
    of the default policy, without training. [bold]noise-resampling[/bold]: the same views with other sensor noise,
    from a second bank (active6d bank --split test --seed 1). [bold]seeds[/bold]: trainings of the learned policies
    among --policies, else of both. [bold]paper[/bold]: trainings in the paper's length, for hours. Missing trainings
    start, begun ones go on.

    Example: [bold]active6d ablate steps --object mug --json steps.json --png steps.png[/bold]
    """
    from active6d_agent.bank.all_views_lookup import make_lookup
    from active6d_agent.bank.best_view_lookup import BestViewLookup
    from active6d_agent.bank.scene_bank import load_bank
    from active6d_agent.evaluation.policy_evaluation import all_starts
    from active6d_tools.report.ablation_plots import ablation_panels
    from active6d_tools.report.line_plots import draw_panels

    paths = _find_banks(part, object_name, banks)
    parameters = parse_overrides(override or [])
    with messages.status("reading the banks"):
        # Candidates of all views cannot be joined from two banks of one scene.
        make = BestViewLookup if part is Part.NOISE_RESAMPLING else make_lookup
        lookups = {split: make(load_bank(path)) for split, path in paths.items()}
    starts = all_starts(lookups["test"], sample, seed)
    names = [name.strip() for name in policies.split(",")]
    if part in _TRAINED:
        rows = _train_variants(part, lookups, _folder(out, "ablations", object_name), steps, length, starts, seed)
    elif part in (Part.SEEDS, Part.PAPER):
        trained = (PAPER,) if part is Part.PAPER else tuple(name for name in LEARNED if name in names) or LEARNED
        weights = _train_seeds(trained, seeds, lookups["val"], _folder(out, "policies", object_name), steps, banks)
        rows = _compare_seeds(lookups, weights, starts, steps, sample, seed)
    else:
        rows = _evaluate_variants(part, lookups, names, starts, steps, seed, parameters)
    _print(rows, f"{part.value}, {object_name}, {len(starts)} episodes")
    if png is not None:
        draw_panels(png, f"{part.value}, {object_name}", ablation_panels(part.value, rows))
        messages.print(f"wrote {png}", highlight=False)
    common = {"object": object_name, "part": part.value, "steps": steps, "episodes": len(starts), "seed": seed}
    write_json(json_file, {**common, "bank": lookups["test"].bank.provenance, "rows": rows})


def _find_banks(part: Part, object_name: str, folder: Path | None) -> dict[str, Path]:
    """The banks of the splits that a part needs, and the test scenes' second one as ``again``."""
    from active6d_agent.bank.scene_bank import find_bank

    splits = {
        **dict.fromkeys((Part.SEEDS, Part.PAPER), ("val", "test")),
        **dict.fromkeys(_TRAINED, ("train", "val", "test")),
    }.get(part, ("test",))
    paths = {split: find_bank(object_name, split, folder) for split in splits}
    return paths | ({"again": find_bank(object_name, "test", folder, _AGAIN)} if part is Part.NOISE_RESAMPLING else {})


def _folder(out: Path | None, kind: str, object_name: str) -> Path:
    from active6d_core.files import cache_folder

    return (out or cache_folder(kind)) / object_name


def _train_variants(
    part: Part,
    lookups: dict[str, "SceneLookup"],
    folder: Path,
    steps: int,
    length: int,
    starts: "np.ndarray",
    seed: int,
) -> list[dict[str, Any]]:
    from active6d_agent.evaluation.ablations import ablate_training, training_variants

    variants = training_variants(part.value, steps, length, seed)
    before = {name: length * index for index, name in enumerate(variants)}
    with progress_bar() as bar:
        task = bar.add_task("training", total=length * len(variants))

        def on_progress(name: str, done: int) -> None:
            bar.update(task, description=name, completed=before[name] + done)

        return list(ablate_training(lookups, variants, folder, starts, seed=seed, on_progress=on_progress))


def _evaluate_variants(
    part: Part,
    lookups: dict[str, "SceneLookup"],
    names: list[str],
    starts: "np.ndarray",
    steps: int,
    seed: int,
    parameters: dict[str, dict[str, Any]],
) -> list[dict[str, Any]]:
    """The ablations without training."""
    from active6d_agent.evaluation.ablations import PLANNING, STEPS, ablate_fusion, ablate_planning, ablate_steps
    from active6d_agent.evaluation.noise_resampling import ablate_noise_resampling

    test, common = lookups["test"], {"seed": seed}
    rows: Iterator[dict[str, Any]]
    if part in (Part.FUSION, Part.VERIFICATION):
        rows = ablate_fusion(test.bank, names[0], starts, steps, scores=part is Part.VERIFICATION, **common)
        return collect_rows(rows, 3, f"fusing the views of {names[0]}")
    if part is Part.PLANNING:
        usable_policies("view-attention", test.bank, parameters)
        rows = ablate_planning(test, starts, steps, parameters=parameters.get("view-attention"), **common)
        return collect_rows(rows, 2 + sum(map(len, PLANNING.values())), "planning")
    usable_policies(",".join(names), test.bank, parameters)
    if part is Part.STEPS:
        rows = ablate_steps(test, names, starts, STEPS, parameters=parameters, **common)
        return collect_rows(rows, len(names) * sum(STEPS), "moving")
    rows = ablate_noise_resampling((test, lookups["again"]), names, starts, steps, parameters=parameters, **common)
    return collect_rows(rows, 2 * len({*names, "random", "oracle"}) + 1, "resampling the noise")


def _compare_seeds(
    lookups: dict[str, "SceneLookup"],
    weights: dict[tuple[str, int], Path],
    starts: "np.ndarray",
    steps: int,
    sample: int | None,
    seed: int,
) -> list[dict[str, Any]]:
    from active6d_agent.evaluation.training_seeds import compare_seeds, mark_best

    made = compare_seeds(lookups["val"], lookups["test"], weights, starts, steps, sample=sample, seed=seed)
    rows = collect_rows(made, len(weights), "evaluating")
    mark_best(rows)
    return rows


def _train_seeds(
    policies: Sequence[str], seeds: int, validation: "SceneLookup", folder: Path, steps: int, banks: Path | None
) -> dict[tuple[str, int], Path]:
    """Weights of every policy and seed; missing ones are trained as by ``active6d train policy``, begun ones go on."""
    from active6d_agent.bank.all_views_lookup import make_lookup
    from active6d_agent.bank.scene_bank import find_bank, load_bank
    from active6d_tools.policy_training import plan_training

    trainings = {}
    for name in policies:
        for seed in range(seeds):
            own = folder / name / f"seed{seed}"
            begun = (own / "latest.json").is_file()
            trainings[name, seed] = plan_training(name, own, steps=steps, seed=seed, resume=begun)
    missing = {key: training for key, training in trainings.items() if not training.is_complete()}
    if missing:
        train = make_lookup(load_bank(find_bank(validation.model.name, "train", banks)))
        for (name, seed), training in missing.items():
            follow_training(training, [train, validation], f"{name}, {validation.model.name}, seed {seed}")
    return {key: training.best for key, training in trainings.items()}


def _print(rows: list[dict[str, Any]], title: str) -> None:
    hidden = ("against_first", "parameter", "value", "policy", "training_seed", "noise")
    columns = [key for key in rows[0] if "_ci95" not in key and key not in hidden]
    cells = [[f"{row[key]:.3f}" if isinstance(row[key], float) else str(row[key]) for key in columns] for row in rows]
    print_table([column.replace("_", " ") for column in columns], cells, title=title)
