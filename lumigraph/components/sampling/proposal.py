"""Proposal grid: a coarse density grid that places a field's samples (Barron 2022, section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...camera.rays import Rays, Samples
from ...volume import weights_of
from ..fields.layers import LIMIT, truncated_exp
from ..fields.spaces import NDC, Contraction, Space, fits_kernels
from ..fields.voxels import VoxelGrid
from .loops import sum_excess
from .sampling import FAINT, inverse_transform, loops_fit

FLAT = (1.5, 1.5, 0.5)  # a forward-facing capture has few depths and many pixels
LITTLE = 1e-5  # weight that counts as none in the loss
SLOPE = 10.0  # of annealing (Barron 2022, appendix)
SHARP = 0.3  # share of the budget after which samples lie where the grid says
DENSE, THIN = 3.0, -3.0  # log density per unit of the coordinates, where places on surfaces are known and elsewhere
SPARE = 0.01  # share of samples that lie anywhere, however little was found there


@dataclass(frozen=True)
class Proposed:
    """Proposals for a batch of rays.

    samples: intervals for the field, as many on each ray
    edges:   of these intervals, as positions from 0 to 1 between near and far
    bins:    edges of the grid's own intervals, in the same unit
    weights: of the grid in those
    """

    samples: Samples
    edges: Float[Tensor, "ray edge"]
    bins: Float[Tensor, "ray bin_edge"]
    weights: Float[Tensor, "ray bin"]


class Proposal(nn.Module):
    """A voxel grid over a space's coordinates, trained to bound the field's weights from above.

    Each ray is sampled everywhere in the grid, and then in the field where the grid has weight. So a ray costs the same
    in fog and in clear air, and regions not yet contradicted by a photograph stay reachable.
    """

    def __init__(self, space: Space, cells: int, bins: int, count: int):
        super().__init__()
        self.space, self.bins, self.count = space, bins, count
        finer = FLAT if isinstance(space, NDC) else (1.0, 1.0, 1.0)
        self.grid = VoxelGrid([[-1.0] * 3, [1.0] * 3], cells**3, 1, finer)
        self.sharpness = 1.0

    def anneal(self, progress: float) -> None:
        """Anneal from nearly uniform sampling. progress: spent share of the budget"""
        share = min(1.0, progress / SHARP)
        self.sharpness = SLOPE * share / ((SLOPE - 1) * share + 1)

    def sample(self, rays: Rays, jitter: Float[Tensor, "ray 2"] | None = None) -> Proposed:
        """Intervals for a field, differentiable in the grid through the weights alone.

        jitter: in [0, 1), shifts each ray's intervals, the grid's and the field's, by that share of one
        """
        rays = replace(rays, origins=rays.origins.detach(), directions=rays.directions.detach())
        near, far = self.space.interval(rays)
        if jitter is None:
            jitter = rays.origins.new_full((len(rays), 2), 0.5)
        bins = edges_of(self.bins, jitter[:, 0])
        looked = self._samples(bins, rays, near, far)
        density = self._density(looked.along(rays)[0])
        weights = weights_of(looked, density).view(len(rays), self.bins)
        with torch.no_grad():
            spread = weights**self.sharpness
            spread = spread + SPARE / self.bins * spread.sum(-1, keepdim=True)
            edges = inverse_transform(bins, spread, edges_of(self.count, jitter[:, 1]))
            samples = self._samples(edges, rays, near, far)
        return Proposed(samples, edges, bins, weights)

    @torch.no_grad()
    def places(self, rays: Rays) -> Samples:
        """The intervals of `sample` for a field, without jitter."""
        if not (isinstance(self.space, Contraction | NDC) and fits_kernels(rays.origins)):
            return self.sample(rays).samples
        origins, directions, frustum = rays.origins, rays.directions, None
        if isinstance(self.space, NDC):
            (origins, directions), frustum = self.space.camera_rays(rays), self.space.frustum
        near, far = self.space.interval(rays)
        grid = self.grid.values.view(self.grid.shape)
        resampling = kernels.Resampling(self.bins, self.count, self.sharpness, SPARE, FAINT, 2 * LIMIT)
        t = kernels.sample_proposals(origins, directions, near, far, grid, resampling, frustum)
        return Samples.rows(t[:, :-1], t[:, -1])

    @torch.no_grad()
    def begin(self, points: Float[Tensor, "point 3"]) -> None:
        """Initialise with density near known points, and little elsewhere."""
        grid, (x, y, z) = self.grid, self.grid.shape
        size = grid.size.to(points.device) - 1
        index = ((self.space.warp(points) + 1) / 2 * size).clamp(min=0)
        index = torch.minimum(index, size).round().long()
        found = torch.zeros(x * y * z, device=points.device)
        found[(index[:, 0] * y + index[:, 1]) * z + index[:, 2]] = 1
        found = nn.functional.max_pool3d(found.view(1, x, y, z), 3, 1, 1)
        grid.values.copy_(torch.where(found.view(-1, 1) > 0, DENSE, THIN))

    def _density(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        coordinates, stretch = self.space.mapped(points)
        return truncated_exp(self.grid(coordinates)[:, 0]) * stretch

    def _samples(self, shares: Tensor, rays: Rays, near: Tensor, far: Tensor) -> Samples:
        t = self._distance(shares, rays, near, far)
        return Samples.rows(t[:, :-1], t[:, -1])

    def _distance(self, shares: Tensor, rays: Rays, near: Tensor, far: Tensor) -> Tensor:
        """Distances linear in normalised device coordinates, or linear within a unit of the camera and in disparity
        beyond."""
        if isinstance(self.space, NDC):
            return self.space.distance(shares, rays, near, far)
        first, last = (torch.where(t < 1, t, 2 - 1 / t.clamp_min(1))[:, None] for t in (near, far))
        s = torch.lerp(first, last, shares)
        return torch.where(s < 1, s, 1 / (2 - s).clamp_min(1e-6))


def edges_of(count: int, jitter: Float[Tensor, " ray"]) -> Float[Tensor, "ray edge"]:
    """Edges of `count` intervals of [0, 1], all but the first and last shifted by jitter - 1/2 of one."""
    inner = torch.arange(1, count, device=jitter.device) + (jitter[:, None] - 0.5)
    return nn.functional.pad(nn.functional.pad(inner / count, (1, 0)), (0, 1), value=1.0)


def proposal_loss(proposed: Proposed, weights: Float[Tensor, " sample"]) -> Float[Tensor, ""]:
    """Proposal loss: excess of the field's weights over the grid's weights in overlapping intervals, mean of all rays
    (Barron 2022, eqs. 12 and 13). Gradients reach the grid alone."""
    w = weights.detach().view(len(proposed.edges), -1)
    excess = _Excess.apply if loops_fit(w) else excess_of
    return excess(proposed.weights, proposed.bins, proposed.edges, w).mean()


def excess_of(
    found: Float[Tensor, "ray bin"],
    bins: Float[Tensor, "ray bin_edge"],
    edges: Float[Tensor, "ray edge"],
    w: Float[Tensor, "ray interval"],
) -> Float[Tensor, " ray"]:
    """sum_i max(0, w_i - bound_i)^2 / w_i of each ray, with bound_i the sum of the grid's weights in bins that overlap
    interval i (Barron 2022, eq. 13)."""
    below = nn.functional.pad(found.cumsum(-1), (1, 0))
    first = torch.searchsorted(bins, edges[:, :-1].contiguous(), right=True) - 1
    last = torch.searchsorted(bins, edges[:, 1:].contiguous()).clamp(max=bins.shape[1] - 1)
    bound = below.gather(-1, last) - below.gather(-1, first.clamp(0, bins.shape[1] - 1))
    return ((w - bound).clamp_min(0).square() / (w + LITTLE)).sum(-1)


class _Excess(torch.autograd.Function):
    """`excess_of` with its gradient, in one loop over rays."""

    @staticmethod
    def forward(ctx, found, bins, edges, w):
        excess, slope = w.new_empty(len(w)), torch.empty_like(found)
        sum_excess(
            *(x.detach().contiguous().numpy() for x in (found, bins, edges, w)), LITTLE, excess.numpy(), slope.numpy()
        )
        ctx.save_for_backward(slope)
        return excess

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return grad[:, None] * ctx.saved_tensors[0], None, None, None
