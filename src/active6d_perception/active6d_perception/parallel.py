"""Runs compiled functions on several cores at the same time: they release the GIL (:mod:`.compiled`)."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numba
import numpy as np

# A task of fewer rows takes less time than handing it over; more threads than these wait for each other.
_ROWS, _MOST_THREADS = 8, 4


def thread_count() -> int:
    """Threads that are used: one per core, at most 4; ``NUMBA_NUM_THREADS`` in the environment limits them."""
    return min(_MOST_THREADS, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_count(), thread_name_prefix="compiled")


# Threads do not exist in a forked process.
os.register_at_fork(after_in_child=_pool.cache_clear)


def map_rows(compute: Callable[..., np.ndarray], tasks: Sequence[tuple[Any, ...]]) -> list[np.ndarray]:
    """Compute rows of tables in parallel. The result does not depend on the number of threads.

    Args:
        compute: from some of a task's rows and the rest of the task to their (., ...) values. It runs several times at
            once, so it must not change what it shares, and a row must not depend on the others.
        tasks: of each, (m,) indices of rows, and more arguments of ``compute``.

    Returns:
        For every task its (m, ...) values.
    """
    threads = thread_count()
    if threads == 1 or sum(len(rows) for rows, *_ in tasks) < 2 * _ROWS:
        return [compute(*task) for task in tasks]
    running = [
        [
            _pool().submit(compute, part, *more)
            for part in np.array_split(rows, min(threads, max(1, len(rows) // _ROWS)))
        ]
        for rows, *more in tasks
    ]
    return [np.concatenate([part.result() for part in parts]) for parts in running]
