"""Shapes: signed distances, exact inside and out, and ray intersection.

Each shape is centred at its own origin; an Object's pose places it in the world. Sizes are outer sizes in scene units.
A rounded edge is a smaller sharp core, dilated: `rounding` preserves the outer size.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from .vector import INNER_OPTIONS, along, dot, unit

SPHERE, BOX, CYLINDER, CONE, TORUS, ARCH, PLANE, TRIANGLE, CAPSULE = range(9)
INFINITY = math.inf
MIN_COMPONENT = 1e-12  # of a direction, against division by zero
ON_SURFACE = 1e-7  # where a march along the ray ends, scene units
NEAR_SURFACE = 5e-3  # within this distance the march around a shape that is not convex may use the secant
MAX_STEPS = 400
MIN_CURVATURE = 1e-6  # per scene unit; an axis of less is straight


class SolidShape:
    """Interface of all shapes: `describe` for the tracer, `reach` for bounding boxes."""

    def describe(self) -> tuple[int, tuple[float, ...], float, tuple[float, float, float]]:
        """Kind, numbers of the core, rounding, and half-size of the bounding box in its own frame."""
        raise NotImplementedError

    def reach(self, rotation: np.ndarray) -> np.ndarray:
        """Half-size of the axis-aligned box around the rotated shape: of a box."""
        return np.abs(rotation) @ np.array(self.describe()[3])

    def at_rest(self, points: np.ndarray) -> np.ndarray:
        """Inverse deformation: rest positions of points of the body; both in the shape's frame."""
        return points

    def deformed(self, points: np.ndarray) -> np.ndarray:
        """Deformation: current positions of points of the body at rest; the inverse of `at_rest`."""
        return points


class Turned(SolidShape):
    """A shape of revolution about z."""

    def reach(self, rotation: np.ndarray) -> np.ndarray:
        """Half-size of the axis-aligned box around the rotated shape: of a cylinder."""
        radius, _, height = self.describe()[3]
        upright = np.abs(rotation[:, 2])
        return radius * np.sqrt(np.maximum(1 - upright**2, 0)) + height * upright


@dataclass(frozen=True)
class Ball(SolidShape):
    radius: float

    def reach(self, rotation: np.ndarray) -> np.ndarray:
        return np.full(3, self.radius)

    def describe(self):
        return SPHERE, (self.radius,), 0.0, (self.radius,) * 3


@dataclass(frozen=True)
class Cuboid(SolidShape):
    half: tuple[float, float, float]
    rounding: float = 0.0

    def describe(self):
        return BOX, tuple(h - self.rounding for h in self.half), self.rounding, self.half


@dataclass(frozen=True)
class Cylinder(Turned):
    """Upright (along z), with flat ends."""

    radius: float
    half_height: float
    rounding: float = 0.0

    def describe(self):
        core = self.radius - self.rounding, self.half_height - self.rounding
        return CYLINDER, core, self.rounding, (self.radius, self.radius, self.half_height)


@dataclass(frozen=True)
class Cone(Turned):
    """Upright, from `bottom` to `top` radius, either of which may be zero."""

    bottom: float
    top: float
    half_height: float
    rounding: float = 0.0

    def describe(self):
        radius = max(self.bottom, self.top, self.rounding)
        core = max(self.bottom - self.rounding, 0.0), max(self.top - self.rounding, 0.0)
        return CONE, (*core, self.half_height - self.rounding), self.rounding, (radius, radius, self.half_height)


@dataclass(frozen=True)
class Torus(Turned):
    """A ring around z. radius: to the middle of the tube; tube: its radius"""

    radius: float
    tube: float

    def describe(self):
        outer = self.radius + self.tube
        return TORUS, (self.radius, self.tube), 0.0, (outer, outer, self.tube)


@dataclass(frozen=True)
class Arch(SolidShape):
    """A box with a gateway along y: `opening` is the gate's half-width and the radius of its vault, which begins
    `spring` above the floor. The gate must stay inside the box: spring + opening < 2 half[2]."""

    half: tuple[float, float, float]
    opening: float
    spring: float = 0.0
    rounding: float = 0.0

    def describe(self):
        r = self.rounding
        core = (*(h - r for h in self.half), self.opening + r, self.spring - r)
        return ARCH, core, r, self.half


