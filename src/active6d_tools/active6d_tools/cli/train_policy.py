"""``active6d train policy``: from scene banks to a deployable policy."""

from pathlib import Path
from typing import Annotated

import typer

from active6d_tools.cli.options import LEARNED, PAPER, Banks, JsonFile, ObjectName, Seed, parse_overrides
from active6d_tools.cli.output import export_weights, write_json
from active6d_tools.cli.progress import follow_training
from active6d_tools.cli.terminal import messages

_OUT = "Folder of the training; by default active6d/policies/OBJECT/POLICY in the cache folder."
_LENGTH = "Rounds of view-attention or environment steps of attention; each has its own default."


def policy(
    object_name: ObjectName = "mug",
    name: Annotated[
        str,
        typer.Option(
            "--policy", help=f"Policy to train: {LEARNED[0]}, {LEARNED[1]} (the paper's) or {PAPER} (10 times as long)."
        ),
    ] = LEARNED[0],
    steps: Annotated[int, typer.Option(min=1, help="Horizon T in moves.")] = 5,
    length: Annotated[int | None, typer.Option(min=1, help=_LENGTH)] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help=_OUT)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the training in that folder.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Replace the training in that folder by a new one.")] = False,
    override: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="GROUP.NAME=VALUE", help="Parameter of training, weighing or reward; repeatable."
        ),
    ] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Copy the best weights to this folder, as POLICY_OBJECT.*.")
    ] = None,
    banks: Banks = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Train a policy on an object's train bank and keep the weights with the best result on its val bank.

    Curves are drawn to DIR/curve.png during training. A folder that holds a training is refused without --resume or
    --again.

    Example: [bold]active6d train policy --object mug --policy view-attention --export weights[/bold]
    """
    from active6d_agent.bank.all_views_lookup import make_lookup
    from active6d_agent.bank.scene_bank import find_bank, load_bank
    from active6d_core.files import cache_folder
    from active6d_tools.policy_training import plan_training

    if name not in (*LEARNED, PAPER):
        raise ValueError(f"--policy '{name}' is not among {', '.join((*LEARNED, PAPER))}")
    folder = out or cache_folder("policies") / object_name / name
    groups = parse_overrides(override or [])
    training = plan_training(
        name, folder, steps=steps, seed=seed, length=length, groups=groups, resume=resume, again=again
    )
    paths = [find_bank(object_name, split, banks) for split in ("train", "val")]
    with messages.status("reading the banks"):
        lookups = [make_lookup(load_bank(path)) for path in paths]
    follow_training(training, lookups, f"{name}, {object_name}")
    if export is not None:
        export_weights(training.best, export, f"{name}_{object_name}")
    results = {"object": object_name, "policy": name, "weights": str(training.best), "seed": seed}
    write_json(json_file, {**results, "curve": training.curve()})
