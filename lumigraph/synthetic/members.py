"""Collections of procedural objects: "toys,count=200" are many, "toys,member=3" is one of them as a scene of its own.
So are meshes: "path/to/folder" are all that lie in it, "path/to/mesh.obj" is a scene.

Its pictures are traced once and then lie in the user's cache, for a collection is gone through again and again.
"""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from ..capture import meshes
from ..errors import LumigraphError
from ..files.names import natural
from ..files.ranges import Seed, between
from . import categories
from .meshes import mesh_stage
from .options import told
from .stage import SyntheticStage
from .turned import turned

Number = Annotated[int, between(0, 99_999)]


@dataclass(frozen=True)
class Member:
    """size: of the square pictures, pixels; views: to learn from; seed: of everything; turned: 1 for a random rotation;
    member: its number."""

    size: Annotated[int, between(1, 8192)] = 64
    views: Annotated[int, between(1, 10_000)] = 20
    seed: Seed = 0
    turned: Annotated[int, between(0, 1)] = 0
    member: Number = 0


@dataclass(frozen=True)
class Many:
    """Request for many members, like `Member`; count: of members."""

    count: Annotated[int, between(1, 100_000)] = 200
    size: Annotated[int, between(1, 8192)] = 64
    views: Annotated[int, between(1, 10_000)] = 20
    seed: Seed = 0
    turned: Annotated[int, between(0, 1)] = 0


def is_category(request: str) -> bool:
    """True if a request is for objects of a category, or for meshes."""
    return request.partition(",")[0] in categories.available() or path_of(request) is not None


def path_of(request: str) -> Path | None:
    """The folder or the mesh that a request names; None where it names something procedural. A category goes first: a
    folder that is called like one is named ./chairs."""
    name = request.partition(",")[0]
    if name in categories.available():
        return None
    path = Path(name).expanduser()
    return path if path.is_dir() or meshes.is_mesh(path) else None


def is_collection(request: str) -> bool:
    """True if a request is for all members of a category, or all meshes of a folder, rather than for one."""
    if (path := path_of(request)) is not None:
        return path.is_dir()
    return is_category(request) and not any(text.strip().startswith("member=") for text in request.split(",")[1:])


def members_of(request: str) -> dict[str, str]:
    """Request for each member, by its name. Raises LumigraphError for a folder without meshes."""
    name, many = told(Many, request)
    said = {key: value for key, value in asdict(many).items() if key != "count" and (key != "turned" or value)}
    shared = ",".join(f"{key}={value}" for key, value in said.items())
    if (folder := path_of(request)) is None:
        return {f"{name}-{i:04d}": f"{name},member={i},{shared}" for i in range(many.count)}
    found = sorted(filter(meshes.is_mesh, folder.resolve().rglob("*")), key=lambda path: natural(path.as_posix()))
    if not found:
        raise LumigraphError(f"{folder} holds no meshes to photograph; name a folder of {', '.join(meshes.SUFFIXES)}")
    return {meshes.name_of(path, folder.resolve()): f"{path},{shared}" for path in found[: many.count]}


def member_stage(request: str) -> SyntheticStage:
    """One object and the cameras around it."""
    name, one = told(Member, request)
    if (path := path_of(request)) is not None:
        stage, number = mesh_stage(path, one.size, one.views, one.seed), zlib.crc32(path.name.encode())
    else:
        stage, number = categories.stage(name, one.member, one.size, one.views, one.seed), one.member
    return turned(stage, one.size, (one.seed, number)) if one.turned else stage
