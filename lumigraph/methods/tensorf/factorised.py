"""A factorised grid: trainable planes and lines, resampled from coarse to fine."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...exchange.packing import most_important
from ...kernels.factor_grid import MODES, Factors, Kind

Nodes = tuple[int, int, int]
Ends = tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]


class FactorGrid(nn.Module):
    """`kernels.factor_grid` with factors of its own, over the unit cube (Chen 2022, section 3).

    kind:       vm (planes and lines) or cp (lines)
    components: of each factor
    deviation:  of the normal distribution that values begin with
    """

    grows: ClassVar[tuple[str, ...]] = ("table",)
    table: nn.Parameter
    nodes: Tensor

    def __init__(self, kind: Kind, nodes: Nodes, components: int, deviation: float = 0.1):
        super().__init__()
        self.kind: Kind = kind
        self.register_buffer("nodes", torch.tensor(nodes))
        self.table = nn.Parameter(deviation * torch.randn(Factors(kind, nodes).rows, components))
        self.register_load_state_dict_post_hook(_check_rows)

    @property
    def factors(self) -> Factors:
        x, y, z = self.nodes.tolist()
        return Factors(self.kind, (x, y, z))

    def forward(self, points: Float[Tensor, "sample 3"], summed: bool = False) -> Float[Tensor, "sample width"]:
        return kernels.factor_grid(points, self.table, self.factors, summed)

    @torch.no_grad()
    def resampled(self, nodes: Nodes, part: Ends) -> Float[Tensor, "row component"]:
        """A table resampled to other nodes over a part of the cube, corner-aligned, by linear interpolation (section
        4.4: upsampling, and shrinking to the occupied region)."""
        places = [torch.linspace(float(a), float(b), n) for a, b, n in zip(*part, nodes, strict=True)]
        factors = self.factors
        axes = [mode[:2] for mode in MODES] if self.kind == "vm" else []
        found = []
        for values, along in zip(factors.split(self.table), [*axes, (0,), (1,), (2,)], strict=True):
            for dimension, axis in enumerate(along):
                values = _between(values, dimension, places[axis].to(values))
            found.append(values.flatten(0, -2))
        return torch.cat(found)

    def sparsity(self) -> Float[Tensor, ""]:
        """Mean magnitude of each factor, summed over them: the L1 loss of section 4.2."""
        return torch.stack([part.abs().mean() for part in self.factors.split(self.table)]).sum()

    def variation(self) -> Float[Tensor, ""]:
        """Mean square of the difference between neighbours along each axis of each plane, or of each line where there
        are no planes, summed over them: the total variation of section 4.2, as its code takes it."""
        factors = self.factors
        parts = factors.split(self.table)[:3]
        return torch.stack([x.diff(dim=axis).square().mean() for x in parts for axis in range(x.ndim - 1)]).sum()


def _check_rows(grid: FactorGrid, keys: object) -> None:
    """Raise RuntimeError, as PyTorch does where weights do not fit, unless a loaded table has its nodes' rows."""
    try:
        rows = grid.factors.rows
    except ValueError as error:
        raise RuntimeError(str(error)) from error
    if len(grid.table) != rows:
        raise RuntimeError(f"a table of {len(grid.table):,} rows, where {grid.nodes.tolist()} nodes have {rows:,}")


def nodes_in(box: Float[Tensor, "2 3"], resolution: int) -> Nodes:
    """Nodes along each axis of a box that has about resolution^3 of them, as far apart along all."""
    extent = (box[1] - box[0]).double().clamp_min(1e-6)
    spacing = float(extent.prod()) ** (1 / 3) / resolution
    x, y, z = (min(max(round(float(e) / spacing), 2), 8 * resolution) for e in extent)
    return x, y, z


def _between(values: Tensor, dimension: int, places: Float[Tensor, " new"]) -> Tensor:
    """Values at places in [0, 1] along one dimension, from those at its nodes."""
    last = values.shape[dimension] - 1
    at = (places * last).clamp(0, last)
    node = at.long().clamp(max=last - 1)
    share = (at - node).view(-1, *[1] * (values.ndim - 1 - dimension))
    return torch.lerp(values.index_select(dimension, node), values.index_select(dimension, node + 1), share)


@torch.no_grad()
def truncate(grid: FactorGrid, share: float, weights: Float[Tensor, "product component"] | None = None) -> None:
    """Zero the least important components, with a given share of the squared magnitude in total.

    weights: of each product in the output. None for a plain sum: then planes and lines are first replaced by the
             singular value decomposition of their products, the best approximation with that number of components
             (Eckart and Young 1936)
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
