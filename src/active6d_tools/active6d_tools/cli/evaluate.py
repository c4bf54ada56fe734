"""``active6d evaluate``: policies on a scene bank, as in the paper's Table 1."""

from pathlib import Path
from typing import Annotated, Any

import typer

from active6d_core.files import write_file
from active6d_tools.cli.options import (
    Banks,
    Imports,
    JsonFile,
    ObjectName,
    PolicyParameters,
    Sample,
    Seed,
    Split,
    parse_overrides,
    recorded_policies,
    usable_policies,
)
from active6d_tools.cli.output import write_json
from active6d_tools.cli.terminal import messages, print_table, progress_bar, work_progress

#: A second table compares this policy with the others.
_DEFAULT = "view-attention"
Policies = Annotated[
    str,
    typer.Option(
        help="Names separated by commas: {policies}; and the bounds oracle and all-views. The word all stands for "
        "these without attention-paper and sb3."
    ),
]


def evaluate(
    object_name: ObjectName = "mug",
    policies: Policies = "all",
    steps: Annotated[int, typer.Option(min=1, help="Budget of moves T; T moves give T + 1 views.")] = 5,
    split: Split = "test",
    sample: Sample = None,
    bop: Annotated[
        Path | None,
        typer.Option("--bop", metavar="DIR", help="Recorded scenes in BOP's format in place of a bank."),
    ] = None,
    object_id: Annotated[int | None, typer.Option(min=1, help="BOP object id of the object, with --bop.")] = None,
    estimator: Annotated[str, typer.Option(help="Estimator for each recorded image: auto, {estimators}.")] = "auto",
    first_views: Annotated[
        int, typer.Option("--starts", min=1, help="First views per recorded scene, with --bop.")
    ] = 5,
    csv: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write a BOP results file for each policy, with --bop.")
    ] = None,
    override: PolicyParameters = None,
    imports: Imports = None,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Evaluate policies from the same scenes and start views: detection rate, ADD and distance, with 95 % intervals.

    Example: [bold]active6d evaluate --object mug --policies all --steps 5 --json mug.json[/bold]
    """
    parameters = parse_overrides(override or [])
    if bop is not None:
        settings = {"steps": steps, "seed": seed, "object_id": object_id, "starts": first_views, "estimator": estimator}
        _evaluate_recorded(bop, object_name, policies, parameters, settings, csv, json_file)
    else:
        _evaluate_bank(object_name, policies, steps, split, sample, parameters, banks, seed, json_file)


def _evaluate_bank(
    object_name: str,
    policies: str,
    steps: int,
    split: str,
    sample: int | None,
    parameters: dict[str, dict[str, Any]],
    banks: Path | None,
    seed: int,
    json_file: Path | None,
) -> None:
    from active6d_agent.bank.all_views_lookup import make_lookup
    from active6d_agent.bank.scene_bank import find_bank, load_bank
    from active6d_agent.evaluation.policy_evaluation import all_starts, summarise
    from active6d_agent.evaluation.policy_evaluation import evaluate as run_all
    from active6d_sim.scenes.scene_store import SPLITS

    if split not in SPLITS:
        raise ValueError(f"--split '{split}' is not among {', '.join(SPLITS)}")
    bank = load_bank(find_bank(object_name, split, banks))
    if steps >= len(bank.sphere):
        raise ValueError(f"--steps {steps}: the grid of {len(bank.sphere)} views leaves {len(bank.sphere) - 1} moves")
    names = usable_policies(policies, bank, parameters)
    with messages.status("reading the bank"):
        lookup = make_lookup(bank)
    starts = all_starts(lookup, sample, seed)
    with progress_bar() as progress:
        task = progress.add_task("evaluating", total=len(names) * len(starts))

        def on_progress(name: str, episodes: int) -> None:
            progress.update(task, description=name, advance=episodes)

        running = run_all(lookup, names, steps, starts, seed=seed, parameters=parameters, on_progress=on_progress)
        results = dict(running)
    summary = summarise(results, object_name, steps, seed)
    _print_policies(summary)
    if _DEFAULT in results and len(results) > 1:
        _print_differences(summary)
    provenance = {"split": split, "seed": seed, "bank": bank.provenance, "parameters": parameters}
    write_json(json_file, {**summary, **provenance})


def _evaluate_recorded(
    folder: Path,
    object_name: str,
    policies: str,
    parameters: dict[str, dict[str, Any]],
    settings: dict[str, Any],
    csv: Path | None,
    json_file: Path | None,
) -> None:
    from active6d_agent.evaluation.policy_evaluation import summarise
    from active6d_core.object_model import load_object
    from active6d_tools.bop_results import bop_csv, once_per_image
    from active6d_tools.recorded_evaluation import RecordedEvaluation, scene_folders

    model, folders = load_object(object_name), scene_folders(folder)
    names = recorded_policies(policies, model, parameters)

    def warn(text: str) -> None:
        messages.print(text, highlight=False, markup=False)

    with messages.status("reading the scenes"):
        evaluation = RecordedEvaluation(folders, model, **settings, warn=warn)
    results = {}
    for name in names:
        with work_progress() as on_progress:
            results[name], estimates = evaluation.run(name, parameters.get(name, {}), on_progress)
        if csv is not None:
            path, (written, others) = csv / f"{name}_{folder.resolve().name}-test.csv", once_per_image(estimates)
            write_file(path, bop_csv(written, model, evaluation.object_id))
            left_out = f"; {others} episodes that ended at an image of another one are not in it" if others else ""
            warn(f"wrote {path}{left_out}")
    if csv is not None and evaluation.numbering:
        warn(evaluation.numbering)
    summary = summarise(results, object_name, settings["steps"], settings["seed"])
    _print_policies(summary)
    episodes = {name: {key: own.measures[key].tolist() for key in own.measures} for name, own in results.items()}
    images = {name: own.views.tolist() for name, own in results.items()}
    scenes = [scene.recording.folder.name for scene in evaluation.scenes]
    more = {"bop": str(folder), "parameters": parameters, "measures": episodes, "views": images}
    write_json(json_file, {**summary, **settings, "starts": evaluation.start_images, "scene_folders": scenes, **more})


def _print_policies(summary: dict[str, Any]) -> None:
    rows = []
    for name, row in summary["policies"].items():
        cells = [name, f"{row['distance_m']:.2f}"]
        for key, digits in (("e_add_mm", 2), ("detection_rate", 3)):
            ends = row[f"{key}_ci95_scenes"]
            cells += [f"{row[key]:.{digits}f}", _range(ends, f".{digits}f", "-")]
        cells += [f"{row[key]:.3f}" if row.get(key) is not None else "-" for key in ("confirmed_rate", "wrong")]
        rows.append([*cells, *([f"{row['gap_closed']:.0%}"] if row["gap_closed"] is not None else [])])
    title = f"{summary['object']}, T = {summary['steps']}, {summary['episodes']} episodes (95 % intervals over scenes)"
    columns = "policy", "metres", "ADD, mm", "", "detected", "", "confirmed", "wrong"
    print_table(
        (*columns, "gap closed") if any(len(row) > len(columns) for row in rows) else columns, rows, title=title
    )


def _print_differences(summary: dict[str, Any]) -> None:
    rows = []
    for name, measured in summary["policies"][_DEFAULT]["against"].items():
        cells = [name, f"{measured['distance_m']['mean']:+.2f}"]
        for key, digits in (("e_add_mm", 2), ("detection_rate", 3)):
            ends = _range(measured[key]["ci95_scenes"], f"+.{digits}f", " ")
            style = "bold" if measured[key]["excludes_zero_scenes"] else "dim"
            cells += [f"[{style}]{measured[key]['mean']:+.{digits}f}[/]", ends]
        rows.append(cells)
    title = f"{_DEFAULT} minus the others, from the same starts"
    print_table(("against", "metres", "ADD, mm", "", "detected", ""), rows, title=title)


def _range(ends: list[float] | None, form: str, between: str) -> str:
    """Both ends of an interval; a dash where there is one scene, and so no interval over scenes."""
    return "-" if ends is None else f"[dim]{between.join(f'{end:{form}}' for end in ends)}[/dim]"
