"""Landscapes: pictures of natural land with their label maps, in several styles, for label-to-picture networks.

    landscape(seed, style="autumn", size=128)     rgb, labels

The land is that of `terrain`, without blocks: a height field with textures, sun, shadows, haze, clouds and water.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from ...datasets.terrain import SKY, TREE, WATER, terrain

WIDTH, FINE = 64, 4  # of the land: blocks a side, points to a block
FIELD_OF_VIEW = 70.0  # degrees
EYE_HEIGHTS, PITCHES = (2.5, 12.0), (-28.0, 4.0)  # above the land, blocks; degrees
FIRST_STEP, STEP_GROWTH, FAR = 0.06, 0.008, 240.0  # of rays: blocks, share of the distance, blocks
CAUTION = 0.3  # of the height above the land, that a ray steps on at least
SHADOW_REACH = 40.0  # blocks
AMBIENT = 0.42  # share of the light that comes from the sky
COMPILE_OPTIONS = {
    "nogil": True,
    "_nrt": False,
    "fastmath": {"reassoc", "nsz", "arcp", "contract"},
    "error_model": "numpy",
}
TEXTURE = 256  # points a side of the noise that textures repeat


Colour = tuple[float, float, float]


@dataclass(frozen=True)
class LandscapeStyle:
    """Light and colours of a landscape; colours as seen on screen (sRGB).

    ground: two colours of each label but the sky, between which its texture varies
    sun:    colour of the sun's light; height: of the sun, degrees
    haze:   share of light lost per block to the horizon's colour
    clouds: share of the sky that clouds cover
    """

    ground: tuple[tuple[Colour, Colour], ...]
    sun: Colour
    height: float
    zenith: Colour
    horizon: Colour
    haze: float
    clouds: float


SUMMER = LandscapeStyle(
    (
        ((0.30, 0.43, 0.14), (0.47, 0.54, 0.22)),  # grass
        ((0.40, 0.30, 0.20), (0.54, 0.43, 0.30)),  # dirt
        ((0.40, 0.39, 0.37), (0.60, 0.57, 0.54)),  # stone
        ((0.76, 0.67, 0.48), (0.87, 0.80, 0.62)),  # sand
        ((0.08, 0.26, 0.36), (0.16, 0.38, 0.46)),  # water
        ((0.08, 0.20, 0.06), (0.25, 0.40, 0.13)),  # tree
        ((0.90, 0.92, 0.96), (0.98, 0.98, 0.99)),  # snow
    ),
    sun=(1.12, 1.08, 1.0), height=48.0, zenith=(0.27, 0.50, 0.86), horizon=(0.76, 0.87, 0.96),
        haze=0.004, clouds=0.35,
)  # fmt: skip
STYLES = {
    "summer": SUMMER,
    "autumn": LandscapeStyle(
        (
            ((0.48, 0.40, 0.16), (0.66, 0.56, 0.26)),
            ((0.34, 0.24, 0.16), (0.48, 0.36, 0.25)),
            ((0.40, 0.37, 0.34), (0.58, 0.53, 0.48)),
            ((0.70, 0.60, 0.44), (0.80, 0.71, 0.55)),
            ((0.13, 0.24, 0.28), (0.22, 0.34, 0.37)),
            ((0.50, 0.18, 0.05), (0.85, 0.55, 0.12)),
            ((0.88, 0.89, 0.92), (0.96, 0.96, 0.97)),
        ),
        sun=(1.18, 1.04, 0.86), height=30.0, zenith=(0.42, 0.58, 0.80), horizon=(0.90, 0.88, 0.83),
        haze=0.007, clouds=0.5,
    ),
    "winter": LandscapeStyle(
        (
            ((0.74, 0.77, 0.82), (0.93, 0.94, 0.96)),
            ((0.44, 0.40, 0.38), (0.70, 0.70, 0.71)),
            ((0.38, 0.39, 0.42), (0.62, 0.64, 0.68)),
            ((0.72, 0.71, 0.70), (0.86, 0.86, 0.87)),
            ((0.30, 0.40, 0.47), (0.46, 0.56, 0.63)),
            ((0.16, 0.22, 0.22), (0.62, 0.68, 0.72)),
            ((0.90, 0.92, 0.96), (0.98, 0.98, 0.99)),
        ),
        sun=(1.02, 1.02, 1.06), height=24.0, zenith=(0.60, 0.69, 0.79), horizon=(0.86, 0.89, 0.92),
        haze=0.012, clouds=0.8,
    ),
    "evening": replace(
        SUMMER, sun=(1.25, 0.72, 0.38), height=11.0, zenith=(0.22, 0.24, 0.46), horizon=(0.98, 0.62, 0.36), haze=0.008
    ),
}  # fmt: skip


def landscape(
    seed: int, style: str, size: int = 128, land: int = 0
) -> tuple[Float[np.ndarray, "size size 3"], Int[np.ndarray, "size size"]]:
    """A picture, sRGB-encoded, and the label of each pixel, as `LABELS` counts them.

    style: a name of `STYLES`, whose light varies a little from one seed to the next
    land:  seed of the terrain, which takes longer to make than a picture
    """
    random, look = np.random.default_rng([seed, 7]), STYLES[style]
    height, label, texture = ground(land)
    origin, directions = viewpoint(height, size, random)
    azimuth = random.uniform(0, 2 * math.pi)
    elevation = math.radians(look.height * random.uniform(0.8, 1.2))
    sun = np.array(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    t = distances(height, origin, directions, FAR)
    hit = np.isfinite(t)
    points = origin + t[hit, None] * directions[hit]
    i, j = (nearest_index(points[:, axis], len(height)) for axis in (0, 1))
    labels = np.full(len(directions), SKY)
    labels[hit] = label[i, j]
    rgb = sky_colour(look, directions, sun, texture, random.uniform(0, 100, 2))
    slopes = np.stack(np.gradient(height, 1 / FINE))[:, i, j]
    rgb[hit] = shaded(look, labels[hit], points, directions[hit], slopes, sun, height, texture, t[hit])
    return srgb_film(rgb).reshape(size, size, 3).astype(np.float32), labels.reshape(size, size)


def shaded(look, labels, points, directions, slopes, sun, height, texture, t):
    """Colours of points of the land: texture, sun with shadows, light of the sky, haze."""
    pairs = np.array([look.ground[0], *look.ground])[labels]  # the sky has none and is not asked for
    fine, coarse = (sampled(texture, points[:, :2] * scale) for scale in (11.0, 2.3))
    rough = np.where(labels == TREE, 0.9, np.where(labels == WATER, 0.05, 0.35))
    bump = np.stack([sampled(texture, points[:, :2] * 5.0 + k) for k in (0.0, 90.0)]) * rough
    normals = np.stack([-slopes[0] + bump[0], -slopes[1] + bump[1], np.ones(len(t))], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    share = (0.5 + 0.35 * fine / (1 + 0.02 * t) + 0.35 * coarse).clip(0, 1)[:, None]
    colour = (1 - share) * pairs[:, 0] + share * pairs[:, 1]
    begin = points + 0.05 * normals
    lit = np.isinf(distances(height, begin, np.broadcast_to(sun, begin.shape), SHADOW_REACH))
    direct = (lit * (normals @ sun).clip(0) * min(1.0, 1.3 / (0.3 + sun[2])))[:, None] * np.array(look.sun)
    above = (AMBIENT * (0.6 + 0.4 * normals[:, 2:])) * (0.5 * np.array(look.zenith) + 0.5)
    colour = colour * (direct + above)
    wet = labels == WATER
    mirrored = directions[wet] * (1, 1, -1) + np.concatenate([0.03 * bump[:, wet].T, np.zeros((wet.sum(), 1))], -1)
    fresnel = (0.04 + 0.96 * (1 - np.abs(directions[wet, 2:])) ** 5).clip(0, 0.9)
    colour[wet] = (1 - fresnel) * colour[wet] + fresnel * sky_colour(look, mirrored, sun, texture, np.zeros(2))
    seen = np.exp(-look.haze * t)[:, None]
    return seen * colour + (1 - seen) * np.array(look.horizon)


def sky_colour(look, directions, sun, texture, shift):
    """Colours of the sky: a gradient, a glow around the sun, and clouds."""
    up = directions[:, 2].clip(0, 1)
    share = (1 - (1 - up) ** 4)[:, None]
    colour = (1 - share) * np.array(look.horizon) + share * np.array(look.zenith)
    cosine = (directions @ sun).clip(0, 1)[:, None]
    colour = colour + 0.35 * cosine**32 * np.array(look.sun) + 0.1 * cosine**4 * np.array(look.sun)
    places = directions[:, :2] / (up[:, None] + 0.18) * 22 + shift
    thick = 0.5 + 0.45 * sampled(texture, places) + 0.15 * sampled(texture, 3.1 * places)
    white = ((thick - (1 - look.clouds)) / 0.35).clip(0, 1) * (up / 0.15).clip(0, 1)
    lit = 0.45 * np.array(look.sun) + 0.55 * np.array(look.horizon)
    return colour + 0.85 * white[:, None] * (lit - colour)


def srgb_film(rgb):
    """Colours with a soft shoulder instead of clipping."""
    return np.where(rgb < 0.8, rgb, 0.8 + 0.2 * np.tanh((rgb - 0.8) / 0.2)).clip(0, 1)


@lru_cache(maxsize=2)
def ground(seed: int):
    """Height and label of the upper surface of a land, and noise that repeats."""
    height, label = terrain(WIDTH, seed, FINE).surface
    random = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(TEXTURE), np.fft.fftfreq(TEXTURE), indexing="ij"))
    spectrum = np.fft.fft2(random.normal(size=(TEXTURE, TEXTURE))) * np.exp(-((frequency * 8) ** 2))
    noise = np.fft.ifft2(spectrum).real
    return np.ascontiguousarray(height), np.ascontiguousarray(label), noise / (2 * noise.std())


def viewpoint(height, size, random):
    """Origin and directions of a random camera above the land, blocks."""
    place = random.uniform(0.2, 0.8, 2) * len(height)
    i, j = place.astype(int)
    near = height[max(i - 8, 0) : i + 9, max(j - 8, 0) : j + 9].max()
    low, high = np.log(EYE_HEIGHTS)
    origin = np.array([*(place / FINE), near + math.exp(random.uniform(low, high)) - 1.5])
    yaw, pitch = random.uniform(0, 2 * math.pi), math.radians(random.uniform(*PITCHES))
    forward = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    down = np.cross(forward, right)
    at = ((np.arange(size) + 0.5) / size * 2 - 1) * math.tan(math.radians(FIELD_OF_VIEW) / 2)
    directions = forward + at[None, :, None] * right + at[:, None, None] * down
    return origin, (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).reshape(-1, 3)


def sampled(texture, places):
    """Values of repeating noise at places, bilinear, a point to a unit."""
    low = np.floor(places).astype(int)
    part = places - low
    total = 0.0
    for di in (0, 1):
        for dj in (0, 1):
            weight = np.abs(1 - di - part[:, 0]) * np.abs(1 - dj - part[:, 1])
            total = total + weight * texture[(low[:, 0] + di) % len(texture), (low[:, 1] + dj) % len(texture)]
    return total


def nearest_index(at, count):
    """Points of the height field nearest to coordinates in blocks; the land is mirrored at its borders."""
    index = np.floor(at * FINE).astype(int) % (2 * count)
    return np.where(index < count, index, 2 * count - 1 - index)


def distances(height, origins, directions, far):
    """Distance along each ray to the height field, blocks; infinite where there is none nearer than `far`."""
    found = np.empty(len(directions))
    origins = np.broadcast_to(origins, directions.shape)
    march(height, height.max(), np.ascontiguousarray(origins), np.ascontiguousarray(directions), far, found)
    return found


@njit(no_cpython_wrapper=True, **COMPILE_OPTIONS)
def elevation_at(height, x, y):
    """Height of the field at a place, bilinear; the land is mirrored at its borders."""
    n = len(height)
    u, v = x * FINE - 0.5, y * FINE - 0.5
    i, j = int(math.floor(u)), int(math.floor(v))
    a, b = u - i, v - j
    total = 0.0
    for di in range(2):
        for dj in range(2):
            k, m = (i + di) % (2 * n), (j + dj) % (2 * n)
            k, m = k if k < n else 2 * n - 1 - k, m if m < n else 2 * n - 1 - m
            total += (a if di else 1 - a) * (b if dj else 1 - b) * height[k, m]
    return total


@njit(cache=True, **COMPILE_OPTIONS)
def march(height, highest, origins, directions, far, found):
    """Fill `found` with the distance along each ray to the height field; see `distances`."""
    for r in range(len(origins)):
        t, before, above = 0.0, 0.0, 0.0
        found[r] = math.inf
        while t < far:
            t += max(FIRST_STEP + STEP_GROWTH * t, CAUTION * above)
            z = origins[r, 2] + t * directions[r, 2]
            if z > highest and directions[r, 2] > 0.0:
                break
            x, y = origins[r, 0] + t * directions[r, 0], origins[r, 1] + t * directions[r, 1]
            above = z - elevation_at(height, x, y)
            if above < 0.0:
                low, high = before, t
                for _ in range(6):
                    middle = 0.5 * (low + high)
                    x, y = origins[r, 0] + middle * directions[r, 0], origins[r, 1] + middle * directions[r, 1]
                    if origins[r, 2] + middle * directions[r, 2] < elevation_at(height, x, y):
                        high = middle
                    else:
                        low = middle
                found[r] = high
                break
            before = t
