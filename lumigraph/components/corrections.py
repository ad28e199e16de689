"""What differs from photograph to photograph: exposure, and small errors of pose."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..rays import Rays


class Exposure(nn.Module):
    """A gain per photograph and colour channel, 1 at first; photographs that were not trained on keep it."""

    def __init__(self, image_count: int):
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(image_count, 3))

    def forward(self, rgb: Float[Tensor, "ray 3"], image_index: Int[Tensor, " ray"]) -> Float[Tensor, "ray 3"]:
        return rgb * self.log_gain[image_index].exp()


class PoseRefinement(nn.Module):
    """A small rotation (radians) and shift (scene units) of each photograph's rays, in the world's frame, 0 at first.

    The exponential map of so(3) by Rodrigues' formula, as in BARF (Lin 2021, section 3).
    """

    def __init__(self, image_count: int):
        super().__init__()
        self.twist = nn.Parameter(torch.zeros(image_count, 6))

    def forward(self, rays: Rays) -> Rays:
        if rays.image_index is None:
            return rays
        omega, shift = self.twist[rays.image_index].split(3, -1)
        squared = omega.square().sum(-1, keepdim=True)
        angle = squared.clamp_min(1e-12).sqrt()
        once = torch.linalg.cross(omega, rays.directions)
        twice = torch.linalg.cross(omega, once)
        directions = rays.directions + angle.sin() / angle * once + (1 - angle.cos()) / angle.square() * twice
        return replace(rays, origins=rays.origins + shift, directions=directions)
