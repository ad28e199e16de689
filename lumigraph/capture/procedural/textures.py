"""Textures: colours that fill space, so that every shape can be cut out of them.

A texture blends two colours by a pattern in the object's own frame. All patterns are band-limited: an edge is as wide as
the pixel's footprint, and noise finer than that fades to its mean, so that far pavements grow grey instead of flickering.
Colours are written as they look on screen (sRGB) and computed with as reflectances (linear).
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import ClassVar

from numba import njit

from .vector import INNER, clamp, smooth

PLAIN, CHECKER, STRIPES, SECTORS, RINGS, WOOD, MARBLE, BRICKS, MOTTLE = range(9)
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Texture:
    """Two colours; each kind of pattern adds its lengths in scene units."""

    kind: ClassVar[int]
    a: Colour
    b: Colour

    def describe(self):
        """Kind, colours and the pattern's own numbers."""
        return self.kind, self.a, self.b, tuple(float(x) for x in astuple(self)[2:])


@dataclass(frozen=True)
class Plain(Texture):
    kind = PLAIN
    b: Colour = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Checker(Texture):
    """Squares with side `size` on whatever faces x, y or z, cubes in between; `shift` is the middle of one of colour b."""

    kind = CHECKER
    size: float = 0.1
    shift: float = 0.0


@dataclass(frozen=True)
class Stripes(Texture):
    """Bands across z, `share` of each period in colour b."""

    kind = STRIPES
    period: float = 0.1
    share: float = 0.5
    shift: float = 0.0


@dataclass(frozen=True)
class Sectors(Texture):
    """`count` pairs of wedges around z, as on a beach ball; caps of colour b beyond |z| = cap."""

    kind = SECTORS
    count: float = 6
    cap: float = math.inf


@dataclass(frozen=True)
class Rings(Texture):
    """Bands around z."""

    kind = RINGS
    period: float = 0.1
    share: float = 0.5
    shift: float = 0.0


@dataclass(frozen=True)
class Wood(Texture):
    """Year rings around a trunk along x that passes at (`seed`, 1.7 `ring` ...) off the centre, wavy and with fibres."""

    kind = WOOD
    ring: float = 0.06
    waviness: float = 0.6
    seed: float = 0.0


@dataclass(frozen=True)
class Marble(Texture):
    """Veins of colour b."""

    kind = MARBLE
    vein: float = 0.4
    turbulence: float = 1.0
    seed: float = 0.0


@dataclass(frozen=True)
class Bricks(Texture):
    """A running bond of colour a with joints of colour b on the sides facing x and y, and square slabs with side `length`
    on those facing z. Every brick has its own shade, darker or lighter by up to `variation`."""

    kind = BRICKS
    length: float = 0.24
    height: float = 0.08
    joint: float = 0.008
    variation: float = 0.25


@dataclass(frozen=True)
class Mottle(Texture):
    """Clouds of two colours, from `size` down over four octaves: plaster, earth, grass, far woods."""

    kind = MOTTLE
    size: float = 0.3
    contrast: float = 1.0
    seed: float = 0.0


@njit(**INNER)
def scramble(x, y, z):
    """A lattice point's own 16 bits."""
    h = ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
    return h >> 16


@njit(**INNER)
def slope(bits, x, y, z):
    """One of twelve gradients times an offset (Perlin 2002)."""
    h = bits & 15
    u = x if h < 8 else y
    v = y if h < 4 else (x if h == 12 or h == 14 else z)
    return (u if h & 1 == 0 else -u) + (v if h & 2 == 0 else -v)


