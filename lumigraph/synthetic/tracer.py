"""Ray tracer of procedural worlds. Compiled once; scenes are data.

Light: direct light of lamps and sun on diffuse (Lambert) and specular surfaces (GGX, Walter 2007; Fresnel after Schlick
1994), with one shadow ray per light and ray; light from the whole sky, with ambient occlusion; and one mirror bounce on
glossy surfaces.
"""

import hashlib
import math
from pathlib import Path

import numpy as np
from numba import njit

from .shapes import INFINITY, at_rest, distance, gradient, hollow, intersect, inverse, slab
from .textures import PRIMES, clouds, pattern, scramble
from .vector import (
    COMPILE_OPTIONS,
    INNER_OPTIONS,
    along,
    clamp,
    cross,
    dot,
    mix,
    mul,
    rotate,
    rotate_back,
    scale,
    smooth,
    unit,
    vec,
)

RAY_OFFSET = 2e-4  # shadow and mirrored rays begin this far above the surface, scene units
REFLECTANCE_LIMITS = 0.04, 0.10  # a weaker reflection shows the sky alone; a stronger one traces the scene
SHOULDER = 0.75  # radiance above this is compressed as by film, so that highlights keep their shape


def spread(count: int) -> np.ndarray:
    """Low-discrepancy points in the unit disc (Roberts' R2 sequence)."""
    k = np.arange(count)
    radius, turn = np.sqrt((0.5 + k * 0.7548776662466927) % 1), 2 * np.pi * (k * 0.5698402909980532 % 1)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], -1)


DISC = spread(256)  # successive rays, hence the samples of a pixel, aim at different points of a light


@njit(**INNER_OPTIONS)
def meet(objects, nodes, o, d, limit, enough, leaving):
    """(distance, object) of the first surface along a ray, or (infinity, -1) if none is nearer than limit.

    enough:  the search ends early with any surface nearer than this: 0 finds the first, infinity any
    leaving: the object on whose surface the ray begins, or -1: a convex one is skipped
    """
    best, found, i = limit, -1, 0
    over = inverse(d)
    while i < len(nodes):
        node = nodes[i]
        enter, leave = slab(o, over, vec(node.low), vec(node.high))
        if enter > leave or enter >= best:
            i = node.skip
            continue
        if node.object >= 0 and (node.object != leaving or hollow(objects[leaving].kind)):
            thing = objects[node.object]
            turn = thing.rotation
            begin = rotate_back(turn, along(o, -1.0, vec(thing.position)))
            t = intersect(thing.kind, thing.size, vec(thing.half), begin, rotate_back(turn, d), best)
            if t < best:
                best, found = t, node.object
                if t < enough:
                    break
        i += 1
    return (best if found >= 0 else INFINITY), found


@njit(**INNER_OPTIONS)
def gap(p, low, high):
    """Squared distance from a point to a box, 0 inside."""
    x = max(0.0, max(low[0] - p[0], p[0] - high[0]))
    y = max(0.0, max(low[1] - p[1], p[1] - high[1]))
    z = max(0.0, max(low[2] - p[2], p[2] - high[2]))
    return x * x + y * y + z * z


@njit(**INNER_OPTIONS)
def clearance(objects, nodes, p):
    """Signed distance from a point to the nearest surface."""
    best, i = INFINITY, 0
    while i < len(nodes):
        node = nodes[i]
        square = gap(p, vec(node.low), vec(node.high))
        if square > 0.0 and square >= best * abs(best):
            i = node.skip
            continue
        if node.object >= 0:
            thing = objects[node.object]
            own = rotate_back(thing.rotation, along(p, -1.0, vec(thing.position)))
            best = min(best, distance(thing.kind, thing.size, own))
        i += 1
    return best


@njit(**INNER_OPTIONS)
def surroundings(sky, d, cover):
    """Radiance of the sky in a direction. cover: share of clouds"""
    if d[2] < 0.0:
        return mix(vec(sky.horizon), vec(sky.ground), smooth(-d[2], 0.0, 0.25))
    colour = mix(vec(sky.horizon), vec(sky.zenith), 1.0 - (1.0 - min(d[2], 1.0)) ** 3)
    if cover > 0.0:
        up = 1.0 / (d[2] + 0.12)
        thick = 0.5 + clouds((d[0] * up, d[1] * up, 0.0), 1.6, 0.1, 0.02 * up * up)
        white = smooth(thick, 1.0 - cover, 1.45 - cover) * smooth(d[2], 0.0, 0.15)
        colour = mix(colour, (1.0, 0.985, 0.96), 0.85 * white)
    return colour


