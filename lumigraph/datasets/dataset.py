"""Dataset: the interface of training data of any kind."""

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
        """Path of the source, or "procedural:<name>"."""

    @property
    def frame(self) -> Frame:
        """Bounds, and the similarity to the source's frame; sufficient to build a method."""

    @property
    def splits(self) -> Mapping[str, Int[Tensor, " item"]]:
        """Numbers of its items by purpose: "train", "test", maybe "val"."""

    @property
    def names(self) -> Sequence[str]:
        """Names of its items, by number."""

    @property
    def warnings(self) -> Sequence[str]:
        """Warnings for the user, one sentence each."""

    def preview(self) -> Camera | None:
        """Camera of the training previews; None for data without pictures."""


def check_kind(
    learner: str,
    wanted: type[Any],
    found: type[Any],
    source: str,
    learning_from: Callable[[type[Any]], Sequence[str]] = lambda _: (),
) -> None:
    """Raise LumigraphError for a dataset of another kind than a method learns from.

    learner:       the method's name
    learning_from: names of the methods for a kind; imports all of them, so it is called only for an error
    """
    if issubclass(found, wanted):
        return
    others = learning_from(found)
    those = f"or train what does: {', '.join(others)}" if others else f"for no method here learns from {found.kind}"
    raise LumigraphError(
        f"{learner} learns from {wanted.kind}, and {source} holds {found.kind}; name {wanted.kind} instead, {those}"
    )


def splits_of(members: int) -> dict[str, Int[Tensor, " member"]]:
    """Splits: every 8th member for testing; a single one for both."""
    index = torch.arange(members)
    held_out = index % HOLD_OUT == 0
    return {"train": index, "test": index} if members == 1 else {"train": index[~held_out], "test": index[held_out]}