@njit(**INNER)
def noise(x, y, z):
    """Gradient noise in about [-1, 1] with features of size one."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    x, y, z = x - i, y - j, z - k
    i, j, k = int(i), int(j), int(k)
    u = x * x * x * (x * (6.0 * x - 15.0) + 10.0)
    v = y * y * y * (y * (6.0 * y - 15.0) + 10.0)
    w = z * z * z * (z * (6.0 * z - 15.0) + 10.0)
    total = 0.0
    for c in range(8):
        a, b, d = c & 1, (c >> 1) & 1, c >> 2
        weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if d else 1.0 - w)
        total += weight * slope(scramble(i + a, j + b, k + d), x - a, y - b, z - d)
    return total


@njit(**INNER)
def clouds(p, size, finest, footprint):
    """Noise summed over octaves from `size` down to `finest`, each half as strong; what the footprint covers fades."""
    total, strength, shift = 0.0, 0.5, 0.0
    while size > 0.99 * finest:
        keep = 1.0 - smooth(footprint / size, 0.25, 0.6)
        if keep <= 0.0:
            break
        total += strength * keep * noise(p[0] / size + shift, p[1] / size - shift, p[2] / size + 2.0 * shift)
        strength, size, shift = 0.5 * strength, 0.5 * size, shift + 17.3
    return total


@njit(**INNER)
def band(x, period, share, footprint):
    """1 on `share` of each period, 0 elsewhere, edges as wide as the footprint; x = 0 is the middle of a band."""
    from_edge = 0.5 * share * period - abs(x - period * math.floor(x / period + 0.5))
    sharp = clamp(0.5 + from_edge / max(footprint, 1e-6), 0.0, 1.0)
    blur = smooth(footprint / period, 0.3, 1.0)
    return sharp + blur * (share - sharp)


@njit(**INNER)
def pattern(kind, n, p, normal, footprint):
    """(blend, shade) at a point p of a surface with some normal, in the object's frame: colour = shade mix(a, b, blend).

    n: the texture's own numbers; footprint: the pixel's width on the surface, scene units
    """
    x, y, z = p
    if kind == CHECKER:
        even = 1.0
        for i in range(3):
            if abs(normal[i]) < 0.7:
                even *= 1.0 - 2.0 * band(p[i] - n[1], 2.0 * n[0], 0.5, footprint)
        return 0.5 - 0.5 * even, 1.0
    if kind == STRIPES:
        return band(z - n[2], n[0], n[1], footprint), 1.0
    if kind == SECTORS:
        radius = math.sqrt(x * x + y * y)
        angle = math.atan2(y, x) / (2.0 * math.pi)
        wedge = band(angle, 1.0 / n[0], 0.5, footprint / max(2.0 * math.pi * radius, 1e-6))
        return max(wedge, clamp(0.5 + (abs(z) - n[1]) / max(footprint, 1e-6), 0.0, 1.0)), 1.0
    if kind == RINGS:
        return band(math.sqrt(x * x + y * y) - n[2], n[0], n[1], footprint), 1.0
    if kind == WOOD:
        ring, s = n[0], n[2]
        q = (0.25 * x, y + s, z)
        wave = clouds((q[0] + 3.1 * s, q[1], q[2] - s), 6.0 * ring, 3.0 * ring, footprint)
        trunk = math.sqrt((y - 2.3 * ring) ** 2 + (z + 5.0 * ring) ** 2) + 2.0 * n[1] * ring * wave
        phase = trunk / ring
        phase -= math.floor(phase)
        late = smooth(phase, 0.15, 0.85) * (1.0 - smooth(phase, 0.88, 1.0))  # late wood darkens slowly and ends at once
        late += (0.4 - late) * smooth(footprint / ring, 0.2, 0.8)
        fibre = clouds((0.1 * x, y, z + s), 0.35 * ring, 0.17 * ring, footprint)
        return clamp(0.75 * late + 0.5 * fibre + 0.1, 0.0, 1.0), 1.0
    if kind == MARBLE:
        s, size = n[2], n[0]
        q = (x + 5.7 * s, y - 3.3 * s, z + 9.1 * s)
        bend = clouds(q, size, size / 8.0, footprint)
        vein = abs(math.sin((q[0] + 0.6 * q[1] + 0.4 * q[2]) * math.pi / size + 5.0 * n[1] * bend))
        cloud = clouds((q[1], q[2], q[0]), 1.3 * size, size / 3.0, footprint)
        return clamp((1.0 - vein) ** 5 * (0.9 + cloud) + 0.25 * smooth(cloud, 0.0, 0.5), 0.0, 1.0), 1.0
    if kind == BRICKS:
        length, height, joint, strength = n[0], n[1], n[2], n[3]
        u, v = x, z
        if abs(normal[0]) > max(abs(normal[1]), abs(normal[2])):
            u = y
        elif abs(normal[2]) > abs(normal[1]):
            v, height = y, length
        row = math.floor(v / height)
        if height != length:
            u += 0.5 * length * (row - 2.0 * math.floor(0.5 * row))
        column = math.floor(u / length)
        gap = max(band(u, length, joint / length, footprint), band(v, height, joint / height, footprint))
        own = scramble(int(column), int(row), int(column + row)) / 65535.0 - 0.5
        fade = 1.0 - smooth(footprint / height, 0.3, 1.0)
        return gap, 1.0 + 2.0 * strength * fade * own * (1.0 - gap)
    if kind == MOTTLE:
        s = n[2]
        return clamp(
            0.5 + 1.4 * n[1] * clouds((x + 7.1 * s, y - 2.9 * s, z + s), n[0], n[0] / 8.0, footprint), 0.0, 1.0
        ), 1.0
    return 0.0, 1.0
