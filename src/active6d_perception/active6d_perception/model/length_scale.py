"""Factors on lengths that were chosen for objects of usual size and shape, such as the millimetres by which a pose may
be off."""

from functools import lru_cache

import numpy as np
import trimesh

from active6d_core.object_model import ObjectModel

_REFERENCE_DIAMETER = 0.14  # metres
# Diameters of the objects on which fusion's weights were fitted, metres.
_FITTED_DIAMETERS = (0.137, 0.159)
# Smaller factors would ask for more than depth sensors resolve.
_SCALES = (0.35, 1.5)
# Two objects side by side are a thickness apart or more. Distances between objects are up to a fifth of the diameter,
# which must stay below that, with a margin for errors of poses.
_LARGEST_SHARE, _OF_THICKNESS = 0.2, 0.75
# Hypotheses of one object scatter by a few hundredths of the diameter, however thin it is.
_LEAST_SLIMNESS = 0.25


def length_scale(model: ObjectModel) -> float:
    """The factor on lengths that are given for an object of 0.14 m."""
    return float(np.clip(model.diameter / _REFERENCE_DIAMETER, *_SCALES))


def fusion_scale(model: ObjectModel) -> float:
    """The factor on the lengths of fusion: 1 for objects of the sizes on which its weights were fitted."""
    return float(np.clip(model.diameter / np.clip(model.diameter, *_FITTED_DIAMETERS), *_SCALES))


@lru_cache(maxsize=16)
def slimness(model: ObjectModel) -> float:
    """The factor on distances that tell objects apart: 1 for compact objects, down to 0.25 for slim ones.

    These distances are fractions of the diameter. Rods that lie side by side are nearer to each other than a fifth of
    their length. So a fifth of the diameter is lowered to three quarters of the object's least thickness, which is that
    of its oriented bounding box.
    """
    _, extents = trimesh.bounds.oriented_bounds(model.mesh)  # type: ignore[no-untyped-call]
    share = _OF_THICKNESS * float(extents.min()) / (_LARGEST_SHARE * model.diameter)
    return float(np.clip(share, _LEAST_SLIMNESS, 1.0))


def spacing(model: ObjectModel) -> float:
    """The length, metres, of which distances that tell objects apart are fractions: the diameter, times
    :func:`slimness`."""
    return model.diameter * slimness(model)
