"""Spaces: coordinates of a network's input, and the sampled interval of each ray.

Coordinates are about uniform in [-1, 1]. An object is used unchanged, a forward-facing capture in normalised device
coordinates (Mildenhall 2020, appendix C), anything else is contracted into a ball (Barron 2022, section 3).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...camera.rays import Rays, Samples
from ...datasets.scene import Forward, Frame, Vector

INFINITY = 1000.0  # times the near plane's distance: rays in normalised device coordinates end at 0.998 instead of 1
SIDEWAYS = 1e-3  # sine of the angle to the near plane, below which a ray is said not to reach it


def space_of(frame: Frame) -> Space:
    """Space for a scene's frame."""
    if not frame.is_open:
        return Box(frame.bounds, frame.near)
    if frame.forward is not None:
        return NDC(frame.forward, frame.near)
    return contraction_of(frame)


def contraction_of(frame: Frame) -> Contraction:
    """Contraction of an unbounded capture."""
    return Contraction(frame.near, 2 * math.sqrt(3) * frame.reach)


class Space(ABC):
    """A map from the scene to coordinates, and the interval of each ray that it covers.

    In plain numbers, so that it works on any device and in any precision.
    is_open: whether it covers an unbounded scene
    """

    is_open: ClassVar[bool] = True

    @abstractmethod
    def interval(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Near and far end of each ray's samples, in scene units: finite, and equal for rays that miss."""

    @abstractmethod
    def distance(
        self, share: Float[Tensor, "ray sample"], rays: Rays, near: Float[Tensor, " ray"], far: Float[Tensor, " ray"]
    ) -> Float[Tensor, "ray sample"]:
        """Distances at positions from 0 (near) to 1 (far) in this space's measure: exact at both ends, ascending."""

    @abstractmethod
    def warp(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Coordinates of points."""

    @abstractmethod
    def unwarp(self, coordinates: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Points with these coordinates; clamped for coordinates outside the space's image."""

    @abstractmethod
    def jacobian(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
        """Derivative of each coordinate (rows) by each axis of the scene (columns)."""

    @abstractmethod
    def stretch(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """|det J|^(1/3): mean scale from scene units to coordinates."""

    def mapped(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
        """Coordinates of points, and `stretch` there."""
        return self.warp(points), self.stretch(points)

    def along(self, rays: Rays, samples: Samples) -> Float[Tensor, " sample"]:
        """Speed of a ray in coordinates per scene unit, averaged over each sample."""
        ray = samples.ray_index
        first, last = (
            self.warp(rays.origins[ray] + t[:, None] * rays.directions[ray]) for t in (samples.t_start, samples.t_end)
        )
        return (last - first).norm(dim=-1) / samples.length.clamp_min(1e-9)

    def warp_gaussians(
        self,
        means: Float[Tensor, "n 3"],
        directions: Float[Tensor, "n 3"],
        along: Float[Tensor, " n"],
        across: Float[Tensor, " n"],
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Coordinates of Gaussians, and their variances along each coordinate, by linearisation (Barron 2022, eq. 9).

        directions: unit length; variances in squared scene units along and across them
        The diagonal of J S J^T with S = along d d^T + across (I - d d^T); with J = I it is Barron 2021, eq. 16.
        """
        jacobian = self.jacobian(means)
        ray = (jacobian @ directions[:, :, None])[:, :, 0].square()
        variances = along[:, None] * ray + across[:, None] * (jacobian.square().sum(-1) - ray).clamp_min(0)
        return self.warp(means), variances


@dataclass(frozen=True)
class Box(Space):
    """Bounds of an object, without a map; samples are uniform along each ray."""

    bounds: tuple[Vector, Vector]
    near: float
    is_open: ClassVar[bool] = False

    def interval(self, rays):
        enter, leave = rays.through_box(rays.origins.new_tensor(self.bounds))
        enter = enter.clamp_min(self.near)
        hit = leave > enter
        return torch.where(hit, enter, self.near), torch.where(hit, leave, self.near)

    def distance(self, share, rays, near, far):
        return torch.lerp(near[:, None], far[:, None], share)

    def warp(self, points):
        return points

    def unwarp(self, coordinates):
        return coordinates

    def jacobian(self, points):
        return torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)

    def stretch(self, points):
        return points.new_ones(len(points))

    def warp_gaussians(self, means, directions, along, across):
        ray = directions.square()
        return means, along[:, None] * ray + across[:, None] * (1 - ray)

    def along(self, rays, samples):
        return torch.ones_like(samples.t_start)


@dataclass(frozen=True)
class NDC(Space):
    """Normalised device coordinates of the mean camera: (s_x x / z, s_y y / z, 1 - 2 n / z), n the near plane.

    Mildenhall 2020, appendix C, which looks along -z where we look along +z. The frustum beyond the near plane becomes
    a cube, and lines stay lines. Samples are linear in the paper's t', from the near plane, or from the frame's near
    distance for cameras beyond it, to nearly infinity. Points in front of the plane are clamped to it.
    """

    forward: Forward
    near: float

    def interval(self, rays):
        z, speed = self._depths(rays)
        near = ((self.forward.near - z) / speed).clamp_min(self.near)
        far = (INFINITY * self.forward.near - z) / speed
        reaches = (rays.directions @ self._pose(rays.origins)[:, 2] > SIDEWAYS) & (far > near)
        return torch.where(reaches, near, 0), torch.where(reaches, far, 0)

    def distance(self, share, rays, near, far):
        z, speed = self._depths(rays)
        first, last = ((z + t * speed).clamp_min(self.forward.near) for t in (near, far))
        return torch.lerp(near[:, None], far[:, None], even_in_inverse(share, first[:, None], last[:, None]))

    def warp(self, points):
        x, y, z = self._in_camera(points)
        (scale_x, scale_y), near = self.forward.scale, self.forward.near
        return torch.stack([scale_x * x / z, scale_y * y / z, 1 - 2 * near / z], -1)

    def unwarp(self, coordinates):
        u, v, w = coordinates.unbind(-1)
        (scale_x, scale_y), pose = self.forward.scale, self._pose(coordinates)
        z = 2 * self.forward.near / (1 - w).clamp(2 / INFINITY, 2)
        return torch.stack([u / scale_x * z, v / scale_y * z, z], -1) @ pose[:, :3].T + pose[:, 3]

    def jacobian(self, points):
        x, y, z = self._in_camera(points)
        (scale_x, scale_y), near = self.forward.scale, self.forward.near
        right, down, ahead = self._pose(points)[:, :3].T
        rows = (
            scale_x * (right - (x / z)[:, None] * ahead),
            scale_y * (down - (y / z)[:, None] * ahead),
            2 * near / z[:, None] * ahead,
        )
        return torch.stack(rows, 1) / z[:, None, None]

    def stretch(self, points):
        _, _, z = self._in_camera(points)
        scale_x, scale_y = self.forward.scale
        return (2 * scale_x * scale_y * self.forward.near) ** (1 / 3) * z ** (-4 / 3)

    def camera_rays(self, rays: Rays) -> tuple[Float[Tensor, "ray 3"], Float[Tensor, "ray 3"]]:
        """Origins and directions of rays in the mean camera's frame."""
        pose = self._pose(rays.origins)
        return (rays.origins - pose[:, 3]) @ pose[:, :3], rays.directions @ pose[:, :3]

    @property
    def frustum(self) -> tuple[float, float, float]:
        """Scale of x, scale of y and the near plane."""
        return *self.forward.scale, self.forward.near

    def _pose(self, like: Tensor) -> Float[Tensor, "3 4"]:
        return like.new_tensor(self.forward.pose)

    def _in_camera(self, points: Float[Tensor, "*n 3"]) -> tuple[Tensor, Tensor, Tensor]:
        """x, y, z in the mean camera, z on or beyond the near plane."""
        pose = self._pose(points)
        x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).unbind(-1)
        return x, y, z.clamp_min(self.forward.near)

    def _depths(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Depth z of each ray's origin, and its derivative along the ray, clamped below for rays not looking ahead."""
        pose = self._pose(rays.origins)
        return (rays.origins - pose[:, 3]) @ pose[:, 2], (rays.directions @ pose[:, 2]).clamp_min(SIDEWAYS)


@dataclass(frozen=True)
class Contraction(Space):
    """Contraction of space into a ball of radius 1: half of contract(x), x inside the unit ball and (2 - 1 / |x|) x /
    |x| outside.

    Barron 2022, eq. 10. Samples are linear in disparity, 1 / t, which far out is linear in coordinates (section 3).
    """

    near: float
    far: float

    def interval(self, rays):
        ends = rays.origins.new_tensor([[self.near], [self.far]]).expand(2, len(rays))
        return ends[0], ends[1]

    def distance(self, share, rays, near, far):
        return torch.lerp(near[:, None], far[:, None], even_in_inverse(share, near[:, None], far[:, None]))

    def warp(self, points):
        if fits_kernels(points):
            return kernels.contract(points.reshape(-1, 3))[0].view(points.shape)
        return points * self._across(points)[..., None]

    def mapped(self, points):
        if not fits_kernels(points):
            return super().mapped(points)
        coordinates, stretch = kernels.contract(points, True)
        assert stretch is not None
        return coordinates, stretch

    def unwarp(self, coordinates):
        doubled = 2 * coordinates
        radius = doubled.norm(dim=-1, keepdim=True).clamp_min(1)  # 2 - 1 / |x| outside
        return doubled / radius / (2 - radius).clamp_min(1 / self.far)

    def jacobian(self, points):
        radial, across = self._radial(points), self._across(points)
        out = points / self._radius(points)[:, None]
        identity = torch.eye(3, dtype=points.dtype, device=points.device)
        return across[:, None, None] * identity + (radial - across)[:, None, None] * out[:, :, None] * out[:, None]

    def stretch(self, points):
        if fits_kernels(points):
            return self.mapped(points)[1]
        return (self._radial(points) * self._across(points).square()) ** (1 / 3)

    def _radius(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        return points.norm(dim=-1).clamp_min(1)  # with 1, what holds outside holds inside too

    def _across(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Scale from scene units to coordinates, tangentially."""
        radius = self._radius(points)
        return 0.5 * (2 - 1 / radius) / radius

    def _radial(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Scale from scene units to coordinates, radially."""
        return 0.5 / self._radius(points).square()


def fits_kernels(points: Tensor) -> bool:
    """True for points supported by kernels without gradients: float32, without gradients."""
    return points.dtype == torch.float32 and not (torch.is_grad_enabled() and points.requires_grad)


def even_in_inverse(share: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Interpolation from first to last, linear in disparity. Returns its position between them."""
    return share * first / (share * first + (1 - share) * last)
