"""``active6d train policy``: from scene banks to a deployable policy."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_tools.cli.bank import Banks
from active6d_tools.cli.output import (
    JsonFile,
    ObjectName,
    Seed,
    console,
    export_weights,
    messages,
    progress_bar,
    write_json,
)

if TYPE_CHECKING:
    from active6d_agent.bank.batched_fusion import BatchedFusion

#: Look-ups of the train and val banks to a training as it goes on, and how many steps or rounds it has in all.
_Training = tuple[Callable[["BatchedFusion", "BatchedFusion"], Iterator[Any]], int]
LEARNED = ("view-attention", "attention")
_OUT = "Folder of the training; by default active6d/policies/OBJECT/POLICY in the cache folder."
_LENGTH = "Rounds of view-attention, environment steps of attention; its own default."


def policy(
    object_name: ObjectName = "mug",
    name: Annotated[str, typer.Option("--policy", help=f"Which: {' or '.join(LEARNED)} (the paper's).")] = LEARNED[0],
    steps: Annotated[int, typer.Option(min=1, help="Horizon T.")] = 5,
    length: Annotated[int | None, typer.Option(min=1, help=_LENGTH)] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help=_OUT)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from where the training in that folder is.")] = False,
    override: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="GROUP.NAME=VALUE", help="Of training, weighing or reward; repeatable."),
    ] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Copy the best weights there, as POLICY_OBJECT.*.")
    ] = None,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Train a policy on the train bank of an object; the weights that do best on its val bank are kept.

    Curves are drawn to DIR/curve.png as it learns.

    Example: [bold]active6d train policy --object mug --policy view-attention --export weights[/bold]
    """
    from active6d_agent.bank.batched_fusion import BatchedFusion
    from active6d_agent.bank.scene_bank import find_bank, load_bank
    from active6d_core.files import cache_folder
    from active6d_tools.cli.episode import parse_overrides

    if name not in LEARNED:
        raise ValueError(f"--policy '{name}' is not among {', '.join(LEARNED)}")
    groups = parse_overrides(override or [])
    folder = out or cache_folder("policies") / object_name / name
    make = _dagger if name == "view-attention" else _ppo
    start, total = make(folder, {"steps": steps, "seed": seed}, length, groups, resume)
    paths = [find_bank(object_name, split, banks) for split in ("train", "val")]
    with messages.status("reading the banks"):
        lookups = [BatchedFusion(load_bank(path)) for path in paths]
    _follow(start(*lookups), total, folder, f"{name}, {object_name}")
    best = folder / "best.safetensors"
    if export is not None:
        export_weights(best, export, f"{name}_{object_name}")
    progress = _read_curve(folder)
    write_json(
        json_file, {"object": object_name, "policy": name, "weights": str(best), "seed": seed, "curve": progress}
    )


def _dagger(folder: Path, common: dict, length: int | None, groups: dict, resume: bool) -> _Training:
    from active6d_agent.policies.view_attention.dagger import DaggerParameters, train_dagger
    from active6d_agent.policies.view_attention.network import Weighing

    own = {"rounds": length} if length else {}
    parameters = _make(DaggerParameters, "training", {**common, **own}, groups)
    weighing = _make(Weighing, "weighing", {}, groups)
    _refuse_others(groups, ("training", "weighing"))
    return lambda train, val: train_dagger(train, val, folder, parameters, weighing, resume=resume), parameters.rounds


def _ppo(folder: Path, common: dict, length: int | None, groups: dict, resume: bool) -> _Training:
    from active6d_agent.environment.gym_environment import RewardParameters
    from active6d_agent.policies.attention.ppo import PpoParameters, train_ppo

    own = {"total": length} if length else {}
    training = groups.get("training", {})
    # The rollout must be a multiple of the horizon.
    if "rollout" not in training:
        own["rollout"] = 4 * training.get("steps", common["steps"])
    parameters = _make(PpoParameters, "training", {**common, **own}, groups)
    reward = _make(RewardParameters, "reward", {}, groups)
    _refuse_others(groups, ("training", "reward"))
    return lambda train, val: train_ppo(train, val, folder, parameters, reward, resume=resume), parameters.total


def _make(kind: type, group: str, own: dict, groups: dict[str, dict]) -> Any:
    """A dataclass from this command's options and what ``--set`` gives of its group.

    Raises:
        ValueError: no such parameter, or a value out of range or of another kind.
    """
    from dataclasses import fields

    given = groups.get(group, {})
    known = [item.name for item in fields(kind)]
    unknown = sorted(given.keys() - set(known))
    if unknown:
        raise ValueError(f"--set {group}.{unknown[0]}: known are {', '.join(known)}")
    try:
        return kind(**{**own, **given})
    except TypeError as error:
        raise ValueError(f"--set {group}: {error}") from error


def _refuse_others(groups: dict[str, dict], known: tuple[str, ...]) -> None:
    others = sorted(groups.keys() - set(known))
    if others:
        raise ValueError(f"--set {others[0]}: known are {', '.join(known)}")


def _follow(curve: Iterator, total: int, folder: Path, title: str) -> None:
    """Show the training's progress and redraw its curve."""
    with progress_bar() as bar:
        task = bar.add_task(title, total=total)
        for progress in curve:
            done = getattr(progress, "round", None) or progress.steps
            found = (
                f"finds {progress.detection_rate:.3f}, e_ADD {progress.e_add_mm:.2f} mm, {progress.distance_m:.2f} m"
            )
            bar.update(task, completed=done, description=f"{title}: finds {found}")
            _draw(folder, title)
    console.print(f"best weights: {folder / 'best.safetensors'}", highlight=False, markup=False)


def _read_curve(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "curve.jsonl").read_text().splitlines()]


def _draw(folder: Path, title: str) -> None:
    from active6d_tools.report.line_plots import Panel, draw_panels

    rows = _read_curve(folder)
    minutes = [row["seconds"] / 60 for row in rows]
    third = ("mean_return", "mean return") if "mean_return" in rows[0] else ("loss", "loss")
    shown = (("detection_rate", "detection rate"), ("e_add_mm", "e_ADD [mm]"), ("distance_m", "d [m]"), third)
    panels = [Panel("minutes", label, {label: (minutes, [row[key] for row in rows])}) for key, label in shown]
    draw_panels(folder / "curve.png", f"{title}: validation scenes", panels)
