"""Codes of a collection's members, learnt beside a decoder (auto-decoder), and those between and beside them."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ...errors import LumigraphError
from ...method.controls import AVERAGE, Control, blend
from .appearance import axes_of

FOUND = "found"  # the choice that evidence gave


class InstanceCodes(nn.Module):
    """Numbers of each member, zeros of those that are not learnt from.

    most:  members that there are room for
    width: numbers of a code
    """

    def __init__(self, most: int, width: int):
        super().__init__()
        self.rows = nn.Parameter(torch.zeros(most, width))

    def check_room(self, members: int, source: str) -> None:
        """Raises LumigraphError for more members than rows."""
        if members > len(self.rows):
            raise LumigraphError(
                f"{source} has {members} members, and there is room for {len(self.rows)} codes; "
                f"give --members {members}"
            )

    @torch.no_grad()
    def begin(self, members: Int[Tensor, " member"], deviation: float, generator: torch.Generator) -> None:
        """Random codes for the members to learn from."""
        drawn = deviation * torch.randn(len(members), self.rows.shape[1], generator=generator)
        self.rows[members.to(self.rows.device)] = drawn.to(self.rows.device)

    def forward(self, members: Int[Tensor, " member"]) -> Float[Tensor, "member code"]:
        return self.rows[members]

    @property
    def learnt(self) -> Bool[Tensor, " member"]:
        """The members whose codes were learnt."""
        return (self.rows != 0).any(-1)

    @property
    def names(self) -> tuple[str, ...]:
        """Numbers of the members whose codes were learnt, as text."""
        return tuple(str(number) for number in self.learnt.nonzero()[:, 0].tolist())

    @property
    def average(self) -> Float[Tensor, " code"]:
        """The mean of the codes that were learnt; zeros where none was."""
        known = self.rows.detach()[self.learnt]
        return known.mean(0) if len(known) else self.rows.detach()[0]

    @property
    def axes(self) -> Float[Tensor, "axis code"]:
        """Along which the codes that were learnt differ, each as long as their deviation along it: `average + w @ axes`
        is distributed as the Gaussian that fits them, where w is of the standard normal distribution."""
        return axes_of(self.rows.detach()[self.learnt])

    def along(self, code: Float[Tensor, " code"]) -> Float[Tensor, " axis"]:
        """Coordinates of a code along the axes, in deviations from the average."""
        axes = self.axes
        return (code - self.average) @ axes.T / axes.square().sum(-1)

    def drawn(self, generator: torch.Generator) -> Float[Tensor, " code"]:
        """A code from the Gaussian that fits those that were learnt."""
        axes = self.axes
        return self.average + torch.randn(len(axes), generator=generator).to(axes) @ axes

    def code_of(self, value: str, **others: Float[Tensor, " code"]) -> Float[Tensor, " code"]:
        """The code that a control's value stands for: a member's, the average, one of the others by its name, or one
        between two, as `controls.blend` takes values apart."""
        known = {AVERAGE: self.average} | others
        first, second, share = blend(value)
        a, b = (known[x] if x in known else self.rows.detach()[int(x)] for x in (first, second))
        return torch.lerp(a, b, share)

    def control(self, found: bool) -> Control:
        """Control of the instance that is shown. found: whether there is a code of evidence, then the default"""
        choices = (*([FOUND] if found else []), AVERAGE, *self.names)
        about = "Which object is shown: the one that was found or drawn, a member of the collection by its number, or "
        about += "the average of all."
        return Control("instance", choices[0], choices=choices, about=about, blends=True)
