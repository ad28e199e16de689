"""Truncation: a factorised grid that does with fewer components (Chen 2022, appendix on compression)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...exchange.packing import most_important
from .factorised import FactorGrid


@torch.no_grad()
def truncate(grid: FactorGrid, share: float, weights: Float[Tensor, "product component"] | None = None) -> None:
    """Set the components to zero that matter least, which together have a share of all squared magnitude.

    weights: how much each product counts in what is made of them. None where all are summed up: then planes and lines
             are first turned into those of the singular value decomposition of their products, which no other
             components of that number come nearer to (Eckart and Young 1936)
    """
    parts = [part.view(-1, part.shape[-1]) for part in grid.factors.split(grid.table)]
    products = grid.factors.products
    together = [parts[i::products] for i in range(products)]  # a plane and its line, or three lines
    if weights is None and grid.kind == "vm":
        for plane, line in together:
            for part, found in zip((plane, line), decomposed(plane, line), strict=True):
                part.copy_(found)
    energy = torch.stack([torch.stack([part.square().sum(0) for part in some]).prod(0) for some in together])
    if weights is not None:
        energy = energy * weights.square()
    gone = ~most_important(energy.flatten(), 1 - share).view_as(energy)
    for some, columns in zip(together, gone, strict=True):
        for part in some:
            part[:, columns] = 0.0


def decomposed(
    plane: Float[Tensor, "node component"], line: Float[Tensor, "other component"]
) -> tuple[Float[Tensor, "node component"], Float[Tensor, "other component"]]:
    """Factors of the same product, orthogonal, the largest first: P' L'ᵀ = P Lᵀ."""
    (p, r), (q, s) = torch.linalg.qr(plane.double()), torch.linalg.qr(line.double())
    u, values, v = torch.linalg.svd(r @ s.T, full_matrices=False)
    root = values.sqrt()
    found = (p @ u * root, q @ v.T * root)
    missing = plane.shape[1] - len(values)
    one, other = (torch.nn.functional.pad(x, (0, missing)).to(plane) for x in found)
    return one, other
