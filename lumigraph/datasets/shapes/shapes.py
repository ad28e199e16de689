"""Shapes: one or many meshes or clouds of points to learn from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Int
from torch import Tensor

from ...camera import Camera, ring
from ..scene import Frame
from .shape import PointBatch, Shape

CUBE = Frame(background=(1.0, 1.0, 1.0))  # of many shapes, each of which has a frame of its own


@dataclass(frozen=True)
class Shapes:
    """Shape i is members[i]. A single one is its own test: other points of the same shape.

    frame:    of a single shape its own; of many the cube that each of them fills
    splits:   numbers of members by purpose
    """

    kind: ClassVar[str] = "shapes"

    members: list[Shape]
    splits: dict[str, Int[Tensor, " member"]]
    source: str = ""

    def __len__(self) -> int:
        return len(self.members)

    @property
    def frame(self) -> Frame:
        return self.members[0].frame if len(self.members) == 1 else CUBE

    @property
    def names(self) -> list[str]:
        return [member.name for member in self.members]

    @property
    def warnings(self) -> list[str]:
        clouds = [member.name for member in self.members if member.is_cloud]
        open_ones = [member.name for member in self.members if not member.is_cloud and not member.closed]
        found = []
        if clouds:
            found.append(
                f"{listed(clouds)}: a cloud of points has no inside; distances are unsigned, and there is no occupancy"
            )
        if open_ones:
            found.append(
                f"{listed(open_ones)}: the surface is not closed; distances are unsigned, and occupancy is where the "
                "winding number is above a half"
            )
        return found

    def preview(self) -> Camera:
        """A camera of 128 pixels before it."""
        return ring(self.frame.bounds, size=128)[0]

    def sample(
        self,
        count: int,
        generator: torch.Generator,
        near: float = 0.5,
        spread: float = 0.05,
        split: str = "train",
        members: int = 1,
    ) -> PointBatch:
        """Random points with their distance and occupancy.

        near:    share of them close to the surface, Gaussian offsets away; the others lie evenly in [-1, 1]^3
        spread:  deviation of these offsets along each axis, scene units
        members: shapes that they are taken from, drawn for this batch; the points are shared out evenly
        """
        there = self.splits[split]
        drawn = there[torch.randint(len(there), (members,), generator=generator)].tolist()
        parts = []
        for place, number in enumerate(drawn):
            shape, own = self.members[number], count * (place + 1) // members - count * place // members
            close = round(near * own)
            offsets = spread * torch.randn(close, 3, generator=generator)
            elsewhere = 2 * torch.rand(own - close, 3, generator=generator) - 1
            points = torch.cat([shape.surface(close, generator).points + offsets, elsewhere])
            parts.append(shape.known(points, number))
        return PointBatch.cat(parts)


def listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
