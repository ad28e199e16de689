"""The canonicaliser: an equivariant frame and invariant canonical coordinates of a density grid, by a small network
(Agaram 2023, sec. 4, after ConDor, Sajnani 2022, sec. 3).

Features are coefficients of harmonics, which turn with the grid (tensor field networks, Thomas 2018). A point asks
them for the value in its own direction, which is invariant; a perceptron makes new weights of the invariant values,
and these weights make the next features. Nothing else meets a coordinate, so all of it is equivariant to rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...files.ranges import LearningRate, NonNegative, Seed, Width, between
from ...system.progress import track
from .grids import Instance
from .harmonics import band, directions_and_distances, harmonics, moments, nearest_rotation, random, shells

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
    """Linear map over channels within each band, followed by normalisation over all."""

    def __init__(self, inner: int, outer: int, bands: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(bands, outer, inner))
        self.bands = bands

    def forward(self, features: Float[Tensor, "some inner basis"]) -> Float[Tensor, "some outer basis"]:
        parts = [self.weight[n] @ features[..., band(n)] for n in range(self.bands)]
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
    """Rotation of each instance into the canonical frame: least squares between points and canonical coordinates
    (Kabsch 1976)."""
    return nearest_rotation((weights[..., None] * found.coordinates).mT @ points)


@dataclass(frozen=True)
class CanonicalConfig:
    """steps:    of learning
    batch:    instances in a step
    points:   of each instance that a step draws, in proportion to their opacity
    channels: of features, in each band of harmonics, on shells about the middle, in layers
    consistency, orthonormality, siamese: weights of the losses
    templates: instances that are taken for the mean shape to begin with, beside what the network says
    """

    steps: Annotated[int, between(0, 1_000_000)] = 300
    batch: Annotated[int, between(2, 256)] = 8
    points: Annotated[int, between(16, 65_536)] = 512
    channels: Width = 24
    shells: Annotated[int, between(2, 64)] = 8
    bands: Annotated[int, between(2, 12)] = 5
    layers: Annotated[int, between(1, 8)] = 3
    learning_rate: LearningRate = 3e-3
    consistency: NonNegative = 1.0
    orthonormality: NonNegative = 1.0
    siamese: NonNegative = 10.0
    templates: Annotated[int, between(1, 1000)] = 8
    seed: Seed = 0


PRESETS = {
    "draft": CanonicalConfig(steps=100, channels=16, templates=4),
    "standard": CanonicalConfig(),
    "thorough": CanonicalConfig(steps=1500, points=1024, channels=32, templates=20),
}


def learn(instances: Sequence[Instance], config: CanonicalConfig) -> Canonicaliser:
    """A canonicaliser of instances of one category."""
    generator = torch.Generator().manual_seed(config.seed)
    network = Canonicaliser(config.channels, config.shells, config.bands, config.layers, generator)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(config.steps, 1))
    for _ in track(range(config.steps), "Learning what the instances share", config.steps):
        points, weights = drawn(instances, config, generator)
        terms = losses(network(points, weights), points, weights, config)
        optimizer.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return network.eval()


def drawn(
    instances: Sequence[Instance], config: CanonicalConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "some point 3"], Float[Tensor, "some point"]]:
    """Points of some instances, each randomly rotated, with equal weights."""
    which = torch.randperm(len(instances), generator=generator)[: config.batch].tolist()
    turns = random(len(which), generator).float()
    chosen = [
        instances[i].points[torch.multinomial(instances[i].weights, config.points, True, generator=generator)]
        for i in which
    ]
    return torch.stack(chosen) @ turns.mT, torch.full((len(which), config.points), 1 / config.points)


def losses(found: Canonical, points: Tensor, weights: Tensor, config: CanonicalConfig) -> dict[str, Tensor]:
    """Canonical consistency: the frame maps canonical coordinates to the points. Orthonormality: the frame is close to
    a rotation. Siamese: canonical coordinates of different instances are similar."""
    back = found.coordinates @ found.frame.mT
    consistency = (weights * (points - back).square().sum(-1)).sum(-1).mean()
    orthonormality = (found.frame - nearest_rotation(found.frame.detach())).square().sum((1, 2)).mean()
    looks = moments(points @ upright(found.frame), weights, config.shells, config.bands)
    apart = (looks - looks.mean(0)).square().sum((1, 2)).mean() / looks.detach().square().sum((1, 2)).mean()
    return {
        "consistency": config.consistency * consistency,
        "orthonormality": config.orthonormality * orthonormality,
        "siamese": config.siamese * apart,
    }


def upright(frame: Float[Tensor, "some 3 3"]) -> Float[Tensor, "some 3 3"]:
    """Rotation from a frame's first two axes (Gram-Schmidt), differentiable."""
    x = torch.nn.functional.normalize(frame[..., 0], dim=-1)
    along = frame[..., 1] - (frame[..., 1] * x).sum(-1, keepdim=True) * x
    y = torch.nn.functional.normalize(along, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


@torch.no_grad()
def found_rotations(network: Canonicaliser, instances: Sequence[Instance]) -> Float[Tensor, "some 3 3"]:
    """The rotation of each instance into the canonical frame, by all of its cells."""
    found = []
    for instance in instances:
        points, weights = instance.points[None], instance.weights[None]
        found.append(rotations_of(network(points, weights), points, weights)[0])
    return torch.stack(found).double()
