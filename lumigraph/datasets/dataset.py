"""Dataset: what a method learns from, whatever kind it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from ..camera import Camera
from ..errors import LumigraphError
from .scene import Frame

HOLD_OUT = 8  # every so many members by name, the first one among them, as with photographs


@runtime_checkable
class Dataset(Protocol):
    """Interface of training data for the trainer, the run and the evaluation.

    kind: contents in a user's words: "photographs", "shapes", "a collection"
    """

    kind: ClassVar[str]

    @property
    def source(self) -> str:
        """Path that it came from, or "procedural:<name>"."""

    @property
    def frame(self) -> Frame:
        """Bounds, and the way back to the source's frame; all that a method must know to be built."""

    @property
    def splits(self) -> Mapping[str, Int[Tensor, " item"]]:
        """Numbers of its items by purpose: "train", "test", maybe "val"."""

    @property
    def names(self) -> Sequence[str]:
        """Names of its items, by number."""

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences that a user should know about it."""

    def preview(self) -> Camera | None:
        """A camera whose picture shows how far training has come; None where there is nothing to look at."""


def check_kind(
    learner: str,
    wanted: type[Any],
    found: type[Any],
    source: str,
    learning_from: Callable[[type[Any]], Sequence[str]] = lambda _: (),
) -> None:
    """Raise LumigraphError if a method that learns from one kind of dataset is to learn from another.

    learner:       the method's name
    learning_from: names of the methods that learn from a kind; it imports all of them, so only an error asks it
    """
    if issubclass(found, wanted):
        return
    others = learning_from(found)
    those = f"or train what does: {', '.join(others)}" if others else f"for no method here learns from {found.kind}"
    raise LumigraphError(
        f"{learner} learns from {wanted.kind}, and {source} holds {found.kind}; name {wanted.kind} instead, {those}"
    )


def splits_of(members: int) -> dict[str, Int[Tensor, " member"]]:
    """Every 8th member of many is for testing; a single one is for both."""
    index = torch.arange(members)
    held_out = index % HOLD_OUT == 0
    return {"train": index, "test": index} if members == 1 else {"train": index[~held_out], "test": index[held_out]}
