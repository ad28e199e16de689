"""Collection: many datasets by name, split by member, for priors across scenes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Int
from torch import Tensor

from ..camera import Camera
from ..errors import LumigraphError, LumigraphWarning
from ..files.names import natural
from .dataset import Dataset, splits_of
from .scene import Frame

MAX_OPEN = 256  # members that stay open, the most recently used


@dataclass(frozen=True)
class Collection:
    """Datasets by name; member i is names[i], opened on first use and kept open.

    A member that cannot be opened is skipped with a warning.

    openers: functions that open each member, by name
    frame:   the cube that all members fill, with the background, alpha and reach of the first training member; each
             member has a frame of its own
    splits:  numbers of members by purpose
    """

    kind: ClassVar[str] = "a collection"

    openers: Mapping[str, Callable[[], Dataset]]
    splits: dict[str, Int[Tensor, " member"]]
    source: str = ""
    _opened: dict[str, Dataset] = field(default_factory=dict, repr=False, compare=False)
    _faults: dict[str, str] = field(default_factory=dict, repr=False, compare=False)  # of members passed over, by name

    @staticmethod
    def of(members: Mapping[str, Dataset | Callable[[], Dataset]], source: str = "") -> Collection:
        """Build from datasets, or functions that open them, by name; hold out every 8th, starting with the first."""
        names = sorted(members, key=natural)
        ready = {name: x for name, x in members.items() if not callable(x)}
        openers = {name: opener_of(members[name]) for name in names}
        return Collection(openers, splits_of(len(names)), source, ready)

    @property
    def names(self) -> list[str]:
        return list(self.openers)

    def __len__(self) -> int:
        return len(self.openers)

    def __getitem__(self, name: str) -> Dataset:
        """Member by name. Raises LumigraphError where it cannot be opened."""
        found = self._opened.pop(name, None) or self.openers[name]()
        self._opened[name] = found  # the latest last
        while len(self._opened) > MAX_OPEN:
            del self._opened[next(iter(self._opened))]
        return found

    def members(self, split: str = "train") -> Iterator[tuple[str, Dataset]]:
        """Names and datasets of a split, opened one by one; members that cannot be opened are skipped. Raises
        LumigraphError where none can."""
        read = 0
        for number in self._numbers(split):
            if (found := self._readable(number)) is not None:
                read += 1
                yield self.names[number], found
        if not read:
            raise self._unreadable(split)

    @cached_property
    def frame(self) -> Frame:
        first, plain = self._first.frame, Frame()
        scale = plain.source_from_scene
        return replace(first, bounds=plain.bounds, forward=None, source_from_scene=scale, metric=False)

    @property
    def warnings(self) -> list[str]:
        """Warnings of the open members, and the names of skipped members."""
        told = [f"{name}: {warning}" for name, data in self._opened.items() for warning in data.warnings]
        return told + [skipped(name, fault) for name, fault in self._faults.items()]

    def preview(self) -> Camera | None:
        """Preview of the first training member."""
        return self._first.preview()

    def sample_member(self, generator: torch.Generator, split: str = "train") -> tuple[int, Dataset]:
        """A random member for one step: its number and its dataset. Raises LumigraphError where none can be opened."""
        there = self._numbers(split)
        while not all(self.names[number] in self._faults for number in there):
            number = there[int(torch.randint(len(there), (), generator=generator))]
            if (found := self._readable(number)) is not None:
                return number, found
        raise self._unreadable(split)

    @property
    def _first(self) -> Dataset:
        """The first training member that can be opened."""
        return next(self.members())[1]

    def _numbers(self, split: str) -> list[int]:
        there = self.splits.get(split)
        if there is None or not len(there):
            kinds = ", ".join(f"{name} ({len(index)} members)" for name, index in self.splits.items() if len(index))
            raise LumigraphError(f"{self.source} has no members in the split {split!r}; there are: {kinds or 'none'}")
        return there.tolist()

    def _readable(self, number: int) -> Dataset | None:
        """A member; None, with a warning the first time, where it cannot be opened."""
        if (name := self.names[number]) in self._faults:
            return None
        try:
            return self[name]
        except (LumigraphError, OSError) as fault:
            self._faults[name] = str(fault)
            warnings.warn(skipped(name, str(fault)), LumigraphWarning, stacklevel=3)
            return None

    def _unreadable(self, split: str) -> LumigraphError:
        names = [self.names[number] for number in self._numbers(split)]
        return LumigraphError(
            f"{self.source}: none of its {len(names)} members in the split {split!r} can be read; "
            f"{names[0]}, for one: {self._faults.get(names[0], 'it could not be opened')}"
        )


def skipped(name: str, fault: str) -> str:
    return f"{name} cannot be read and is passed over: {fault}"


def opener_of(member: Dataset | Callable[[], Dataset]) -> Callable[[], Dataset]:
    return member if callable(member) else (lambda: member)
