"""Collection: many datasets by name, split by member, to learn from what they have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Int
from torch import Tensor

from .camera import Camera
from .dataset import Dataset, splits_of
from .names import natural
from .scene import Frame


@dataclass(frozen=True)
class Collection:
    """Member i is called names[i] and is opened when it is first asked for.

    openers: what opens each, by name
    frame:   the cube that all members fill, with the background, alpha and reach of the first one to learn from; each
             member has a frame of its own
    splits:  numbers of members by purpose
    """

    kind: ClassVar[str] = "a collection"

    openers: Mapping[str, Callable[[], Dataset]]
    splits: dict[str, Int[Tensor, " member"]]
    source: str = ""
    _opened: dict[str, Dataset] = field(default_factory=dict, repr=False, compare=False)

    @staticmethod
    def of(members: Mapping[str, Dataset | Callable[[], Dataset]], source: str = "") -> Collection:
        """Of datasets, or of what opens them, by name; every 8th is held out, the first one among them."""
        names = sorted(members, key=natural)
        ready = {name: x for name, x in members.items() if isinstance(x, Dataset)}
        openers = {name: opener_of(members[name]) for name in names}
        return Collection(openers, splits_of(len(names)), source, ready)

    @property
    def names(self) -> list[str]:
        return list(self.openers)

    def __len__(self) -> int:
        return len(self.openers)

    def __getitem__(self, name: str) -> Dataset:
        if name not in self._opened:
            self._opened[name] = self.openers[name]()
        return self._opened[name]

    def members(self, split: str = "train") -> Iterator[tuple[str, Dataset]]:
        """Names and datasets of a split, opened one by one."""
        for number in self.splits[split].tolist():
            yield self.names[number], self[self.names[number]]

    @cached_property
    def frame(self) -> Frame:
        first = self[self.names[int(self.splits["train"][0])]].frame
        plain = Frame()
        return replace(first, bounds=plain.bounds, source_from_scene=plain.source_from_scene, forward=None)

    @property
    def warnings(self) -> list[str]:
        """Those of the members that are open."""
        return [f"{name}: {warning}" for name, data in self._opened.items() for warning in data.warnings]

    def preview(self) -> Camera | None:
        """That of the first member to learn from."""
        return self[self.names[int(self.splits["train"][0])]].preview()

    def sample_member(self, generator: torch.Generator, split: str = "train") -> tuple[int, Dataset]:
        """A random member, for one step: its number and its dataset."""
        there = self.splits[split]
        number = int(there[torch.randint(len(there), (), generator=generator)])
        return number, self[self.names[number]]


def opener_of(member: Dataset | Callable[[], Dataset]) -> Callable[[], Dataset]:
    return (lambda: member) if isinstance(member, Dataset) else member
