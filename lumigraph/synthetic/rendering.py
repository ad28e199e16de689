"""Rendering of a world for a camera: rays through every pixel, traced on all cores, averaged."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rays, Rendering
from ..color.srgb import srgb_from_linear
from ..light import EnvironmentLight
from . import environment, scattering, tracer
from .world import World

RAYS_PER_TASK = 4096
POINTS_PER_TASK = 64
FILM_HEADROOM = 64.0  # radiance relative to white that stays below the film's shoulder
MAX_CONTRAST = 0.08  # between samples of a pixel; above it more are taken (0 is black, 1 white, sRGB-encoded)


class RayHits(NamedTuple):
    """Hits of single rays; arrays with leading axis ray."""

    radiance: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    identity: np.ndarray
    reflectance: np.ndarray


def render(world: World, camera: Camera, samples: int = 4, more: int = 8) -> Rendering:
    """Render a world for a camera (a batch of one, any lens): the exact ground truth.

    samples: rays per pixel; more: further rays where the first ones differ

    Returns (height, width, ...). Straight `rgb` (black for the background), `opacity`, each pixel's coverage by objects
    (and the sky where it is visible), and `depth` along the ray through the pixel's centre, infinite in the sky.
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
    """Only the picture, float32: straight sRGB colours (height, width, 3) and coverage (height, width) in [0, 1]."""
    width, height = camera.size[0].tolist()
    if world.environment is not None:
        light = lit(world, camera)
        return srgb_from_linear(light[..., :3].clip(0, 1)).astype(np.float32), light[..., 3]
    if world.fog is not None:
        rgb = srgb_from_linear(scattered(world, camera).clip(0, 1)).astype(np.float32)
        return rgb, np.ones((height, width), np.float32)
    places = camera.pixels()
    pixels = _gather(world, camera, places, samples, aims=1)
    count = np.full((len(pixels), 1), samples)
    again = np.flatnonzero(_uneven((pixels / samples).reshape(height, width, 5), pixels[:, 4].reshape(height, width)))
    if more and len(again):
        pixels[again] += _gather(world, camera, places[again], more, aims=3)
        count[again] += more
    rgb = srgb_from_linear(pixels[:, :3] / np.maximum(pixels[:, 3:4], 1)).astype(np.float32)
    opacity = (pixels[:, 3:4] / count).astype(np.float32)
    return rgb.reshape(height, width, 3), opacity.reshape(height, width)


def radiance(world: World, camera: Camera, samples: int = 12) -> np.ndarray:
    """Radiance of every pixel, linear sRGB (height, width, 3), without the film's tone curve."""
    if world.environment is not None:
        return lit(world, camera)[..., :3]
    if world.fog is not None:
        return scattered(world, camera)
    width, height = camera.size[0].tolist()
    dim = replace(world, sky=replace(world.sky, exposure=world.sky.exposure / FILM_HEADROOM))
    pixels = _gather(dim, camera, camera.pixels(), samples, aims=1)
    return (FILM_HEADROOM / samples * pixels[:, :3]).astype(np.float32).reshape(height, width, 3)


def lit(world: World, camera: Camera, samples: int = 4, lights: int = 32) -> Float[np.ndarray, "height width 4"]:
    """Straight radiance (linear sRGB) and coverage of every pixel in the world's environment light.

    samples: rays per pixel; lights: samples of the light for each of them
    """
    assert world.environment is not None
    width, height = camera.size[0].tolist()
    rays = _stratified(camera, camera.pixels(), samples)
    table, seen = environment.LightTable.of(world.environment), np.empty((len(rays[0]), 4))

    def work(part: slice) -> None:
        given = (x[part] for x in rays)
        environment.light(world.arrays, table, *given, part.start, lights, world.bounces, seen[part])

    _share_out(work, len(seen))
    pixels = seen.reshape(height, width, samples, 4).sum(2)
    pixels[..., :3] /= np.maximum(pixels[..., 3:], 1)
    pixels[..., 3] /= samples
    return pixels.astype(np.float32)


def scattered(world: World, camera: Camera, samples: int = 4, along: int = 16) -> Float[np.ndarray, "height width 3"]:
    """Radiance (linear sRGB) of every pixel of a world in fog, over black.

    samples: rays per pixel; along: samples along each ray for each lamp
    """
    assert world.fog is not None
    width, height = camera.size[0].tolist()
    rays, fog = _stratified(camera, camera.pixels(), samples), world.fog
    numbers = np.array([fog.scattering, fog.scattering + fog.absorption, fog.anisotropy, fog.reach])
    seen = np.empty((len(rays[0]), 3))

    def work(part: slice) -> None:
        scattering.light(world.arrays, numbers, *(x[part] for x in rays), part.start, along, seen[part])

    _share_out(work, len(seen))
    return seen.reshape(height, width, samples, 3).mean(2).astype(np.float32)


def unoccluded(
    world: World, points: np.ndarray, normals: np.ndarray, directions: np.ndarray
) -> Bool[np.ndarray, "point direction"]:
    """Mask of the unoccluded directions above each surface point."""
    out = np.empty((len(points), len(directions)), bool)

    def work(part: slice) -> None:
        given = (np.ascontiguousarray(x, np.float64) for x in (points[part], normals[part], directions))
        environment.unoccluded(world.arrays, *given, out[part])

    _share_out(work, len(points), POINTS_PER_TASK)
    return out


