"""Density grids of fields: where an instance is opaque, centred and scaled, as weighted points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...datasets.scene import Vector
from ...errors import LumigraphError
from ...geometry import Similarity

MIN_OPACITY = 0.1  # of a cell that counts as occupied
CHUNK_POINTS = 1 << 16  # points per density query

Density = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]


@dataclass(frozen=True)
class Instance:
    """Opaque cells of a grid as weighted points, normalised: weighted mean at the origin, spread one.

    points:  centres of the non-empty cells
    weights: opacity of each cell, 1 - exp(-density times its side); they add up to one
    place:   the similarity from that frame to the grid's
    """

    points: Float[Tensor, "cell 3"]
    weights: Float[Tensor, " cell"]
    place: Similarity

    def turned(self, rotation: Float[Tensor, "3 3"]) -> Instance:
        """The same instance rotated about its centre."""
        back = Similarity.make(1.0, rotation.T)
        return Instance(self.points @ rotation.T.to(self.points), self.weights, self.place @ back)


def sampled(density: Density, bounds: tuple[Vector, Vector], cells: int, name: str = "It") -> Instance:
    """Instance of a density within bounds.

    density: per unit of the frame of the bounds
    cells:   of the grid along the longest side
    Raises LumigraphError, naming it, if it is empty.
    """
    low, high = torch.tensor(bounds, dtype=torch.float64)
    side = float((high - low).max()) / cells
    axes = [torch.arange(a + side / 2, b, side, dtype=torch.float64) for a, b in zip(low, high, strict=True)]
    points = torch.cartesian_prod(*axes).float()
    with torch.no_grad():
        opacity = torch.cat([1 - (-side * density(some).float().cpu()).exp() for some in points.split(CHUNK_POINTS)])
    there = opacity > MIN_OPACITY
    if not there.any():
        raise LumigraphError(f"{name} is empty, nothing in it is opaque; leave it out, or train it for longer")
    weights = (opacity[there] / opacity[there].sum()).double()
    middle = (weights[:, None] * points[there]).sum(0)
    away = points[there].double() - middle
    spread = float((weights * away.square().sum(-1)).sum().sqrt().clamp_min(1e-9))
    return Instance((away / spread).float(), weights.float(), Similarity.make(spread, translation=middle))
