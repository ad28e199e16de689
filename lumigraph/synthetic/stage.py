"""Stage: a world with cameras; and options in its name: "still-life,size=400,seed=1"."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any, Literal, TypeVar, get_origin, get_type_hints

from ..camera import Camera
from ..datasets.skeleton import Skeleton
from ..datasets.tracks import BoxTrack
from ..errors import LumigraphError
from ..files.ranges import Seed, between, numbers, typed
from ..geometry import evenly
from .depth_camera import DepthCamera
from .sensor import Sensor
from .world import Rotation, Vector, World

MOMENTS = 16  # at which one sees what moves
MAX_DIGITS = 20  # of a number
Flag = Annotated[int, between(0, 1)]  # an option that its name alone turns on
Options = TypeVar("Options")


@dataclass(frozen=True)
class SyntheticStage:
    """A procedural scene with cameras.

    world:   at the first time of a dynamic scene
    cameras: by split; with `time` in a dynamic scene
    bounds:  the box of interest, lowest and highest corner
    reach:   half-size of the cube around the origin that contains the whole model
    near:    near distance of every camera; the space in front is empty
    moving:  the world at a time; None for a static scene
    differing: the world of a photograph, by its `image_index`, where light or people vary; None where they do not
    lasting: the same without transient objects
    turn:    rotation to the world from the common upright orientation of a category; None without one
    sensor:  takes raw photographs, indexed by `image_index`; None for pictures alone
    facts:   values of a photograph by its `image_index`; see `Scene.about`
    called:  cache key of a photograph's world, by its `image_index`; None for pictures that are not cached
    depth_camera: measures depth beside the pictures, indexed by `image_index`; None for exact depth
    unit:    of the source's frame per unit of the world
    tracks:  boxes of the moving rigid objects
    skeleton: bones of a character at all times, in the world
    error:   reference length of pose errors in percent; None for the longest side of the bounds
    """

    world: World
    cameras: dict[str, Camera]
    bounds: tuple[Vector, Vector]
    reach: float
    near: float
    moving: Callable[[float], World] | None = None
    differing: Callable[[int], World] | None = None
    lasting: Callable[[int], World] | None = None
    turn: Rotation | None = None
    sensor: Sensor | None = None
    facts: Callable[[int], dict[str, Any]] | None = None
    called: Callable[[int], str] | None = None
    depth_camera: DepthCamera | None = None
    unit: float = 1.0
    tracks: tuple[BoxTrack, ...] = ()
    skeleton: Skeleton | None = None
    error: float | None = None

    @cached_property
    def moving_things(self) -> tuple[int, ...]:
        """Numbers, in the world's `names`, of the moving objects."""
        if self.moving is None:
            return ()
        times = [t for cameras in self.cameras.values() if cameras.time is not None for t in cameras.time.tolist()]
        moments = [self.moving(t) for t in evenly(sorted(times), MOMENTS)]
        pairs = [pair for world in moments for pair in zip(world.objects, moments[0].objects, strict=True)]
        changed = {now.name for now, first in pairs if now != first}
        return tuple(i for i, name in enumerate(self.world.names) if name in changed)

    def world_of(self, camera: Camera) -> World:
        """The world at the time of a camera (a batch of one)."""
        if self.differing is not None and camera.image_index is not None:
            return self.differing(int(camera.image_index))
        return self.world if self.moving is None or camera.time is None else self.moving(float(camera.time))


@dataclass(frozen=True)
class Pictures:
    """Options of every scene.

    size: of the square pictures, pixels; views: number of training photographs; seed: of the camera positions;
    jitter_poses: error of training poses: degrees, and percent of the box of interest
    """

    size: Annotated[int, between(1, 8192)] = 200
    views: Annotated[int, between(1, 10_000)] = 100
    seed: Seed = 0
    jitter_poses: Annotated[int, between(0, 45)] = 0


@dataclass(frozen=True)
class Nuisances:
    """Options of every scene that make it like data that nobody made for a method, each off by default.

    shape: seed of a random object in place of the scene's, with a hole, thin rods and a hollow base
    open: distance of a background behind the cameras, scene units; clutter: number of small things near cameras
    turntable: the background goes with the camera, as where the object turns; backdrop: a board that is carried round
    step: one of so many training photographs in turn is kept; few: so many, evenly spread; order: shuffled names
    poses: error of training poses, pixels; blur: of moved cameras, pixels
    exposure: stops up or down; white_balance: percent
    holes: unknown pixels of measured depth; noise: errors of it
    labels: percent of wrong pixels, and of photographs without labels
    scale: unit of the source; offset: of its origin along each axis
    """

    shape: Seed = 0
    open: Annotated[float, between(0, 1e4)] = 0.0
    clutter: Annotated[int, between(0, 1000)] = 0
    turntable: Flag = 0
    backdrop: Flag = 0
    step: Annotated[int, between(1, 1000)] = 1
    few: Annotated[int, between(0, 10_000)] = 0
    order: Flag = 0
    poses: Annotated[float, between(0, 100)] = 0.0
    blur: Annotated[float, between(0, 100)] = 0.0
    exposure: Annotated[float, between(0, 8)] = 0.0
    white_balance: Annotated[float, between(0, 90)] = 0.0
    holes: Literal["", "grid", "columns", "borders", "far"] = ""
    noise: Literal["", "quantised", "scaled", "returns"] = ""
    labels: Annotated[float, between(0, 100)] = 0.0
    scale: Annotated[float, between(1e-6, 1e6)] = 1.0
    offset: Annotated[float, between(-1e7, 1e7)] = 0.0


def nuisances_of(request: str) -> tuple[str, list[str]]:
    """The request without its nuisances, and these as they are written."""
    name, *rest = request.split(",")
    known = {field.name for field in fields(Nuisances)}
    own = [text for text in rest if text.strip().partition("=")[0] in known]
    return ",".join([name, *(text for text in rest if text not in own)]), own


def told(kind: type[Options], request: str) -> tuple[str, Options]:
    """Parse a name with options to the name and a dataclass. Raises LumigraphError for an unknown option."""
    name, *rest = request.split(",")
    return name, typed(kind, dict(parse(kind, request, text) for text in rest), f"procedural:{request}")


def parse(kind: type, request: str, text: str) -> tuple[str, float | str]:
    """One option, "size=400", "scale=0.01" or "file=fox.glb", or a flag, "depth"."""
    name, equals, value = text.strip().partition("=")
    known = [field.name for field in fields(kind)]
    if name not in known:
        known += [] if kind is Nuisances else [field.name for field in fields(Nuisances)]
        raise LumigraphError(f"procedural:{request}: there is no option {name!r}; there are {', '.join(known)}")
    meant = get_type_hints(kind, include_extras=True)[name]
    if not equals and meant == Flag:
        return name, 1
    if meant is str or get_origin(meant) is Literal:
        return name, value
    if next(numbers(meant))[0] is float:
        try:
            return name, float(value)
        except ValueError as error:
            raise LumigraphError(f"procedural:{request}: {name} must be a number; got {value!r}") from error
    if not value.isdecimal() or len(value) > MAX_DIGITS:
        raise LumigraphError(f"procedural:{request}: {name} must be a whole number, as in {name}=20; got {value!r}")
    return name, int(value)
