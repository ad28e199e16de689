"""Contents of a procedural scene: objects with a shape, a material and a rigid pose; lights; a sky.

Everything is a frozen value: a moved, relit or repainted scene is a `dataclasses.replace`. `World.arrays` flattens it
for the tracer, which needs no compilation for a new scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..color.srgb import linear_from_srgb
from ..light import EnvironmentLight
from .shapes import SolidShape
from .textures import Colour, Texture

Vector = tuple[float, float, float]
Rotation = tuple[Vector, Vector, Vector]  # its rows

KINDS = ("objects", "materials", "nodes")  # of `Arrays`, what is each object's own
FAR_DISTANCE = 1e30  # in place of infinity, because infinity times zero is not a number


def record(**fields: str) -> np.dtype:
    """Row type for the tracer, from NumPy's names of its fields' types."""
    return np.dtype(list(fields.items()))


OBJECT = record(kind="i8", material="i8", identity="i8", size="6f8", half="3f8", rotation="(3,3)f8", position="3f8")
MATERIAL = record(texture="i8", a="3f8", b="3f8", numbers="4f8", gloss="f8", roughness="f8", metal="f8")
LIGHT = record(distant="i8", position="3f8", radius="f8", colour="3f8")
SKY = record(
    visible="i8", zenith="3f8", horizon="3f8", ground="3f8", clouds="f8", haze="f8", reach="f8", exposure="3f8"
)
NODE = record(low="3f8", high="3f8", object="i8", skip="i8")


class Arrays(NamedTuple):
    """A world as input of the tracer."""

    objects: np.ndarray
    materials: np.ndarray
    lights: np.ndarray
    sky: np.ndarray
    nodes: np.ndarray


@dataclass(frozen=True)
class Pose:
    """A rigid motion from an object's own frame to the world: x -> rotation x + position."""

    position: Vector = (0.0, 0.0, 0.0)
    rotation: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    @staticmethod
    def at(x: float, y: float, z: float, turn: float = 0.0, tilt: float = 0.0) -> Pose:
        """Pose at a position, tilted by `tilt` degrees (about x), then turned by `turn` degrees (about z)."""
        rotation = rotation_about((0, 0, 1), turn) @ rotation_about((1, 0, 0), tilt)
        return Pose((x, y, z), nested(rotation))

    @staticmethod
    def about(axis: Vector, degrees: float) -> Pose:
        return Pose(rotation=nested(rotation_about(axis, degrees)))

    def applied(self, points: np.ndarray) -> np.ndarray:
        """Points (point, 3) of the object's own frame in the world."""
        return points @ np.array(self.rotation).T + np.array(self.position)

    def inverted(self, points: np.ndarray) -> np.ndarray:
        """Points (point, 3) of the world in the object's own frame."""
        return (points - np.array(self.position)) @ np.array(self.rotation)

    def __matmul__(self, inner: Pose) -> Pose:
        """Composition: `inner` first, then this pose."""
        rotation, position = np.array(self.rotation), np.array(self.position)
        moved = rotation @ np.array(inner.position) + position
        return Pose(tuple(moved.tolist()), nested(rotation @ np.array(inner.rotation)))


@dataclass(frozen=True)
class Material:
    """Reflectance of a surface.

    texture:   diffuse colour, and specular colour of a metal
    gloss:     strength of the clear coat, 0 for chalk, 1 for varnish (reflects 4 % head-on, more at grazing angles)
    roughness: width of the highlights, 0.1 polished, 0.6 satin
    metal:     0 for paint, wood and stone, 1 for bare metal
    """

    texture: Texture
    gloss: float = 0.0
    roughness: float = 0.4
    metal: float = 0.0

    def describe(self):
        texture, a, b, numbers = self.texture.describe()
        numbers = (*numbers, 0.0, 0.0, 0.0, 0.0)[:4]
        return texture, linear_from_srgb(a), linear_from_srgb(b), numbers, self.gloss, self.roughness, self.metal


