"""Merging: a cloud simplified to fewer Gaussians, as a level of detail.

Neighbours become one Gaussian with the mean and covariance of both, as Kerbl 2024 ("A Hierarchical 3D Gaussian
Representation", section 4.1) merges them, and those pairs merge whose pictures change the least.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ..geometry import to_matrix, to_quaternion
from ..kernels.spherical_harmonics import K00
from .cloud import Gaussians

MERGE_NEIGHBOURS = 8  # merge candidates per Gaussian
MAX_OPACITY = 0.999  # opacity at most
PLANES = (1, 2), (0, 2), (0, 1)  # across each of three axes
EPSILON = 1e-30


@torch.no_grad()
def simplified(gaussians: Gaussians, count: int) -> Gaussians:
    """The cloud simplified to at most `count` Gaussians, at least one; on the CPU. Order is not kept.

    In each round the pairs that are each other's best merge, the cheapest first, which halves the cloud at most.
    """
    some = _Ellipsoids.of(gaussians.to("cpu"))
    while len(some.means) > max(1, count):
        one, other = _neighbours(some.means)
        merged = some[one].merged(some[other])
        order = _cost(some[one], some[other], merged).argsort(stable=True)
        pairs = order[_matching(one[order], other[order], len(some.means))][: len(some.means) - max(1, count)]
        alone = torch.ones(len(some.means), dtype=torch.bool)
        alone[one[pairs]] = alone[other[pairs]] = False
        some = some[alone].with_(merged[pairs])
    return some.gaussians(gaussians)


@dataclass(frozen=True)
class _Ellipsoids:
    """Gaussians in double precision, with linear opacities and harmonics. covariances: of N x 3 x 3"""

    means: Float[Tensor, "gaussian 3"]
    covariances: Float[Tensor, "gaussian 3 3"]
    opacities: Float[Tensor, " gaussian"]
    harmonics: Float[Tensor, "gaussian coefficient 3"]

    @staticmethod
    def of(cloud: Gaussians) -> _Ellipsoids:
        axes = to_matrix(cloud.quaternions.double()) * cloud.log_scales.double().exp()[:, None]
        opacities = cloud.opacities.double().sigmoid()
        return _Ellipsoids(cloud.means.double(), axes @ axes.mT, opacities, cloud.harmonics.double())

    def gaussians(self, like: Gaussians) -> Gaussians:
        """Cloud in single precision, with the remaining fields of `like`."""
        squares, axes = torch.linalg.eigh(self.covariances)
        axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # turned, not mirrored
        scales = squares.clamp_min(EPSILON).sqrt().log()
        opacities = self.opacities.clamp(1e-6, MAX_OPACITY).logit()
        parts = self.means, to_quaternion(axes), scales, opacities, self.harmonics
        means, quaternions, scales, opacities, harmonics = (x.to(like.means.dtype) for x in parts)
        return Gaussians(means, quaternions, scales, opacities, harmonics, like.antialiased)

    def __getitem__(self, index: Tensor) -> _Ellipsoids:
        return _Ellipsoids(*(getattr(self, field.name)[index] for field in fields(self)))

    def with_(self, other: _Ellipsoids) -> _Ellipsoids:
        return _Ellipsoids(*(torch.cat([getattr(x, field.name) for x in (self, other)]) for field in fields(self)))

    @property
    def weights(self) -> Float[Tensor, " gaussian"]:
        """Weight of each in a merge: opacity times mean projected area, up to a factor."""
        c = self.covariances
        trace = c.diagonal(dim1=-2, dim2=-1).sum(-1)
        return self.opacities * (0.5 * (trace.square() - c.square().sum((-1, -2)))).clamp_min(EPSILON).sqrt()

    def merged(self, other: _Ellipsoids) -> _Ellipsoids:
        """Pairs merged, with the weighted mean, covariance and harmonics of both.

        The opacity preserves the light stopped along the shortest axis. Where that needs more than 1, the Gaussian
        grows instead.
        """
        a, b = self.weights, other.weights
        share = (a / (a + b).clamp_min(EPSILON))[:, None]
        apart = self.means - other.means
        means = other.means + share * apart
        share = share[..., None]
        spread = share * (1 - share) * apart[:, :, None] * apart[:, None, :]
        covariances = share * self.covariances + (1 - share) * other.covariances + spread
        harmonics = share * self.harmonics + (1 - share) * other.harmonics
        plane = torch.linalg.eigh(covariances).eigenvectors[:, :, 1:]
        mine, others, both = (_Footprint.of(x, plane) for x in (self.covariances, other.covariances, covariances))
        stopped = 2 * math.pi * (self.opacities * mine.size + other.opacities * others.size)
        stopped = stopped - self.opacities * other.opacities * mine.overlap(others, _across(apart, plane))
        opacities = stopped / (2 * math.pi * both.size)
        grown = covariances * (opacities / MAX_OPACITY).clamp_min(1)[:, None, None]
        return _Ellipsoids(means, grown, opacities.clamp_max(MAX_OPACITY), harmonics)

    @property
    def colours(self) -> Float[Tensor, "gaussian 4"]:
        """Base colour (view-independent) and opacity at the centre."""
        rgb = 0.5 + K00 * self.harmonics[:, 0]
        return self.opacities[:, None] * torch.cat([rgb, torch.ones_like(rgb[:, :1])], -1)


@dataclass(frozen=True)
class _Footprint:
    """Gaussians projected along an axis: covariance in the plane across, and the square root of its determinant."""

    covariance: Float[Tensor, "gaussian 2 2"]
    size: Float[Tensor, " gaussian"]

    @staticmethod
    def of(covariances: Float[Tensor, "gaussian 3 3"], plane: Float[Tensor, "gaussian 3 2"]) -> _Footprint:
        seen = plane.mT @ covariances @ plane
        return _Footprint(seen, _determinant(seen).sqrt())

    def overlap(self, other: _Footprint, apart: Float[Tensor, "gaussian 2"]) -> Float[Tensor, " gaussian"]:
        """The integral of the product of two Gaussians whose peaks are 1:
        2 pi sqrt(|A| |B| / |A + B|) exp(-d^T (A + B)^-1 d / 2)"""
        both = self.covariance + other.covariance
        determinant, (x, y) = _determinant(both), apart.unbind(-1)
        square = (both[:, 1, 1] * x * x - 2 * both[:, 0, 1] * x * y + both[:, 0, 0] * y * y) / determinant
        return 2 * math.pi * self.size * other.size / determinant.sqrt() * torch.exp(-0.5 * square)


def _cost(one: _Ellipsoids, other: _Ellipsoids, merged: _Ellipsoids) -> Float[Tensor, " pair"]:
    """Squared change of colour and opacity by a merge, integrated over the plane, along the merged Gaussian's three
    axes.

    Light is additive here, as at low opacity: the integral of (a A + b B - m M)^2.
    """
    axes = torch.linalg.eigh(merged.covariances).eigenvectors
    parts, signs = (one, other, merged), (1, 1, -1)
    total = torch.zeros_like(one.opacities)
    for plane in (axes[:, :, list(which)] for which in PLANES):
        seen = [_Footprint.of(part.covariances, plane) for part in parts]
        for i in range(3):
            for j in range(i, 3):
                apart = _across(parts[i].means - parts[j].means, plane)
                product = (parts[i].colours * parts[j].colours).sum(-1) * seen[i].overlap(seen[j], apart)
                total += (1 if i == j else 2) * signs[i] * signs[j] * product
    return total.clamp_min(0)


def _neighbours(means: Float[Tensor, "gaussian 3"]) -> tuple[Int[Tensor, " pair"], Int[Tensor, " pair"]]:
    """Pairs of nearest neighbours, each once."""
    count = len(means)
    nearest = cKDTree(means.numpy()).query(means.numpy(), min(MERGE_NEIGHBOURS + 1, count))[1]
    here, there = torch.arange(count)[:, None].expand(nearest.shape), torch.from_numpy(nearest)
    pairs = torch.unique(torch.minimum(here, there) * count + torch.maximum(here, there))
    one, other = pairs // count, pairs % count
    return one[one != other], other[one != other]


def _matching(one: Int[Tensor, " pair"], other: Int[Tensor, " pair"], count: int) -> Int[Tensor, " chosen"]:
    """Greedy matching of pairs sorted best first: indices of the chosen ones; none shares a Gaussian."""
    left, chosen = torch.arange(len(one)), []
    while len(left):
        a, b = one[left], other[left]
        best = torch.full((count,), len(one)).scatter_reduce(0, torch.cat([a, b]), left.repeat(2), "amin")
        taken = (best[a] == left) & (best[b] == left)
        chosen.append(left[taken])
        free: Bool[Tensor, " gaussian"] = torch.ones(count, dtype=torch.bool)
        free[a[taken]] = free[b[taken]] = False
        left = left[free[a] & free[b]]
    return torch.cat(chosen).sort().values


def _across(vectors: Float[Tensor, "gaussian 3"], plane: Float[Tensor, "gaussian 3 2"]) -> Float[Tensor, "gaussian 2"]:
    return (plane.mT @ vectors[..., None])[..., 0]


def _determinant(matrices: Float[Tensor, "gaussian 2 2"]) -> Float[Tensor, " gaussian"]:
    return (matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]).clamp_min(EPSILON**2)
