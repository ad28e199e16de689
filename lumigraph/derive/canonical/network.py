"""The canonicaliser: an equivariant frame and invariant canonical coordinates of a density grid, by a small network
(Agaram 2023, sec. 4, after ConDor, Sajnani 2022, sec. 3).

Features are coefficients of harmonics, which turn with the grid (tensor field networks, Thomas 2018). A point asks
them for the value in its own direction, which is invariant; a perceptron makes new weights of the invariant values,
and these weights make the next features. Nothing else meets a coordinate, so all of it is equivariant to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .harmonics import band, band_sizes, harmonics
from .moments import directions_and_distances, shells
from .rotations import nearest_rotation

VECTORS = 4  # of degree one, of which frames and cross products are made


@dataclass(frozen=True)
class Canonical:
    """Output of the network for a batch of instances.

    frame:       three vectors each, as columns, that turn with the instance; learnt to be a rotation
    coordinates: of each point in the canonical frame; they stay when the instance is turned
    """

    frame: Float[Tensor, "some 3 3"]
    coordinates: Float[Tensor, "some point 3"]


class Canonicaliser(nn.Module):
    """channels: of features in each band; shells: about the middle; bands: of harmonics"""

    def __init__(self, channels: int, shells: int, bands: int, layers: int, generator: torch.Generator):
        super().__init__()
        self.shells, self.bands = shells, bands
        self.mix = nn.ModuleList([BandMix(shells if i == 0 else channels, channels, bands) for i in range(layers)])
        told = channels * bands + shells
        self.weigh = nn.ModuleList([perceptron(told, channels, channels) for _ in range(layers - 1)])
        self.vectors = nn.Parameter(torch.empty(VECTORS, channels))
        crosses = VECTORS * (VECTORS - 1) // 2
        self.axes = nn.Parameter(torch.empty(3, VECTORS + crosses))
        self.place = perceptron(told + VECTORS + crosses, 2 * channels, 3)
        with torch.no_grad():
            for parameter in self.parameters():
                if parameter.ndim > 1:
                    parameter.normal_(std=parameter.shape[-1] ** -0.5, generator=generator)
                else:
                    parameter.zero_()  # a bias, which would be drawn from chance that no seed decides

    def forward(self, points: Float[Tensor, "some point 3"], weights: Float[Tensor, "some point"]) -> Canonical:
        """points: centred, of spread one; weights: adding up to one"""
        directions, distances = directions_and_distances(points)
        basis, near = harmonics(directions, self.bands), shells(distances, self.shells)
        value, told = near, near
        for i, mix in enumerate(self.mix):
            features = mix((weights[..., None] * value).mT @ basis)
            told = torch.cat([self.invariants(features, basis), near], -1)
            if i < len(self.weigh):
                value = self.weigh[i](told)
        vectors = self.vectors @ as_vectors(features[..., band(1)])
        first, second = torch.triu_indices(VECTORS, VECTORS, 1)
        vectors = torch.cat([vectors, torch.linalg.cross(vectors[:, first], vectors[:, second])], 1)
        vectors = vectors / vectors.square().sum(-1, keepdim=True).mean(1, keepdim=True).add(1e-12).sqrt()
        coordinates = self.place(torch.cat([told, points @ vectors.mT], -1))
        return Canonical((self.axes @ vectors).mT, coordinates)

    def invariants(
        self, features: Float[Tensor, "some channel basis"], basis: Float[Tensor, "some point basis"]
    ) -> Float[Tensor, "some point value"]:
        """The features' functions in the direction of each point, band by band: <F_l, Y_l(x)>."""
        parts = [basis[..., band(n)] @ features[..., band(n)].mT for n in range(self.bands)]
        return torch.cat(parts, -1)


class BandMix(nn.Module):
    """Channels of features mixed, each band by itself, and brought to size one all together."""

    def __init__(self, inner: int, outer: int, bands: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(bands, outer, inner))
        self.sizes = band_sizes(bands)

    def forward(self, features: Float[Tensor, "some inner basis"]) -> Float[Tensor, "some outer basis"]:
        parts = [self.weight[n] @ features[..., band(n)] for n in range(len(self.sizes))]
        parts = [part / part.square().sum((1, 2), keepdim=True).div(part.shape[1]).add(1e-12).sqrt() for part in parts]
        return torch.cat(parts, -1)


def as_vectors(coefficients: Float[Tensor, "*some 3"]) -> Float[Tensor, "*some 3"]:
    """Coefficients of degree one, those of -y, z and -x, as vectors."""
    y, z, x = coefficients.unbind(-1)
    return torch.stack([-x, -y, z], -1)


def perceptron(inner: int, hidden: int, outer: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inner, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU(), nn.Linear(hidden, outer)
    )


def rotations_of(
    found: Canonical, points: Float[Tensor, "some point 3"], weights: Float[Tensor, "some point"]
) -> Float[Tensor, "some 3 3"]:
    """The rotation that brings each instance into the canonical frame: least squares between points and their canonical
    coordinates (Kabsch 1976)."""
    return nearest_rotation((weights[..., None] * found.coordinates).mT @ points)
