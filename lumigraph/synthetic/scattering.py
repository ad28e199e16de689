"""Single scattering: lamps in fog (Chandrasekhar 1960; Henyey and Greenstein 1941).

    L(o, d) = int_0^t T(s) sigma_s p(cos) E(x_s) ds + T(t) L_surface,      T(s) = exp(-sigma_t s)
    p(cos)  = (1 - g^2) / (4 pi (1 + g^2 - 2 g cos)^(3/2)),                E(x) = Phi / r^2 exp(-sigma_t r) V

E is the irradiance of a lamp at a distance r on a surface facing it, V its visibility. The integral is sampled at equal
angles around each lamp (Kulla and Fajardo 2012), where its 1 / r^2 is constant. Surfaces are matt.
"""

import math

from numba import njit

from .shapes import INFINITY
from .textures import PRIMES, scramble
from .tracer import RAY_OFFSET, SOURCES, meet, surface
from .vector import COMPILE_OPTIONS, INNER_OPTIONS, along, dot, mul, scale, vec

MIN_DISTANCE = 1e-3  # of a ray from a lamp's middle, scene units


@njit(**INNER_OPTIONS)
def henyey_greenstein(cosine, g):
    """Phase function: share of scattered light per steradian, by the cosine of the scattering angle."""
    return (1.0 - g * g) / (4.0 * math.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)


@njit(**INNER_OPTIONS)
def visible(objects, nodes, start, way, away):
    return meet(objects, nodes, start, way, away, INFINITY, -1)[1] < 0


def _build(sources: int):
    """Compile the entry point; see `tracer._build`."""

    @njit(cache=True, **COMPILE_OPTIONS)
    def light(arrays, fog, origins, directions, radius, first, samples, out):
        """Radiance of each ray. fog: sigma_s, sigma_t, g, radius of its ball; samples: along the ray for each lamp"""
        objects, materials, lights, _, nodes = arrays
        scattering, extinction, g, reach = fog[0], fog[1], fog[2], fog[3]
        for i in range(len(origins)):
            o, d = vec(origins[i]), vec(directions[i])
            t, found = meet(objects, nodes, o, d, INFINITY, 0.0, -1)
            middle = dot(o, d)
            under = middle * middle - dot(o, o) + reach * reach
            half = math.sqrt(max(under, 0.0))
            enter, leave = max(-middle - half, 0.0), min(-middle + half, t)
            total = (0.0, 0.0, 0.0)
            jitter = scramble((first + i) * PRIMES[0], 5, 0 * sources) / 65536.0
            for lamp in range(len(lights)):
                place, power, size = vec(lights[lamp].position), vec(lights[lamp].colour), lights[lamp].radius
                if under > 0.0 and leave > enter:
                    to = along(place, -1.0, o)
                    nearest = dot(to, d)
                    aside = along(to, -nearest, d)
                    apart = max(math.sqrt(dot(aside, aside)), max(0.5 * size, MIN_DISTANCE))
                    low, high = math.atan((enter - nearest) / apart), math.atan((leave - nearest) / apart)
                    for k in range(samples):
                        x = apart * math.tan(low + (k + jitter) / samples * (high - low))
                        p = along(o, nearest + x, d)
                        back = along(place, -1.0, p)
                        r = max(math.sqrt(dot(back, back)), MIN_DISTANCE)
                        way = scale(back, 1.0 / r)
                        if visible(objects, nodes, p, way, r - size):
                            kept = math.exp(-extinction * (nearest + x - enter + r))
                            phase = henyey_greenstein(dot(way, d), g)  # light arrives along -way and leaves along -d
                            share = math.pi * scattering * phase * kept * (high - low) / (apart * samples)
                            total = along(total, share, power)
                if found >= 0:
                    p = along(o, t, d)
                    n, albedo = surface(objects[found], materials[objects[found].material], p, d, radius[i] * t)
                    back = along(place, -1.0, p)
                    r = math.sqrt(dot(back, back))
                    way = scale(back, 1.0 / r)
                    facing = dot(n, way)
                    if facing > 0.0 and visible(objects, nodes, along(p, RAY_OFFSET, n), way, r - size):
                        kept = math.exp(-extinction * (max(leave - enter, 0.0) + r))
                        total = along(total, facing * kept / (r * r), mul(albedo, power))
            out[i, 0], out[i, 1], out[i, 2] = total[0], total[1], total[2]

    return light


light = _build(SOURCES)
