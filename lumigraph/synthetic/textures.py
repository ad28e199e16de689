"""Textures: solid textures, which fill space.

A texture blends two colours by a pattern in the object's own frame. All patterns are band-limited: an edge is as wide
as the pixel's footprint, and finer noise fades to its mean, so that distant pavements are grey, not noisy. Colours are
specified as sRGB and computed with as linear reflectances.
"""

import math
from dataclasses import astuple, dataclass
from typing import ClassVar

import numpy as np
from numba import njit

from .vector import INNER_OPTIONS, clamp, smooth

PLAIN, CHECKER, STRIPES, SECTORS, RINGS, WOOD, MARBLE, BRICKS, MOTTLE = range(9)
PRIMES = (73856093, 19349663, 83492791)
GRADIENTS = np.array([(a, b, 0) for a in (1, -1) for b in (1, -1)], float)  # towards the edges of a cube, four twice
GRADIENTS = np.concatenate([np.roll(GRADIENTS, k, 1) for k in (0, 1, 2, 0)])

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
    """Squares of side `size` on faces across x, y or z, cubes in between; `shift` is a square's centre."""

    kind = CHECKER
    size: float = 0.1
    shift: float = 0.0


@dataclass(frozen=True)
class Stripes(Texture):
    """Bands across z. share: of each period in colour b"""

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
class Rings(Stripes):
    """Bands around z."""

    kind = RINGS


@dataclass(frozen=True)
class Wood(Texture):
    """Wavy year rings around a trunk along x, somewhat below the object, with fibres."""

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
    """A running bond of colour a with joints of colour b on faces across x and y, square slabs of side `length` on
    faces across z. Every brick has its own shade, darker or lighter by up to `variation`."""

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


@njit(**INNER_OPTIONS)
def scramble(x, y, z):
    """Hash of a lattice point, 16 bits: its coordinates times three large primes (Teschner 2003)."""
    h = (x ^ y ^ z) & 0xFFFFFFFF
    return (((h ^ (h >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF) >> 16


@njit(**INNER_OPTIONS)
def slope(bits, x, y, z):
    """Dot product of a lattice point's gradient with an offset from it."""
    k = bits & 15
    return GRADIENTS[k, 0] * x + GRADIENTS[k, 1] * y + GRADIENTS[k, 2] * z


@njit(**INNER_OPTIONS)
def fade(t):
    return t * t * t * (t * (6.0 * t - 15.0) + 10.0)


@njit(**INNER_OPTIONS)
def noise(x, y, z):
    """Gradient noise in about [-1, 1] with features of size one (Perlin 2002)."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    x, y, z = x - i, y - j, z - k
    i, j, k = int(i) * PRIMES[0], int(j) * PRIMES[1], int(k) * PRIMES[2]
    p, q, r = i + PRIMES[0], j + PRIMES[1], k + PRIMES[2]
    u, v, w = fade(x), fade(y), fade(z)
    a, b = slope(scramble(i, j, k), x, y, z), slope(scramble(p, j, k), x - 1.0, y, z)
    c, d = slope(scramble(i, q, k), x, y - 1.0, z), slope(scramble(p, q, k), x - 1.0, y - 1.0, z)
    low = a + u * (b - a) + v * (c + u * (d - c) - a - u * (b - a))
    z -= 1.0
    a, b = slope(scramble(i, j, r), x, y, z), slope(scramble(p, j, r), x - 1.0, y, z)
    c, d = slope(scramble(i, q, r), x, y - 1.0, z), slope(scramble(p, q, r), x - 1.0, y - 1.0, z)
    high = a + u * (b - a) + v * (c + u * (d - c) - a - u * (b - a))
    return low + w * (high - low)


@njit(**INNER_OPTIONS)
def clouds(p, size, finest, footprint):
    """Fractal noise over octaves from `size` to `finest`, each half as strong; those below the footprint fade."""
    total, strength, shift = 0.0, 0.5, 0.0
    while size > 0.99 * finest:
        keep = 1.0 - smooth(footprint / size, 0.25, 0.6)
        if keep <= 0.0:
            break
        total += strength * keep * noise(p[0] / size + shift, p[1] / size - shift, p[2] / size + 2.0 * shift)
        strength, size, shift = 0.5 * strength, 0.5 * size, shift + 17.3
    return total


@njit(**INNER_OPTIONS)
def band(x, period, share, footprint):
    """Square wave: 1 on `share` of each period, else 0, edges as wide as the footprint; x = 0 is a band's middle."""
    from_edge = 0.5 * share * period - abs(x - period * math.floor(x / period + 0.5))
    sharp = clamp(0.5 + from_edge / max(footprint, 1e-6), 0.0, 1.0)
    blur = smooth(footprint / period, 0.3, 1.0)
    return sharp + blur * (share - sharp)


@njit(**INNER_OPTIONS)
def pattern(kind, n, p, normal, footprint):
    """(blend, shade) at a point p of a surface, so that colour = shade mix(a, b, blend). All in the object's frame.

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
        own = scramble(int(column) * PRIMES[0], int(row) * PRIMES[1], PRIMES[2]) / 65535.0 - 0.5
        fade = 1.0 - smooth(footprint / height, 0.3, 1.0)
        return gap, 1.0 + 2.0 * strength * fade * own * (1.0 - gap)
    if kind == MOTTLE:
        s = n[2]
        cloud = clouds((x + 7.1 * s, y - 2.9 * s, z + s), n[0], n[0] / 8.0, footprint)
        return clamp(0.5 + 1.4 * n[1] * cloud, 0.0, 1.0), 1.0
    return 0.0, 1.0
