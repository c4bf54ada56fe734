"""How large an object is in the images of the simulated camera."""

import numpy as np

from active6d_core.camera import DEFAULT_CAMERA
from active6d_core.object_model import ObjectModel
from active6d_core.view_sphere import ViewSphere

#: Pixels that an object's diameter should span.
_ENOUGH = 40
#: The least radius that camera_simulator takes, metres.
_LEAST_RADIUS = 0.1


def pixels_across(model: ObjectModel, radius: float) -> float:
    """Pixels that an object's diameter spans in the default camera's image from ``radius`` metres away."""
    return DEFAULT_CAMERA.fx * model.diameter / radius


def size_note(model: ObjectModel) -> str:
    """That size from the default radius of views, and where it is small the radius that would do."""
    radius = ViewSphere().radius
    pixels = pixels_across(model, radius)
    note = f"from the simulated camera's {radius:g} m it spans {pixels:.0f} pixels"
    if pixels >= _ENOUGH:
        return note
    # Rounded down to centimetres, so that the image is large enough.
    nearer = max(float(np.floor(100 * radius * pixels / _ENOUGH)) / 100, _LEAST_RADIUS)
    settings = " ".join(f"--set {node}.radius={nearer:g}" for node in ("camera_simulator", "attention_policy"))
    return f"{note}, and small parts are hard; from {nearer:g} m {pixels_across(model, nearer):.0f}: episode {settings}"
