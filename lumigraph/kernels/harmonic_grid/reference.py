"""Reference implementation: all 28 channels interpolated, then a scalar product with the harmonics."""

import torch
from torch import Tensor

from ..sparse_grid import Nodes
from ..sparse_grid.reference import run as interpolated
from ..spherical_harmonics.reference import run as basis
from . import BANDS


def run(points: Tensor, directions: Tensor, nodes: Nodes, density: Tensor, harmonics: Tensor) -> tuple[Tensor, Tensor]:
    blended = interpolated(points.detach(), nodes, torch.cat([density[:, None], harmonics.flatten(1)], 1))
    coefficients = blended[:, 1:].unflatten(1, harmonics.shape[1:])
    return blended[:, 0], (basis(directions.detach(), BANDS)[:, :, None] * coefficients).sum(1)
