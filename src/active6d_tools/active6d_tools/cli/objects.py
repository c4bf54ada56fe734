"""``active6d object list|show|add``."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from active6d_core.files import write_file
from active6d_tools.cli.options import JsonFile
from active6d_tools.cli.output import write_json, write_png
from active6d_tools.cli.terminal import console, messages, print_table

if TYPE_CHECKING:
    import numpy as np

    from active6d_core.object_model import ObjectModel
    from active6d_perception.model.exact_symmetry import Turn
    from active6d_sim.datasets.bop_models import ModelSymmetry

#: Share of the diameter by which a symmetry may move the centroid.
_SHIFT = 0.02
app = typer.Typer(help="Object models: list, show, add.", rich_markup_mode="rich")


@app.command("list")
def list_models(json_file: JsonFile = None) -> None:
    """List all objects.

    Example: [bold]active6d object list[/bold]
    """
    from active6d_core.object_model import list_objects, load_object

    rows, refused = [], {}
    for name in list_objects():
        try:
            rows.append(_describe(load_object(name)))
        except ValueError as error:
            refused[name] = str(error)
    cells = [
        (
            row["name"],
            row["symmetry"],
            f"{row['diameter_mm']:.1f} mm",
            "{}-{}".format(*row["instances"]),
            f"{row['triangles']:,}",
            escape(", ".join(row["features"]) or "-"),
        )
        for row in rows
    ]
    print_table(("name", "symmetry", "diameter", "instances", "triangles", "features"), cells, left=2)
    for name, reason in refused.items():
        messages.print(f"left out: {name}: {reason}", highlight=False, markup=False)
    write_json(json_file, {"objects": rows, "left_out": refused})


@app.command()
def show(
    name: Annotated[str, typer.Argument(help="Name of the object.")],
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Render the object from four sides to this PNG file.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Print the properties of an object and render it.

    Example: [bold]active6d object show mug --png mug.png[/bold]
    """
    from active6d_core.object_model import load_object

    model = load_object(name)
    description = _describe(model)
    for key, value in description.items():
        console.print(f"[dim]{key.replace('_', ' '):13}[/dim]", end="")
        console.print(f" {value}", markup=False, highlight=False)
    if png is not None:
        with messages.status("rendering"):
            write_png(png, _render(model))
        messages.print(f"wrote {png}", highlight=False, markup=False)
    write_json(json_file, description)


@app.command()
def add(
    mesh: Annotated[
        Path,
        typer.Argument(help="Triangle mesh (ply, stl, obj, off or glb); small holes are closed."),
    ],
    name: Annotated[str, typer.Option(help="Name of the new object.")],
    scale: Annotated[float, typer.Option(help="Unit of the mesh in metres, such as 0.001 for millimetres.")] = 1.0,
    axis: Annotated[
        tuple[float, float, float] | None, typer.Option(help="Axis of a continuous symmetry in the mesh frame.")
    ] = None,
    symmetry: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AXIS:FOLD",
            help="Part of a turn after which it looks the same, such as z:6 for a sixth of a turn about z; AXIS is x, "
            "y, z or three numbers with commas. Repeatable; all products of the turns are written.",
        ),
    ] = None,
    instances: Annotated[tuple[int, int], typer.Option(help="Fewest and most instances in a scene.")] = (8, 14),
    color: Annotated[tuple[float, float, float], typer.Option(help="RGB, each from 0 to 1.")] = (0.6, 0.6, 0.62),
    into: Annotated[Path, typer.Option(metavar="DIR", help="Folder of description and mesh.")] = Path("objects"),
) -> None:
    """Add an object: copy its mesh and write its description file.

    Example: [bold]active6d object add bracket.stl --name bracket --scale 0.001 --into objects[/bold]

    A hexagonal nut: [bold]active6d object add nut.stl --name nut --scale 0.001 --symmetry z:6 --symmetry x:2[/bold]
    """
    import yaml

    from active6d_core.mesh_file import mesh_notes
    from active6d_sim.datasets.bop_models import symmetry_beside
    from active6d_tools.symmetry_check import parse_turn, rotation_vectors, symmetry_notes

    if not name.replace("_", "").replace("-", "").isalnum():
        raise ValueError(f"--name '{name}': use letters, digits, - and _")
    if not mesh.is_file():
        raise ValueError(f"mesh {mesh} does not exist")
    description_path, mesh_path = into / f"{name}.yaml", into / "meshes" / f"{name}{mesh.suffix.lower()}"
    for path in (description_path, mesh_path):
        if path.exists():
            raise ValueError(f"{path} exists already; choose another --name or remove it")
    description = {"name": name, "mesh": f"meshes/{mesh_path.name}", "scale": scale}
    notes, turns = mesh_notes(mesh), [parse_turn(text) for text in symmetry or []]
    declared: dict[str, Any] = {} if axis is None else {"axis": list(axis)}
    declared |= {"discrete_rotvec_degrees": rotation_vectors(turns)} if turns else {}
    known = None if declared else symmetry_beside(mesh)
    if declared or known is not None:
        description["symmetry"] = declared if known is None else known.description
    description |= {"instances": list(instances), "color": list(color), "source": mesh.name}
    text = yaml.safe_dump(description, sort_keys=False, default_flow_style=None)
    # Makers of data sets choose symmetries by rules of their own.
    model = _store(mesh, mesh_path, description_path, text, axis is not None, turns)
    notes += [*_mesh_notes(mesh), *symmetry_notes(model)]
    for note in notes + ([] if known is None else _data_set_notes(known, model, scale)):
        console.print(note, highlight=False, markup=False, soft_wrap=True)
    _print_added(model, into)


