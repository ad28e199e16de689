"""Photographs of any lens resampled to small ideal pinhole pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from ..camera.lens import Pinhole
from ..datasets.scene import Photograph

MAX_ANGLE = math.radians(50.0)  # from the axis to the left and right border, where a lens sees further
GREY = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class FlatView:
    """A picture through a pinhole.

    pose:       camera-to-world; +x right, +y down, +z forward
    intrinsics: K, from the camera's frame to pixels
    rgb:        sRGB-encoded, not premultiplied
    trust:      from 0 to 1: opacity within the mask of trusted pixels
    """

    pose: Float[Tensor, "3 4"]
    intrinsics: Float[Tensor, "3 3"]
    rgb: Float[Tensor, "height width 3"]
    trust: Float[Tensor, "height width"]

    @cached_property
    def grey(self) -> Float[Tensor, "height width"]:
        return self.rgb @ torch.tensor(GREY)

    @cached_property
    def local_rays(self) -> Float[Tensor, "height width 3"]:
        """Rays of the pixels in the camera's frame, with z = 1: K^-1 (x, y, 1)."""
        height, width = self.trust.shape
        y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        return torch.stack([x, y, torch.ones_like(x)], -1) @ self.intrinsics.inverse().T

    @cached_property
    def rays(self) -> Float[Tensor, "height width 3"]:
        """Rays of the pixels in the world's frame, with depth 1."""
        return self.local_rays @ self.pose[:, :3].T

    def project(self, points: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, "point 2"], Float[Tensor, " point"]]:
        """Pixels of points, and their depths along the axis; pixels of points behind are meaningless."""
        homogeneous = (points - self.pose[:, 3]) @ self.pose[:, :3] @ self.intrinsics.T
        depth = homogeneous[:, 2]
        return homogeneous[:, :2] / depth.clamp_min(1e-9)[:, None], depth

    def sees(self, points: Float[Tensor, "point 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Mask of points inside the picture, their row, their column, their distance along the axis."""
        pixels, depth = self.project(points)
        column, row = pixels.clamp(-1, 1e6).floor().long().unbind(-1)
        height, width = self.trust.shape
        seen = (depth > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return seen, row.clamp(0, height - 1), column.clamp(0, width - 1), depth

    def warp_to(self, other: FlatView) -> Float[Tensor, "3 4"]:
        """(A | b) of `kernels.patch_cost`: from a pixel here and its inverse depth along the axis to a pixel there."""
        rotation, towards = other.pose[:, :3].T @ self.pose[:, :3], self.pose[:, 3] - other.pose[:, 3]
        along = other.intrinsics @ rotation @ self.intrinsics.inverse()
        return torch.cat([along, (other.intrinsics @ other.pose[:, :3].T @ towards)[:, None]], 1)


def flat_view(photograph: Photograph, longest: int) -> FlatView:
    """A photograph reduced by an integer factor, to about `longest` pixels along its longer side, resampled to a
    pinhole.

    Only the part within 50 degrees to the sides of the axis is kept.
    """
    small = photograph.reduced(max(1, round(max(photograph.rgb.shape[:2]) / longest)))
    height, width = small.rgb.shape[:2]
    trust = torch.ones(height, width) if small.alpha is None else small.alpha
    if small.mask is not None:
        trust = trust * small.mask
    lens, pose = small.camera.lens, small.camera.pose[0]
    axis = torch.tensor([[0.0, 0.0, 1.0]])
    centre, _ = lens.project(axis)
    if isinstance(lens, Pinhole):
        intrinsics = torch.diag(torch.cat([lens.focal[0], torch.ones(1)]))
        intrinsics[:2, 2] = centre[0]
        return FlatView(pose, intrinsics, small.rgb, trust)
    focal = 1 / float(lens.solid_angle(centre, axis).sqrt())
    reach = focal * math.tan(MAX_ANGLE)
    size = torch.tensor([width, height])
    first = (centre[0] - reach).clamp_min(0).floor()
    last = torch.minimum(centre[0] + reach, size).ceil().maximum(first + 1)
    intrinsics = torch.diag(torch.tensor([focal, focal, 1.0]))
    intrinsics[:2, 2] = centre[0] - first
    columns, rows = (last - first).int().tolist()
    flat = FlatView(pose, intrinsics, torch.empty(rows, columns, 3), torch.empty(rows, columns))
    pixels, valid = lens.project(flat.rays.reshape(-1, 3) @ pose[:, :3])
    at = torch.where(valid[:, None], pixels / size * 2 - 1, -4).view(1, rows, columns, 2)
    known = torch.cat([small.rgb, trust[..., None]], -1).movedim(-1, 0)[None]
    rgb, trust = grid_sample(known, at, align_corners=False)[0].split([3, 1])
    return FlatView(pose, intrinsics, rgb.movedim(0, -1).contiguous(), trust[0].contiguous())
