"""Depth maps of any lens as depth maps of pinholes: one, or the faces of a cube around the camera."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..camera.lens import Lens, OmnidirectionalStereo, Pinhole
from ..errors import LumigraphError
from . import loops
from .depth_map import DEPTH_EDGE, DepthMap

MAX_ANGLE = math.radians(60.0)  # from the axis, up to which one pinhole holds a picture
FACES = ((0, 0), (90, 0), (180, 0), (270, 0), (0, 90), (0, -90))  # of a cube: turned to the right and up, degrees


@dataclass(frozen=True)
class PinholeMap:
    """A depth map through a pinhole.

    depth: along rays, NaN or infinity without a surface; rgb: sRGB-encoded; trust: at least 0
    pose:  camera-to-world; lens: (fx, fy, cx, cy) in pixels
    """

    depth: Float[Tensor, "height width"]
    rgb: Float[Tensor, "height width 3"]
    trust: Float[Tensor, "height width"]
    pose: Float[Tensor, "3 4"]
    lens: Float[Tensor, " 4"]


@dataclass(frozen=True)
class PinholeFace:
    """One pinhole that covers a part of a lens.

    rotation: from its frame to the camera's
    pixels:   of the lens, in the direction of each of its own; `valid` for valid projections
    """

    rotation: Float[Tensor, "3 3"]
    lens: Float[Tensor, " 4"]
    shape: tuple[int, int]
    pixels: Float[Tensor, "pixel 2"]
    valid: Bool[Tensor, " pixel"]


def pinhole_maps(seen: DepthMap, trust: Float[Tensor, "height width"]) -> Iterator[PinholeMap]:
    """The depth map unchanged, or resampled. Depth is interpolated, at depth edges the nearest pixel's; trust and
    colour likewise. Raises LumigraphError for lenses whose rays do not share an origin."""
    lens, pose = seen.camera.lens, seen.camera.pose[0]
    if isinstance(lens, Pinhole):
        yield PinholeMap(seen.depth, seen.rgb, trust, pose, torch.cat([lens.focal[0], lens.centre[0]]))
        return
    if isinstance(lens, OmnidirectionalStereo):
        raise LumigraphError("Stereo panoramas have no one centre, so their depth cannot be fused; use another lens")
    width, height = seen.camera.size[0].tolist()
    for face in faces(json.dumps(lens.to_json()), width, height):
        inside = face.valid & ((face.pixels >= 0) & (face.pixels < seen.camera.size)).all(-1)
        away = torch.zeros(len(inside))
        depth, smooth = torch.empty_like(away), torch.empty_like(inside)
        edge = DEPTH_EDGE.per_distance * float(seen.depth[seen.solid].median()) if seen.solid.any() else 1.0
        given = face.pixels, inside, away, seen.depth.contiguous()
        loops.compare(*(x.numpy() for x in given), edge, 0.0, depth.numpy(), smooth.numpy())
        depth = torch.where(smooth, depth, seen.at_pixels(seen.depth, face.pixels))
        rgb, sure = seen.at_pixels(seen.rgb, face.pixels), seen.at_pixels(trust, face.pixels) * inside
        turned = torch.cat([pose[:, :3] @ face.rotation, pose[:, 3:]], 1)
        yield PinholeMap(depth.view(face.shape), rgb.view(*face.shape, 3), sure.view(face.shape), turned, face.lens)


@lru_cache(maxsize=8)
def faces(kind: str, width: int, height: int) -> tuple[PinholeFace, ...]:
    """Pinholes that together cover a lens's picture, at its central resolution.

    kind: the lens as JSON
    """
    lens = Lens.from_json(json.loads(kind))
    x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    border = torch.cat([torch.stack(pair, -1) for pair in _sides(x, y)])
    outward, axis = lens.unproject(border), torch.tensor([[0.0, 0.0, 1.0]])
    centre, _ = lens.project(axis)
    focal = 1 / float(lens.solid_angle(centre, axis).sqrt())
    if bool((outward[:, 2] > math.cos(MAX_ANGLE)).all()):
        slopes = outward[:, :2] / outward[:, 2:]
        low, high = slopes.amin(0), slopes.amax(0)
        columns, rows = ((high - low) * focal).ceil().int().tolist()
        numbers = torch.tensor([focal, focal, *(-low * focal).tolist()])
        return (_face(lens, torch.eye(3), numbers, (rows, columns)),)
    side = math.ceil(2 * focal)
    numbers = torch.tensor([focal, focal, side / 2, side / 2])
    every = (_face(lens, _turned(*angles), numbers, (side, side)) for angles in FACES)
    size = torch.tensor([width, height])
    return tuple(f for f in every if (f.valid & ((f.pixels >= 0) & (f.pixels < size)).all(-1)).any())


def _sides(x: Tensor, y: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Pixels along the four sides of a picture."""
    for end in (y[:1], y[-1:]):
        yield x, end.expand(len(x))
    for end in (x[:1], x[-1:]):
        yield end.expand(len(y)), y


def _face(lens: Lens, rotation: Tensor, numbers: Tensor, shape: tuple[int, int]) -> PinholeFace:
    """A pinhole's pixels on a lens. numbers: (fx, fy, cx, cy)"""
    y, x = torch.meshgrid(torch.arange(shape[0]) + 0.5, torch.arange(shape[1]) + 0.5, indexing="ij")
    towards = torch.stack([(x - numbers[2]) / numbers[0], (y - numbers[3]) / numbers[1], torch.ones_like(x)], -1)
    pixels, valid = lens.project(towards.view(-1, 3) @ rotation.T)
    return PinholeFace(rotation, numbers, shape, pixels.contiguous(), valid.contiguous())


def _turned(right: float, up: float) -> Float[Tensor, "3 3"]:
    """Rotation to a frame that looks to the right and up, degrees."""
    a, b = math.radians(right), math.radians(up)
    about_y = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    about_x = torch.tensor([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    return about_y @ about_x
