"""Average-linkage clustering of many small groups at once.

The fusion node clusters one scene at a time, the agent's training environment hundreds. Both call these functions, so
that their results agree.
"""

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

#: Items of a group from which on scipy's linkage is faster than merging many groups at once.
_LARGE_GROUP = 256


def cluster_groups(distance: np.ndarray, valid: np.ndarray, cut: float) -> np.ndarray:
    """Hierarchical clustering with average linkage within each of B groups.

    Average linkage merges two clusters by the mean distance of all their pairs. Single linkage would join neighbouring
    objects through outliers between them, and complete linkage would split an object because of its worst hypothesis.

    Args:
        distance: (B, m, m) symmetric, metres.
        valid: (B, m) bool, which items exist; the others are padding.
        cut: metres; clusters with a larger mean distance are not merged.

    Returns:
        (B, m) cluster of each item: the index of the cluster's first item.
    """
    size = valid.shape[1]
    labels = np.tile(np.arange(size), (len(valid), 1))
    pairs = valid[:, :, None] & valid[:, None, :]
    # If all distances are within the cut, all means are.
    tight = np.where(pairs, distance, 0.0).max(axis=(1, 2), initial=0.0) <= cut
    labels[tight] = np.where(valid[tight], valid[tight].argmax(axis=1)[:, None], labels[tight])
    groups = np.flatnonzero(~tight)
    table = np.where(pairs[groups] & ~np.eye(size, dtype=bool), distance[groups], np.inf)
    weight, label = np.ones((len(groups), size)), labels[groups]
    while len(groups):
        flat = table.reshape(len(groups), -1)
        nearest = flat.argmin(axis=1)
        open_ = flat[np.arange(len(groups)), nearest] <= cut
        if not open_.all():
            labels[groups[~open_]] = label[~open_]
            groups, table, weight = groups[open_], table[open_], weight[open_]
            label, nearest = label[open_], nearest[open_]
        row = np.arange(len(groups))
        # The first of equal entries lies above the diagonal, so that the earlier item names the cluster.
        first, second = np.divmod(nearest, size)
        share = weight[row, first] / (weight[row, first] + weight[row, second])
        merged = share[:, None] * table[row, first] + (1.0 - share)[:, None] * table[row, second]
        table[row, first], table[row, :, first] = merged, merged
        table[row, second], table[row, :, second] = np.inf, np.inf
        weight[row, first] += weight[row, second]
        label = np.where(label == second[:, None], first[:, None], label)
    return labels


def cluster(distance: np.ndarray, cut: float) -> np.ndarray:
    """:func:`cluster_groups` for one group: (k, k) distances in metres to the (k,) clusters of the items."""
    count = len(distance)
    labels = np.arange(count)
    # Clusters lie within connected components of the near pairs: no mean of larger distances is within the cut.
    members, valid = group(_components(distance <= cut))
    if valid.shape[1] > _LARGE_GROUP:
        # Scattered hypotheses of many views form chains. Merging one pair after the other costs the cube of a chain.
        for items in (row[used] for row, used in zip(members, valid, strict=True)):
            labels[items] = items[_link(distance[np.ix_(items, items)], cut)]
        return labels
    blocks = distance[members[:, :, None], members[:, None, :]]
    local = cluster_groups(blocks, valid, cut)
    labels[members[valid]] = np.take_along_axis(members, local, axis=1)[valid]
    return labels


def _link(distance: np.ndarray, cut: float) -> np.ndarray:
    """:func:`cluster_groups` for one group of any size, at the cost of the square of its size."""
    if len(distance) < 2:
        return np.zeros(len(distance), np.intp)
    numbers = fcluster(linkage(squareform(distance, checks=False), "average"), cut, "distance")
    _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    return first[inverse]


def _components(near: np.ndarray) -> np.ndarray:
    """(k,) first item of each item's connected component; for tens of items faster than a sparse graph."""
    component = near.argmax(axis=1)
    while True:
        lowest = np.where(near, component, len(near)).min(axis=1, initial=len(near))
        lowest = lowest[lowest]
        if (lowest == component).all():
            return component
        component = lowest


def group(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group items by their keys.

    Args:
        keys: (k,) integers; items with equal keys form a group.

    Returns:
        (B, m) indices of the items of each group, rising, with arbitrary padding; (B, m) bool, which are not padding.
    """
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1 if not len(keys) else keys[order[0]] - 1))
    sizes = np.diff(starts, append=len(keys))
    place = np.arange(sizes.max(initial=0))
    valid = place < sizes[:, None]
    return order[np.minimum(starts[:, None] + place, max(len(keys) - 1, 0))], valid
