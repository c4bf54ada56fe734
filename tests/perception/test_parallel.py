"""Rows that are computed on several cores are those of one."""

import os
import threading

import numpy as np
import pytest

from active6d_perception import parallel
from active6d_perception.parallel import map_rows


@pytest.fixture(params=[1, 2, 4])
def threads(monkeypatch, request):
    """So many threads, whatever the machine has."""
    monkeypatch.setattr(parallel, "thread_count", lambda: request.param)
    parallel._pool.cache_clear()
    yield request.param
    parallel._pool().shutdown()
    parallel._pool.cache_clear()


def test_every_task_has_its_rows_in_their_order(threads):
    rows = [np.arange(40), np.array([], np.intp), np.array([7, 7, 3]), np.arange(100)[::-1]]
    used = set()

    def power(index, exponent):
        used.add(threading.get_ident())
        return np.stack([index**exponent, index], axis=1)

    found = map_rows(power, [(index, exponent) for exponent, index in enumerate(rows)])
    for exponent, (index, values) in enumerate(zip(rows, found, strict=True)):
        np.testing.assert_array_equal(values, np.stack([index**exponent, index], axis=1))
    assert (threading.get_ident() in used) == (threads == 1)


def test_few_rows_are_not_handed_over(threads):
    (names,) = map_rows(lambda index: np.full(len(index), threading.get_ident()), [(np.arange(9),)])
    assert set(names) == {threading.get_ident()}


def test_a_failure_reaches_the_caller(threads):
    def fail(index):
        raise ValueError(f"{len(index)} rows")

    with pytest.raises(ValueError, match="rows"):
        map_rows(fail, [(np.arange(100),)])


@pytest.mark.parametrize("threads", [2], indirect=True)
def test_a_forked_process_has_threads_of_its_own(threads):
    def total():
        return sum(int(values.sum()) for values in map_rows(lambda index: index, [(np.arange(100),)]))

    assert total() == 4950
    child = os.fork()
    if child == 0:
        os._exit(0 if total() == 4950 else 1)
    assert os.waitpid(child, 0)[1] == 0
