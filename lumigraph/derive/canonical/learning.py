"""Learning the canonicaliser from instances in any pose, without being told one (Agaram 2023, sec. 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from ...files.ranges import LearningRate, NonNegative, Seed, Width, between
from ...system.progress import track
from .grids import Instance
from .moments import moments
from .network import Canonical, Canonicaliser, rotations_of
from .rotations import nearest_rotation, random


@dataclass(frozen=True)
class Config:
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
    "draft": Config(steps=100, channels=16, templates=4),
    "standard": Config(),
    "thorough": Config(steps=1500, points=1024, channels=32, templates=20),
}


def learn(instances: Sequence[Instance], config: Config) -> Canonicaliser:
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
    instances: Sequence[Instance], config: Config, generator: torch.Generator
) -> tuple[Float[Tensor, "some point 3"], Float[Tensor, "some point"]]:
    """Points of some instances, each turned at random, with equal weights."""
    which = torch.randperm(len(instances), generator=generator)[: config.batch].tolist()
    turns = random(len(which), generator).float()
    chosen = [
        instances[i].points[torch.multinomial(instances[i].weights, config.points, True, generator=generator)]
        for i in which
    ]
    return torch.stack(chosen) @ turns.mT, torch.full((len(which), config.points), 1 / config.points)


def losses(found: Canonical, points: Tensor, weights: Tensor, config: Config) -> dict[str, Tensor]:
    """Canonical consistency: the frame brings canonical coordinates back to the points. Orthonormality: the frame is
    near to a rotation. Siamese: what different instances look like in the canonical frame is alike."""
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
    """The rotation of a frame's first two axes (Gram-Schmidt), which gradients pass through."""
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
