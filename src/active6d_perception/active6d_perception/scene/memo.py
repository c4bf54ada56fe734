"""Caches of table rows by key, so that a result for a pose is computed once."""

from collections.abc import Callable, Hashable, Sequence

import numpy as np

from active6d_perception.parallel import map_rows
from active6d_perception.scene.measured_view import MeasuredView


class Memo:
    """Rows by key. Rows that are not used between two calls of :meth:`sweep` are removed.

    The cache does not change a result if ``compute`` depends on the key alone.
    """

    def __init__(self) -> None:
        self._old: dict[Hashable, np.ndarray] = {}
        self._new: dict[Hashable, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._old.keys() | self._new.keys())

    def rows(self, keys: Sequence[Hashable], compute: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the rows of all keys.

        Args:
            keys: of k rows.
            compute: (m,) indices of the keys that are not remembered to their (m, ...) rows; see :func:`.map_rows`.

        Returns:
            (k, ...) rows.
        """
        new, old = self._new, self._old
        for key in keys:
            if key not in new and key in old:
                new[key] = old[key]
        missing = list({key: index for index, key in enumerate(keys) if key not in new}.values())
        if missing or not len(keys):
            rows = map_rows(compute, [(np.array(missing, np.intp),)])[0]
            if not len(keys):
                return rows
            new.update(zip((keys[index] for index in missing), rows, strict=True))
        return np.stack([new[key] for key in keys])

    def sweep(self) -> None:
        """Forget the rows that have not been asked for since the last sweep."""
        self._old, self._new = self._new, {}


class ViewSums:
    """Sums of rows over views, by key. A view that comes after the known ones costs one row for each known key.

    Views are summed in their order, so that a sum does not depend on when it was begun. Sums that are not used between
    two calls of :meth:`sweep` are removed.
    """

    def __init__(self) -> None:
        self._views: list[MeasuredView] = []
        self._old: dict[Hashable, tuple[int, np.ndarray]] = {}
        self._new: dict[Hashable, tuple[int, np.ndarray]] = {}

    def follow(self, views: Sequence[MeasuredView]) -> None:
        """Sum over these views from now on; sums are kept if the known views are the first of them."""
        if len(self._views) > len(views) or any(a is not b for a, b in zip(self._views, views, strict=False)):
            self._old, self._new = {}, {}
        self._views = list(views)

    def sums(
        self, keys: Sequence[Hashable], compute: Callable[[np.ndarray, MeasuredView], np.ndarray], zero: np.ndarray
    ) -> np.ndarray:
        """Return the sums of all keys.

        Args:
            keys: of k rows.
            compute: (m,) indices of keys and a view to their (m, ...) rows there; see :func:`.map_rows`.
            zero: (...) sum over no view; its shape and type are those of the sums.

        Returns:
            (k, ...) sums.
        """
        number: dict[Hashable, int] = {}
        of_key = np.array([number.setdefault(key, len(number)) for key in keys], np.intp)
        known = [self._new.get(key) or self._old.get(key) or (0, zero) for key in number]
        total = np.array([total for _, total in known], zero.dtype).reshape(-1, *zero.shape)
        covered = np.array([count for count, _ in known], np.intp)
        index = np.full(len(number), -1)
        index[of_key[::-1]] = np.arange(len(keys))[::-1]
        places = range(int(covered.min(initial=len(self._views))), len(self._views))
        missing = [np.flatnonzero(covered <= place) for place in places]
        tasks = [(index[rows], self._views[place]) for place, rows in zip(places, missing, strict=True)]
        for rows, values in zip(missing, map_rows(compute, tasks), strict=True):
            total[rows] += values
        for key, row in number.items():
            self._new[key] = len(self._views), total[row]
        return total[of_key]

    def sweep(self) -> None:
        """Forget the sums that have not been asked for since the last sweep."""
        self._old, self._new = self._new, {}
