"""Clouds of 3D Gaussians (Kerbl 2023); joining, cropping, and removal by opacity, size and isolation."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import pad

from .. import kernels
from ..camera.crop import Crop
from ..errors import LumigraphWarning
from ..geometry import multiply, to_quaternion

ISOLATION_NEIGHBOURS = 16  # nearest Gaussians whose mean distance measures isolation
BAND_0 = 0.5 / math.sqrt(math.pi)  # the constant harmonic
EXTENT_OPACITY = 0.1  # opacity from which on a Gaussian counts for the extent of the cloud
NEEDLE_RATIO = 10.0  # of the largest deviation to the second, beyond which a Gaussian is a needle
ROUNDING = 0.01  # of a Gaussian's size, which a centre may be off by
EXTENT_SHARE = 0.9  # of these Gaussians are within the extent, along each axis


@dataclass(frozen=True)
class Gaussians:
    """A cloud of N Gaussians, in unconstrained parameters.

    means:       centres, in the frame's units; in double precision far from the origin, see `as_precise_as_needed`
    quaternions: rotations (w, x, y, z), of any length but zero
    log_scales:  natural logarithm of the standard deviation along each of the rotated axes
    opacities:   logits; the sigmoid is the opacity at the centre
    harmonics:   colour, sRGB-encoded: c(d) = max(0, 1/2 + sum_k Y_k(d) h_k), where d points from the eye to the centre
                 and Y_k are those of `kernels.spherical_harmonics`; K is 1, 4, 9 or 16
    antialiased: whether opacities are meant for the 2-D filter that keeps a small Gaussian's light (Yu 2024)
    """

    means: Float[Tensor, "gaussian 3"]
    quaternions: Float[Tensor, "gaussian 4"]
    log_scales: Float[Tensor, "gaussian 3"]
    opacities: Float[Tensor, " gaussian"]
    harmonics: Float[Tensor, "gaussian coefficient 3"]
    antialiased: bool = False

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: slice | Tensor) -> Gaussians:
        """The Gaussians that a slice, mask or index tensor picks."""
        return self._map(lambda x: x[index])

    def to(self, device: torch.device | str) -> Gaussians:
        return self._map(lambda x: x.to(device))

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    def transformed(self, similarity: Float[Tensor, "4 4"], far: bool = False) -> Gaussians:
        """The same cloud in another frame, x' = M x, with rotated spherical harmonics.

        far: whether centres may be in double precision, see `as_precise_as_needed`; a scene's own frame needs none
        """
        similarity = similarity.double().cpu()
        scale = torch.linalg.det(similarity[:3, :3]) ** (1 / 3)
        rotation = similarity[:3, :3] / scale
        moved = self.means.double() @ similarity[:3, :3].T.to(self.means.device)
        means = moved + similarity[:3, 3].to(self.means.device)
        turn = to_quaternion(rotation).to(self.quaternions)
        return replace(
            self,
            means=as_precise_as_needed(means, self.log_scales + float(scale.log())) if far else means.float(),
            quaternions=multiply(turn[None], self.quaternions),
            log_scales=self.log_scales + float(scale.log()),
            harmonics=turned(self.harmonics, rotation),
        )

    def _map(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        tensors = self.means, self.quaternions, self.log_scales, self.opacities, self.harmonics
        means, quaternions, log_scales, opacities, harmonics = map(change, tensors)
        return Gaussians(means, quaternions, log_scales, opacities, harmonics, self.antialiased)


def as_precise_as_needed(
    means: Float[Tensor, "gaussian 3"], log_scales: Float[Tensor, "gaussian 3"]
) -> Float[Tensor, "gaussian 3"]:
    """Centres in single precision, unless its step there is more than ROUNDING of most Gaussians' largest deviation."""
    if means.dtype != torch.float64 or not len(means):
        return means
    steps = torch.finfo(torch.float32).eps * means.abs().amax(-1)
    return means if (steps / log_scales.amax(-1).exp()).nanmedian() > ROUNDING else means.float()


