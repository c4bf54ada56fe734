"""``active6d ablate PART``: the paper's figures, and what else a policy owes to its parts."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_tools.cli.bank import Banks
from active6d_tools.cli.evaluate import Sample
from active6d_tools.cli.output import JsonFile, ObjectName, Seed, console, messages, progress_bar, write_json

if TYPE_CHECKING:
    from active6d_agent.bank.batched_fusion import BatchedFusion
    from active6d_tools.report.line_plots import Panel


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


_TRAINED = (Part.ALPHA, Part.ATTENTION, Part.SIGNS)
#: Seed of the noise in the second bank of ``noise-resampling``.
_AGAIN = 1
#: Trainings of each learned policy that ``seeds`` compares.
_SEEDS = 3
_OUT = "Folder of the trainings; the cache's."


def ablate(
    part: Annotated[Part, typer.Argument(help="What is varied or left out.")],
    object_name: ObjectName = "mug",
    policies: Annotated[
        str, typer.Option(help="Whose views; verification and fusion use the first one only.")
    ] = "random,max-distance,unidirectional,lowest-score",
    steps: Annotated[int, typer.Option(min=1, help="Budget of moves T, where it is not varied.")] = 5,
    length: Annotated[
        int, typer.Option(min=1, help="Environment steps of each training (alpha, attention, signs).")
    ] = 200_000,
    sample: Sample = 200,
    override: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="POLICY.NAME=VALUE", help="A policy's parameter; repeatable."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help=_OUT)] = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the figure into this PNG.")] = None,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Measure what a part is worth, as in the paper's figures.

    alpha: the weight of getting closer in the reward. steps: the number of moves. attention: the learned one against
    the lowest score. verification: its score against the estimator's. fusion: with clustering and without. signs: the
    reward's, turned round and as the paper prints them. planning: what the default policy weighs, without training.
    noise-resampling: the same views with other sensor noise, from a second bank (active6d bank --split test --seed 1).
    seeds: three trainings of both learned policies, made where they are missing.

    Example: [bold]active6d ablate steps --object mug --json steps.json --png steps.png[/bold]
    """
    from active6d_agent.bank.batched_fusion import BatchedFusion
    from active6d_agent.bank.scene_bank import load_bank
    from active6d_agent.evaluation.policy_evaluation import all_starts
    from active6d_tools.cli.episode import parse_overrides
    from active6d_tools.report.line_plots import draw_panels

    paths = _find_banks(part, object_name, banks)
    parameters = parse_overrides(override or [])
    if part is Part.SEEDS:
        weights = _train_seeds(object_name, out, steps, banks)
    with messages.status("reading the banks"):
        lookups = {split: BatchedFusion(load_bank(path)) for split, path in paths.items()}
    starts = all_starts(lookups["test"], sample, seed)
    names = [name.strip() for name in policies.split(",")]
    if part in _TRAINED:
        rows = _train_variants(part, lookups, _folder(out, object_name), steps, length, starts, seed)
    elif part is Part.STEPS:
        rows = _vary_steps(lookups["test"], names, starts, seed, parameters)
    elif part is Part.PLANNING:
        rows = _vary_planning(lookups["test"], starts, steps, seed, parameters)
    elif part is Part.NOISE_RESAMPLING:
        rows = _try_other_noise(lookups["test"], lookups["again"], names, starts, steps, seed, parameters)
    elif part is Part.SEEDS:
        rows = _compare_seeds(lookups, weights, starts, steps, sample, seed)
    else:
        rows = _vary_fusion(part, lookups["test"], names[0], starts, steps, seed)
    _print(rows, f"{part.value}, {object_name}, {len(starts)} episodes")
    if png is not None:
        draw_panels(png, f"{part.value}, {object_name}", _panels(part, rows))
        messages.print(f"wrote {png}", highlight=False)
    common = {"object": object_name, "part": part.value, "steps": steps, "episodes": len(starts), "seed": seed}
    write_json(json_file, {**common, "bank": lookups["test"].bank.provenance, "rows": rows})


def _find_banks(part: Part, object_name: str, folder: Path | None) -> dict[str, Path]:
    """The banks of the splits that a part needs, and the test scenes' second one as ``again``."""
    from active6d_agent.bank.scene_bank import find_bank

    splits = {Part.SEEDS: ("val", "test"), **dict.fromkeys(_TRAINED, ("train", "val", "test"))}.get(part, ("test",))
    paths = {split: find_bank(object_name, split, folder) for split in splits}
    return paths | ({"again": find_bank(object_name, "test", folder, _AGAIN)} if part is Part.NOISE_RESAMPLING else {})


def _folder(out: Path | None, object_name: str) -> Path:
    from active6d_agent.bank.scene_bank import cached_banks

    return (out or cached_banks().parent / "ablations") / object_name