@njit(**INNER_OPTIONS)
def ambient(objects, nodes, sky, found, p, n):
    """Sky light on a surface with ambient occlusion (Evans 2006): nested balls that touch the surface from outside, and
    the clearance around their centres."""
    h = sky.reach
    large, middle, small = 1.0, 1.0, 1.0
    centre = along(p, h, n)
    i = 0
    while i < len(nodes):
        node = nodes[i]
        if gap(centre, vec(node.low), vec(node.high)) > h * h:
            i = node.skip
            continue
        if node.object >= 0 and (node.object != found or hollow(objects[found].kind)):
            thing = objects[node.object]
            own = rotate_back(thing.rotation, along(p, -1.0, vec(thing.position)))
            up = rotate_back(thing.rotation, n)
            large = min(large, distance(thing.kind, thing.size, along(own, h, up)) / h)
            middle = min(middle, distance(thing.kind, thing.size, along(own, 0.4 * h, up)) / (0.4 * h))
            small = min(small, distance(thing.kind, thing.size, along(own, 0.16 * h, up)) / (0.16 * h))
        i += 1
    # Squares, so that no line shows where something comes within reach.
    hidden = (1.0 - max(large, 0.0)) ** 2 + (1.0 - max(middle, 0.0)) ** 2 + (1.0 - max(small, 0.0)) ** 2
    light = mix(vec(sky.ground), mix(vec(sky.horizon), vec(sky.zenith), 0.6), 0.5 + 0.5 * n[2])
    return scale(light, 1.0 - 0.29 * hidden)


@njit(**INNER_OPTIONS)
def towards(toward, width, ray):
    """Direction to a sample point of a round light; successive rays choose different ones.

    toward: direction to its centre; width: tangent of half its apparent size
    """
    side = unit((-toward[1], toward[0], 0.0) if abs(toward[2]) < 0.9 else (0.0, -toward[2], toward[1]))
    point = DISC[ray % len(DISC)]
    return unit(along(along(toward, width * point[0], side), width * point[1], cross(toward, side)))


@njit(**INNER_OPTIONS)
def reflect(objects, nodes, lights, sky, found, p, n, d, albedo, material, ray, aims):
    """Reflected radiance of a surface along a ray d, without mirror reflections."""
    base = scale(albedo, 1.0 - material.metal)
    coat = 0.04 * material.gloss
    mirror = mix((coat, coat, coat), albedo, material.metal)
    colour = mul(base, ambient(objects, nodes, sky, found, p, n))
    start = along(p, RAY_OFFSET, n)
    for i in range(len(lights)):
        light = lights[i]
        toward, away, power, width = vec(light.position), INFINITY, vec(light.colour), light.radius
        if light.distant == 0:
            toward = along(toward, -1.0, p)
            away = math.sqrt(dot(toward, toward))
            toward, power, width = scale(toward, 1.0 / away), scale(power, 1.0 / (away * away)), width / away
        facing = dot(n, toward)
        if facing <= 0.0:
            continue
        seen = 0
        for k in range(aims):
            aim = towards(toward, width, aims * ray + k)
            if meet(objects, nodes, start, aim, away, INFINITY, found)[1] < 0:
                seen += 1
        if seen == 0:
            continue
        send = base
        if coat > 0.0 or material.metal > 0.0:
            half = unit(along(toward, -1.0, d))
            nh, nv, vh = dot(n, half), max(-dot(n, d), 1e-3), -dot(half, d)
            wide = min(material.roughness**2 + 0.5 * width, 1.0)  # a large light makes a large highlight (Karis 2013)
            ggx = wide * wide / (nh * nh * (wide * wide - 1.0) + 1.0) ** 2
            k = 0.5 * wide
            shape = 0.25 * ggx / ((facing * (1.0 - k) + k) * (nv * (1.0 - k) + k))
            fresnel = (1.0 - vh) ** 5 * max(material.gloss, material.metal)
            send = along(send, shape, mix(mirror, (1.0, 1.0, 1.0), fresnel))
        colour = along(colour, facing * seen / aims, mul(send, power))
    return colour


@njit(**INNER_OPTIONS)
def film(x):
    """Tone curve of the film: linear up to the shoulder, then saturating towards one."""
    return x if x < SHOULDER else 1.0 - (1.0 - SHOULDER) * math.exp((SHOULDER - x) / (1.0 - SHOULDER))


@njit(**INNER_OPTIONS)
def surface(thing, material, p, d, width):
    """(normal, reflectance) at a ray's hit on an object. d: ray direction; width: of the ray there"""
    local = rotate_back(thing.rotation, along(p, -1.0, vec(thing.position)))
    shape_normal = gradient(thing.kind, thing.size, local)
    n = rotate(thing.rotation, shape_normal)
    fixed = at_rest(thing.kind, thing.size, local)
    blend, shade = pattern(material.texture, material.numbers, fixed, shape_normal, width / max(-dot(n, d), 0.05))
    return n, scale(mix(vec(material.a), vec(material.b), blend), shade)


