"""Factors on lengths that were chosen for objects of usual size, such as the millimetres by which a pose may be off."""

import numpy as np

from active6d_core.object_model import ObjectModel

_REFERENCE_DIAMETER = 0.14  # metres
# Diameters of the objects on which fusion's weights were fitted, metres.
_FITTED_DIAMETERS = (0.137, 0.159)
# Smaller factors would ask for more than depth sensors resolve.
_SCALES = (0.35, 1.5)


def length_scale(model: ObjectModel) -> float:
    """The factor on lengths that are given for an object of 0.14 m."""
    return float(np.clip(model.diameter / _REFERENCE_DIAMETER, *_SCALES))


def fusion_scale(model: ObjectModel) -> float:
    """The factor on the lengths of fusion: 1 for objects of the sizes on which its weights were fitted."""
    return float(np.clip(model.diameter / np.clip(model.diameter, *_FITTED_DIAMETERS), *_SCALES))
