"""From a world and a camera to a picture: rays through every pixel, traced on all cores, averaged."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...rays import Rays, Rendering
from . import tracer
from .world import World, srgb_from_linear

RAYS_PER_TASK = 4096
CONTRAST = 0.08  # samples of a pixel that differ by more, in encoded colour, are not enough


class Seen(NamedTuple):
    """What single rays met; arrays with leading axis ray."""

    radiance: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    identity: np.ndarray
    reflectance: np.ndarray


def render(world: World, camera: Camera, samples: int = 4, more: int = 8) -> Rendering:
    """What a camera (a batch of one, any lens) sees of a world: the exact ground truth.

    samples: rays per pixel; more: further rays where the first ones differ

    Returns (height, width, ...). Straight `rgb` (black where nothing is), `opacity` the share of the pixel that things
    cover (sky counts where it is visible), and `depth` along the ray through the pixel's centre, infinite in the sky.
    Extras, for the same ray: `normals` (unit, world frame, zero in the sky), `ids` (index into `world.names`, -1 for
    none), `albedo` (diffuse reflectance, linear).
    """
    width, height = camera.size[0].tolist()
    rgb, opacity = photograph(world, camera, samples, more)
    seen = trace(world, camera.rays(camera.pixels()), shaded=False)
    extra = {"normals": seen.normal, "ids": seen.identity, "albedo": seen.reflectance}
    rendering = Rendering(
        torch.from_numpy(rgb).reshape(-1, 3),
        torch.from_numpy(seen.depth).float(),
        torch.from_numpy(opacity).reshape(-1),
        {k: torch.from_numpy(v) if k == "ids" else torch.from_numpy(v).float() for k, v in extra.items()},
    )
    return rendering.reshape(height, width)


def photograph(world: World, camera: Camera, samples: int = 4, more: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """The picture alone, float32: straight sRGB colours (height, width, 3) and coverage (height, width) in [0, 1]."""
    width, height = camera.size[0].tolist()
    pixels = camera.pixels()
    picture, spread = _sample(world, camera, pixels, samples)
    count = np.full((len(pixels), 1), samples)
    again = np.flatnonzero(_uneven((picture / samples).reshape(height, width, 4), spread.reshape(height, width)))
    if more and len(again):
        picture[again] += _sample(world, camera, pixels[again], more)[0]
        count[again] += more
    rgb = srgb_from_linear(picture[:, :3] / np.maximum(picture[:, 3:], 1)).astype(np.float32)
    opacity = (picture[:, 3:] / count).astype(np.float32)
    return rgb.reshape(height, width, 3), opacity.reshape(height, width)


def eight_bits(rgb: np.ndarray, opacity: np.ndarray, alpha: bool) -> np.ndarray:
    """A picture as bytes (height, width, 3), or with straight alpha (height, width, 4)."""
    channels = np.concatenate([rgb, opacity[..., None]], -1) if alpha else rgb
    return (channels.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def trace(world: World, rays: Rays, shaded: bool = True) -> Seen:
    """What each ray meets. `radiance` is linear light after the film's response, in [0, 1]; black unless shaded."""
    n = len(rays)
    origins, directions = (x.detach().double().contiguous().numpy() for x in (rays.origins, rays.directions))
    radius = rays.radius.detach().double().contiguous().numpy()
    seen = Seen(*(np.empty(shape) for shape in ((n, 3), (n,), (n, 3))), np.empty(n, np.int64), np.empty((n, 3)))

    def work(first: int) -> None:
        part = slice(first, first + RAYS_PER_TASK)
        out = (x[part] for x in seen)
        tracer.trace(world.arrays, origins[part], directions[part], radius[part], first, shaded, *out)

    list(_workers().map(work, range(0, n, RAYS_PER_TASK)))
    return seen


def signed_distance(world: World, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
    """Distance from points to the nearest surface, scene units, negative inside: the surface is its zero level.

    Exact outside; inside exact where objects do not overlap, otherwise no further than the true surface.
    """
    out = np.empty(len(points))
    points_in = points.detach().double().contiguous().numpy()

    def work(first: int) -> None:
        part = slice(first, first + RAYS_PER_TASK)
        tracer.signed_distance(world.arrays, points_in[part], out[part])

    list(_workers().map(work, range(0, len(out), RAYS_PER_TASK)))
    return torch.from_numpy(out).to(points.dtype)


def _sample(world: World, camera: Camera, pixels: Tensor, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Over `samples` rays through each pixel: the sums of linear colour and of hits (pixel, 4), and the range of the
    encoded colours (pixel,)."""
    offsets = torch.from_numpy(hammersley(samples)).to(pixels) - 0.5
    rays = camera.rays((pixels[:, None] + offsets).reshape(-1, 2))
    seen = trace(world, Rays(rays.origins, rays.directions, rays.radius / samples**0.5))
    radiance = seen.radiance.reshape(-1, samples, 3)
    hits = np.full(len(pixels), samples) if world.sky.visible else (seen.identity >= 0).reshape(-1, samples).sum(1)
    spread = srgb_from_linear(radiance.max(1)) - srgb_from_linear(radiance.min(1))
    return np.concatenate([radiance.sum(1), hits[:, None]], 1), spread.max(-1)


def _uneven(picture: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Pixels whose few samples may have missed something: they differ among themselves, or from their neighbours."""
    uneven = spread > CONTRAST
    encoded = np.concatenate([srgb_from_linear(picture[..., :3]), picture[..., 3:]], -1)
    for axis in (0, 1):
        jump = np.abs(np.diff(encoded, axis=axis)).max(-1) > 4 * CONTRAST
        uneven[(slice(1, None), slice(None))[:: 1 - 2 * axis]] |= jump
        uneven[(slice(None, -1), slice(None))[:: 1 - 2 * axis]] |= jump
    return uneven


def hammersley(count: int) -> np.ndarray:
    """Evenly spread points in the unit square; a rotated grid for four."""
    k = np.arange(count)
    mirrored = sum((k >> bit & 1) / 2.0 ** (bit + 1) for bit in range(count.bit_length()))
    return np.stack([(k + 0.5) / count, mirrored + 0.5 / count], -1)


@cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS, "tracer")