@njit(**INNER_OPTIONS)
def look(objects, materials, lights, sky, nodes, o, d, radius, ray, aims):
    """(radiance, distance, normal, thing, reflectance) for one ray; see `trace`."""
    t, found = meet(objects, nodes, o, d, INFINITY, 0.0, -1)
    black = (0.0, 0.0, 0.0)
    depth, facing, identity, own = t, black, -1, black
    total, weight, travelled = black, (1.0, 1.0, 1.0), 0.0
    for bounce in range(2):
        if found < 0:
            if bounce > 0 or sky.visible:
                total = along(total, 1.0, mul(weight, surroundings(sky, d, sky.clouds if bounce == 0 else 0.0)))
            break
        thing = objects[found]
        material = materials[thing.material]
        p = along(o, t, d)
        travelled += t
        n, albedo = surface(thing, material, p, d, radius * travelled)
        if bounce == 0:
            facing, identity, own = n, thing.identity, albedo
            if aims == 0:
                break
        colour = reflect(objects, nodes, lights, sky, found, p, n, d, albedo, material, ray, aims)
        thick = 1.0 - math.exp(-sky.haze * travelled) if bounce == 0 else 0.0
        colour = mix(colour, surroundings(sky, (d[0], d[1], max(d[2], 0.0)), 0.0), thick)
        total = along(total, 1.0, mul(weight, colour))
        if bounce > 0:
            break
        coat = 0.04 * material.gloss
        fresnel = (1.0 - clamp(-dot(n, d), 0.0, 1.0)) ** 5 * max(material.gloss, material.metal)
        weight = mix(mix((coat, coat, coat), albedo, material.metal), (1.0, 1.0, 1.0), fresnel)
        weight = scale(weight, (1.0 - material.roughness) ** 2 * (1.0 - thick))  # roughness blurs it away
        o, d = along(p, RAY_OFFSET, n), along(d, -2.0 * dot(d, n), n)
        strong = smooth(max(weight[0], max(weight[1], weight[2])), REFLECTANCE_LIMITS[0], REFLECTANCE_LIMITS[1])
        total = along(total, 1.0 - strong, mul(weight, surroundings(sky, d, 0.0)))
        if strong <= 0.0:
            break
        weight = scale(weight, strong)
        t, found = meet(objects, nodes, o, d, INFINITY, 0.0, found)
    return total, depth, facing, identity, own


def _build(sources: int):
    """Compile the entry points. Numba's disk cache checks this file only; `sources`, part of the compiled functions,
    renews it when any file of the tracer changes."""

    @njit(cache=True, **COMPILE_OPTIONS)
    def trace(arrays, origins, directions, radius, first, aims, radiance, depth, normal, identity, reflectance):
        """All outputs of each ray. first: number of the first; aims: shadow rays to each light, 0 for no shading"""
        objects, materials, lights, sky, nodes = arrays
        for i in range(len(origins)):
            o, d, ray = vec(origins[i]), vec(directions[i]), first + i + 0 * sources
            c, t, n, k, own = look(objects, materials, lights, sky[0], nodes, o, d, radius[i], ray, aims)
            depth[i], identity[i] = t, k
            for axis in range(3):
                radiance[i, axis] = film(sky[0].exposure[axis] * c[axis])
                normal[i, axis], reflectance[i, axis] = n[axis], own[axis]

    @njit(cache=True, **COMPILE_OPTIONS)
    def gather(arrays, origins, directions, radius, first, aims, samples, pixels):
        """Sums over `samples` rays of each pixel: radiance of hits, number of hits, and the largest difference between
        two samples in the square root of radiance, which approximates perceived difference."""
        objects, materials, lights, sky, nodes = arrays
        for pixel in range(len(pixels)):
            begin = scramble((first + pixel) * PRIMES[0], PRIMES[1], 0 * sources)  # pixels should form no pattern
            low, high, total, hits = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0
            for s in range(samples):
                i = samples * pixel + s
                o, d = vec(origins[i]), vec(directions[i])
                c, _, _, k, _ = look(objects, materials, lights, sky[0], nodes, o, d, radius[i], begin + s, aims)
                e = sky[0].exposure
                c = (film(e[0] * c[0]), film(e[1] * c[1]), film(e[2] * c[2]))
                low = (min(low[0], c[0]), min(low[1], c[1]), min(low[2], c[2]))
                high = (max(high[0], c[0]), max(high[1], c[1]), max(high[2], c[2]))
                total = along(total, 1.0, c)
                hits += 1 if k >= 0 or sky[0].visible else 0
            spread = 0.0
            for axis in range(3):
                pixels[pixel, axis] = total[axis]
                spread = max(spread, math.sqrt(high[axis]) - math.sqrt(low[axis]))
            pixels[pixel, 3], pixels[pixel, 4] = hits, spread

    @njit(cache=True, **COMPILE_OPTIONS)
    def signed_distance(arrays, points, out):
        for i in range(len(points)):
            out[i] = clearance(arrays.objects, arrays.nodes, vec(points[i])) + 0 * sources

    return trace, gather, signed_distance


def _digest() -> int:
    folder = Path(__file__).parent
    text = b"".join((folder / f"{name}.py").read_bytes() for name in ("vector", "shapes", "textures", "tracer"))
    return int.from_bytes(hashlib.sha256(text).digest()[:6], "big")


SOURCES = _digest()
trace, gather, signed_distance = _build(SOURCES)
