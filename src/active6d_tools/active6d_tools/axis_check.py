"""Whether a mesh has the axis of continuous symmetry that a user names."""

import numpy as np
import open3d as o3d
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel

#: Share of the diameter by which a turned surface may leave the surface. It is .03 for a bolt with a hexagonal head.
_TOLERANCE = 0.05
#: The rest of the surface may be details, such as the drinking hole of a lid. A mug's handle is 5 % of its surface.
_SHARE = 0.98
# The golden angle: no number of teeth or corners turns onto itself each time.
_ANGLES = np.radians(137.508) * np.arange(1, 25)
_POINTS = 4096


def refuse_wrong_axis(model: ObjectModel) -> None:
    """Refuse an axis about which the mesh cannot be turned.

    Args:
        model: an object with an axis of continuous symmetry.

    Raises:
        ValueError: the turned surface leaves the surface; the text has the distance and the axes that would do.
    """
    if model.symmetry.axis is None:
        return
    deviation, allowed = _deviation(_scene(model), model, model.symmetry.axis), _TOLERANCE * model.diameter
    if deviation <= allowed:
        return
    fits = axes_of_symmetry(model)
    advice = f"--axis can be {' or '.join(fits)}" if fits else "none of x, y and z is one, so leave --axis out"
    raise ValueError(
        f"--axis is no axis of symmetry: turned about it through the centroid, {1 - _SHARE:.0%} of the surface move by "
        f"{1e3 * deviation:.1f} mm or more, {1e3 * allowed:.1f} mm are allowed; {advice}"
    )


def axes_of_symmetry(model: ObjectModel) -> list[str]:
    """Those of x, y and z about which the mesh can be turned, with the numbers that name them: "x (1 0 0)"."""
    scene, allowed = _scene(model), _TOLERANCE * model.diameter
    axes = zip(("x (1 0 0)", "y (0 1 0)", "z (0 0 1)"), np.eye(3), strict=True)
    return [name for name, axis in axes if _deviation(scene, model, axis) <= allowed]


def _scene(model: ObjectModel) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.asarray(model.mesh.vertices, np.float32), np.asarray(model.mesh.faces, np.uint32))
    return scene


def _deviation(scene: o3d.t.geometry.RaycastingScene, model: ObjectModel, axis: np.ndarray) -> float:
    """Distance from the surface that most of the turned surface does not exceed, metres."""
    turns = Rotation.from_rotvec(_ANGLES[:, None] * axis).as_matrix()
    moved = np.einsum("aij,nj->ani", turns, model.surface[0][:_POINTS]).reshape(-1, 3)
    return float(np.quantile(scene.compute_distance(moved.astype(np.float32), nthreads=1).numpy(), _SHARE))
