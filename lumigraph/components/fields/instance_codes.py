"""Latent codes of a collection's members, trained with a decoder (auto-decoder), with interpolation and sampling."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ...errors import LumigraphError
from ...method.controls import AVERAGE, Control, blend
from .appearance import axes_of

FOUND = "found"  # the choice that evidence gave


class InstanceCodes(nn.Module):
    """Code of each member, zeros for untrained ones.

    most:  largest number of members
    width: length of a code
    """

    def __init__(self, most: int, width: int):
        super().__init__()
        self.rows = nn.Parameter(torch.zeros(most, width))

    def check_room(self, members: int, source: str) -> None:
        """Raise LumigraphError for more members than rows."""
        if members > len(self.rows):
            raise LumigraphError(
                f"{source} has {members} members, and there is room for {len(self.rows)} codes; "
                f"give --members {members}"
            )

    @torch.no_grad()
    def begin(self, members: Int[Tensor, " member"], deviation: float, generator: torch.Generator) -> None:
        """Initialise random codes of the training members."""
        drawn = deviation * torch.randn(len(members), self.rows.shape[1], generator=generator)
        self.rows[members.to(self.rows.device)] = drawn.to(self.rows.device)

    def forward(self, members: Int[Tensor, " member"]) -> Float[Tensor, "member code"]:
        return self.rows[members]

    @property
    def learnt(self) -> Bool[Tensor, " member"]:
        """Mask of the members with trained codes."""
        return (self.rows != 0).any(-1)

    @property
    def names(self) -> tuple[str, ...]:
        """Numbers of the members with trained codes, as text."""
        return tuple(str(number) for number in self.learnt.nonzero()[:, 0].tolist())

    @property
    def average(self) -> Float[Tensor, " code"]:
        """Mean of the trained codes; zeros without any."""
        known = self.rows.detach()[self.learnt]
        return known.mean(0) if len(known) else self.rows.detach()[0]

    @property
    def axes(self) -> Float[Tensor, "axis code"]:
        """Principal axes of the trained codes, scaled by their deviations: `average + w @ axes` with standard normal w
        has the distribution of the fitted Gaussian."""
        return axes_of(self.rows.detach()[self.learnt])

    def along(self, code: Float[Tensor, " code"]) -> Float[Tensor, " axis"]:
        """Coordinates of a code along the principal axes, in deviations from the average."""
        axes = self.axes
        return (code - self.average) @ axes.T / axes.square().sum(-1)

    def draw_code(self, seed: int) -> Float[Tensor, " code"]:
        """Random code from the Gaussian fitted to the trained codes."""
        axes = self.axes
        return self.average + torch.randn(len(axes), generator=torch.Generator().manual_seed(seed)).to(axes) @ axes

    def code_of(self, value: str, found: Float[Tensor, "found code"] | None = None) -> Float[Tensor, " code"]:
        """Code of a control's value: a member's, the average, that of evidence, or an interpolation of two, parsed by
        `controls.blend`. found: the code of evidence; no row without one"""
        known = {AVERAGE: self.average} | ({FOUND: found[0]} if found is not None and len(found) else {})
        first, second, share = blend(value)
        a, b = (known[x] if x in known else self.rows.detach()[int(x)] for x in (first, second))
        return torch.lerp(a, b, share)

    def control(self, found: bool) -> Control:
        """Control of the current instance. found: whether there is a code of evidence, then the default"""
        choices = (*([FOUND] if found else []), AVERAGE, *self.names)
        about = "Which object is shown: the one that was found or drawn, a member of the collection by its number, or "
        about += "the average of all."
        return Control("instance", choices[0], choices=choices, about=about, blends=True)