def _train_variants(
    part: Part, lookups: dict[str, "BatchedFusion"], folder: Path, steps: int, length: int, starts: Any, seed: int
) -> list[dict]:
    from active6d_agent.environment.gym_environment import RewardParameters
    from active6d_agent.evaluation.ablations import ALPHAS, ablate_training
    from active6d_agent.policies.attention.network import ATTENTION_RULES
    from active6d_agent.policies.attention.ppo import PpoParameters

    common = {"steps": steps, "total": length, "rollout": 4 * steps, "seed": seed}
    if part is Part.ALPHA:
        variants = {str(alpha): (PpoParameters(**common), RewardParameters(alpha=alpha)) for alpha in ALPHAS}
    elif part is Part.SIGNS:
        signs = {"turned round": RewardParameters(), "as printed": RewardParameters(as_printed=True)}
        variants = {name: (PpoParameters(**common), reward) for name, reward in signs.items()}
    else:
        variants = {rule: (PpoParameters(**common, attend=rule), RewardParameters()) for rule in ATTENTION_RULES}
    with progress_bar() as bar:
        order = {name: length * index for index, name in enumerate(variants)}
        task = bar.add_task("training", total=length * len(variants))
        made = ablate_training(
            lookups,
            variants,
            folder,
            starts,
            seed=seed,
            on_progress=lambda name, done: bar.update(task, description=name, completed=order[name] + done),
        )
        return [{"variant": name, **row} for name, row in made]


def _vary_steps(
    lookup: "BatchedFusion", names: list[str], starts: Any, seed: int, parameters: dict[str, dict]
) -> list[dict]:
    from active6d_agent.evaluation.ablations import STEPS, ablate_steps
    from active6d_tools.cli.evaluate import usable_policies

    usable_policies(",".join(names), lookup.bank, parameters)
    rows = []
    with progress_bar() as bar:
        task = bar.add_task("moving", total=len(names) * sum(STEPS))
        for name, budget, row in ablate_steps(lookup, names, starts, STEPS, seed=seed, parameters=parameters):
            rows.append({"variant": name, "budget": budget, **row})
            bar.update(task, advance=budget, description=f"{name}, T = {budget}")
    return rows


def _vary_planning(
    lookup: "BatchedFusion", starts: Any, steps: int, seed: int, parameters: dict[str, dict]
) -> list[dict]:
    from active6d_agent.evaluation.ablations import PLANNING, ablate_planning
    from active6d_tools.cli.evaluate import usable_policies

    usable_policies("view-attention", lookup.bank, parameters)
    rows = []
    with progress_bar() as bar:
        task = bar.add_task("planning", total=2 + sum(map(len, PLANNING.values())))
        own = parameters.get("view-attention")
        for name, value, row in ablate_planning(lookup, starts, steps, seed=seed, parameters=own):
            variant = name if value is None else f"{name} {value:g}"
            rows.append({"variant": variant, "parameter": name, "value": value, **row})
            bar.update(task, advance=1, description=variant)
    return rows


def _try_other_noise(
    lookup: "BatchedFusion",
    again: "BatchedFusion",
    names: list[str],
    starts: Any,
    steps: int,
    seed: int,
    parameters: dict[str, dict],
) -> list[dict]:
    from active6d_agent.evaluation.noise_resampling import ablate_noise_resampling
    from active6d_tools.cli.evaluate import usable_policies

    usable_policies(",".join(names), lookup.bank, parameters)
    rows = []
    with progress_bar() as bar:
        task = bar.add_task("noise-resampling", total=len({*names, "random", "oracle"}))
        for name, noise, row in ablate_noise_resampling(
            (lookup, again), names, starts, steps, seed=seed, parameters=parameters
        ):
            rows.append({"variant": f"{name}, {noise} noise", "policy": name, "noise": noise, **row})
            bar.update(task, completed=len({row["policy"] for row in rows}), description=rows[-1]["variant"])
    return rows


def _train_seeds(object_name: str, out: Path | None, steps: int, banks: Path | None) -> dict[tuple[str, int], Path]:
    """Weights of every learned policy and seed; trains, as ``active6d train policy`` does, those that are not there."""
    from active6d_agent.bank.scene_bank import cached_banks
    from active6d_tools.cli.policy_training import LEARNED, policy

    folder = (out or cached_banks().parent / "policies") / object_name
    found = {(name, seed): folder / name / f"seed{seed}" for name in LEARNED for seed in range(_SEEDS)}
    for (name, seed), own in found.items():
        if not (own / "best.safetensors").is_file():
            policy(object_name, name, steps, out=own, banks=banks, seed=seed)
    return {key: own / "best.safetensors" for key, own in found.items()}


