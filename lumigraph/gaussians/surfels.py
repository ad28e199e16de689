"""2D Gaussians: discs whose ray-splat intersection is exact (Huang 2024, arXiv 2403.17888), in plain PyTorch.

Slow beside the kernels: each tile is a dense matrix of pixels and discs, made again in the backward pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize, pad
from torch.utils.checkpoint import checkpoint

from ..geometry import to_matrix
from ..kernels.project import MAX_ALPHA, MIN_ALPHA
from ..kernels.tile import Tiles
from .projection import RADIUS_DEVIATIONS
from .rasterization import STOP

SCREEN_FILTER = 2.0  # of the squared distance in pixels: low-pass filter of discs seen from their edges, section 4.2
MEDIAN_TRANSMITTANCE = 0.5  # the last disc in front of it has the median depth
CHANNELS = 3  # of a normal


@dataclass(frozen=True)
class ProjectedDiscs:
    """ProjectedDiscs in one camera; rows of those that are not visible have zero radii.

    transforms: rows u, v, w of the map from a disc's (s, t, 1) to homogeneous pixels
    normals:    towards the camera, in its frame
    """

    radii: Int[Tensor, "gaussian 2"]
    centres: Float[Tensor, "gaussian 2"]
    depths: Float[Tensor, " gaussian"]
    transforms: Float[Tensor, "gaussian 3 3"]
    normals: Float[Tensor, "gaussian 3"]


def discs_of(
    means: Float[Tensor, "gaussian 3"],
    quats: Float[Tensor, "gaussian 4"],
    scales: Float[Tensor, "gaussian 3"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    near: float = 0.01,
    far: float = 1e10,
    radius_clip: float = 0.0,
) -> ProjectedDiscs:
    """Project discs; the third scale is not used (section 4.1, and the bounds of eqs. 9 to 11)."""
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    axes = viewmat[:3, :3] @ to_matrix(quats)
    normals = axes[..., 2] * torch.where((axes[..., 2] * points).sum(-1, keepdim=True) < 0, 1.0, -1.0)
    transforms = K @ torch.cat([axes[..., :2] * scales[:, None, :2], points[..., None]], -1)
    u, v, w = transforms.unbind(1)
    sign = points.new_tensor([1.0, 1.0, -1.0])
    distance = (sign * w * w).sum(-1)
    valid = distance != 0
    share = sign / torch.where(valid, distance, 1.0)[:, None]
    centres = torch.stack([(share * u * w).sum(-1), (share * v * w).sum(-1)], -1)
    squares = torch.stack([(share * u * u).sum(-1), (share * v * v).sum(-1)], -1)
    reach = (RADIUS_DEVIATIONS * (centres.square() - squares).detach().clamp_min(1e-4).sqrt()).ceil()
    z, edge = points[:, 2], reach.new_tensor(size)
    visible = valid & (z > near) & (z < far) & (reach.amax(-1) > radius_clip)
    visible &= ((centres + reach > 0) & (centres - reach < edge)).all(-1)
    shown = visible[:, None]
    transforms = torch.where(shown[..., None], transforms, 0.0)
    centres, normals = torch.where(shown, centres, 0.0), torch.where(shown, normals, 0.0)
    return ProjectedDiscs((reach * shown).int(), centres, torch.where(visible, z, 0.0), transforms, normals)


def composited_discs(
    centres: Float[Tensor, "gaussian 2"],
    transforms: Float[Tensor, "gaussian 3 3"],
    normals: Float[Tensor, "gaussian 3"],
    opacities: Float[Tensor, " gaussian"],
    values: Float[Tensor, "gaussian channel"],
    tiles: Tiles,
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width 6"]]:
    """Values, and beside them normal, opacity, distortion and median of the last channel.

    Distortion is sum_i sum_{j<i} 2 w_i w_j (m_i - m_j), m the last channel, usually depth (section 5, eq. 13).
    """
    width, height = tiles.size
    channels = values.shape[1] + CHANNELS + 3
    parts, places = [values.new_zeros(0, channels)], [torch.zeros(0, dtype=torch.int64, device=values.device)]
    tensors = transforms, centres, opacities, torch.cat([values, normals], -1)
    for k in (tiles.starts.diff() > 0).nonzero()[:, 0].tolist():
        rows = tiles.order[tiles.starts[k] : tiles.starts[k + 1]].long()
        x = torch.arange(tiles.side, device=rows.device) + k % tiles.across * tiles.side
        y = torch.arange(tiles.side, device=rows.device) + k // tiles.across * tiles.side
        pixels = torch.cartesian_prod(y[y < height], x[x < width]).flip(-1)
        parts.append(checkpoint(_tile, pixels, *(t[rows] for t in tensors), use_reentrant=False))
        places.append(pixels[:, 1] * width + pixels[:, 0])
    whole = values.new_zeros(height * width, channels).index_copy(0, torch.cat(places), torch.cat(parts))
    whole = whole.view(height, width, channels)
    return whole[..., : values.shape[1]], whole[..., values.shape[1] :]


def _tile(pixels: Tensor, transforms: Tensor, centres: Tensor, opacities: Tensor, values: Tensor) -> Tensor:
    """Values, normals, opacity, distortion and median of a tile's pixels, (P, channel + 6)."""
    at = pixels + 0.5
    u, v, w = transforms.unbind(1)
    along, down = at[:, None, :1] * w - u, at[:, None, 1:] * w - v
    cross = torch.linalg.cross(along, down)
    crossed = cross[..., 2] != 0
    place = cross[..., :2] / torch.where(crossed, cross[..., 2], 1.0)[..., None]
    screen = SCREEN_FILTER * (at[:, None] - centres).square().sum(-1)
    raw = opacities * torch.exp(-0.5 * torch.minimum(place.square().sum(-1), screen))
    alpha = torch.where(crossed & (raw >= MIN_ALPHA), raw.clamp(max=MAX_ALPHA), 0.0)
    T = pad(1 - alpha, (1, 0), value=1.0).cumprod(1)
    weights = torch.where(T[:, 1:] <= STOP, 0.0, alpha * T[:, :-1])
    m = values[:, -CHANNELS - 1]
    before, depth_before = (pad(x.cumsum(1), (1, 0))[:, :-1] for x in (weights, weights * m))
    distortion = 2 * (weights * (m * before - depth_before)).sum(1)
    counts = (weights > 0) & (T[:, :-1] > MEDIAN_TRANSMITTANCE)
    last = (counts * torch.arange(1, counts.shape[1] + 1, device=counts.device)).amax(1)
    median = torch.where(last > 0, m[(last - 1).clamp_min(0)], 0.0)
    return torch.cat([weights @ values, torch.stack([weights.sum(1), distortion, median], -1)], -1)


def normals_from_depth(
    depth: Float[Tensor, "height width"], viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "height width 3"]:
    """Unit normals of a map of z-depths, in the world, by differences of the neighbours; zero at the border."""
    height, width = depth.shape
    row, column = torch.meshgrid(*(torch.arange(n, device=depth.device) + 0.5 for n in (height, width)), indexing="ij")
    flat = torch.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], torch.ones_like(row)], -1)
    points = (depth[..., None] * flat) @ viewmat[:3, :3]
    down, across = points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2]
    return pad(normalize(torch.linalg.cross(down, across), dim=-1), (0, 0, 1, 1, 1, 1))