@dataclass(frozen=True)
class Plane(SolidShape):
    """The half-space z < 0."""

    def describe(self):
        return PLANE, (), 0.0, (INFINITY,) * 3

    def reach(self, rotation: np.ndarray) -> np.ndarray:
        return np.full(3, INFINITY)


@dataclass(frozen=True)
class Triangle(SolidShape):
    """A plate, twice `rounding` thick: (-base, -height), (base, -height) and (apex, height) before rounding, in the
    plane z = 0. The longest side lies along x, so that |apex| <= base; see `triangle_of`."""

    base: float
    apex: float
    height: float
    rounding: float

    def describe(self):
        r = self.rounding
        return TRIANGLE, (self.base, self.apex, self.height), r, (self.base + r, self.height + r, r)


@dataclass(frozen=True)
class SoftCapsule(SolidShape):
    """A soft body: a capsule along z that stretches, and whose axis bends into an arc about the origin.

    radius, half_height: at rest; the axis is 2 half_height long
    curvature: of the axis, per scene unit, towards +x; at most a half circle
    stretch:   factor on the axis's length; the cross-section shrinks by its root, which preserves the volume
    """

    radius: float
    half_height: float
    curvature: float = 0.0
    stretch: float = 1.0

    def describe(self):
        radius, half = self.radius / math.sqrt(self.stretch), self.half_height * self.stretch
        aside = abs(self.axis(half)[0])
        numbers = self.radius, self.half_height, self.curvature, self.stretch
        return CAPSULE, numbers, 0.0, (aside + radius, radius, half + radius)

    def axis(self, along: np.ndarray | float) -> tuple[Any, Any, Any]:
        """x and z of the axis at a length along it, and its angle there, radians."""
        angle = self.curvature * along
        half = 0.5 * angle
        chord = along * np.sinc(half / math.pi)
        return chord * np.sin(half), chord * np.cos(half), angle

    def at_rest(self, points: np.ndarray) -> np.ndarray:
        numbers = self.describe()[1]
        return np.array([at_rest.py_func(CAPSULE, numbers, tuple(p)) for p in points.tolist()]).reshape(-1, 3)

    def deformed(self, points: np.ndarray) -> np.ndarray:
        across = math.sqrt(self.stretch)
        on_axis = points[:, 2].clip(-self.half_height, self.half_height)
        x, z, angle = self.axis(on_axis * self.stretch)
        aside, beyond = points[:, 0] / across, (points[:, 2] - on_axis) / across
        cos, sin = np.cos(angle), np.sin(angle)
        return np.stack([x + aside * cos + beyond * sin, points[:, 1] / across, z - aside * sin + beyond * cos], -1)


def triangle_of(corners: np.ndarray, thickness: float) -> tuple[Triangle, np.ndarray, np.ndarray] | None:
    """The plate between three points (corner, 3), with its rotation and position; None for points on a line."""
    sides = np.roll(corners, -1, 0) - corners
    a, b, c = np.roll(corners, -int(np.argmax(np.linalg.norm(sides, axis=1))), 0)
    long = float(np.linalg.norm(b - a))
    normal = np.cross(b - a, c - a)
    if np.linalg.norm(normal) < MIN_COMPONENT:
        return None
    x, z = (b - a) / long, normal / np.linalg.norm(normal)
    y = np.cross(z, x)
    along_x, up = float((c - a) @ x), float((c - a) @ y)
    shape = Triangle(0.5 * long, along_x - 0.5 * long, 0.5 * up, 0.5 * thickness)
    return shape, np.stack([x, y, z], 1), a + 0.5 * long * x + 0.5 * up * y


@njit(**INNER_OPTIONS)
def beside_segment(x, y, ax, ay, bx, by):
    """Squared distance to a segment in the plane; and the side, positive to its left."""
    dx, dy, px, py = bx - ax, by - ay, x - ax, y - ay
    s = min(max((px * dx + py * dy) / (dx * dx + dy * dy), 0.0), 1.0)
    return (px - s * dx) ** 2 + (py - s * dy) ** 2, dx * py - dy * px


@njit(**INNER_OPTIONS)
def hollow(kind):
    """True for a shape that is not convex: a ray that leaves it can meet it again."""
    return kind == TORUS or kind == ARCH or kind == CAPSULE


