"""Skinning weights at points of the body at rest, as a learnt volume (Weng 2022, section 3.2 and its supplement)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from ...datasets.scene import Frame
from ...files.ranges import LearningRate, PositiveShare, between
from ...method import Part
from .bone_motion import skeleton_of

MIN_PRIOR = 1e-6  # of a bone's share at first among bones, and of all bones beside no body
LEAF_LENGTH = 0.6  # of a bone without children, in lengths of its parent's
FIRST_CELLS = 1  # along an axis, from which convolutions begin
SLOPE = 0.2  # of leaky ReLUs
FIRST_LOGIT = 1e-4  # largest weight of the last convolution at first, when shares are the prior's


@dataclass(frozen=True)
class WeightNumbers:
    """A Config's numbers of the weight volume."""

    weight_cells: Annotated[int, between(4, 256)] = 32  # cells of the weight volume along an axis; more: sharper joints
    weight_code: Annotated[int, between(0, 4096)] = 256  # numbers that convolutions make it of; 0: it is learnt itself
    weights_lr: LearningRate = 5e-5  # learning rate of the weight volume
    bone_radius: PositiveShare = 0.035  # deviation of a bone's first weights about it, as a share of the body's size


class WeightVolume(Part):
    """Skinning weights w_c, and that of empty space, in a box around the body at rest: the softmax of a learnt volume
    plus the logarithm of a prior, Gaussians around the bones.

    box: lowest and highest corner of the volume
    """

    box: Tensor
    prior: Tensor

    def __init__(self, frame: Frame, numbers: WeightNumbers):
        super().__init__()
        skeleton, self.numbers = skeleton_of(frame), numbers
        self.bones, cells = len(skeleton), numbers.weight_cells
        ends = segments(skeleton.parents, skeleton.rest.matrices[:, :, 3].float())
        every = torch.cat([torch.cat(pair) for pair in ends])
        low, high = torch.tensor(frame.bounds)
        low, high = torch.minimum(low, every.amin(0)), torch.maximum(high, every.amax(0))
        self.register_buffer("box", torch.stack([low, high]), persistent=False)
        radius = numbers.bone_radius * float((every.amax(0) - every.amin(0)).max())
        axes = [low[i] + (high[i] - low[i]) * torch.linspace(0, 1, cells) for i in range(3)]
        places = torch.stack(torch.meshgrid(*reversed(axes), indexing="ij")[::-1], -1).view(-1, 3)  # x changes fastest
        away = torch.stack([distance(places, *pair) for pair in ends])
        self.register_buffer("prior", shares(away / radius).view(-1, cells, cells, cells), persistent=False)
        self.volume: nn.Parameter | None = None
        self.code: nn.Parameter | None = None
        if numbers.weight_code:
            levels = max(1, (cells - 1).bit_length())
            widths = [
                numbers.weight_code,
                *(max(self.bones + 1, numbers.weight_code >> k) for k in range(levels - 1)),
                self.bones + 1,
            ]
            self.code = nn.Parameter(torch.randn(1, widths[0], *[FIRST_CELLS] * 3))
            layers: list[nn.Module] = []
            for a, b in zip(widths, widths[1:], strict=False):
                layers += [nn.ConvTranspose3d(a, b, 4, 2, 1), nn.LeakyReLU(SLOPE)]
            self.convolutions = nn.Sequential(*layers[:-1])
            nn.init.uniform_(layers[-2].weight, -FIRST_LOGIT, FIRST_LOGIT)  # type: ignore[arg-type]
            nn.init.zeros_(layers[-2].bias)  # type: ignore[arg-type]
        else:
            self.volume = nn.Parameter(torch.zeros_like(self.prior))

    def weights(self) -> Float[Tensor, "channel z y x"]:
        """Weights of the bones and, as last channel, of empty space."""
        if self.volume is not None:
            learnt = self.volume
        else:
            cells = self.numbers.weight_cells
            learnt = self.convolutions(self.code)[0, :, :cells, :cells, :cells]
        return torch.softmax(self.prior + learnt, 0)

    def coordinates(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points in the coordinates of `grid_sample`."""
        return 2 * (points - self.box[0]) / (self.box[1] - self.box[0]) - 1

    def forward(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point bone"]:
        """Skinning weights at points of the body at rest; they sum to 1."""
        seen = grid_sample(
            self.weights()[None], self.coordinates(points)[None, None, None], padding_mode="border", align_corners=True
        )
        own = seen[0, :-1, 0, 0].T
        return own / own.sum(-1, keepdim=True).clamp_min(MIN_PRIOR**2)

    def of_each(
        self, points: Float[Tensor, "bone point 3"], weights: Float[Tensor, "channel z y x"]
    ) -> Float[Tensor, "bone point"]:
        """Weight of each bone at points of its own; 0 outside the box."""
        at = self.coordinates(points)[:, None, None]
        return grid_sample(weights[:-1, None], at, padding_mode="zeros", align_corners=True)[:, 0, 0, 0]

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam([{"name": "weights", "params": list(self.parameters())}], self.numbers.weights_lr)]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        return {"weights": self.numbers.weights_lr}


def segments(
    parents: tuple[int, ...], joints: Float[Tensor, "bone 3"]
) -> list[tuple[Float[Tensor, "segment 3"], Float[Tensor, "segment 3"]]]:
    """Bones as segments from their joint to their children's; a bone without any extends its parent's direction."""
    found = []
    for number, parent in enumerate(parents):
        children = [child for child, own in enumerate(parents) if own == number]
        if children:
            ends = joints[children]
        else:
            along = joints[number] - joints[parent] if parent >= 0 else torch.zeros(3)
            ends = joints[number][None] + LEAF_LENGTH * along
        found.append((joints[number].expand(len(ends), 3), ends))
    return found


def distance(
    points: Float[Tensor, "point 3"], starts: Float[Tensor, "segment 3"], ends: Float[Tensor, "segment 3"]
) -> Float[Tensor, " point"]:
    """Distance of points to the nearest of some segments."""
    along = ends - starts
    away = points[:, None] - starts
    share = ((away * along).sum(-1) / along.square().sum(-1).clamp_min(1e-12)).clamp(0, 1)
    return (away - share[..., None] * along).norm(dim=-1).amin(1)


def shares(away: Float[Tensor, "bone point"]) -> Float[Tensor, "channel point"]:
    """Log prior of bones, and of empty space. away: distances to the bones, in their deviations

    Near the body it is Gaussians around bones, shared where they overlap, and farther out the nearest bone's.
    """
    body = torch.exp(-0.5 * away.square()).amax(0)
    each = torch.softmax(-0.5 * away.square(), 0).clamp_min(MIN_PRIOR) * body.clamp_min(MIN_PRIOR)
    return torch.cat([each, (1 - body)[None].clamp_min(MIN_PRIOR)]).log()
