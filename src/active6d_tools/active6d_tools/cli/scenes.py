"""``active6d scenes generate|export|report|show``."""

from pathlib import Path
from typing import Annotated

import typer

from active6d_tools.cli.options import JsonFile, ObjectName, Seed, SensorName, Split
from active6d_tools.cli.output import write_json, write_png
from active6d_tools.cli.terminal import console, messages, print_table, progress_bar

app = typer.Typer(help="Stored scenes: generate, export, report, show.", rich_markup_mode="rich")


@app.command()
def generate(
    object_name: ObjectName = "mug",
    into: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the stored scenes.")] = Path("scenes"),
    split: Annotated[
        list[str] | None,
        typer.Option(help="Split: train, val, test, wild_val or wild_test; repeatable. By default all."),
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of processes; by default one per core.")] = None,
) -> None:
    """Simulate the piles of every split and store them; stored ones are kept. Their seeds are fixed.

    Example: [bold]active6d scenes generate --object mug --into scenes[/bold]
    """
    import os

    from active6d_sim.scenes.scene_store import SPLITS
    from active6d_sim.scenes.scene_store import generate as store_scenes

    splits = tuple(split or SPLITS)
    with progress_bar() as progress:
        total = sum(SPLITS.get(name, 0) for name in splits)
        there = sum(1 for name in splits for _ in (into / object_name).glob(f"{name}_??.npz"))
        task = progress.add_task(f"simulating {object_name}", total=total, completed=there)
        for path in store_scenes(object_name, into, splits=splits, workers=workers):
            progress.update(task, advance=1, description=path.stem)
    console.print(f"{total} scenes in {into / object_name}", highlight=False, markup=False)
    if str(into.resolve()) not in os.environ.get("ACTIVE6D_SCENE_PATH", "").split(os.pathsep):
        console.print(f"export ACTIVE6D_SCENE_PATH={into.resolve()}", highlight=False, markup=False)


@app.command()
def export(
    bop: Annotated[Path, typer.Option("--bop", metavar="DIR", help="Folder of the BOP data set to write.")],
    object_name: ObjectName = "mug",
    split: Split = "test",
    count: Annotated[int | None, typer.Option(min=1, help="Number of scenes; by default all of the split.")] = None,
    view: Annotated[
        list[int] | None,
        typer.Option(min=0, help="Number of a view of the grid; repeatable. By default every fourth view."),
    ] = None,
    sensor: SensorName = "auto",
    seed: Seed = 0,
) -> None:
    """Write stored scenes as a BOP data set: images, camera poses, ground truth, visible fractions, model.

    Poses are those of the mesh file's frame, in millimetres.

    Example: [bold]active6d scenes export --bop dataset --object mug --split test --count 2[/bold]
    """
    from active6d_core.object_model import load_object
    from active6d_core.view_sphere import ViewSphere
    from active6d_sim.datasets.bop_export import export_scenes
    from active6d_sim.scenes.scene_store import SPLITS, load_scene

    model = load_object(object_name)
    if split not in SPLITS:
        raise ValueError(f"--split '{split}' is not among {', '.join(SPLITS)}")
    total = min(count or SPLITS[split], SPLITS[split])
    views = view or list(range(0, len(ViewSphere()), 4))
    scenes = (load_scene(object_name, split, index) for index in range(total))
    with progress_bar() as progress:
        task = progress.add_task("rendering", total=total)
        export_scenes(
            bop,
            model,
            split,
            scenes,
            views,
            sensor,
            seed=seed,
            on_scene=lambda name: progress.update(task, advance=1, description=name),
        )
    console.print(f"{total} scenes with {len(views)} images each in {bop / split}", highlight=False, markup=False)


@app.command()
def report(
    object_name: ObjectName = "mug",
    split: Split = "test",
    moves: Annotated[int, typer.Option(min=0, help="Number of moves T; T + 1 views are taken.")] = 5,
    seed: Seed = 0,
    json_file: JsonFile = None,
) -> None:
    """Print the share of objects that are at least half visible in one view, and in several chosen views.

    Example: [bold]active6d scenes report --object mug --split test[/bold]
    """
    import numpy as np

    from active6d_core.object_model import load_object
    from active6d_sim.scenes.scene_store import SPLITS, density_report, load_scene

    load_object(object_name)
    scenes = [load_scene(object_name, split, index) for index in range(SPLITS.get(split, 1))]
    counts = [len(scene) for scene in scenes]
    shares = density_report(scenes, np.random.default_rng(seed), moves=moves)
    titles = {
        "one_view": "one view",
        "random": f"{moves + 1} random views",
        "revolution": f"{moves + 1} views around at 45°",
        "oracle": f"{moves + 1} views of a greedy oracle",
        "all_views": "all views",
    }
    rows = [("scenes", str(len(scenes))), ("objects per scene", f"{min(counts)}-{max(counts)}")]
    print_table(("", ""), [*rows, *((title, f"{shares[key]:.3f}") for key, title in titles.items())])
    write_json(
        json_file, {"object": object_name, "split": split, "moves": moves, "seed": seed, "counts": counts, **shares}
    )


@app.command()
def show(
    scene_name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of the scene, such as mug/test/3 or mug/seed/7.")
    ],
    png: Annotated[Path, typer.Option(metavar="FILE", help="PNG file to write.")] = Path("scene.png"),
    view: Annotated[
        list[int] | None,
        typer.Option(min=0, help="Number of a view of the grid; repeatable. By default four views around the bin."),
    ] = None,
    sensor: SensorName = "auto",
    noise: Annotated[float, typer.Option(min=0.0, help="Factor on the noise of the simulated sensor.")] = 1.0,
    seed: Seed = 0,
) -> None:
    """Render views of a scene: colour above, depth below.

    Example: [bold]active6d scenes show mug/test/3 --png scene.png[/bold]
    """
    import numpy as np

    from active6d_core.object_model import load_object
    from active6d_core.view_sphere import ViewSphere
    from active6d_sim.rendering.random_sensor import sensor_of
    from active6d_sim.rendering.simulator import Simulator
    from active6d_sim.scenes.scene_store import find_scene
    from active6d_tools.report.drawing import depth_to_color

    sphere = ViewSphere()
    views = view or [40, 45, 50, 55]
    if max(views) >= len(sphere):
        raise ValueError(f"--view {max(views)}: the grid has views 0 to {len(sphere) - 1}")
    parts = scene_name.split("/")
    if len(parts) != 3 or not parts[2].isdecimal():
        raise ValueError(f"scene '{scene_name}' is not of the form mug/test/3 or mug/seed/7")
    object_name, kind, number = parts
    model = load_object(object_name)
    with messages.status("simulating and rendering"):
        scene = find_scene(object_name, "" if kind == "seed" else scene_name, int(number) if kind == "seed" else seed)
        simulator = Simulator(scene, noise=sensor_of(sensor, model, scene).scaled(noise), seed=seed)
        columns = []
        for index in views:
            image = simulator.capture(sphere.pose(sphere.positions[index]), (index + 1) * 1_000_000_000)
            columns.append(np.vstack([image.color, depth_to_color(image.depth)[0]]))
        write_png(png, np.hstack(columns))
    for index in views:
        fraction = scene.visible_fraction[index]
        shown = f"{(fraction >= 0.5).sum()} of {len(scene)} objects at least half visible"
        azimuth, elevation = np.degrees(sphere.angles(sphere.positions[index]))
        console.print(
            f"view {index:2d}   azimuth {azimuth % 360:3.0f}°   elevation {elevation:2.0f}°   {shown}", highlight=False
        )
    messages.print(f"wrote {png}", highlight=False, markup=False)
