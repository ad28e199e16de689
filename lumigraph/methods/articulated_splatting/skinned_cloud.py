"""A cloud of Gaussians that bones move: linear blend skinning of centres and rotations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from ...components.clouds.addition import Addition, Step
from ...components.skinning.bone_motion import BoneMotion, BoneNumbers
from ...components.skinning.weight_volume import WeightNumbers, WeightVolume, segments
from ...datasets.scene import Frame
from ...gaussians import Gaussians
from ...geometry import multiply, to_quaternion
from ...method.controls import Value

LONE_REACH = 0.25  # deviation of places about a lone bone, in distances to the nearest other


class SkinnedCloud(Addition):
    """The canonical cloud, posed to the moment of a photograph before it is rasterized.

    bones:   transforms of the bones at a moment
    weights: shares of the bones at the canonical centres
    """

    def __init__(self, frame: Frame, bones: BoneNumbers, weights: WeightNumbers):
        super().__init__()
        self.bones, self.weights = BoneMotion(frame, bones), WeightVolume(frame, weights)

    def first_means(self, count: int, generator: torch.Generator) -> Float[Tensor, "gaussian 3"]:
        """Random points around the bones at rest, evenly along them, within the reach of their initial weights; for a
        body of one bone, which has no length, within a share of the distance to the next body."""
        parents, rest = self.bones.skeleton.parents, self.bones.skeleton.rest
        bones = segments(parents, rest.matrices[:, :, 3].float())
        starts, ends = (torch.cat(side) for side in zip(*bones, strict=True))
        size = float((torch.cat([starts, ends]).amax(0) - torch.cat([starts, ends]).amin(0)).max())
        radius = torch.full((len(starts), 1), self.weights.numbers.bone_radius * size)
        number = torch.arange(len(parents)).repeat_interleave(torch.tensor([len(side) for side, _ in bones]))
        lone = torch.tensor([parent < 0 and i not in parents for i, parent in enumerate(parents)])[number]
        away = torch.cdist(starts[lone], starts)
        widest = float((self.weights.box[1] - self.weights.box[0]).max())
        radius[lone] = LONE_REACH * away.where(away > 0, widest).amin(1, keepdim=True)
        chosen = torch.multinomial((ends - starts).norm(dim=1) + radius[:, 0], count, True, generator=generator)
        share = torch.rand(count, 1, generator=generator)
        spread = radius[chosen] * torch.randn(count, 3, generator=generator)
        return torch.lerp(starts[chosen], ends[chosen], share) + spread

    def before_raster(self, step: Step) -> None:
        step.cloud = self.at({}, step.cloud, step.moment)

    def at(self, settings: Mapping[str, Value], cloud: Gaussians, time: float) -> Gaussians:
        """The cloud at a moment under settings."""
        return skinned(cloud, self.weights(cloud.means), self.bones.at(settings, time))


def skinned(
    cloud: Gaussians, weights: Float[Tensor, "gaussian bone"], transforms: Float[Tensor, "bone 3 4"]
) -> Gaussians:
    """The cloud moved by bones (Pokhariya 2024, section 4.1): m' = sum_k w_k M_k m, and q' = r q with the normalised
    blend r of the bones' rotations, whose signs are those of the first bone."""
    turns = to_quaternion(transforms[:, :, :3].detach()).to(transforms)
    turns = torch.where(turns @ turns[:1].T < 0, -turns, turns)
    blend = weights @ transforms.flatten(1)
    moved = blend.view(-1, 3, 4)
    means = (moved[:, :, :3] @ cloud.means[:, :, None])[:, :, 0] + moved[:, :, 3]
    turn = normalize(weights @ turns, dim=-1)
    return replace(cloud, means=means, quaternions=multiply(turn, cloud.quaternions))
