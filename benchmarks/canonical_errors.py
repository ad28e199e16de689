"""How far canonical frames are from the truth, where that is known: up to one rotation for all, and to symmetry."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lumigraph.datasets.alignment import angles
from lumigraph.derive.canonical.harmonics import nearest_rotation

ROUNDS = 10


def rotation_errors(
    rotations: Float[Tensor, "some 3 3"], turns: Float[Tensor, "some 3 3"], fold: int = 1
) -> Float[Tensor, " some"]:
    """Degrees by which each instance is off once it is canonical.

    rotations: into the canonical frame
    turns:     by which each was turned since it stood upright
    fold:      of the category's symmetry: it looks alike turned by 360 / fold degrees about the vertical
    A canonical frame is as good as any other, so what all instances have in common counts as no error: the rotation
    that half of them are nearest to. Each is then compared with the nearest of its symmetric poses.
    """
    stands = rotations.double() @ turns.double()
    symmetry = about_vertical(fold)
    near = [to_nearest(stands, common, symmetry) for common in stands]
    best = min(range(len(stands)), key=lambda i: float(near[i][1].median()))
    (alike, apart), common = near[best], stands[best]
    for _ in range(ROUNDS):
        common = nearest_rotation(alike[apart <= apart.median()].mean(0))
        alike, apart = to_nearest(stands, common, symmetry)
    return apart


def to_nearest(stands: Tensor, common: Tensor, symmetry: Tensor) -> tuple[Tensor, Tensor]:
    """Each rotation's symmetric form that is nearest to a common one, and degrees between them."""
    forms = stands[:, None] @ symmetry
    apart = angles(forms.flatten(0, 1), common.expand(forms.shape[0] * forms.shape[1], 3, 3)).view(forms.shape[:2])
    least, which = apart.min(1)
    return forms[torch.arange(len(forms)), which], least


def about_vertical(fold: int) -> Float[Tensor, "turn 3 3"]:
    """The rotations about +z by whole multiples of 360 / fold degrees."""
    angle = 2 * math.pi / fold * torch.arange(fold, dtype=torch.float64)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = [[angle.cos(), -angle.sin(), zero], [angle.sin(), angle.cos(), zero], [zero, zero, one]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