def roughness(world: World, rays: Rays) -> Float[np.ndarray, " ray"]:
    """Roughness of the material at each ray's hit; NaN for a miss."""
    origins, directions, _ = _arrays(rays)
    out = np.empty(len(rays))
    environment.roughness(world.arrays, origins, directions, out)
    return out


def open_sky(world: World, rays: Rays) -> Float[np.ndarray, " ray"]:
    """Ambient visibility at each ray's hit under a uniform sky; NaN for a miss."""
    seen, even = trace(world, rays, shaded=False), EnvironmentLight.uniform()
    towards, power = (x.double().numpy() for x in even.lamps)
    hit = np.flatnonzero(seen.identity >= 0)
    points = rays.origins.double().numpy()[hit] + seen.depth[hit, None] * rays.directions.double().numpy()[hit]
    weight = (seen.normal[hit] @ towards.T).clip(0) * power[:, 0]
    out = np.full(len(rays), np.nan)
    out[hit] = (unoccluded(world, points, seen.normal[hit], towards) * weight).sum(-1) / weight.sum(-1)
    return out


def eight_bits(rgb: np.ndarray, opacity: np.ndarray, alpha: bool) -> np.ndarray:
    """A picture as bytes (height, width, 3), or with straight alpha (height, width, 4)."""
    channels = np.concatenate([rgb, opacity[..., None]], -1) if alpha else rgb
    return (channels.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def trace(world: World, rays: Rays, shaded: bool = True) -> RayHits:
    """Hits of rays. `radiance` is linear light after the film's response, in [0, 1]; black unless `shaded`."""
    n = len(rays)
    origins, directions, radius = _arrays(rays)
    seen = RayHits(np.empty((n, 3)), np.empty(n), np.empty((n, 3)), np.empty(n, np.int64), np.empty((n, 3)))

    def work(part: slice) -> None:
        out = (x[part] for x in seen)
        tracer.trace(world.arrays, origins[part], directions[part], radius[part], part.start, int(shaded), *out)

    _share_out(work, n)
    return seen


def signed_distance(world: World, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
    """Distance from points to the nearest surface, scene units, negative inside: the surface is its zero level.

    Exact outside; inside exact where objects do not overlap, otherwise a lower bound.
    """
    out = np.empty(len(points))
    points_in = points.detach().double().contiguous().numpy()

    def work(part: slice) -> None:
        tracer.signed_distance(world.arrays, points_in[part], out[part])

    _share_out(work, len(out))
    return torch.from_numpy(out).to(points.dtype)


def _gather(world: World, camera: Camera, places: Tensor, samples: int, aims: int) -> np.ndarray:
    """Sums over `samples` rays around each pixel position, and their differences: see `tracer.gather`.

    aims: shadow rays that each of them sends to each light
    """
    rays, pixels = _stratified(camera, places, samples), np.empty((len(places), 5))

    def work(part: slice) -> None:
        some = (x[part.start * samples : part.stop * samples] for x in rays)
        tracer.gather(world.arrays, *some, part.start, aims, samples, pixels[part])

    _share_out(work, len(places), -(-RAYS_PER_TASK // samples))
    return pixels


def _stratified(camera: Camera, places: Tensor, samples: int) -> tuple[np.ndarray, ...]:
    """Origins, directions and radius of `samples` rays around each pixel position, as input of the tracer."""
    offsets = torch.from_numpy(hammersley(samples)).to(places) - 0.5
    origins, directions, radius = _arrays(camera.rays((places[:, None] + offsets).reshape(-1, 2)))
    return origins, directions, radius / samples**0.5


def _share_out(work: Callable[[slice], None], count: int, step: int = RAYS_PER_TASK) -> None:
    """Call work(part) for each run of `step` out of `count` items, on all cores."""
    list(_workers().map(lambda first: work(slice(first, first + step)), range(0, count, step)))


def _uneven(pixels: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Pixels to supersample: their samples differ, or they differ from their neighbours."""
    uneven = spread > MAX_CONTRAST
    seen = np.sqrt(pixels[..., :4])
    for axis in (0, 1):
        jump = np.abs(np.diff(seen, axis=axis)).max(-1) > 4 * MAX_CONTRAST
        uneven[(slice(1, None), slice(None))[:: 1 - 2 * axis]] |= jump
        uneven[(slice(None, -1), slice(None))[:: 1 - 2 * axis]] |= jump
    return uneven


def _arrays(rays: Rays) -> tuple[np.ndarray, ...]:
    """Origins, directions and radius as input of the tracer."""
    return tuple(x.detach().double().contiguous().numpy() for x in (rays.origins, rays.directions, rays.radius))


def hammersley(count: int) -> np.ndarray:
    """Hammersley points in the unit square; a rotated grid for four."""
    k = np.arange(count)
    mirrored = sum((k >> bit & 1) / 2.0 ** (bit + 1) for bit in range(count.bit_length()))
    return np.stack([(k + 0.5) / count, mirrored + 0.5 / count], -1)


@cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS, "tracer")