@njit(**INNER_OPTIONS)
def at_rest(kind, size, p):
    """Rest position of a body's point, where textures are fixed. Beyond the ends of a soft capsule's axis, along their
    tangents. It calls nothing compiled, so that Python may call it."""
    if kind != CAPSULE:
        return p
    x, y, z = p
    bend, half, across = size[2], size[1] * size[3], math.sqrt(size[3])
    along = z
    if abs(bend) >= MIN_CURVATURE:
        radius, side = 1.0 / bend, math.copysign(1.0, bend)
        along = math.atan2(side * z, side * (radius - x)) / bend
        if abs(along) <= half:
            x = radius - side * math.sqrt((radius - x) ** 2 + z * z)
        else:
            end = math.copysign(half, along)
            cos, sin = math.cos(bend * end), math.sin(bend * end)
            u, w = x - (1.0 - cos) * radius, z - sin * radius
            x, along = u * cos - w * sin, end + u * sin + w * cos
    on_axis = min(max(along, -half), half)
    return (x * across, y * across, on_axis / size[3] + (along - on_axis) * across)


@njit(**INNER_OPTIONS)
def outside_corner(x, y):
    """Distance to the quadrant x < 0, y < 0."""
    if x > 0.0 and y > 0.0:
        return math.sqrt(x * x + y * y)
    return max(x, y)


@njit(**INNER_OPTIONS)
def arch_profile(x, z, a, c, r, spring):
    """Distance to a rectangle of half-size (a, c) less a gate of radius r; x >= 0."""
    up = z + c  # above the floor
    if up >= 0.0 and x < a and z < c:
        gate = math.hypot(x, max(up - spring, 0.0)) - r  # positive outside the gate
        if gate < 0.0:
            return -gate
        floor = up if x > r else math.hypot(r - x, up)
        return -min(min(a - x, c - z), min(gate, floor))
    if up < 0.0 and x < r:
        return math.hypot(r - x, up)
    return outside_corner(x - a, abs(z) - c)


@njit(**INNER_OPTIONS)
def distance(kind, size, p):
    """Signed distance from a point to a shape, both in the shape's frame; size[5] is the rounding."""
    x, y, z = p
    if kind == SPHERE:
        return math.sqrt(dot(p, p)) - size[0]
    if kind == BOX:
        x, y, z = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
        out = math.sqrt(max(x, 0.0) ** 2 + max(y, 0.0) ** 2 + max(z, 0.0) ** 2)
        return out + min(max(x, max(y, z)), 0.0) - size[5]
    if kind == CYLINDER:
        return outside_corner(math.sqrt(x * x + y * y) - size[0], abs(z) - size[1]) - size[5]
    if kind == TORUS:
        ring = math.sqrt(x * x + y * y) - size[0]
        return math.sqrt(ring * ring + z * z) - size[1]
    if kind == ARCH:
        d = arch_profile(abs(x), z, size[0], size[2], size[3], size[4])
        return outside_corner(d, abs(y) - size[1]) - size[5]
    if kind == CONE:  # a trapezium turned about z: the nearer of its end caps and its slanted side
        q = math.sqrt(x * x + y * y)
        bottom, top, h = size[0], size[1], size[2]
        cap_x, cap_z = q - min(q, bottom if z < 0.0 else top), abs(z) - h
        side_x, side_z = top - bottom, 2.0 * h
        s = ((q - bottom) * side_x + (z + h) * side_z) / (side_x * side_x + side_z * side_z)
        s = min(max(s, 0.0), 1.0)
        off_x, off_z = q - bottom - s * side_x, z + h - s * side_z
        squared = min(cap_x * cap_x + cap_z * cap_z, off_x * off_x + off_z * off_z)
        inside = off_x < 0.0 and cap_z < 0.0
        return (-math.sqrt(squared) if inside else math.sqrt(squared)) - size[5]
    if kind == TRIANGLE:
        first, below = beside_segment(x, y, -size[0], -size[2], size[0], -size[2])
        second, right = beside_segment(x, y, size[0], -size[2], size[1], size[2])
        third, left = beside_segment(x, y, size[1], size[2], -size[0], -size[2])
        flat = 0.0 if min(below, min(right, left)) >= 0.0 else min(first, min(second, third))
        return math.sqrt(flat + z * z) - size[5]
    if kind == CAPSULE:
        x, y, z = at_rest(kind, size, p)
        z = max(abs(z) - size[1], 0.0)
        return (math.sqrt(x * x + y * y + z * z) - size[0]) / math.sqrt(size[3])
    return z  # a plane