def _mesh_notes(mesh: Path) -> list[str]:
    """What is repaired of a mesh file each time it is loaded, and what stays open."""
    from active6d_core.mesh_file import close_mesh, load_mesh, open_edges

    loaded = load_mesh(mesh)
    notes = [f"repaired each time it is loaded: {repair}" for repair in close_mesh(loaded)]
    if (edges := open_edges(loaded)) > 0:
        notes.append(
            f"the mesh is open at {edges} edges and is used as it is; close it in a mesh editor, such as MeshLab"
        )
    return notes


def _print_added(model: "ObjectModel", into: Path) -> None:
    """What a user needs to go on with a new object: its measures, its frame and where it is found."""
    import os

    from active6d_tools.image_size import size_note

    size = " x ".join(f"{1e3 * extent:.1f}" for extent in model.mesh.extents)
    origin = " ".join(f"{1e3 * value:.2f}" for value in model.origin)
    for line in (
        f"added {model.name}: {1e3 * model.diameter:.1f} mm in diameter ({size} mm)",
        f"origin_mm {origin}: the object frame's origin, its centroid, in the mesh file's frame",
        size_note(model),
    ):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    folders = os.environ.get("ACTIVE6D_OBJECT_PATH", "").split(os.pathsep)
    if str(into) not in folders and str(into.resolve()) not in folders:
        command = f"export ACTIVE6D_OBJECT_PATH={into.resolve()}"
        console.print(f"to use it: {command}", highlight=False, markup=False, soft_wrap=True)


def _data_set_notes(known: "ModelSymmetry", model: "ObjectModel", scale: float) -> list[str]:
    """What a user should know of symmetries that a data set names."""
    from active6d_sim.datasets.bop_models import INFO_FILE

    notes = [f"symmetry taken from {INFO_FILE}"]
    if known.axes > 1:
        notes.append(f"of its {known.axes} symmetry axes the first is used; an object has one")
    shift = scale * known.shift(model.origin / scale)
    if shift > _SHIFT * model.diameter:
        notes.append(f"these symmetries move the centroid by {1e3 * shift:.1f} mm: are they of this mesh?")
    return notes


def _store(
    mesh: Path, mesh_path: Path, description_path: Path, description: str, check_axis: bool, turns: "list[Turn]"
) -> "ObjectModel":
    """Copy the mesh, write the description and read the object; nothing is left where that fails."""
    from active6d_core.object_model import read_description
    from active6d_tools.symmetry_check import refuse_wrong_axis, refuse_wrong_turns

    mesh_path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(mesh, mesh_path)
    try:
        write_file(description_path, description)
        model = read_description(description_path)
        if check_axis:
            refuse_wrong_axis(model)
        if turns:
            refuse_wrong_turns(model, turns)
        return model
    except Exception as error:  # readers of meshes raise many kinds on damaged files
        description_path.unlink(missing_ok=True)
        mesh_path.unlink()
        # The description is gone, and the copy is the user's file.
        reason = str(error).removeprefix(f"{description_path}: ").replace(mesh_path.name, mesh.name)
        raise ValueError(f"{mesh} cannot be added: {reason}") from error


def _describe(model: "ObjectModel") -> dict[str, Any]:
    symmetry = "about an axis" if model.symmetry.axis is not None else "none"
    if len(model.symmetry.discrete) > 1:
        symmetry = f"{len(model.symmetry.discrete)} rotations" + (", about an axis" if symmetry != "none" else "")
    return {
        "name": model.name,
        "diameter_mm": round(1e3 * model.diameter, 2),
        "size_mm": (1e3 * model.mesh.extents).round(2).tolist(),
        "origin_mm": (1e3 * model.origin).round(2).tolist(),
        "volume_ml": round(1e6 * float(model.mesh.volume), 2),
        "symmetry": symmetry,
        "instances": list(model.instances),
        "triangles": len(model.mesh.faces),
        "features": sorted(model.features),
    }


def _render(model: "ObjectModel") -> "np.ndarray":
    """Picture of the object on a plate from four sides, 30 degrees above the horizon."""
    import numpy as np

    from active6d_core.camera import PinholeCamera
    from active6d_core.se3 import look_at, make_transform
    from active6d_sim.rendering.renderer import SceneRenderer
    from active6d_sim.scenes.scene import Bin, Scene

    height = -float(model.mesh.bounds[0, 2])
    plate = Bin(2.2 * model.diameter, 2.2 * model.diameter, 0.0)
    pose = make_transform(np.eye(3), (0.0, 0.0, height))[None]
    renderer = SceneRenderer(Scene(model.name, f"{model.name}/show", 0, pose, plate, np.zeros((0, 1))))
    camera = PinholeCamera.from_field_of_view(420, 420, 30.0)
    target = np.array([0.0, 0.0, height])
    pictures = []
    for azimuth in np.radians((-60.0, 30.0, 120.0, 210.0)):
        toward = np.array([np.cos(azimuth), np.sin(azimuth), 0.58])
        eye = target + 3.0 * model.diameter * toward / np.linalg.norm(toward)
        pictures.append(np.asarray(renderer.render(look_at(eye, target), camera).color))
    return np.hstack(pictures)
