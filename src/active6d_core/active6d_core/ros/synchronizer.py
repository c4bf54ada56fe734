"""Matching of messages by their stamps."""

from collections.abc import Callable, Sequence
from typing import Any

from active6d_core.ros.conversions import OutdatedError

#: Stamps remembered as over; a restarted node repeats far fewer messages.
_REMEMBERED = 256


class StampSynchronizer:
    """Collects one value per name for each stamp and hands complete sets on.

    Order of arrival decides what is old, never the stamps themselves. A single message stamped in the future would
    otherwise make everything after it look outdated.

    Args:
        names: what makes a set complete.
        callback: called with the stamp (ns) and {name: value}.
        on_loss: called with the stamp (ns) of every set that stays incomplete, and the names that it lacks.
        depth: incomplete sets kept, more than a transient local topic repeats; the one that began first is dropped
            first, never the one that has just come.
    """

    def __init__(
        self,
        names: Sequence[str],
        callback: Callable[[int, dict[str, Any]], None],
        on_loss: Callable[[int, list[str]], None] = lambda stamp, absent: None,
        depth: int = 16,
    ) -> None:
        self._names = frozenset(names)
        self._callback = callback
        self._on_loss = on_loss
        self._depth = depth
        self._pending: dict[int, dict[str, Any]] = {}
        self._over: dict[int, str] = {}
        self._begun = 0
        self._place: dict[int, int] = {}

    def add(self, name: str, stamp: int, value: Any) -> None:
        """Take a value; a second one for an incomplete stamp replaces the first (its sender was restarted).

        A complete set ends the sets with smaller stamps that are still incomplete.

        Raises:
            OutdatedError: the set of this stamp was completed or ended already.
        """
        if stamp in self._over:
            raise OutdatedError(f"{self._over[stamp]} {stamp * 1e-9:.3f} s of {name}")
        if stamp not in self._pending:
            self._pending[stamp] = {}
            self._begun += 1
            self._place[stamp] = self._begun
        self._pending[stamp][name] = value
        if self._pending[stamp].keys() == self._names:
            values = self._pending.pop(stamp)
            self._close(stamp, "duplicate stamp")
            for earlier in [other for other in self._pending if other < stamp]:
                self._drop(earlier)
            self._callback(stamp, values)
        elif len(self._pending) > self._depth:
            # A stamp that has lost its place may come again from another sender: it is not over.
            oldest = next(iter(self._pending))
            del self._place[oldest]
            self._on_loss(oldest, sorted(self._names - self._pending.pop(oldest).keys()))

    def over(self, stamp: int) -> bool:
        """Whether the set of this stamp was completed or ended."""
        return stamp in self._over

    def end_before(self, stamp: int) -> None:
        """End the incomplete sets that began before the one of ``stamp``; all of them if that one has not begun."""
        place = self._place.get(stamp, self._begun + 1)
        for other in [each for each in self._pending if self._place[each] < place]:
            del self._pending[other]
            self._close(other, "older than the episode, stamp")

    def missing(self) -> dict[int, set[str]]:
        """Names still awaited, per incomplete stamp, in the order in which the sets began."""
        return {stamp: set(self._names - values.keys()) for stamp, values in self._pending.items()}

    def _drop(self, stamp: int) -> None:
        absent = sorted(self._names - self._pending.pop(stamp).keys())
        self._close(stamp, "stale stamp")
        self._on_loss(stamp, absent)

    def _close(self, stamp: int, reason: str) -> None:
        self._over[stamp] = reason
        if len(self._over) > _REMEMBERED:
            oldest = next(iter(self._over))
            del self._over[oldest], self._place[oldest]
