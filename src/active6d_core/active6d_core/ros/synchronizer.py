"""Matching of messages by their stamps."""

from collections.abc import Callable, Sequence
from typing import Any

from active6d_core.ros.conversions import OutdatedError


class StampSynchronizer:
    """Collects one value per name for each stamp and hands complete sets on, in order of their stamps.

    Args:
        names: what makes a set complete.
        callback: called with the stamp (ns) and {name: value}.
        on_loss: called with the stamp (ns) of every set that stays incomplete, and the names that it lacks.
        depth: incomplete stamps kept, more than a transient local topic repeats; the oldest is dropped first.
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
        self._last_complete = -1

    def add(self, name: str, stamp: int, value: Any) -> None:
        """Take a value; a second one for an incomplete stamp replaces the first (its sender was restarted).

        Raises:
            OutdatedError: the stamp was completed already, or is older than the last complete one.
        """
        if stamp <= self._last_complete:
            kind = "duplicate" if stamp == self._last_complete else "stale"
            raise OutdatedError(
                f"{kind} stamp {stamp * 1e-9:.3f} s of {name}, already at {self._last_complete * 1e-9:.3f} s"
            )
        self._pending.setdefault(stamp, {})[name] = value
        if self._pending[stamp].keys() == self._names:
            values = self._pending.pop(stamp)
            self._last_complete = stamp
            for overtaken in sorted(earlier for earlier in self._pending if earlier < stamp):
                self._drop(overtaken)
            self._callback(stamp, values)
        elif len(self._pending) > self._depth:
            self._drop(min(self._pending))

    def _drop(self, stamp: int) -> None:
        self._on_loss(stamp, sorted(self._names - self._pending.pop(stamp).keys()))

    def missing(self) -> dict[int, set[str]]:
        """Names still awaited, per incomplete stamp."""
        return {stamp: set(self._names - values.keys()) for stamp, values in self._pending.items()}
