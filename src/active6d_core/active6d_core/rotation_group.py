"""The finite group of rotations that some rotations generate."""

import numpy as np

#: Rotations of the largest group: those of a prism with sixty sides. A twenty-sided die has sixty.
LARGEST_GROUP = 120
#: Coordinates of rotations that count as the same; data sets round theirs.
_SAME_ROTATION = 1e-3


def rotation_group(generators: np.ndarray) -> np.ndarray:
    """(s, 3, 3) all products of (g, 3, 3) rotations, the identity first.

    Symmetries must be a complete group. Otherwise an error would depend on which of two symmetric poses is the true
    one.

    Raises:
        ValueError: there are more than ``LARGEST_GROUP`` products.
    """
    group = [np.eye(3)]
    for element in group:  # grows while it is read
        for product in generators @ element:
            if np.abs(np.array(group) - product).max(axis=(1, 2)).min() < _SAME_ROTATION:
                continue
            if len(group) == LARGEST_GROUP:
                raise ValueError(f"they generate no finite group of at most {LARGEST_GROUP} rotations")
            group.append(product)
    return np.array(group)
