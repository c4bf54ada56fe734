"""Matching of messages by their stamps."""

from collections.abc import Callable, Sequence
from typing import Any

from active6d_core.ros.conversions import MessageError, OutdatedError


class StampSynchronizer:
    """Collects one value per name for each stamp and hands complete sets on, in order of their stamps.

    Args:
        names: what makes a set complete.
        callback: called with the stamp (ns) and {name: value}.
        depth: incomplete stamps kept, more than a transient local topic repeats; the oldest is dropped first.
    """

    def __init__(self, names: Sequence[str], callback: Callable[[int, dict[str, Any]], None], depth: int = 16) -> None:
        self._names = frozenset(names)
        self._callback = callback
        self._depth = depth
        self._pending: dict[int, dict[str, Any]] = {}
        self._last_complete = -1

    def add(self, name: str, stamp: int, value: Any) -> None:
        """Take a value; a second one for an incomplete stamp replaces the first (its sender was restarted).

        Raises:
            OutdatedError: the stamp was completed already, or is older than the last complete one.
            MessageError: the value is taken, but an older incomplete set had to make room.
        """
        if stamp <= self._last_complete:
            kind = "duplicate" if stamp == self._last_complete else "stale"
            raise OutdatedError(
                f"{kind} stamp {stamp * 1e-9:.3f} s of {name}, already at {self._last_complete * 1e-9:.3f} s"
            )
        self._pending.setdefault(stamp, {})[name] = value
        if self._pending[stamp].keys() == self._names:
            values = self._pending[stamp]
            self._last_complete = stamp
            self._pending = {later: kept for later, kept in self._pending.items() if later > stamp}
            self._callback(stamp, values)
        elif len(self._pending) > self._depth:
            oldest = min(self._pending)
            absent = ", ".join(sorted(self._names - self._pending.pop(oldest).keys()))
            raise MessageError(f"view of {oldest * 1e-9:.3f} s is dropped: no {absent} for it")

    def missing(self) -> dict[int, set[str]]:
        """Names still awaited, per incomplete stamp."""
        return {stamp: set(self._names - values.keys()) for stamp, values in self._pending.items()}
