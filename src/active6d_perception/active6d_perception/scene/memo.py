"""A cache of table rows by key, so that a result for a pose is computed once."""

from collections.abc import Callable, Hashable, Sequence

import numpy as np


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
            compute: (m,) indices of the keys that are not remembered to their (m, ...) rows.

        Returns:
            (k, ...) rows.
        """
        new, old = self._new, self._old
        for key in keys:
            if key not in new and key in old:
                new[key] = old[key]
        missing = list({key: index for index, key in enumerate(keys) if key not in new}.values())
        if missing or not len(keys):
            rows = compute(np.array(missing, np.intp))
            if not len(keys):
                return rows
            new.update(zip((keys[index] for index in missing), rows, strict=True))
        return np.stack([new[key] for key in keys])

    def sweep(self) -> None:
        """Forget the rows that have not been asked for since the last sweep."""
        self._old, self._new = self._new, {}
