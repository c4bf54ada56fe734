"""``active6d replay``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from active6d_tools.cli.options import (
    BagDepthScale,
    BagFolder,
    BagObject,
    BagRectified,
    BagTopics,
    Imports,
    JsonFile,
    NodeParameters,
    ParamsFile,
    Processes,
    parse_overrides,
)
from active6d_tools.cli.output import print_left_out, write_json
from active6d_tools.cli.terminal import console, messages, progress_bar

if TYPE_CHECKING:
    from active6d_bringup.bags.replay import ReplayResult, ReplaySettings, ReplayStep


def replay(
    folder: BagFolder,
    rate: Annotated[float, typer.Option(min=1e-3, help="Speed relative to the recording.")] = 1.0,
    as_fast: Annotated[
        bool, typer.Option("--as-fast", help="Send each view as soon as the previous one is processed.")
    ] = False,
    compare: Annotated[
        bool, typer.Option("--compare", help="Exit with code 1 unless hypotheses and objects equal the recorded ones.")
    ] = False,
    object_name: BagObject = None,
    topics: BagTopics = "",
    depth_scale: BagDepthScale = 0.0,
    rectified: BagRectified = None,
    estimator: Annotated[
        str | None, typer.Option(help="Estimator to use instead of the recorded one: auto, {estimators}.")
    ] = None,
    bag: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record the replay to a bag in this new folder.")
    ] = None,
    processes: Processes = False,
    params_file: ParamsFile = None,
    override: NodeParameters = None,
    imports: Imports = None,
    json_file: JsonFile = None,
) -> None:
    """Send the camera images of a bag, also of another program, through the perception nodes.

    Prints what was found after each view. With --bag, report and viewers can show it; --json has the poses.

    Example: [bold]active6d replay bags/mug --as-fast --compare[/bold]
    """
    if as_fast and rate != 1.0:
        raise ValueError("--rate and --as-fast exclude each other")
    from active6d_bringup.bags.camera_topics import CameraOptions
    from active6d_bringup.bags.replay import ReplaySettings
    from active6d_bringup.graph.params_file import check_parameters

    settings = ReplaySettings(
        bag=folder,
        rate=0.0 if as_fast else rate,
        object=object_name,
        camera=CameraOptions.parse(topics, depth_scale, rectified),
        estimator=estimator,
        processes=processes,
        params_file=params_file,
        overrides=parse_overrides(override or []),
        record=bag,
    )
    check_parameters(settings.overrides)
    result = _run(settings)
    console.print(f"{result.views} views in {result.seconds:.1f} s", highlight=False)
    print_left_out(result.left_out, result.notes)
    if bag is not None:
        console.print(f"recorded into {bag}; active6d report {bag} shows it", highlight=False, markup=False)
    if compare:
        _print_comparison(result)
    write_json(json_file, _summary(result))
    if compare and not result.equal:
        raise typer.Exit(1)


def _run(settings: "ReplaySettings") -> "ReplayResult":
    """Run with one line per view and a progress bar; a failed replay gives one line and exit code 1."""
    from active6d_bringup.bags.replay import play, prepare
    from active6d_bringup.graph.episode import EpisodeError, EpisodeInterrupted
    from active6d_bringup.graph.processes import ProcessError

    with messages.status("reading the bag"):
        prepared = prepare(settings, lambda text: typer.echo(text, err=True))
    with progress_bar() as progress:
        task = progress.add_task("starting the nodes", total=len(prepared.views))
        try:
            return play(
                prepared,
                lambda done, total: progress.update(task, completed=done, description="replaying"),
                lambda text: typer.echo(text, err=True),
                lambda step: progress.console.print(_describe(step, prepared.confirmed), highlight=False, markup=False),
            )
        except (EpisodeError, ProcessError) as error:
            failure, code = str(error), 1
        except EpisodeInterrupted:
            kept = f"; {settings.record} holds what was recorded" if settings.record else ""
            failure, code = "interrupted" + kept, 130
    typer.echo(f"active6d: {failure}", err=True)
    raise typer.Exit(code)


def _describe(step: "ReplayStep", confirmed_from: float) -> str:
    from active6d_tools.report.analysis import count_confirmed

    confirmed, _ = count_confirmed(step.objects, None, confirmed_from)
    counts = f"hypotheses {step.hypotheses:2d}  objects {len(step.objects):2d}  confirmed {confirmed:2d}"
    return f"view {step.index:2d}  {counts}"


def _print_comparison(result: "ReplayResult") -> None:
    if result.equal:
        console.print("[green]equal[/green]: every view's hypotheses, masks, objects and surface are the recorded ones")
        return
    views = {comparison.stamp for comparison in result.comparisons if not comparison.equal}
    console.print(f"[red]different[/red] in {len(views)} of {result.views} views")
    missing = sorted({comparison.topic for comparison in result.comparisons if comparison.recorded is None})
    if missing:
        console.print(f"the bag lacks messages of {', '.join(missing)}", highlight=False)
    for name, difference in result.largest_differences().items():
        text = "other sizes" if difference != difference else f"{difference:.3g} at most"
        console.print(f"  {name}: {text}", highlight=False, markup=False)


def _summary(result: "ReplayResult") -> dict[str, Any]:
    return {
        "object": result.object,
        "world_frame": result.world_frame,
        "steps": [
            {
                "stamp": step.stamp,
                "T_world_camera": step.T_world_camera.tolist(),
                "hypotheses": step.hypotheses,
                "T_world_object": step.objects.T_world_object.tolist(),
                "verification": step.objects.verification.tolist(),
                "probability": step.objects.probability.tolist(),
            }
            for step in result.steps
        ],
        "views": result.views,
        "seconds": result.seconds,
        "equal": result.equal,
        "left_out": result.left_out,
        "notes": result.notes,
        "messages": [
            {
                "stamp": comparison.stamp,
                "topic": comparison.topic,
                "recorded": comparison.recorded,
                "live": comparison.live,
                "equal": comparison.equal,
            }
            for comparison in result.comparisons
        ],
        # JSON has no NaN, which stands for sizes that differ.
        "largest_differences": {
            name: None if difference != difference else difference
            for name, difference in result.largest_differences().items()
        },
    }
