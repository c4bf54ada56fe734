"""The entry of a history that is nearest in time."""

from bisect import bisect_left
from collections.abc import Sequence


def nearest_position(stamps: Sequence[int], stamp: int) -> int | None:
    """Position of the stamp nearest to another, of stamps in order; None where there is none."""
    after = bisect_left(stamps, stamp)
    around = range(max(after - 1, 0), min(after + 1, len(stamps)))
    return min(around, key=lambda position: abs(stamps[position] - stamp), default=None)
