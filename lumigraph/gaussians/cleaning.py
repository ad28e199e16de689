"""Cleaning a cloud: what lies outside a crop, and floaters, by opacity, size and isolation."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from ..camera.crop import Crop
from .cloud import Gaussians

ISOLATION_NEIGHBOURS = 16  # nearest Gaussians whose mean distance measures isolation
EXTENT_OPACITY = 0.1  # opacity from which on a Gaussian counts for the extent of the cloud
EXTENT_SHARE = 0.9  # of these Gaussians are within the extent, along each axis

# What most captures gain from and few lose by; the command line's `--clean`.
MIN_OPACITY, MAX_SCALE, ISOLATION = 0.02, 1.0, 3.0


def cleaned(
    gaussians: Gaussians,
    crop: Crop | None = None,
    min_opacity: float = 0.0,
    max_scale: float | None = None,
    isolation: float | None = None,
) -> Gaussians:
    """The Gaussians that a crop holds, without floaters; see `unwanted`."""
    return gaussians[~gone(unwanted(gaussians, crop, min_opacity, max_scale, isolation))]


def gone(reasons: dict[str, Bool[Tensor, " gaussian"]]) -> Bool[Tensor, " gaussian"]:
    """Mask of all Gaussians to remove."""
    return torch.stack(list(reasons.values())).any(0)


@torch.no_grad()
def unwanted(
    gaussians: Gaussians,
    crop: Crop | None = None,
    min_opacity: float = 0.0,
    max_scale: float | None = None,
    isolation: float | None = None,
) -> dict[str, Bool[Tensor, " gaussian"]]:
    """Masks of Gaussians to remove, by reason, in the order of the arguments; each under its first reason.

    crop:        keeps those whose centres it holds, in the cloud's frame
    min_opacity: that is left, in [0, 1]
    max_scale:   largest standard deviation that is left, as a share of `extent`; None for any
    isolation:   how many standard deviations above the mean the logarithm of `gaps` may be; None for any
    """
    keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    reasons = {}

    def drop(reason: str, which: Bool[Tensor, " gaussian"]) -> None:
        nonlocal keep
        reasons[reason] = keep & which
        keep = keep & ~which

    drop("outside the crop", ~keep if crop is None else ~crop.holds(gaussians.means))
    drop("too faint", gaussians.opacities.sigmoid() < min_opacity)
    largest = math.inf if max_scale is None or not keep.any() else max_scale * extent(gaussians[keep])
    drop("too large", gaussians.log_scales.exp().amax(-1) > largest)
    alone = ~keep
    if isolation is not None and int(keep.sum()) > ISOLATION_NEIGHBOURS:
        logs = gaps(gaussians[keep]).log()
        alone[keep] = logs > logs.mean() + isolation * logs.std()
    drop("isolated", alone)
    return reasons


def extent(gaussians: Gaussians) -> float:
    """The longest side of the upright box that holds the middle of the solid Gaussians' centres along each axis."""
    solid = gaussians.means[gaussians.opacities.sigmoid() > EXTENT_OPACITY]
    some = (solid if len(solid) else gaussians.means)[:: max(1, len(gaussians) // 100_000)]
    low, high = torch.quantile(some, some.new_tensor([0.5 - EXTENT_SHARE / 2, 0.5 + EXTENT_SHARE / 2]), dim=0)
    return float((high - low).max())


def gaps(gaussians: Gaussians) -> Float[Tensor, " gaussian"]:
    """Mean distance of each Gaussian to its nearest neighbours, in sums of both's sizes.

    About 1 on a surface, however coarse: there Gaussians touch. It does not depend on the cloud's units, and sparse
    backgrounds, whose Gaussians are large, are not taken for floaters. A size is the geometric mean of deviations.
    """
    means = gaussians.means.detach().cpu().numpy()
    sizes = gaussians.log_scales.mean(-1).exp().cpu()
    count = min(ISOLATION_NEIGHBOURS + 1, len(gaussians))
    distances, neighbours = cKDTree(means).query(means, count, workers=-1)
    away = torch.from_numpy(distances[:, 1:]).to(sizes)
    both = sizes[:, None] + sizes[torch.from_numpy(neighbours[:, 1:])]
    return (away / both).mean(-1).clamp_min(1e-9).to(gaussians.means.device)