@dataclass(frozen=True)
class Object:
    """A shape with a pose. Objects of one name are parts of one thing: they share its mask and move together; only a
    single object may deform."""

    shape: SolidShape
    material: Material
    pose: Pose = Pose()
    name: str = "object"

    def scaled(self, factor: float) -> Object:
        """The object scaled about the world's origin; its texture keeps its scale."""

        def times(value: Any) -> Any:
            return tuple(map(times, value)) if isinstance(value, tuple) else factor * value

        shape = type(self.shape)(**{name: times(value) for name, value in vars(self.shape).items()})
        return replace(self, shape=shape, pose=replace(self.pose, position=times(self.pose.position)))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of a box around it, scene units."""
        reach = self.shape.reach(np.array(self.pose.rotation))
        return np.array(self.pose.position) - reach, np.array(self.pose.position) + reach


@dataclass(frozen=True)
class Lamp:
    """A glowing ball, with soft shadows by its radius.

    power: radiance of a white diffuse surface that faces it at distance one; falls off with the distance squared
    """

    position: Vector
    radius: float
    power: float
    colour: Colour = (1.0, 1.0, 1.0)

    def describe(self):
        return 0, self.position, self.radius, linear_from_srgb(self.colour) * self.power

    def transformed(self, pose: Pose) -> Lamp:
        return replace(self, position=(pose @ Pose(self.position)).position)


@dataclass(frozen=True)
class Sun:
    """A light at infinity.

    direction: towards it
    radius:    half its apparent width, radians
    power:     radiance of a white diffuse surface that faces it
    """

    direction: Vector
    radius: float
    power: float
    colour: Colour = (1.0, 1.0, 1.0)

    def describe(self):
        toward = np.array(self.direction) / np.linalg.norm(self.direction)
        return 1, toward, self.radius, linear_from_srgb(self.colour) * self.power

    def transformed(self, pose: Pose) -> Sun:
        return replace(self, direction=(Pose(rotation=pose.rotation) @ Pose(self.direction)).position)


@dataclass(frozen=True)
class Sky:
    """Environment of a scene: light from all sides, reflections, and the background if it is visible.

    visible: False leaves the background transparent
    light:   factor on the three colours
    clouds:  share of white clouds, 0 for none
    haze:    share of light lost per scene unit to the horizon's colour
    reach:   of ambient occlusion, scene units
    exposure: factor on all radiance before the film's response
    balance: white balance of the camera: factors on red, green and blue
    """

    zenith: Colour = (1.0, 1.0, 1.0)
    horizon: Colour = (1.0, 1.0, 1.0)
    ground: Colour = (1.0, 1.0, 1.0)
    light: float = 1.0
    visible: bool = False
    clouds: float = 0.0
    haze: float = 0.0
    reach: float = 0.25
    exposure: float = 1.0
    balance: Colour = (1.0, 1.0, 1.0)

    def describe(self):
        colours = (linear_from_srgb(c) * self.light for c in (self.zenith, self.horizon, self.ground))
        exposure = self.exposure * np.array(self.balance)
        return int(self.visible), *colours, self.clouds, self.haze, self.reach, exposure


@dataclass(frozen=True)
class Fog:
    """Fog in a ball around the origin with single scattering of lamps' light.

    scattering, absorption: per scene unit
    anisotropy: g of the phase function (Henyey and Greenstein 1941): 0 for isotropic, towards 1 for forward scattering
    reach:      radius of the ball
    """

    scattering: float
    absorption: float
    anisotropy: float = 0.0
    reach: float = 1.0


@dataclass(frozen=True)
class World:
    """A procedural scene. z points up, lengths in scene units.

    environment: an exact environment light in place of lights and sky; None without one
    bounces:     interreflections of its light, 0 or 1
    fog:         scatters the light of lamps, then the only lights; None for clear air
    """

    objects: tuple[Object, ...]
    lights: tuple[Lamp | Sun, ...] = ()
    sky: Sky = Sky()
    environment: EnvironmentLight | None = None
    bounces: int = 0
    fog: Fog | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers in a mask."""
        return tuple(dict.fromkeys(o.name for o in self.objects))

    def move_object(self, name: str, motion: Pose) -> World:
        """The world with the object of this name transformed."""
        if name not in self.names:
            raise KeyError(f"nothing here is called {name!r}; there are {', '.join(self.names)}")
        objects = (replace(o, pose=motion @ o.pose) if o.name == name else o for o in self.objects)
        return replace(self, objects=tuple(objects))

    def carried(self, points: np.ndarray, things: np.ndarray, later: World) -> np.ndarray:
        """Positions (point, 3) in a later world of surface points of this one. The exact correspondence.

        things: number in `names` of each point's object; points of -1 stay
        later:  the same objects, moved or deformed
        """
        found = np.array(points, np.float64)
        for number, name in enumerate(self.names):
            own = things == number
            before, after = (next(o for o in world.objects if o.name == name) for world in (self, later))
            at_rest = before.shape.at_rest(before.pose.inverted(found[own]))
            found[own] = after.pose.applied(after.shape.deformed(at_rest))
        return found

    def transformed(self, motion: Pose) -> World:
        """The world with everything in it, lights included, transformed; the sky stays."""
        objects = (replace(o, pose=motion @ o.pose) for o in self.objects)
        return replace(self, objects=tuple(objects), lights=tuple(x.transformed(motion) for x in self.lights))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the box around all objects; infinite where a plane is."""
        boxes = [o.bounds() for o in self.objects]
        return np.min([low for low, _ in boxes], 0), np.max([high for _, high in boxes], 0)

    @cached_property
    def arrays(self) -> Arrays:
        """The world as flat arrays, for the tracer."""
        objects = np.zeros(len(self.objects), OBJECT)
        materials = numbered(o.material for o in self.objects)
        names = numbered(self.names)
        for row, thing in zip(objects, self.objects, strict=True):
            kind, size, rounding, half = thing.shape.describe()
            row["kind"], row["half"] = kind, half
            row["size"][: len(size)], row["size"][5] = size, rounding
            row["rotation"], row["position"] = thing.pose.rotation, thing.pose.position
            row["material"], row["identity"] = materials[thing.material], names[thing.name]
        return Arrays(
            objects,
            np.array([material.describe() for material in materials], MATERIAL),
            np.array([x.describe() for x in self.lights], LIGHT),
            np.array([self.sky.describe()], SKY),
            hierarchy([o.bounds() for o in self.objects]),
        )


def joined(parts: Sequence[World], lights: tuple[Lamp | Sun, ...], sky: Sky) -> World:
    """Objects of several worlds in one, with one light. Each part is flattened once for all worlds that it becomes part
    of. Names must be unique."""
    world = World(tuple(o for part in parts for o in part.objects), lights, sky)
    names = [name for part in parts for name in part.names]
    assert len(names) == len(set(names)), "a name is in two parts"
    flat = [part.arrays for part in parts]
    objects, materials, nodes = (np.concatenate([getattr(a, kind) for a in flat]) for kind in KINDS)
    begin = Arrays(*(np.cumsum([0, *(len(a[k]) for a in flat)]) for k in range(len(Arrays._fields))))
    seen = np.cumsum([0, *(len(part.names) for part in parts)])
    for k in range(len(parts)):
        own = slice(begin.objects[k], begin.objects[k + 1])
        objects["material"][own] += begin.materials[k]
        objects["identity"][own] += seen[k]
        tree = nodes[begin.nodes[k] : begin.nodes[k + 1]]
        tree["skip"] += begin.nodes[k]
        tree["object"][tree["object"] >= 0] += begin.objects[k]
    light = World((), lights, sky).arrays
    # What `arrays` would find, without building the tree again.
    world.__dict__["arrays"] = Arrays(objects, materials, light.lights, light.sky, nodes)
    return world


def numbered(things: Iterable[Any]) -> dict[Any, int]:
    """Each different thing with its number."""
    return {thing: number for number, thing in enumerate(dict.fromkeys(things))}


def rotation_about(axis: Vector, degrees: float) -> np.ndarray:
    """The matrix that turns by an angle about an axis, anticlockwise seen from its tip (Rodrigues)."""
    x, y, z = np.array(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def nested(matrix: np.ndarray):
    """Rows of the matrix as nested tuples, the type of `Pose.rotation`."""
    return tuple(tuple(row) for row in matrix.tolist())


def hierarchy(boxes: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Bounding volume hierarchy over boxes (low, high), as an array of NODE in depth-first order: where a ray misses a
    box, it continues at `skip`, past everything inside it; there is no stack. Unbounded ones come first; the others are
    split by the surface area heuristic (Goldsmith and Salmon 1987)."""
    if not boxes:
        return np.zeros(0, NODE)
    low, high = (np.clip(np.array(x).reshape(-1, 3), -FAR_DISTANCE, FAR_DISTANCE) for x in zip(*boxes, strict=True))
    bounded = high[:, 0] < FAR_DISTANCE
    nodes: list[tuple] = []

    def grow(members: np.ndarray) -> None:
        box = low[members].min(0), high[members].max(0)
        if len(members) == 1:
            nodes.append((*box, members[0], len(nodes) + 1))
            return
        place = len(nodes)
        nodes.append(())
        for half in split_boxes(low, high, members):
            grow(half)
        nodes[place] = (*box, -1, len(nodes))

    for one in np.flatnonzero(~bounded):
        grow(np.array([one]))
    if bounded.any():
        grow(np.flatnonzero(bounded))
    return np.array(nodes, NODE)


def split_boxes(low: np.ndarray, high: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split into two groups of least surface area times number."""
    if len(members) == 2:
        return members[:1], members[1:]
    best, groups = np.inf, (members[:1], members[1:])
    for axis in range(3):
        order = members[np.argsort((low + high)[members, axis], kind="stable")]
        left = half_surface(np.minimum.accumulate(low[order]), np.maximum.accumulate(high[order]))[:-1]
        back = order[::-1]
        right = half_surface(np.minimum.accumulate(low[back]), np.maximum.accumulate(high[back]))[-2::-1]
        count = np.arange(1, len(members))
        cost = left * count + right * count[::-1]
        if cost.min() < best:
            best, cut = cost.min(), cost.argmin() + 1
            groups = order[:cut], order[cut:]
    return groups


def half_surface(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    x, y, z = (high - low).T
    return x * y + y * z + z * x