@njit(**INNER_OPTIONS)
def gradient(kind, size, p):
    """Outward normal at a point of the surface: central differences over a tetrahedron (Quilez 2015)."""
    h = 1e-5
    a = distance(kind, size, (p[0] + h, p[1] - h, p[2] - h))
    b = distance(kind, size, (p[0] - h, p[1] - h, p[2] + h))
    c = distance(kind, size, (p[0] - h, p[1] + h, p[2] - h))
    d = distance(kind, size, (p[0] + h, p[1] + h, p[2] + h))
    return unit((a - b - c + d, -a - b + c + d, -a + b - c + d))


@njit(**INNER_OPTIONS)
def inverse(d):
    """The reciprocal of each component."""
    x = d[0] if abs(d[0]) > MIN_COMPONENT else math.copysign(MIN_COMPONENT, d[0])
    y = d[1] if abs(d[1]) > MIN_COMPONENT else math.copysign(MIN_COMPONENT, d[1])
    z = d[2] if abs(d[2]) > MIN_COMPONENT else math.copysign(MIN_COMPONENT, d[2])
    return (1.0 / x, 1.0 / y, 1.0 / z)


@njit(**INNER_OPTIONS)
def slab(o, over, low, high):
    """Entry and exit distances of a ray in a box, enter > leave for a miss. over: one over its direction"""
    ax, bx = (low[0] - o[0]) * over[0], (high[0] - o[0]) * over[0]
    ay, by = (low[1] - o[1]) * over[1], (high[1] - o[1]) * over[1]
    az, bz = (low[2] - o[2]) * over[2], (high[2] - o[2]) * over[2]
    enter = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), 0.0))
    return enter, min(min(max(ax, bx), max(ay, by)), max(az, bz))


@njit(**INNER_OPTIONS)
def quadratic(a, b, c):
    """Roots of a t² + 2 b t + c, smaller first; infinity twice without any."""
    root = b * b - a * c
    if root < 0.0 or a < MIN_COMPONENT:
        return INFINITY, INFINITY
    root = math.sqrt(root)
    return (-b - root) / a, (-b + root) / a


@njit(**INNER_OPTIONS)
def intersect(kind, size, half, o, d, limit):
    """Distance to the first hit of a ray from outside, infinity beyond `limit`. In the shape's frame."""
    if kind == PLANE:
        t = -o[2] / (d[2] if abs(d[2]) > MIN_COMPONENT else MIN_COMPONENT)
        return t if t > 0.0 and t < limit and d[2] < 0.0 else INFINITY
    if kind == SPHERE:
        t, _ = quadratic(1.0, dot(o, d), dot(o, o) - size[0] * size[0])
        return t if t > 0.0 and t < limit else INFINITY
    t, leave = slab(o, inverse(d), (-half[0], -half[1], -half[2]), half)
    leave = min(leave, limit)
    if t >= leave:
        return INFINITY
    if kind == BOX and size[5] == 0.0:
        return t if t > 0.0 else INFINITY
    if kind == CYLINDER and size[5] == 0.0:
        outside = o[0] ** 2 + o[1] ** 2 - size[0] ** 2
        near, far = quadratic(d[0] * d[0] + d[1] * d[1], o[0] * d[0] + o[1] * d[1], outside)
        if near == INFINITY:  # parallel to the axis, or passing by
            return t if outside < 0.0 and t > 0.0 else INFINITY
        near = max(near, ((-half[2] if d[2] > 0.0 else half[2]) - o[2]) * inverse(d)[2])
        return near if near > 0.0 and near < min(far, leave) else INFINITY
    # Sphere tracing (Hart 1996): a step as long as the distance cannot pass the surface. Along a ray, the distance to a
    # convex body is a convex function: the secant through the last two points cannot pass the surface either, and once
    # the distance grows it grows for ever. Other shapes take the secant only close to the surface.
    convex = not hollow(kind)
    before = distance(kind, size, along(o, t, d))
    step = before
    for _ in range(MAX_STEPS):
        if abs(before) < ON_SURFACE:
            return t + before
        t += step
        if t > leave:
            return INFINITY
        now = distance(kind, size, along(o, t, d))
        fall = (before - now) / step
        if convex and fall <= 0.0:
            return INFINITY
        step = now / fall if convex or (now < NEAR_SURFACE and fall > 0.3) else now
        before = now
    return INFINITY
