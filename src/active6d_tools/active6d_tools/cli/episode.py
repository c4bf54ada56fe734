"""``active6d episode``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from active6d_tools.cli.options import (
    Imports,
    JsonFile,
    NodeParameters,
    ParamsFile,
    Processes,
    parse_overrides,
)
from active6d_tools.cli.output import write_json, write_reports
from active6d_tools.cli.terminal import messages, print_table, progress_bar

if TYPE_CHECKING:
    from active6d_bringup.graph.episode import EpisodeResult, EpisodeStep, ResolvedSettings
    from active6d_core.metrics import SceneScore

_FILE = "by default that of the params file"
_OBJECT = f"Name of the object, see `active6d object list`; {_FILE}, else mug."
_SEED = f"Seed of the pile, the sensor noise and the policy; {_FILE}, else 0."
_POLICY = (
    "Policy that chooses the views: {policies}, or auto for view-attention where it has weights for the object, "
    f"else unidirectional; {_FILE}, else auto."
)
_STEPS = f"Budget of moves T; T moves give T + 1 views; {_FILE}, else 5."
_METRES = f"Travel budget in metres along the hemisphere, 0: none; {_FILE}, else none."
_SECONDS = f"Budget of seconds of motion, 0: none; {_FILE}, else none."
_CAMERA = f"Simulated camera: flying, or arm for one at the wrist of a simulated arm; {_FILE}, else flying."
_ESTIMATOR = (
    "Estimator of the poses in each view: {estimators}, or auto for dense where the object has weights, "
    f"else geometric; {_FILE}, else auto."
)
_SCENE = f"Stored scene, such as mug/test/3, instead of a pile simulated with --seed; {_FILE}, else none."
_SENSOR = f"Sensor model: auto (active_stereo, in wild scenes random), {{sensors}}; {_FILE}, else auto."


def episode(
    object_name: Annotated[str | None, typer.Option("--object", help=_OBJECT)] = None,
    seed: Annotated[int | None, typer.Option(min=0, help=_SEED)] = None,
    policy: Annotated[str | None, typer.Option(help=_POLICY)] = None,
    steps: Annotated[int | None, typer.Option(min=0, help=_STEPS)] = None,
    metres: Annotated[float | None, typer.Option(min=0.0, help=_METRES)] = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help=_SECONDS)] = None,
    camera: Annotated[str | None, typer.Option(help=_CAMERA)] = None,
    estimator: Annotated[str | None, typer.Option(help=_ESTIMATOR)] = None,
    scene: Annotated[str | None, typer.Option(metavar="NAME", help=_SCENE)] = None,
    sensor: Annotated[str | None, typer.Option(help=_SENSOR)] = None,
    bag: Annotated[Path | None, typer.Option(metavar="DIR", help="Record to a bag in this new folder.")] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write an HTML report of the bag; needs --bag.")
    ] = None,
    figure: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a figure as PNG; needs --bag.")] = None,
    processes: Processes = False,
    params_file: ParamsFile = None,
    override: NodeParameters = None,
    imports: Imports = None,
    json_file: JsonFile = None,
) -> None:
    """Run one episode: the node graph estimates, fuses and moves the camera until the budget is spent.

    The same seed gives the same episode.

    Example: [bold]active6d episode --object mug --seed 7 --policy lowest-score --steps 5 --bag bags/mug[/bold]
    """
    _check_reports(bag, report, figure)
    with messages.status("starting"):
        from active6d_bringup.graph.episode import EpisodeSettings, resolve
        from active6d_bringup.graph.params_file import check_parameters

        asked = EpisodeSettings(
            object=object_name,
            seed=seed,
            scene=scene,
            policy=policy,
            steps=steps,
            metres=metres,
            seconds=seconds,
            carrier=camera,
            estimator=estimator,
            sensor=sensor,
            bag=bag,
            processes=processes,
            params_file=params_file,
            overrides=parse_overrides(override or []),
        )
        check_parameters(asked.overrides)
        settings = resolve(asked)
        _check_names(settings)
    result = _run(settings)
    summary = _summary(result)
    _print_summary(result, summary)
    _write_reports(bag, report, figure)
    write_json(json_file, summary)


def _check_reports(bag: Path | None, report: Path | None, figure: Path | None) -> None:
    if bag is None and (report is not None or figure is not None):
        option = "--report" if report is not None else "--figure"
        raise ValueError(f"{option} needs --bag, because it is made from the bag")


def _write_reports(bag: Path | None, report: Path | None, figure: Path | None) -> None:
    if bag is None or (report is None and figure is None):
        return
    from active6d_bringup.bags.reader import read_episode
    from active6d_tools.report.analysis import analyse

    write_reports(analyse(read_episode(bag)), report, figure=figure)


def _check_names(settings: "ResolvedSettings") -> None:
    """Refuse wrong names before any node starts; a node in its own process could report them only in its log."""
    from active6d_agent.policies.registry import list_policies
    from active6d_core.nearest_name import did_you_mean
    from active6d_core.object_model import load_object
    from active6d_core.registry import AUTOMATIC
    from active6d_perception.estimators.registry import list_estimators
    from active6d_sim.rendering.sensor_registry import list_sensors
    from active6d_sim.robot.arm import CARRIERS

    load_object(settings.object)
    for option, value, known in (
        ("--policy", settings.policy, [AUTOMATIC, *list_policies()]),
        ("--estimator", settings.estimator, [AUTOMATIC, *list_estimators()]),
        ("--camera", settings.carrier, CARRIERS),
        ("--sensor", settings.sensor, [AUTOMATIC, *list_sensors()]),
    ):
        if value is not None and value not in known:
            raise ValueError(f"{option} '{value}' is not among {', '.join(known)}{did_you_mean(value, known)}")


def _run(settings: "ResolvedSettings") -> "EpisodeResult":
    """Run with one line per view and a progress bar; a failed episode gives one line and exit code 1."""
    from active6d_bringup.graph.episode import EpisodeError, EpisodeInterrupted, run_episode
    from active6d_bringup.graph.processes import ProcessError

    with progress_bar() as progress:
        task = progress.add_task("starting the nodes", total=settings.steps + 1)

        def on_step(step: "EpisodeStep") -> None:
            progress.update(task, advance=1, description=f"view {step.index}")
            progress.console.print(_describe(step, settings.object), highlight=False, markup=False)

        def on_event(text: str) -> None:
            progress.update(task, description=escape(text))

        try:
            return run_episode(settings, on_step, on_event)
        except (EpisodeError, ProcessError) as error:
            failure, code = str(error), 1
        except EpisodeInterrupted:
            failure, code = "interrupted" + (f"; {settings.bag} holds what was recorded" if settings.bag else ""), 130
    typer.echo(f"active6d: {failure}", err=True)
    raise typer.Exit(code)


def _describe(step: "EpisodeStep", object_name: str) -> str:
    import numpy as np

    x, y, z = step.T_world_camera[:3, 3]
    azimuth, elevation = np.degrees([np.arctan2(y, x) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))])
    score = _score(step, object_name)
    found = f"  found {score.detected.sum():2d}/{len(score.detected)}" if score else ""
    return (
        f"view {step.index:2d} at {azimuth:3.0f}° {elevation:2.0f}°  hypotheses {step.hypotheses:2d}  "
        f"objects {len(step.objects):2d}{found}  {step.distance:5.2f} m"
    )


def _score(step: "EpisodeStep", object_name: str) -> "SceneScore | None":
    if step.ground_truth is None or not len(step.ground_truth):
        return None
    from active6d_core.metrics import evaluate_scene
    from active6d_core.object_model import load_object

    return evaluate_scene(load_object(object_name), step.objects.T_world_object, step.ground_truth)


def _summary(result: "EpisodeResult") -> dict[str, Any]:
    """The numbers for JSON, with all poses, so that two episodes can be compared."""
    from active6d_tools.report.analysis import count_confirmed

    last = _score(result.steps[-1], result.settings.object)
    confirmed, wrong = count_confirmed(result.objects, last, result.settings.confirmed)
    return {
        "object": result.settings.object,
        "scene": result.info.get("scene"),
        "seed": int(result.info["seed"]) if "seed" in result.info else None,
        "policy": result.info.get("policy"),
        "moves": len(result.steps) - 1,
        "end_reason": result.reason,
        "distance_m": result.distance,
        "seconds": result.seconds,
        "motion_seconds": result.motion_seconds,
        "refused": result.refused,
        "objects_true": len(last.detected) if last else None,
        "detection_rate": last.detection_rate if last else None,
        "e_add_mm": last.mean_e_add_mm if last else None,
        "confirmed": confirmed,
        "wrong": wrong,
        "events": result.events,
        "steps": [
            {
                "stamp": step.stamp,
                "T_world_camera": step.T_world_camera.tolist(),
                "goal": None if step.goal is None else step.goal.tolist(),
                "hypotheses": step.hypotheses,
                "T_world_object": step.objects.T_world_object.tolist(),
                "verification": step.objects.verification.tolist(),
                "latency_ms": step.latency_ms,
            }
            for step in result.steps
        ],
    }


def _print_summary(result: "EpisodeResult", summary: dict[str, Any]) -> None:
    moves = f"{summary['moves']} moves, {result.distance:.2f} m, {result.motion_seconds:.1f} s of motion"
    moves += f", {result.seconds:.1f} s of computation"
    rows = [("episode", f"{summary['scene'] or result.settings.object}, {summary['policy']}: {moves}")]
    rows.append(("ended", result.reason))
    if summary["objects_true"] is None:
        rows.append(("objects", str(len(result.objects))))
    else:
        found = f"{summary['detection_rate'] * summary['objects_true']:.0f} of {summary['objects_true']}"
        rows.append(("found", f"{found} ({summary['detection_rate']:.0%}), mean ADD {summary['e_add_mm']:.1f} mm"))
    wrong = "" if summary["wrong"] is None else f", of which {summary['wrong']} wrong"
    rows.append(("confirmed", f"{summary['confirmed']}{wrong}"))
    rows += [("refused", reason) for reason in result.refused]
    rows += [("event", event) for event in result.events if not event.startswith("starting ")]
    if result.settings.bag is not None:
        rows.append(("bag", str(result.settings.bag)))
    print_table(("", ""), rows, left=2)
