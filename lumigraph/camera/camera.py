"""Cameras: poses, lenses and sizes of photographs, and the rays of their pixels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry import look_at
from .lens import Equirectangular, Lens, Pinhole, one_or_more, rows
from .rays import Rays

RING_CAMERAS, RING_ELEVATION = 24, 15.0  # cameras per ring; degrees above the horizon
DOME_ELEVATIONS = (0.0, 30.0, 60.0)  # degrees, one per ring
# A disc of this radius varies as much as a square pixel of side one (Barron 2021, section 3.1).
PIXEL_RADIUS = 2 / math.sqrt(12)


@dataclass(frozen=True)
class Camera:
    """A batch of cameras.

    pose:        camera-to-world, rotation and position; +x right, +y down, +z forward; position in scene units
    lens:        intrinsics, one row per camera
    size:        (width, height) in pixels
    time:        time of exposure, for a dynamic capture
    image_index: number of each camera's photograph, if any
    """

    pose: Float[Tensor, "camera 3 4"]
    lens: Lens
    size: Int[Tensor, "camera 2"]
    time: Float[Tensor, " camera"] | None = None
    image_index: Int[Tensor, " camera"] | None = None

    def __len__(self) -> int:
        return len(self.pose)

    def __repr__(self) -> str:
        """Number, lens and sizes in one line."""
        sizes = sorted({f"{width}x{height}" for width, height in self.size.tolist()})
        shown = f"{len(sizes)} sizes" if len(sizes) > 2 else " and ".join(sizes)
        where = f" at {[round(x, 3) for x in self.position[0].tolist()]}" if len(self) == 1 else ""
        return f"Camera: {len(self)} {type(self.lens).__name__}, {shown} pixels{where}"

    def __getitem__(self, index: int | np.integer | slice | Tensor) -> Camera:
        """Some of the cameras; an int gives a batch of one."""
        keep = one_or_more(index)
        time, image_index = (None if x is None else x[keep] for x in (self.time, self.image_index))
        return Camera(self.pose[keep], self.lens[keep], self.size[keep], time, image_index)

    def to(self, device: torch.device | str) -> Camera:
        """The same cameras on a device; tensors that are there already are not copied."""
        time, image_index = (None if x is None else x.to(device) for x in (self.time, self.image_index))
        return Camera(self.pose.to(device), self.lens.to(device), self.size.to(device), time, image_index)

    @property
    def position(self) -> Float[Tensor, "camera 3"]:
        """Centre of each camera in the world, in scene units."""
        return self.pose[:, :, 3]

    @property
    def forward(self) -> Float[Tensor, "camera 3"]:
        """Viewing direction of each camera, unit length."""
        return self.pose[:, :, 2]

    def pixels(self) -> Float[Tensor, "pixel 2"]:
        """The centres (x, y) of all pixels of a batch of one, row by row."""
        if len(self) != 1:
            raise ValueError(f"pixels() is for one camera at a time; this batch has {len(self)}")
        width, height = self.size[0].tolist()
        x = torch.arange(width, dtype=self.pose.dtype, device=self.pose.device) + 0.5
        y = torch.arange(height, dtype=self.pose.dtype, device=self.pose.device) + 0.5
        return torch.stack([x.expand(height, width), y[:, None].expand(height, width)], -1).reshape(-1, 2)

    def rays(self, pixels: Float[Tensor, "ray 2"], index: Int[Tensor, " ray"] | None = None) -> Rays:
        """The rays through pixels (x, y), in the world's frame; differentiable in the poses.

        index: the camera of each pixel; None means camera 0 for all
        """
        inward = self.lens.unproject(pixels, index)
        radius = PIXEL_RADIUS * self.lens.solid_angle(pixels, inward, index).sqrt()
        pose = rows(self.pose.reshape(-1, 12), index).view(-1, 3, 4)
        origins, begin = pose[:, :, 3], self.lens.origins(pixels, index)
        if begin is not None:
            origins = origins + rotate(pose, begin)
        time, image_index = (gather(x, index, len(pixels)) for x in (self.time, self.image_index))
        return Rays(origins.expand(len(pixels), 3), rotate(pose, inward), radius, time, image_index)

    def cosines(self) -> Float[Tensor, "height width"]:
        """Cosine of the angle between each pixel's ray and the optical axis, of a batch of one."""
        width, height = self.size[0].tolist()
        lens = self.lens
        if not isinstance(lens, Pinhole):
            return lens.unproject(self.pixels())[:, 2].view(height, width)
        axes = zip((width, height), lens.centre[0], lens.focal[0], strict=True)
        x, y = ((torch.arange(n).to(c) + 0.5 - c) / f for n, c, f in axes)
        return torch.rsqrt((1 + x * x) + (y * y)[:, None])

    def project(
        self, points: Float[Tensor, "point 3"], index: Int[Tensor, " point"] | None = None
    ) -> tuple[Float[Tensor, "point 2"], Bool[Tensor, " point"]]:
        """Pixels (x, y) of points in the world, and a mask of valid projections (see `Lens.project`).

        index: the camera of each point; None means camera 0 for all
        """
        pose = rows(self.pose.reshape(-1, 12), index).view(-1, 3, 4)
        return self.lens.project(rotate(pose[:, :, :3].mT, points - pose[:, :, 3]), index)

    def locate(self, points: Float[Tensor, "point 3"]) -> tuple[Int[Tensor, "point 2"], Bool[Tensor, " point"]]:
        """Row and column of the pixel of each point, clamped to the picture, and a mask of points inside it.

        For a batch of one: the shared projection of cells into silhouettes, masks and superpixels.
        """
        pixels, valid = self.project(points)
        places = pixels.nan_to_num(-1.0, -1.0, -1.0).clamp(-1, 1e6).floor().long().flip(-1)
        last = self.size[0].flip(-1) - 1
        inside = valid & (places >= 0).all(-1) & (places <= last).all(-1)
        return places.clamp_min(0).minimum(last), inside

    def resized(self, factor: float) -> Camera:
        """Cameras of pictures scaled by a factor. Sizes are rounded; intrinsics follow the rounded sizes exactly."""
        size = (self.size * factor).round().clamp_min(1).to(self.size.dtype)
        return replace(self, size=size, lens=self.lens.resized((size.double() / self.size).to(self.pose.dtype)))

    def reduced(self, factor: int) -> Camera:
        """Cameras of pictures a whole number of times smaller; incomplete squares at the border are cropped."""
        scale = torch.full((1, 2), 1 / factor, device=self.pose.device)
        return replace(self, lens=self.lens.resized(scale), size=self.size // factor)

    def transformed(self, similarity: Float[Tensor, "4 4"]) -> Camera:
        """The cameras in another frame, x' = M x: positions and stereo offsets scale, rotations stay rotations."""
        similarity = similarity.to(self.pose)
        scale = torch.linalg.det(similarity[:3, :3]) ** (1 / 3)
        rotation = similarity[:3, :3] / scale @ self.pose[:, :, :3]
        position = self.position @ similarity[:3, :3].mT + similarity[:3, 3]
        pose = torch.cat([rotation, position[:, :, None]], -1)
        return replace(self, pose=pose, lens=self.lens.enlarged(float(scale)))

    def sheared(self, right: float, down: float, focus: float) -> Camera:
        """The cameras shifted in their own planes with sheared projections, as on a two-plane light field: points at
        the depth `focus` (scene units, along the axis) stay at their pixels. For lenses with a focal length."""
        lens: Any = self.lens
        aside = torch.tensor([right, down], dtype=self.pose.dtype, device=self.pose.device)
        position = self.position + (self.pose[:, :, :2] @ aside)
        pose = torch.cat([self.pose[:, :, :3], position[:, :, None]], -1)
        return replace(self, pose=pose, lens=replace(lens, centre=lens.centre + lens.focal * aside / focus))

    @staticmethod
    def pinhole(pose: Float[Tensor, "camera 3 4"], size: tuple[int, int], angle: float) -> Camera:
        """Cameras of one size with square pixels. angle: of view across the picture's height, degrees, as of MuJoCo"""
        many, focal = len(pose), 0.5 * size[1] / math.tan(0.5 * math.radians(angle))
        pixels = torch.tensor(size).expand(many, 2)
        return Camera(pose, Pinhole(torch.full((many, 2), focal), pixels / 2), pixels)

    @staticmethod
    def spinning(
        pose: Float[Tensor, "camera 3 4"], beams: int = 64, columns: int = 1024, low: float = -25.0, high: float = 15.0
    ) -> Camera:
        """Range sensors that turn, such as a LiDAR: a row for each beam, the highest first, a column for each azimuth.

        pose:      the middle column looks along +z; the axis of rotation is y
        low, high: elevations of the lower edge of the last row and the upper edge of the first, degrees, evenly divided
        """
        rows_around = beams * 180 / (high - low)
        lens = Equirectangular(*(torch.tensor([x]).expand(len(pose), 2) for x in (
            (float(columns), rows_around), (columns / 2, high / 180 * rows_around))))  # fmt: skip
        return Camera(pose, lens, torch.tensor([columns, beams]).expand(len(pose), 2))

    @staticmethod
    def cat(cameras: Sequence[Camera]) -> Camera:
        """Concatenate batches of cameras."""
        pose, size = torch.cat([c.pose for c in cameras]), torch.cat([c.size for c in cameras])
        time, image_index = join(c.time for c in cameras), join(c.image_index for c in cameras)
        return Camera(pose, Lens.cat([c.lens for c in cameras]), size, time, image_index)


def ring(
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]],
    distance: float = 2.6,
    angle: float = 50.0,
    size: int = 800,
    count: int = RING_CAMERAS,
) -> Camera:
    """Cameras on a circle around a box, looking at its centre, for scenes without photographs.

    distance: from the centre, scene units
    angle:    of view, degrees
    size:     pixels a side
    """
    middle = torch.tensor(bounds).mean(0)
    azimuth = torch.arange(count) * (2 * math.pi / count)
    height = torch.full_like(azimuth, math.radians(RING_ELEVATION))
    outward = torch.stack([height.cos() * azimuth.cos(), height.cos() * azimuth.sin(), height.sin()], -1)
    pose = look_at(middle + distance * outward, -outward, torch.tensor([0.0, 0.0, 1.0]))
    focal = 0.5 * size / math.tan(0.5 * math.radians(angle))
    lens = Pinhole(torch.full((count, 2), focal), torch.full((count, 2), size / 2))
    return Camera(pose, lens, torch.full((count, 2), size))


