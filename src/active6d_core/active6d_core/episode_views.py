"""Views of an episode, kept by their stamps in the order in which they were added."""

from collections.abc import Mapping
from typing import TypeVar

_View = TypeVar("_View")


def views_from(views: Mapping[int, _View], stamp: int) -> dict[int, _View]:
    """The view of ``stamp`` (nanoseconds) and those added after it; none without that view."""
    stamps = list(views)
    first = stamps.index(stamp) if stamp in views else len(stamps)
    return {at: views[at] for at in stamps[first:]}
