"""``active6d ablate alpha|steps|attention|verification|fusion``: the paper's figures."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_bringup.cli.bank import Banks
from active6d_bringup.cli.evaluate import Sample
from active6d_bringup.cli.output import JsonFile, ObjectName, Seed, console, messages, progress_bar, write_json

if TYPE_CHECKING:
    from active6d_agent.lookup import BankLookup
    from active6d_bringup.report.lines import Panel


class Part(StrEnum):
    """What is varied."""

    ALPHA = "alpha"
    STEPS = "steps"
    ATTENTION = "attention"
    VERIFICATION = "verification"
    FUSION = "fusion"


def ablate(
    part: Annotated[Part, typer.Argument(help="What is varied or left out.")],
    object_name: ObjectName = "mug",
    policies: Annotated[
        str, typer.Option(help="Whose views: several for steps, the first of them for verification and fusion.")
    ] = "random,max-distance,lowest-score",
    steps: Annotated[int, typer.Option(min=1, help="Budget of moves T, where it is not varied.")] = 5,
    length: Annotated[
        int, typer.Option(min=1, help="Environment steps of each training (alpha, attention).")
    ] = 200_000,
    sample: Sample = 200,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of the trainings; the cache's.")] = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the figure into this PNG.")] = None,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Measure what a part is worth, as in the paper's figures.

    alpha: the weight of getting closer in the reward. steps: the number of moves. attention: the learned one against
    the lowest score. verification: its score against the estimator's. fusion: with clustering and without.

    Example: [bold]active6d ablate steps --object mug --json steps.json --png steps.png[/bold]
    """
    from active6d_agent.bank import find_bank, load_bank
    from active6d_agent.evaluation import all_starts
    from active6d_agent.lookup import BankLookup
    from active6d_bringup.report.lines import draw_panels

    trained = part in (Part.ALPHA, Part.ATTENTION)
    splits = ("train", "val", "test") if trained else ("test",)
    paths = {split: find_bank(object_name, split, banks) for split in splits}
    with messages.status("reading the banks"):
        lookups = {split: BankLookup(load_bank(path)) for split, path in paths.items()}
    starts = all_starts(lookups["test"], sample, seed)
    names = [name.strip() for name in policies.split(",")]
    if trained:
        rows = _train_variants(part, lookups, _folder(out, object_name, part), steps, length, starts, seed)
    elif part is Part.STEPS:
        rows = _vary_steps(lookups["test"], names, starts, seed)
    else:
        rows = _vary_fusion(part, lookups["test"], names[0], starts, steps, seed)
    _print(rows, f"{part.value}, {object_name}, {len(starts)} episodes")
    if png is not None:
        draw_panels(png, f"{part.value}, {object_name}", _panels(part, rows))
        messages.print(f"wrote {png}", highlight=False)
    bank = lookups["test"].bank.provenance
    common = {"object": object_name, "part": part.value, "steps": steps, "episodes": len(starts), "seed": seed}
    write_json(json_file, {**common, "bank": bank, "rows": rows})


def _folder(out: Path | None, object_name: str, part: Part) -> Path:
    from active6d_agent.bank import cached_banks

    return (out or cached_banks().parent / "ablations") / object_name / part.value


def _train_variants(
    part: Part, lookups: dict[str, "BankLookup"], folder: Path, steps: int, length: int, starts: Any, seed: int
) -> list[dict]:
    from active6d_agent.ablation import ALPHAS, ablate_training
    from active6d_agent.attention import ATTENTION_RULES
    from active6d_agent.environment import RewardParameters
    from active6d_agent.train import TrainingParameters

    common = {"steps": steps, "total": length, "rollout": 4 * steps, "seed": seed}
    if part is Part.ALPHA:
        variants = {str(alpha): (TrainingParameters(**common), RewardParameters(alpha=alpha)) for alpha in ALPHAS}
    else:
        variants = {rule: (TrainingParameters(**common, attend=rule), RewardParameters()) for rule in ATTENTION_RULES}
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


def _vary_steps(lookup: "BankLookup", names: list[str], starts: Any, seed: int) -> list[dict]:
    from active6d_agent.ablation import STEPS, ablate_steps
    from active6d_bringup.cli.evaluate import usable_policies

    usable_policies(",".join(names), lookup.bank, {})
    rows = []
    with progress_bar() as bar:
        task = bar.add_task("moving", total=len(names) * sum(STEPS))
        for name, budget, row in ablate_steps(lookup, names, starts, STEPS, seed=seed):
            rows.append({"variant": name, "budget": budget, **row})
            bar.update(task, advance=budget, description=f"{name}, T = {budget}")
    return rows


def _vary_fusion(part: Part, lookup: "BankLookup", name: str, starts: Any, steps: int, seed: int) -> list[dict]:
    from active6d_agent.ablation import ablate_fusion

    scores = part is Part.VERIFICATION
    with messages.status(f"fusing the views of {name}"):
        made = ablate_fusion(lookup.bank, name, starts, steps, seed=seed, scores=scores)
        return [{"variant": variant, **row} for variant, row in made]


def _print(rows: list[dict], title: str) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, title=title)
    columns = [key for key in rows[0] if not key.endswith("_ci95")]
    for column in columns:
        table.add_column(column.replace("_", " "), justify="left" if column == "variant" else "right")
    for row in rows:
        table.add_row(*(f"{row[key]:.3f}" if isinstance(row[key], float) else str(row[key]) for key in columns))
    console.print(table)


def _panels(part: Part, rows: list[dict]) -> list["Panel"]:
    """Detection rate and e_ADD, and a third measure, over what is varied."""
    from active6d_bringup.report.lines import Panel

    third = ("reported", "hypotheses an object") if "reported" in rows[0] else ("distance_m", "d [m]")
    panels = []
    for key, label in (("detection_rate", "detection rate"), ("e_add_mm", "e_ADD [mm]"), third):
        lines: dict[str, tuple] = {}
        for variant in dict.fromkeys(row["variant"] for row in rows) if part is Part.STEPS else (label,):
            own = [row for row in rows if part is not Part.STEPS or row["variant"] == variant]
            x = [row["budget"] if part is Part.STEPS else row["variant"] for row in own]
            interval = list(zip(*(row[f"{key}_ci95"] for row in own), strict=True))
            lines[variant] = (x, [row[key] for row in own], interval)
        panels.append(Panel("T" if part is Part.STEPS else part.value, label, lines))
    return panels
