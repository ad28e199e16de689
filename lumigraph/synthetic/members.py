"""Collections of procedural objects: "toys,count=200" are many, "toys,member=3" is one of them as a scene of its own.
So are meshes: "path/to/folder" is a collection of all its meshes, "path/to/mesh.obj" a scene.

Pictures are rendered once and cached, since training passes over a collection many times.
"""

import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from ..errors import LumigraphError
from ..files.names import natural
from ..files.ranges import Seed, between
from ..readers import meshes
from . import categories, scenes
from .cameras import dome, pinhole, spiral
from .categories import FIELD_OF_VIEW, surrounded
from .shapes import triangle_of
from .stage import SyntheticStage, nuisances_of, told
from .textures import Plain
from .world import Material, Object, Pose, Vector, nested

RADIUS = 0.85  # of the ball around a mesh, about its middle
THICKNESS = 4e-3  # of its triangles
BOUNDS: tuple[Vector, Vector] = ((-RADIUS,) * 3, (RADIUS,) * 3)
BALL_RADIUS = 1.2  # contains every member in every rotation
CAMERA_DISTANCE = 4.1  # from the centre, at which that ball just fits into the picture
MAX_ELEVATION = 60.0  # degrees of the cameras above and below the horizon: no side is the lower one


@dataclass(frozen=True)
class Member:
    """Request for one member. size: of the square pictures, pixels; views: training views; seed: of everything; turned:
    1 for a random rotation; member: its number"""

    size: Annotated[int, between(1, 8192)] = 64
    views: Annotated[int, between(1, 10_000)] = 20
    seed: Seed = 0
    turned: Annotated[int, between(0, 1)] = 0
    member: Annotated[int, between(0, 99_999)] = 0


@dataclass(frozen=True)
class Many:
    """Request for many members, like `Member`. count: of members"""

    count: Annotated[int, between(1, 100_000)] = 200
    size: Annotated[int, between(1, 8192)] = 64
    views: Annotated[int, between(1, 10_000)] = 20
    seed: Seed = 0
    turned: Annotated[int, between(0, 1)] = 0


def is_category(request: str) -> bool:
    """True for a request for objects of a category, or for meshes."""
    return request.partition(",")[0] in categories.available() or path_of(request) is not None


def path_of(request: str) -> Path | None:
    """Folder or mesh of a request; None for a procedural one. Scenes and categories take precedence: a folder of the
    same name is given as ./chairs."""
    name = request.partition(",")[0]
    if name in (*categories.available(), *scenes.available()):
        return None
    path = Path(name).expanduser()
    return path if path.is_dir() or meshes.is_mesh(path) else None


def is_collection(request: str) -> bool:
    """True for all members of a category, or all meshes of a folder; False for a single one."""
    if (path := path_of(request)) is not None:
        return path.is_dir()
    return is_category(request) and not any(text.strip().startswith("member=") for text in request.split(",")[1:])


def members_of(request: str) -> dict[str, str]:
    """Request for each member, by name. Raises LumigraphError for a folder without meshes."""
    plain, disturbances = nuisances_of(request)
    name, many = told(Many, plain)
    said = {key: value for key, value in asdict(many).items() if key != "count" and (key != "turned" or value)}
    shared = ",".join([*(f"{key}={value}" for key, value in said.items()), *disturbances])
    if (folder := path_of(request)) is None:
        return {f"{name}-{i:04d}": f"{name},member={i},{shared}" for i in range(many.count)}
    found = sorted(filter(meshes.is_mesh, folder.resolve().rglob("*")), key=lambda path: natural(path.as_posix()))
    if not found:
        raise LumigraphError(f"{folder} holds no meshes to photograph; name a folder of {', '.join(meshes.SUFFIXES)}")
    return {meshes.name_of(path, folder.resolve()): f"{path},{shared}" for path in found[: many.count]}


def member_stage(request: str) -> SyntheticStage:
    """One object with cameras around it. Raises LumigraphError for a mesh file without a surface."""
    name, one = told(Member, request)
    if (path := path_of(request)) is not None:
        number = zlib.crc32(path.name.encode())
        random = np.random.default_rng((one.seed, number))
        stage = surrounded(tuple(plates(path)), BOUNDS, one.size, one.views, random)
    else:
        stage, number = categories.stage(name, one.member, one.size, one.views, one.seed), one.member
    return turned(stage, one.size, (one.seed, number)) if one.turned else stage


def plates(path: Path) -> Iterator[Object]:
    """Plates for the triangles of a mesh, centred at the origin, in the mean colours of their corners. Raises
    LumigraphError for a file without a surface."""
    mesh = meshes.read_shape(path, path.stem).mesh
    if not len(mesh.faces):
        raise LumigraphError(f"{path} holds points and no surface, of which there is nothing to photograph")
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    points = mesh.vertices - 0.5 * (low + high)
    points = points * ((RADIUS - THICKNESS) / np.linalg.norm(points, axis=1).max())
    for face in mesh.faces:
        if (plate := triangle_of(points[face].astype(float), THICKNESS)) is not None:
            shape, rotation, position = plate
            red, green, blue = (mesh.colours[face].mean(0) / 255).round(3).tolist()
            paint = Material(Plain((red, green, blue)), gloss=0.3, roughness=0.5)
            yield Object(shape, paint, Pose(tuple(position.tolist()), nested(rotation)), path.stem)


def turned(stage: SyntheticStage, size: int, seed: tuple[int, int]) -> SyntheticStage:
    """The stage with its objects in a random rotation about the origin; light and horizon stay. Cameras are all around.
    `Stage.turn` is the rotation from the upright orientation, if known.

    size: of the square pictures, pixels
    """
    random = np.random.default_rng((*seed, 0x7EEDED))
    motion = Pose(rotation=nested(any_rotation(random)))
    objects = tuple(replace(thing, pose=motion @ thing.pose) for thing in stage.world.objects)
    views, held_out = (len(stage.cameras[split]) for split in ("train", "test"))
    cameras = {
        "train": pinhole(dome(views, CAMERA_DISTANCE, random, -MAX_ELEVATION, MAX_ELEVATION), size, FIELD_OF_VIEW),
        "test": pinhole(spiral(held_out, CAMERA_DISTANCE, random, -MAX_ELEVATION, MAX_ELEVATION), size, FIELD_OF_VIEW),
    }
    bounds = (-BALL_RADIUS, -BALL_RADIUS, -BALL_RADIUS), (BALL_RADIUS, BALL_RADIUS, BALL_RADIUS)
    known = Pose() if stage.turn is None else Pose(rotation=stage.turn)
    world, turn = replace(stage.world, objects=objects), (motion @ known).rotation
    return replace(stage, world=world, cameras=cameras, bounds=bounds, reach=BALL_RADIUS, turn=turn)


def any_rotation(random: np.random.Generator) -> np.ndarray:
    """Uniformly random rotation matrix: the first factor of a Gaussian matrix (Stewart 1980)."""
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))
