"""Blocks of splats: clouds that were trained apart, each in a part of a large scene, as one cloud of that scene.

Each block sees beyond its own ground, and models what is out there from afar and badly. So each gives only what lies
in its own cell; cells touch and do not overlap, and nothing of the scene is there twice (Lin 2024, VastGaussian,
section 3.4; Liu 2024, CityGaussian, section 3.3).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..composition import Placed
from ..errors import LumigraphError
from ..gaussians import Gaussians, joined


@torch.no_grad()
def merged(parts: Sequence[Placed], centres: Float[Tensor, "block 3"] | None = None) -> Gaussians:
    """One cloud in the frame that the parts are placed in: of each part the Gaussians whose centres its cell holds.

    parts:   one for each block, its method a cloud; a part's crop, in the part's own frame, holds besides its cell
    centres: of the blocks, in the order of the parts, in the common frame; a part's cell are the points nearest to its
             centre (Voronoi's), which reach to infinity at the outermost blocks, so that the sky is kept once as well.
             None where the parts' crops are the cells
    Ground plans stay upright where all centres have the same height. Harmonics, and what opacities mean, as `joined`
    has them. Raises LumigraphError where parts and centres differ in number, no part is given, or one is no cloud.
    """
    if not parts or (centres is not None and len(centres) != len(parts)):
        raise LumigraphError(
            f"{len(parts)} blocks of splats and {0 if centres is None else len(centres)} centres do not go together; "
            "give each block its centre"
        )
    clouds = [part.gaussians() for part in parts]
    if centres is not None:
        clouds = [cloud[nearest(cloud.means, centres) == i] for i, cloud in enumerate(clouds)]
    return joined(clouds)


def nearest(points: Float[Tensor, "point 3"], centres: Float[Tensor, "block 3"]) -> Int[Tensor, " point"]:
    """The number of the centre nearest to each point, the first of equals."""
    best = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    least = torch.full((len(points),), torch.inf, dtype=torch.float64, device=points.device)
    for i, centre in enumerate(centres.to(points.device).double()):
        squared = (points - centre).square().sum(-1)
        best = torch.where(squared < least, i, best)
        least = torch.minimum(squared, least)
    return best
