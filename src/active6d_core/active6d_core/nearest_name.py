"""The known name that a mistyped one was probably meant to be."""

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(name: str, known: Iterable[str], alike: float = 0.6) -> str:
    """``, did you mean 'epsilon'?`` for the nearest known name; empty if none is at least so much ``alike``, of 1."""
    near = get_close_matches(str(name)[:100], list(known), n=1, cutoff=alike)
    return f", did you mean '{near[0]}'?" if near else ""
