"""Frequency encodings of points, so that a network can represent fine detail (Tancik 2020, Mildenhall 2020)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn


class FrequencyEncoding(nn.Module):
    """Sines and cosines of each coordinate, an octave apart (Mildenhall 2020, eq. 4).

        gamma(p) = (p, sin(2^0 base p), cos(2^0 base p), ..., sin(2^(L-1) base p), cos(2^(L-1) base p))

    inputs:     coordinates of a point
    bands:      L, octaves
    keep_input: whether p itself comes first
    base:       angle at p = 1 in the first band; pi in the paper, 1 in its published code
    Every octave computes its own sine and cosine. Doubling angles is not faster in PyTorch, and at 10 bands it has an
    error of up to 9e-4 in float32, against 1e-4 (for base 1 of 5e-4, against 4e-8).
    """

    octaves: Tensor

    def __init__(self, inputs: int, bands: int, keep_input: bool = True, base: float = math.pi):
        super().__init__()
        self.keep_input = keep_input
        self.width = inputs * (2 * bands + keep_input)
        octaves = base * 2.0 ** torch.arange(bands, dtype=torch.float64)
        self.register_buffer("octaves", octaves.float(), persistent=False)

    def forward(
        self, points: Float[Tensor, "sample input"], weights: Float[Tensor, " octave"] | None = None
    ) -> Float[Tensor, "sample feature"]:
        """Encode points. weights: coarse-to-fine weights of the octaves; see `training.schedules.band_weights`"""
        angles = self.octaves[:, None] * points[:, None]  # (sample, octave, input)
        waves = weighted(torch.stack([angles.sin(), angles.cos()], 2), weights).flatten(1)
        return torch.cat([points, waves], 1) if self.keep_input else waves


class IntegratedEncoding(nn.Module):
    """The mean of a frequency encoding over a Gaussian: waves shorter than the Gaussian fade (Barron 2021, eq. 14).

        gamma(mu, sigma^2) = (sin(2^l mu), cos(2^l mu)) exp(-4^l sigma^2 / 2),  l = 0 ... L - 1

    inputs: coordinates of a point
    bands:  L, octaves
    Only variances along each coordinate are needed, since the encoding is separable (eq. 13).
    """

    octaves: Tensor

    def __init__(self, inputs: int, bands: int):
        super().__init__()
        self.width = 2 * inputs * bands
        self.register_buffer("octaves", 2.0 ** torch.arange(bands), persistent=False)

    def forward(
        self,
        means: Float[Tensor, "sample input"],
        variances: Float[Tensor, "sample input"],
        weights: Float[Tensor, " octave"] | None = None,
    ) -> Float[Tensor, "sample feature"]:
        """Encode Gaussians. weights: coarse-to-fine weights of the octaves; see `training.schedules.band_weights`"""
        angles = self.octaves[:, None] * means[:, None]  # (sample, octave, input)
        left = torch.exp(-0.5 * self.octaves.square()[:, None] * variances[:, None])
        return weighted(torch.stack([angles.sin() * left, angles.cos() * left], 2), weights).flatten(1)


def weighted(
    waves: Float[Tensor, "sample octave wave input"], weights: Float[Tensor, " octave"] | None
) -> Float[Tensor, "sample octave wave input"]:
    return waves if weights is None else waves * weights[:, None, None]


class FourierEncoding(nn.Module):
    """Fourier features with frequencies in the rows of B (Tancik 2020, section 4).

        gamma(p) = (cos(2 pi B p), sin(2 pi B p))

    frequencies: B, in cycles per unit of p. It is fixed, and saved with its method.
    """

    frequencies: Tensor

    def __init__(self, frequencies: Float[Tensor, "frequency input"]):
        super().__init__()
        self.register_buffer("frequencies", frequencies)
        self.width = 2 * len(frequencies)

    def forward(self, points: Float[Tensor, "sample input"]) -> Float[Tensor, "sample feature"]:
        angles = 2 * math.pi * (points @ self.frequencies.t())
        return torch.cat([angles.cos(), angles.sin()], 1)