def turned(
    harmonics: Float[Tensor, "gaussian coefficient 3"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "gaussian coefficient 3"]:
    """Rotate spherical harmonics: c'(R d) = c(d).

    Each band is rotated by a matrix of its own, found by least squares in double precision: it maps the band's values
    at some directions to those at the rotated ones. With more directions than unknowns the error is that of rounding.
    """
    bands = math.isqrt(harmonics.shape[1])
    directions = torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    with kernels.using("reference"):
        before = kernels.spherical_harmonics(directions, bands)
        after = kernels.spherical_harmonics(directions @ rotation.double().cpu().T, bands)
    parts = []
    for band in range(bands):
        inside = slice(band**2, (band + 1) ** 2)
        matrix = torch.linalg.lstsq(after[:, inside], before[:, inside]).solution
        parts.append(torch.einsum("jk,nkc->njc", matrix.to(harmonics), harmonics[:, inside]))
    return torch.cat(parts, 1)


def joined(clouds: Sequence[Gaussians]) -> Gaussians:
    """One cloud from several. Missing harmonics are zero; opacities keep the meaning that most clouds have."""
    coefficients = max(cloud.harmonics.shape[1] for cloud in clouds)
    antialiased = [cloud.antialiased for cloud in clouds for _ in range(len(cloud))]
    majority = 2 * sum(antialiased) > len(antialiased)
    if len({cloud.antialiased for cloud in clouds}) > 1:
        warnings.warn(
            "Some of these clouds were learnt with the antialiasing filter and some without; the smallest Gaussians of "
            f"{'the latter' if majority else 'the former'} look a little too {'thin' if majority else 'thick'}",
            LumigraphWarning,
            2,
        )
    names = ("means", "quaternions", "log_scales", "opacities")
    columns = {name: torch.cat([getattr(x, name) for x in clouds]) for name in names}
    harmonics = torch.cat([pad(x.harmonics, (0, 0, 0, coefficients - x.harmonics.shape[1])) for x in clouds])
    return Gaussians(**columns, harmonics=harmonics, antialiased=majority)


def needle_share(gaussians: Gaussians) -> float:
    """Share of needles: Gaussians whose largest deviation is over NEEDLE_RATIO times their second; 0 without any."""
    ordered = gaussians.log_scales.sort(-1).values
    return float((ordered[:, 2] - ordered[:, 1] > math.log(NEEDLE_RATIO)).float().mean().nan_to_num())


def cleaned(gaussians: Gaussians, crop: Crop | None = None, max_scale: float | None = None) -> Gaussians:
    """The cloud without the Gaussians of `unwanted`."""
    return gaussians[~gone(unwanted(gaussians, crop, max_scale))]


def gone(reasons: Mapping[str, Bool[Tensor, " gaussian"]]) -> Bool[Tensor, " gaussian"]:
    """Mask of all Gaussians to remove."""
    return torch.stack(list(reasons.values())).any(0)


@torch.no_grad()
def unwanted(
    gaussians: Gaussians,
    crop: Crop | None = None,
    max_scale: float | None = None,
    floating: Bool[Tensor, " gaussian"] | None = None,
) -> dict[str, Bool[Tensor, " gaussian"]]:
    """Masks of Gaussians to remove, by reason, in the order of the arguments; each under its first reason.

    crop:      keeps those with centres inside, in the cloud's frame
    max_scale: largest standard deviation to keep, as a share of `extent`; None for any
    floating:  floaters; None for none
    """
    outside = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    if crop is not None:
        outside = ~crop.holds(gaussians.means)
    largest = math.inf if max_scale is None or outside.all() else max_scale * extent(gaussians[~outside])
    large = ~outside & (gaussians.log_scales.exp().amax(-1) > largest)
    reasons = {"outside the crop": outside, "too large": large}
    return reasons if floating is None else reasons | {"floaters": floating & ~outside & ~large}


def painted(gaussians: Gaussians, which: Bool[Tensor, " gaussian"], colour: tuple[float, float, float]) -> Gaussians:
    """The cloud with the Gaussians of a mask in one view-independent colour, sRGB-encoded."""
    plain = torch.zeros_like(gaussians.harmonics)
    plain[:, 0] = (plain.new_tensor(colour) - 0.5) / BAND_0
    return replace(gaussians, harmonics=torch.where(which[:, None, None], plain, gaussians.harmonics))


def extent(gaussians: Gaussians) -> float:
    """Longest side of the upright box around the central part of the solid Gaussians' centres."""
    solid = gaussians.means[gaussians.opacities.sigmoid() > EXTENT_OPACITY]
    some = (solid if len(solid) else gaussians.means)[:: max(1, len(gaussians) // 100_000)]
    low, high = torch.quantile(some, some.new_tensor([0.5 - EXTENT_SHARE / 2, 0.5 + EXTENT_SHARE / 2]), dim=0)
    return float((high - low).max())


def gaps(gaussians: Gaussians) -> Float[Tensor, " gaussian"]:
    """Mean distance of each Gaussian to its nearest neighbours, relative to the sum of their sizes.

    About 1 on a surface of any resolution: there Gaussians touch. It does not depend on the cloud's units, and sparse
    backgrounds, whose Gaussians are large, are not taken for floaters. A size is the geometric mean of deviations.
    """
    means = gaussians.means.detach().cpu().numpy()
    sizes = gaussians.log_scales.mean(-1).exp().cpu()
    count = min(ISOLATION_NEIGHBOURS + 1, len(gaussians))
    distances, neighbours = cKDTree(means).query(means, count, workers=-1)
    away = torch.from_numpy(distances[:, 1:]).to(sizes)
    both = sizes[:, None] + sizes[torch.from_numpy(neighbours[:, 1:])]
    return (away / both).mean(-1).clamp_min(1e-9).to(gaussians.means.device)
