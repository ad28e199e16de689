"""LRU cache of the blocks of a scene that is too large for memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence

from ..composition import Placed

MAX_OPEN_BLOCKS = 8  # parts that stay open; a picture needs three


class Nearby:
    """Parts by number; the most recently used are open.

    open:  opens a part by its number, on its device
    most:  largest number of open parts
    """

    def __init__(self, open: Callable[[int], Placed], count: int, most: int = MAX_OPEN_BLOCKS):
        self._open, self._count, self._most = open, count, most
        self._there: OrderedDict[int, Placed] = OrderedDict()
        self._lock = threading.RLock()

    @classmethod
    def of(cls, parts: Sequence[Placed] | Nearby) -> Nearby:
        """Wrap a list, whose parts all stay open; a Nearby is returned unchanged."""
        return parts if isinstance(parts, Nearby) else cls(parts.__getitem__, len(parts), max(1, len(parts)))

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, number: int) -> Placed:
        with self._lock:
            if number not in self._there:
                while len(self._there) >= self._most:
                    self._there.popitem(last=False)
                self._there[number] = self._open(number)
            self._there.move_to_end(number)
            return self._there[number]

    def __iter__(self) -> Iterator[Placed]:
        return (self[number] for number in range(len(self)))

    def each(self, change: Callable[[Placed], Placed]) -> Nearby:
        """Lazy map: the parts with `change` applied on access."""
        return Nearby(lambda number: change(self[number]), len(self), self._most)

    def but(self, others: Mapping[int, Placed]) -> Nearby:
        """The parts with some replaced by others, which stay open."""
        return Nearby(lambda number: others[number] if number in others else self[number], len(self), self._most)