def _compare_seeds(
    lookups: dict[str, "BatchedFusion"],
    weights: dict[tuple[str, int], Path],
    starts: Any,
    steps: int,
    sample: int | None,
    seed: int,
) -> list[dict]:
    """Test figures of every training, its minutes, and which one is best on the same validation starts."""
    import json

    from active6d_agent.evaluation.policy_evaluation import Intervals, all_starts, describe, run_named
    from active6d_agent.policies.registry import weights_path

    validation, intervals, rows = all_starts(lookups["val"], sample, seed), Intervals(starts[:, 0], seed), []
    with progress_bar() as bar:
        for (name, number), path in bar.track(weights.items(), description="evaluating"):
            own = {"weights": str(path)}
            chosen_on = run_named(lookups["val"], name, validation, steps, parameters=own)
            results = run_named(lookups["test"], name, starts, steps, parameters=own)
            shipped = weights_path(name, lookups["test"].model.name)
            curve = (path.parent / "curve.jsonl").read_text().splitlines()
            rows.append(
                {
                    "variant": f"{name}, seed {number}",
                    "policy": name,
                    "training_seed": number,
                    "training_minutes": json.loads(curve[-1])["seconds"] / 60,
                    "validation_detection_rate": float(chosen_on.detection_rate.mean()),
                    "validation_e_add_mm": float(chosen_on.e_add_mm.mean()),
                    "shipped": shipped.is_file() and shipped.read_bytes() == path.read_bytes(),
                    **describe(results.measures, intervals),
                }
            )
    for name in dict.fromkeys(row["policy"] for row in rows):
        own = [row for row in rows if row["policy"] == name]
        best = max(own, key=lambda row: (row["validation_detection_rate"], -row["validation_e_add_mm"]))
        for row in own:
            row["best_on_validation"] = row is best
    return rows


def _vary_fusion(part: Part, lookup: "BatchedFusion", name: str, starts: Any, steps: int, seed: int) -> list[dict]:
    from active6d_agent.evaluation.ablations import ablate_fusion

    scores = part is Part.VERIFICATION
    with messages.status(f"fusing the views of {name}"):
        made = ablate_fusion(lookup.bank, name, starts, steps, seed=seed, scores=scores)
        return [{"variant": variant, **row} for variant, row in made]


def _print(rows: list[dict], title: str) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, title=title)
    hidden = ("against_first", "parameter", "value", "policy", "training_seed", "noise")
    columns = [key for key in rows[0] if "_ci95" not in key and key not in hidden]
    for column in columns:
        table.add_column(column.replace("_", " "), justify="left" if column == "variant" else "right")
    for row in rows:
        table.add_row(*(f"{row[key]:.3f}" if isinstance(row[key], float) else str(row[key]) for key in columns))
    console.print(table)


def _panels(part: Part, rows: list[dict]) -> list["Panel"]:
    """Detection rate and e_ADD, and a third measure, over what is varied; around them the interval over scenes."""
    from active6d_tools.report.line_plots import Panel

    if part is Part.PLANNING:
        return _trade_offs(rows)
    reported = ("reported", "hypotheses an object")
    share = ("gap_closed", "share of the gap on own noise")
    third = {Part.FUSION: reported, Part.VERIFICATION: reported, Part.NOISE_RESAMPLING: share}.get(
        part, ("distance_m", "d [m]")
    )
    line, x, x_label = {
        Part.STEPS: ("variant", "budget", "T"),
        Part.SEEDS: ("policy", "training_seed", "seed of the training"),
        Part.NOISE_RESAMPLING: ("noise", "policy", "views chosen by"),
    }.get(part, (None, "variant", part.value))
    panels = []
    for key, label in (("detection_rate", "detection rate"), ("e_add_mm", "e_ADD [mm]"), third):
        lines: dict[str, tuple] = {}
        for name in dict.fromkeys(row.get(line, label) for row in rows):
            own = [row for row in rows if row.get(line, label) == name]
            interval = list(zip(*(row[f"{key}_ci95_scenes"] for row in own), strict=True))
            # As text, so that few views have as much room as many.
            lines[name] = ([str(row[x]) for row in own], [row[key] for row in own], interval)
        panels.append(Panel(x_label, label, lines))
    return panels


def _trade_offs(rows: list[dict]) -> list["Panel"]:
    """What metres and moves buy."""
    from active6d_tools.report.line_plots import Panel

    panels = []
    everything = ("metres_weight", "stop_below", "as shipped", "random")
    for x, x_label, y, y_label, names in (
        ("distance_m", "d [m]", "detection_rate", "detection rate", everything),
        ("distance_m", "d [m]", "e_add_mm", "e_ADD [mm]", everything),
        ("moves", "moves taken", "detection_rate", "detection rate", everything[1:]),
    ):
        lines = {}
        for name in names:
            own = [row for row in rows if row["parameter"] == name]
            lines[name] = ([row[x] for row in own], [row[y] for row in own])
        panels.append(Panel(x_label, y_label, lines))
    return panels
