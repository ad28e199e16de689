"""Interface for reporting the progress of long work."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

# (items, what is being done, how many there will be) -> the items one by one; display.track is one
Track = Callable[[Iterable[Any], str, int], Iterator[Any]]


def untracked(items: Iterable[Any], description: str, total: int) -> Iterator[Any]:
    """Tells nobody."""
    yield from items