def dome(ring: Camera) -> Camera:
    """Cameras on a dome, at the distances and azimuths of a ring around the origin."""
    parts = []
    for degrees in DOME_ELEVATIONS:
        angle = torch.full((len(ring),), math.radians(degrees))
        flat = torch.nn.functional.normalize(ring.position[:, :2], dim=-1)
        outward = torch.cat([angle.cos()[:, None] * flat, angle.sin()[:, None]], -1)
        position = ring.position.norm(dim=-1, keepdim=True) * outward
        pose = look_at(position, -outward, torch.tensor([0.0, 0.0, 1.0]))
        parts.append(replace(ring, pose=pose))
    return Camera.cat(parts)


def rotate(matrix: Float[Tensor, "#ray 3 _"], vectors: Float[Tensor, "ray 3"]) -> Float[Tensor, "ray 3"]:
    """Rotate each vector by the first three columns of its matrix."""
    if len(matrix) == 1:
        return vectors @ matrix[0, :, :3].mT
    x, y, z = vectors[:, :, None].unbind(1)
    return torch.addcmul(torch.addcmul(x * matrix[:, :, 0], y, matrix[:, :, 1]), z, matrix[:, :, 2])


def join(parts: Iterable[Tensor | None]) -> Tensor | None:
    """Concatenate tensors; None if any is missing."""
    columns = list(parts)
    found = [x for x in columns if x is not None]
    return torch.cat(found) if len(found) == len(columns) else None


def gather(values: Tensor | None, index: Tensor | None, count: int) -> Tensor | None:
    """One value for each ray, or None without values."""
    if values is None:
        return None
    return values[:1].expand(count) if index is None else values.index_select(0, index)
