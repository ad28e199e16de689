"""Atlas: a sparse grid of blocks, each with opacity, diffuse colour and features (Hedman 2021, arXiv 2103.14645)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor


@dataclass(frozen=True)
class ViewNetwork:
    """Network that adds the view-dependent colour to a pixel's diffuse one (section 4.2): three layers, ReLU between
    them, a sigmoid at the end. Inputs: direction encoded at four frequencies (27), diffuse colour (3), features (4).

        colour = diffuse + (1 - opacity) background + opacity network(gamma(d), diffuse, features)
        gamma(d) = (d, sin d, sin 2d, sin 4d, sin 8d, cos d, cos 2d, cos 4d, cos 8d), each x, y, z

    d is the ray's unit direction in the scene's frame; diffuse, features and opacity are summed along the ray, nothing
    behind them: s_0 = 0, T_0 = 1, s_i = s_(i-1) + T_(i-1) v_i, T_i = T_(i-1) (1 - alpha_i), one voxel a step.
    """

    weights: tuple[Float[Tensor, "in out"], Float[Tensor, "in2 out2"], Float[Tensor, "in3 3"]]
    biases: tuple[Float[Tensor, " out"], Float[Tensor, " out2"], Float[Tensor, " 3"]]


@dataclass(frozen=True)
class Atlas:
    """Voxels in blocks; `index` says where each block of the whole grid lies in the atlas, or −1 where nothing is.

    index:    block's number in the atlas, for each block of the grid (x, y, z)
    values:   of each voxel of each block with one voxel of apron around: red, green, blue, alpha, four features, all in
              256 steps. Colours and features are premultiplied by alpha = 1 − exp(−density · voxel)
    low:      corner of the grid, in the scene's frame
    voxel:    side of a voxel, in scene units
    block:    voxels along a block's side, without the apron
    network:  None where the diffuse colour is all there is
    contracted: whether the grid is the cube of [-2, 2]^3 and holds an open capture: places x beyond the unit ball lie
              at (2 - 1 / |x|) x / |x| in it (Barron 2022, eq. 10), a step is a voxel long there, and alpha is that of
              a ray straight out
    """

    index: Int[Tensor, "x y z"]
    values: UInt8[Tensor, "block side side side 8"]
    low: Float[Tensor, " 3"]
    voxel: float
    block: int
    network: ViewNetwork | None = None
    contracted: bool = False

    def voxels(self) -> tuple[Int[Tensor, "voxel 3"], UInt8[Tensor, "voxel 8"]]:
        """Positions in the grid of the occupied voxels, and their values."""
        inner = self.values[:, 1:-1, 1:-1, 1:-1]
        number, *inside = inner.any(-1).nonzero().unbind(-1)
        there = (self.index >= 0).nonzero()
        corner = torch.zeros(len(inner), 3, dtype=torch.int64)
        corner[self.index[tuple(there.unbind(-1))].long()] = there
        return corner[number] * self.block + torch.stack(inside, -1), inner[number, *inside]
