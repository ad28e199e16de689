"""Light of an environment map on a world: exact materials, shadows, and one matt bounce.

Radiance of a surface (Kajiya 1986) by multiple importance sampling of the map and of the highlights (Veach 1995,
balance heuristic). Reflectance is Lambert plus GGX with Smith's masking (Walter 2007) and Schlick's Fresnel term:

    f = (1 - metal) albedo / pi + D(h) G(l) G(v) F(v.h) / (4 n.l n.v),    alpha = roughness^2
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ..light import EnvironmentLight
from .shapes import INFINITY
from .textures import PRIMES, scramble
from .tracer import RAY_OFFSET, SOURCES, meet, surface
from .vector import COMPILE_OPTIONS, INNER_OPTIONS, along, cross, dot, mix, mul, scale, unit, vec

MIN_ALPHA = 1e-3
MIN_SHARE = 0.1  # of the samples of the map that are spread evenly over the sphere
BOUNCE_SHARE = 4  # samples of light for each ray that bounces
GOLDEN = 0.7548776662466927, 0.5698402909980532  # Roberts' R2 sequence


class LightTable(NamedTuple):
    """An environment map as input of the tracer.

    ends:       cumulative probability of the pixels
    density:    probability of each pixel per steradian
    """

    radiance: np.ndarray
    ends: np.ndarray
    density: np.ndarray
    toward: np.ndarray
    irradiance: np.ndarray

    @staticmethod
    def of(light: EnvironmentLight) -> LightTable:
        radiance, solid = light.radiance.double().numpy(), light.solid_angles.double().numpy()
        share = radiance.mean(-1) * solid
        even = solid / solid.sum()
        probability = (1 - MIN_SHARE) * share / share.sum() + MIN_SHARE * even if share.sum() > 0 else even
        ends = np.cumsum(probability)
        suns = light.toward.double().numpy(), light.irradiance.double().numpy()
        return LightTable(radiance, ends / ends[-1], probability / solid, *suns)


@njit(**INNER_OPTIONS)
def pixel_at(table, d):
    """Row and column of the map from a direction."""
    rows, columns = table.density.shape
    row = int(math.acos(min(max(d[2], -1.0), 1.0)) / math.pi * rows)
    column = int((math.atan2(d[0], d[1]) / (2.0 * math.pi) + 0.5) * columns)
    return min(row, rows - 1), min(column, columns - 1)


@njit(**INNER_OPTIONS)
def sample_direction(table, u, v, w):
    """Importance-sampled direction of the map from three numbers in [0, 1): pixel and position within it."""
    rows, columns = table.density.shape
    pixel, last = 0, rows * columns - 1
    while pixel < last:
        middle = (pixel + last) // 2
        pixel, last = (middle + 1, last) if table.ends[middle] <= u else (pixel, middle)
    row, column = pixel // columns, pixel % columns
    top, bottom = math.cos(math.pi * row / rows), math.cos(math.pi * (row + 1) / rows)
    z = top + v * (bottom - top)
    level, longitude = math.sqrt(max(0.0, 1.0 - z * z)), 2.0 * math.pi * ((column + w) / columns - 0.5)
    return (level * math.sin(longitude), level * math.cos(longitude), z)


@njit(**INNER_OPTIONS)
def frame_of(n):
    side = unit((-n[1], n[0], 0.0) if abs(n[2]) < 0.9 else (0.0, -n[2], n[1]))
    return side, cross(n, side)


@njit(**INNER_OPTIONS)
def reflected(base, mirror, alpha, n, v, way):
    """(f, pdf of `highlight` per steradian) of a material from a light direction `way` to an eye direction v."""
    nl, nv = dot(n, way), max(dot(n, v), 1e-4)
    f = scale(base, 1.0 / math.pi)
    if mirror[0] + mirror[1] + mirror[2] <= 0.0:
        return f, 0.0
    h = unit(along(way, 1.0, v))
    nh, vh = dot(n, h), max(dot(v, h), 1e-6)
    square = alpha * alpha
    d = square / (math.pi * (nh * nh * (square - 1.0) + 1.0) ** 2)
    shadowing = 2.0 * nl / (nl + math.sqrt(square + (1.0 - square) * nl * nl))
    masking = 2.0 * nv / (nv + math.sqrt(square + (1.0 - square) * nv * nv))
    fresnel = mix(mirror, (1.0, 1.0, 1.0), (1.0 - vh) ** 5)
    return along(f, 0.25 * d * shadowing * masking / (nl * nv), fresnel), 0.25 * d * nh / vh


@njit(**INNER_OPTIONS)
def highlight(n, v, alpha, u, w):
    """Light direction for a microfacet normal sampled by D (Walter 2007, eq. 35)."""
    cosine = math.sqrt((1.0 - u) / (1.0 + (alpha * alpha - 1.0) * u))
    sine, turn = math.sqrt(max(0.0, 1.0 - cosine * cosine)), 2.0 * math.pi * w
    x, y = frame_of(n)
    h = along(along(scale(n, cosine), sine * math.cos(turn), x), sine * math.sin(turn), y)
    return along(scale(v, -1.0), 2.0 * dot(v, h), h)


@njit(**INNER_OPTIONS)
def colours_of(material, albedo):
    """(diffuse reflectance, specular reflectance at normal incidence, alpha)"""
    coat = 0.04 * material.gloss
    mirror = mix((coat, coat, coat), albedo, material.metal)
    return scale(albedo, 1.0 - material.metal), mirror, max(material.roughness**2, MIN_ALPHA)


@njit(**INNER_OPTIONS)
def direct(objects, nodes, table, found, p, n, v, base, mirror, alpha, samples, u0, v0, w0):
    """Radiance towards v of a surface from map and suns, `samples` of either sampling strategy."""
    total = (0.0, 0.0, 0.0)
    start = along(p, RAY_OFFSET, n)
    glossy = mirror[0] + mirror[1] + mirror[2] > 0.0
    for k in range(samples * (2 if glossy else 1)):
        s = k % samples
        a, b = (v0 + s * GOLDEN[0]) % 1.0, (w0 + s * GOLDEN[1]) % 1.0
        way = (
            sample_direction(table, (s + u0) / samples, a, b)
            if k < samples
            else highlight(n, v, alpha, (s + u0) / samples, b)
        )
        if dot(n, way) <= 1e-6:
            continue
        f, by_highlight = reflected(base, mirror, alpha, n, v, way)
        row, column = pixel_at(table, way)
        sent = vec(table.radiance[row, column])
        if sent[0] + sent[1] + sent[2] <= 0.0 or meet(objects, nodes, start, way, INFINITY, INFINITY, found)[1] >= 0:
            continue
        share = dot(n, way) / (samples * (table.density[row, column] + by_highlight))
        total = along(total, share, mul(f, sent))
    for i in range(len(table.toward)):
        way = vec(table.toward[i])
        if dot(n, way) > 0.0 and meet(objects, nodes, start, way, INFINITY, INFINITY, found)[1] < 0:
            f, _ = reflected(base, mirror, alpha, n, v, way)
            total = along(total, dot(n, way), mul(f, vec(table.irradiance[i])))
    return total


def _build(sources: int):
    """Compile the entry points; see `tracer._build`."""

    @njit(cache=True, **COMPILE_OPTIONS)
    def light(arrays, table, origins, directions, radius, first, samples, bounces, out):
        """Radiance of each ray, and 1 for a hit; `samples` of map and highlights each."""
        objects, materials, _, _, nodes = arrays
        for i in range(len(origins)):
            o, d = vec(origins[i]), vec(directions[i])
            for axis in range(4):
                out[i, axis] = 0.0
            t, found = meet(objects, nodes, o, d, INFINITY, 0.0, -1)
            if found < 0:
                continue
            p = along(o, t, d)
            material = materials[objects[found].material]
            n, albedo = surface(objects[found], material, p, d, radius[i] * t)
            base, mirror, alpha = colours_of(material, albedo)
            k = (first + i) * PRIMES[0] + 0 * sources
            a, b, c = scramble(k, 1, 0) / 65536.0, scramble(k, 7, 1) / 65536.0, scramble(k, 3, 2) / 65536.0
            v = scale(d, -1.0)
            total = direct(objects, nodes, table, found, p, n, v, base, mirror, alpha, samples, a, b, c)
            x, y = frame_of(n)
            count = max(1, samples // BOUNCE_SHARE) if bounces > 0 else 0
            for s in range(count):
                u, w = (b + s * GOLDEN[0]) % 1.0, 2.0 * math.pi * ((c + s * GOLDEN[1]) % 1.0)
                level = math.sqrt(u)  # cosine-weighted
                way = along(along(scale(n, math.sqrt(1.0 - u)), level * math.cos(w), x), level * math.sin(w), y)
                start = along(p, RAY_OFFSET, n)
                far, other = meet(objects, nodes, start, way, INFINITY, 0.0, found)
                if other < 0:
                    continue
                q = along(start, far, way)
                substance = materials[objects[other].material]
                m, own = surface(objects[other], substance, q, way, 0.05 * far)
                b2, m2, a2 = colours_of(substance, own)
                e, f, g = (a + s * GOLDEN[1]) % 1.0, (c + s * GOLDEN[0]) % 1.0, (b + s * GOLDEN[1]) % 1.0
                sent = direct(objects, nodes, table, other, q, m, scale(way, -1.0), b2, m2, a2, 1, e, f, g)
                total = along(total, 1.0 / count, mul(base, sent))
            out[i, 0], out[i, 1], out[i, 2], out[i, 3] = total[0], total[1], total[2], 1.0

    @njit(cache=True, **COMPILE_OPTIONS)
    def unoccluded(arrays, points, normals, directions, out):
        """Visibility: 1 for a direction above a surface that leaves the world unoccluded, else 0."""
        for i in range(len(points)):
            n = vec(normals[i])
            start = along(vec(points[i]), RAY_OFFSET, n)
            for j in range(len(directions)):
                way = vec(directions[j])
                free = dot(n, way) > 0.0
                out[i, j] = free and meet(arrays.objects, arrays.nodes, start, way, INFINITY, INFINITY, -1)[1] < 0

    @njit(cache=True, **COMPILE_OPTIONS)
    def roughness(arrays, origins, directions, out):
        """Roughness of the material at each ray's hit; NaN for a miss."""
        for i in range(len(origins)):
            o, d = vec(origins[i]), vec(directions[i])
            _, found = meet(arrays.objects, arrays.nodes, o, d, INFINITY, 0.0, -1)
            out[i] = arrays.materials[arrays.objects[found].material].roughness if found >= 0 else np.nan

    return light, unoccluded, roughness


light, unoccluded, roughness = _build(SOURCES)
