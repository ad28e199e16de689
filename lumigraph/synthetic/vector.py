"""Vectors of three as tuples, for compiled code: they live in registers."""

import math

from numba import njit

# How every function of the tracer is compiled. Infinity means "nothing is hit", so fast-math may not assume it away.
COMPILE_OPTIONS = {
    "nogil": True,
    "_nrt": False,
    "error_model": "numpy",
    "fastmath": {"reassoc", "nsz", "arcp", "contract"},
}
INNER_OPTIONS = {**COMPILE_OPTIONS, "no_cpython_wrapper": True}  # of functions for compiled code only: compile quicker


@njit(**INNER_OPTIONS)
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**INNER_OPTIONS)
def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(**INNER_OPTIONS)
def mul(a, b):
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@njit(**INNER_OPTIONS)
def scale(a, s):
    return (a[0] * s, a[1] * s, a[2] * s)


@njit(**INNER_OPTIONS)
def along(a, s, b):
    """a + s b"""
    return (a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2])


@njit(**INNER_OPTIONS)
def mix(a, b, w):
    """a where w = 0, b where w = 1"""
    return (a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1]), a[2] + w * (b[2] - a[2]))


@njit(**INNER_OPTIONS)
def unit(a):
    s = 1.0 / math.sqrt(max(dot(a, a), 1e-300))
    return (a[0] * s, a[1] * s, a[2] * s)


@njit(**INNER_OPTIONS)
def vec(row):
    """A tuple from three consecutive numbers."""
    return (row[0], row[1], row[2])


@njit(**INNER_OPTIONS)
def rotate(m, v):
    """M v"""
    return (
        m[0, 0] * v[0] + m[0, 1] * v[1] + m[0, 2] * v[2],
        m[1, 0] * v[0] + m[1, 1] * v[1] + m[1, 2] * v[2],
        m[2, 0] * v[0] + m[2, 1] * v[1] + m[2, 2] * v[2],
    )


@njit(**INNER_OPTIONS)
def rotate_back(m, v):
    """Mᵀ v: the inverse of `rotate` for a rotation."""
    return (
        m[0, 0] * v[0] + m[1, 0] * v[1] + m[2, 0] * v[2],
        m[0, 1] * v[0] + m[1, 1] * v[1] + m[2, 1] * v[2],
        m[0, 2] * v[0] + m[1, 2] * v[1] + m[2, 2] * v[2],
    )


@njit(**INNER_OPTIONS)
def clamp(x, low, high):
    return min(max(x, low), high)


@njit(**INNER_OPTIONS)
def smooth(x, low, high):
    """0 below low, 1 above high, a cubic between."""
    s = clamp((x - low) / (high - low), 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)
