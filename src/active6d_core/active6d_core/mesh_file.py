"""Triangle meshes as users bring them: loaded, repaired where that is safe, else refused with the likely cause."""

import io
import re
from pathlib import Path

import numpy as np
import trimesh

from active6d_core.mesh_limits import check_counts, read_limited

#: Diameters in metres that an object in a bin can have; others are of another unit.
PLAUSIBLE_DIAMETER = (0.002, 2.0)
#: Faces of a mesh that is repaired; the repair takes seconds each time that a mesh is loaded.
_MOST_REPAIRED = 100_000
#: Separate bodies; more are the crumbs of a scan.
_MOST_BODIES = 20
#: What announces colours in OBJ, GLB and PLY, and how far a file is searched for it.
_MATERIALS = (rb"^mtllib ", rb'"materials"\s*:', rb"^comment TextureFile", rb"^property uchar (red|texture)")
_MARKED = 2**20
#: Share of its size to which a mesh may be rounded: files hold coordinates of 32 bits.
_ROUNDED = 1e-3
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "metres": 1.0}


def load_mesh(path: Path) -> trimesh.Trimesh:
    """One mesh of a file's triangles, in the file's frame and unit.

    Materials and textures are not read, nor any other file that this one names.

    Raises:
        ValueError: no file, not within the limits of :mod:`active6d_core.mesh_limits`, damaged, no triangles, or
            vertices that are not finite.
    """
    content = read_limited(path)
    try:
        # Trimesh would look for other files beside a file that it knows by its path.
        with np.errstate(all="ignore"):
            mesh = trimesh.load_mesh(io.BytesIO(content), file_type=path.suffix[1:].lower(), skip_materials=True)
    # Readers of meshes raise many kinds of errors on damaged files.
    except Exception as error:
        raise ValueError(f"mesh {path.name} cannot be read ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        what = (
            "is an empty file" if not content else "has no faces; it is a point cloud, which has no surface, or no mesh"
        )
        raise ValueError(f"mesh {path.name} {what}")
    check_counts(path.name, len(mesh.vertices), len(mesh.faces))
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"mesh {path.name} has vertices that are not finite")
    # Files repeat a vertex for every normal and every place in the texture, which leaves a closed mesh open.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.remove_unreferenced_vertices()
    return mesh


def mesh_notes(path: Path) -> list[str]:
    """What of a mesh file is used in another way than a user may expect, in words; empty for most files.

    Raises:
        ValueError: see :func:`load_mesh`.
    """
    mesh, content, notes = load_mesh(path), path.read_bytes(), []
    bodies = len(trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces))))
    if 1 < bodies <= _MOST_BODIES and mesh.is_watertight:
        notes.append(f"the file holds {bodies} separate bodies; they are taken as one rigid object")
    rounding = float(np.abs(mesh.vertices).max()) * np.finfo(np.float32).eps
    if rounding > _ROUNDED * float(mesh.extents.max()):
        share = float(mesh.extents.max()) / rounding
        notes.append(f"it lies so far from the file's origin that its size has only {share:.0f} steps; move it there")
    if any(re.search(mark, content[:_MARKED], re.MULTILINE) for mark in _MATERIALS):
        notes.append("colours and textures of the file are not used; --color sets one colour")
    return notes


def close_mesh(mesh: trimesh.Trimesh) -> list[str]:
    """Turn faces outwards and close holes, in place, where a mesh does not say what is inside.

    A mesh that is closed, or encloses its centre of mass with outward faces, stays as it is.

    Returns:
        what was done, in words.

    Raises:
        ValueError: afterwards there is still no inside.
    """
    done = []
    faces = len(mesh.faces)
    if faces > _MOST_REPAIRED and not (mesh.is_watertight and _has_inside(mesh)):
        raise ValueError(
            f"mesh is open, or its faces do not agree on what is outside; with {faces} faces it is too large to be "
            "repaired here: do it in a mesh editor, such as MeshLab"
        )
    closed = mesh.copy()
    if not mesh.is_watertight and trimesh.repair.fill_holes(closed):
        mesh.vertices, mesh.faces = closed.vertices, closed.faces
        done.append(f"holes closed with {len(mesh.faces) - faces} faces")
    if not _has_inside(mesh):
        before = mesh.face_normals[:faces].copy()
        trimesh.repair.fix_winding(mesh)  # type: ignore[no-untyped-call]
        if mesh.volume < 0:
            mesh.faces = np.fliplr(mesh.faces)
        turned = int((np.einsum("ij,ij->i", before, mesh.face_normals[:faces]) < 0).sum())
        if turned:
            done.append(f"{turned} of {faces} faces turned outwards")
    if not _has_inside(mesh):
        raise ValueError(
            f"mesh has no inside: it is open at {open_edges(mesh)} edges, or its faces do not agree on what is "
            "outside; close it in a mesh editor, such as MeshLab"
        )
    return done


def open_edges(mesh: trimesh.Trimesh) -> int:
    """Number of edges with a face at one side only; 0 for a closed mesh."""
    return int((np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1] == 1).sum())


def check_diameter(diameter: float, scale: float) -> None:
    """Raise ValueError where an object of this diameter (metres) must be of another unit than ``scale`` says."""
    low, high = PLAUSIBLE_DIAMETER
    if low <= diameter <= high:
        return
    fitting = [
        f"{unit}: scale {factor:g} makes it {1e3 * diameter / scale * factor:.0f} mm"
        for unit, factor in _UNITS.items()
        if low <= diameter / scale * factor <= high
    ]
    advice = f"; is it in {', or in '.join(fitting)}?" if fitting else ""
    limits = "" if fitting else f", and not within {low:g} to {high:g} m"
    raise ValueError(f"with scale {scale:g} the object is {diameter:.4g} m in diameter{limits}{advice}")


def _has_inside(mesh: trimesh.Trimesh) -> bool:
    """Whether faces are turned outwards around a centre of mass within the bounds."""
    if not mesh.is_winding_consistent or mesh.volume <= 0:
        return False
    low, high = mesh.bounds
    return bool(((mesh.center_mass >= low) & (mesh.center_mass <= high)).all())
