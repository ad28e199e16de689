"""Photographs of a collection's members, to learn from together."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from ...camera.rays import Rays
from ...datasets.dataset import Dataset
from ...datasets.scene import Batch, Photograph, Scene
from ...errors import LumigraphError


def photographed(member: Dataset, method: str) -> Scene:
    """A member as photographs. Raises LumigraphError for any other kind. method: to name"""
    if not isinstance(member, Scene):
        raise LumigraphError(
            f"{method} learns from collections of photographs, and {member.source} holds {member.kind}; "
            "name a folder of scenes"
        )
    return member


def rays_through(photographs: Sequence[Photograph], count: int, boxed: bool, generator: torch.Generator) -> Batch:
    """Random pixels of photographs, about as many of each. boxed: see `pixels_of`"""
    parts = []
    counts = [len(x) for x in torch.arange(count).tensor_split(len(photographs))]
    for photograph, wanted in zip(photographs, counts, strict=True):
        places = pixels_of(photograph, boxed)
        x, y = places[torch.randint(len(places), (wanted,), generator=generator)].unbind(-1)
        alpha = None if photograph.alpha is None else photograph.alpha[y, x]
        parts.append(Batch(photograph.camera.rays(torch.stack([x, y], -1) + 0.5), photograph.rgb[y, x], alpha))
    names = ("origins", "directions", "radius")
    rays = Rays(*(torch.cat([getattr(part.rays, name) for part in parts]) for name in names))
    known = [part.alpha for part in parts if part.alpha is not None]
    return Batch(rays, torch.cat([part.rgb for part in parts]), torch.cat(known) if len(known) == len(parts) else None)


def pixels_of(photograph: Photograph, boxed: bool) -> Int[Tensor, "pixel 2"]:
    """Pixels (x, y) to be trusted; boxed: within the box around what is opaque, where anything is."""
    height, width = photograph.rgb.shape[:2]
    there = torch.ones(height, width, dtype=torch.bool) if photograph.mask is None else photograph.mask.clone()
    if boxed and photograph.alpha is not None and (opaque := photograph.alpha > 0.5).any():
        rows, columns = opaque.any(1).nonzero(), opaque.any(0).nonzero()
        box = torch.zeros_like(there)
        box[int(rows.min()) : int(rows.max()) + 1, int(columns.min()) : int(columns.max()) + 1] = True
        there = there & box if (there & box).any() else there
    return there.nonzero().flip(-1)


def chance(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))
