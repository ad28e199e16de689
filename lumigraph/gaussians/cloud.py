"""Gaussians: a scene as a cloud of soft, coloured ellipsoids (Kerbl 2023), as methods learn it and files hold it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from .. import kernels
from ..geometry import multiply, to_quaternion


@dataclass(frozen=True)
class Gaussians:
    """A cloud of N Gaussians, in the numbers that learning moves freely.

    means:       centres, in the frame's units
    quaternions: rotations (w, x, y, z), of any length but zero
    log_scales:  natural logarithm of the standard deviation along each of the rotated axes
    opacities:   logits; the sigmoid is the opacity at the centre
    harmonics:   colour, sRGB-encoded: c(d) = 1/2 + sum_k Y_k(d) h_k, negative ones cut to 0, where d points from the
                 eye to the centre and Y_k are those of `kernels.spherical_harmonics`; K is 1, 4, 9 or 16
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

    def transformed(self, similarity: Float[Tensor, "4 4"]) -> Gaussians:
        """The same cloud in another frame, x' = M x: moved, turned, scaled, and its colours turned with it."""
        similarity = similarity.double().cpu()
        scale = torch.linalg.det(similarity[:3, :3]) ** (1 / 3)
        rotation = similarity[:3, :3] / scale
        means = self.means.double() @ similarity[:3, :3].T.to(self.means.device) + similarity[:3, 3].to(
            self.means.device
        )
        turn = to_quaternion(rotation).to(self.quaternions)
        return replace(
            self,
            means=means.to(self.means),
            quaternions=multiply(turn[None], self.quaternions),
            log_scales=self.log_scales + float(scale.log()),
            harmonics=turned(self.harmonics, rotation),
        )

    def _map(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        tensors = self.means, self.quaternions, self.log_scales, self.opacities, self.harmonics
        means, quaternions, log_scales, opacities, harmonics = map(change, tensors)
        return Gaussians(means, quaternions, log_scales, opacities, harmonics, self.antialiased)


def turned(
    harmonics: Float[Tensor, "gaussian coefficient 3"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "gaussian coefficient 3"]:
    """Coefficients of the turned function: c'(R d) = c(d).

    Each band turns within itself. Its matrix is what sends the band's values at some directions to those at the turned
    ones, found by least squares in double precision, where more directions than needed leave no error but rounding.
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
