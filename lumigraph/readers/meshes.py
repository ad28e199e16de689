"""Shapes from files of meshes and point clouds."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from ..datasets.dataset import splits_of
from ..datasets.mesh import Mesh
from ..datasets.shapes import Shape, Shapes, normalised
from ..errors import LumigraphError, LumigraphWarning
from ..exchange.unpacked_gltf import plain
from ..files import is_file, read_text
from ..files.names import natural
from ..files.ply import columns, plain_names, read_header
from ..files.reading import reads
from ..system.memory import ask_for, free_memory
from ..system.progress import track
from .finding import find_named
from .points import colours_of as ply_colours
from .points import read_vertices

SUFFIXES = (".obj", ".ply", ".off", ".stl", ".glb", ".gltf")
Z_UP_SUFFIXES = (".stl", ".off")  # by custom with +z up; the others have +y up
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # to +z
OFF = re.compile("(ST)?(C)?(N)?(4)?OFF")
MAX_COORDINATE, ZERO_EXTENT = 1e12, 1e-12  # units of a file, from its origin; largest extent that counts as zero
POLYGONS = "vertex_indices", "vertex_index"  # names of lists of corners in PLY files
NORMAL = ["nx", "ny", "nz"]
DEFAULT_GREY = 160  # for meshes without colour
TRIANGLE_BYTES = 500  # of memory for each triangle: its corners, and the tree over all of them


def recognises(path: Path) -> bool:
    """True if a path is a mesh or a point cloud, or a folder with some at its top."""
    return is_mesh(path) or (path.is_dir() and any(is_mesh(file) for file in path.iterdir()))


def is_mesh(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in SUFFIXES


def read_shapes(path: Path, partial: bool = False) -> Shapes:
    """The shape in a file, or the shapes in a folder and its subfolders, each normalised by itself.

    partial: whether they are scans of some sides, see `Shape`
    Of many, every 8th by name is for testing. Warnings in Shapes are LumigraphWarnings too.
    Raises LumigraphError for files without a surface or points.
    """
    found = [path] if path.is_file() else filter(is_mesh, path.rglob("*"))
    files = sorted(found, key=lambda file: natural(file.as_posix()))
    if not files:
        raise LumigraphError(f"{path} holds no meshes; name a file or a folder of {', '.join(SUFFIXES)}")
    read = [read_shape(file, name_of(file, path)) for file in track(files, "Reading meshes", len(files))]
    members = [replace(shape, partial=partial) for shape in read]
    shapes = Shapes(members, splits_of(len(members)), str(path))
    for warning in shapes.warnings:
        warnings.warn(warning, LumigraphWarning, stacklevel=3)
    return shapes


@reads("cannot be read as a shape", "export it once more")
def read_shape(path: Path, name: str) -> Shape:
    """The contents of one file as one shape. Raises LumigraphError for an empty one."""
    made, up = read_mesh(path), None if path.suffix.lower() in Z_UP_SUFFIXES else Y_UP
    return normalised(name, made, None if len(made.faces) else normals_of(path), up)


@reads("cannot be read as a mesh", "export it once more")
def read_mesh(path: Path) -> Mesh:
    """All triangles of a file, or all its points, in its own frame. Raises LumigraphError for an empty one."""
    import trimesh  # which takes a while

    if path.stat().st_size > free_memory():
        raise LumigraphError(f"{path} is larger than the memory that is free; make it smaller")
    suffix, loaded = path.suffix.lower(), None
    if suffix in (".glb", ".gltf"):
        loaded = trimesh.load(io.BytesIO(plain(path)), process=False, file_type="glb")
    elif suffix == ".ply" and not has_texture(path):
        loaded = read_ply(path)
    elif suffix == ".off":
        loaded = read_off(path)
    else:
        loaded = trimesh.load(path, process=False, file_type=suffix[1:], resolver=Beside(path))
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    parts = [part for part in parts if isinstance(part, trimesh.Trimesh | trimesh.PointCloud)]  # no lines
    if suffix == ".stl":
        parts = [with_colours(part, path) for part in parts]
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    clouds = [part for part in parts if len(getattr(part, "vertices", ()))]
    if not meshes and not clouds:
        raise LumigraphError(f"{path} holds neither triangles nor points; name another file")
    if not all(map(is_sound, meshes or clouds[:1])):
        raise LumigraphError(f"{path} has corners without three numbers, or triangles of corners that it has not")
    count = sum(len(part.faces) for part in meshes)
    what, remedy = f"{path} has {count:,} triangles, which", "reduce their number in a mesh editor"
    ask_for(TRIANGLE_BYTES * count, torch.device("cpu"), what, remedy)
    made = joined(meshes) if meshes else cloud(clouds[0])
    if not (np.abs(made.vertices) <= MAX_COORDINATE).all() or not np.ptp(made.vertices, 0).max() > ZERO_EXTENT:
        raise LumigraphError(
            f"{path} has points that are not finite or farther than {MAX_COORDINATE:g} units, or all in one place; "
            "name another file"
        )
    if meshes and not len(made.faces):
        raise LumigraphError(f"{path} has triangles, and none of them has an area; export it once more")
    return made


@dataclass(frozen=True)
class Beside:
    """Files that an .obj names, wherever `find_named` finds them, options before the name passed over. Several
    materials' files on one line are one."""

    path: Path

    def get(self, name: str) -> bytes:
        words = name.split()
        if len(words) > 1 and all(word.lower().endswith(".mtl") for word in words):
            return b"\n".join(self.get(word) for word in words)
        files = (find_named(self.path.parent, " ".join(words[i:])) for i in range(len(words)))
        if (found := next(filter(is_file, files), None)) is None:
            text = f"{self.path} names {name.strip()}, which is not beside it; its colours are left out"
            warnings.warn(text, LumigraphWarning, stacklevel=2)
            raise FileNotFoundError(name)
        return found.read_bytes()

    __getitem__ = get


def has_texture(path: Path) -> bool:
    """True if a PLY file names a picture for its surface, as MeshLab writes it; those are read by trimesh."""
    return any(line.startswith("TextureFile") for line in read_header(path).comments)


def read_ply(path: Path) -> Any:
    """Triangles of a PLY file, its polygons triangulated as fans; its points if it has none."""
    import trimesh

    rows = read_vertices(path, "face", "tristrips")
    vertices, faces = rows["vertex"], rows.get("face", np.empty(0, []))
    positions, colours = np.array(columns(vertices, "xyz", np.float64)), ply_colours(vertices)
    if (strips := rows.get("tristrips")) is not None and len(strips):
        corners = np.concatenate([np.asarray(x) for x in strips[POLYGONS[0]]])
        parts = np.split(corners, np.flatnonzero(corners < 0))
        triangles = trimesh.util.triangle_strips_to_faces([x for part in parts if len(x := part[part >= 0]) > 2])
        return trimesh.Trimesh(positions, triangles, vertex_colors=colours, process=False)
    name = next((name for name in POLYGONS if name in (faces.dtype.names or ())), None)
    if name is None or not len(faces):
        return trimesh.PointCloud(positions, colours)
    triangles, face = fans(faces[name])
    face_colours = None if (found := ply_colours(faces)) is None else found[face]
    return trimesh.Trimesh(positions, triangles, face_colors=face_colours, vertex_colors=colours, process=False)


def read_off(path: Path) -> Any:
    """Triangles of an OFF file (Geomview), its points if it has none; with colours of corners or of polygons.

    Letters of its first word name what follows a corner: a weight (4), normal (N), colour (C), texture (ST).
    """
    import trimesh

    lines = [words for line in read_text(path).splitlines() if (words := line.partition("#")[0].split())]
    kind = OFF.fullmatch(lines[0][0])
    counts, *rows = [words for words in (lines[0][1:] if kind else lines[0], *lines[1:]) if words]
    corners, polygons = int(counts[0]), int(counts[1])
    if not 0 <= corners <= corners + polygons <= len(rows):
        raise ValueError("it ends early")
    table = np.array(rows[:corners], np.float64).reshape(corners, -1)
    texture, _, normal, weight = kind.groups() if kind else (None,) * 4
    positions = table[:, :3] / table[:, 3:4] if weight else table[:, :3]
    before = 3 + bool(weight) + 3 * bool(normal)
    behind = table[:, before : table.shape[1] - 2 * bool(texture)][:, :3]
    colours = bytes_of(behind) if behind.shape[1] == 3 else None
    faces, sizes = rows[corners : corners + polygons], [int(row[0]) for row in rows[corners : corners + polygons]]
    cornered = np.empty(polygons, object)
    cornered[:] = [np.array(row[1 : 1 + size], np.int64) for row, size in zip(faces, sizes, strict=True)]
    triangles, face = fans(cornered)
    if not len(triangles):
        return trimesh.PointCloud(positions, colours)
    further = [row[1 + size :] for row, size in zip(faces, sizes, strict=True)]  # one number is of a table elsewhere
    own = [i for i, words in enumerate(further) if len(words) >= 3]
    of_faces: np.ndarray | None = None
    if own:
        of_faces = np.full((polygons, 3), DEFAULT_GREY, np.uint8)
        of_faces[own] = bytes_of(np.array([further[i][:3] for i in own], np.float64))
        of_faces = of_faces[face]
    return trimesh.Trimesh(positions, triangles, face_colors=of_faces, vertex_colors=colours, process=False)


def bytes_of(colours: Float[np.ndarray, "row 3"]) -> UInt8[np.ndarray, "row 3"]:
    """Colours up to 255, or all up to 1."""
    return (colours * (255 if colours.max(initial=0) <= 1 else 1)).round().clip(0, 255).astype(np.uint8)


def with_colours(part: Any, path: Path) -> Any:
    """Triangles of an STL file with the colours in their 16 spare bits, as VisCAM or, with COLOR= in the header,
    Magics puts them there."""
    spare = getattr(part, "face_attributes", {}).get("stl")
    if spare is None:
        return part
    bits = np.asarray(spare, np.int64).reshape(-1)
    _, magics, default = path.read_bytes()[:80].partition(b"COLOR=")
    own = (bits >> 15 == (0 if magics else 1)) & (bits > 0)
    if not magics and not own.any():
        return part
    channels = np.stack([bits >> shift & 31 for shift in ((0, 5, 10) if magics else (10, 5, 0))], -1)
    others = [*default[:3]] if magics else [DEFAULT_GREY] * 3
    part.visual.face_colors = np.where(own[:, None], np.rint(channels * 255 / 31), others).astype(np.uint8)
    return part


def fans(polygons: np.ndarray) -> tuple[Int[np.ndarray, "triangle 3"], Int[np.ndarray, " triangle"]]:
    """Triangle fans of polygons, and the polygon of each triangle."""
    lengths = np.array([*map(len, polygons)]) if polygons.dtype == object else np.full(*polygons.shape)
    triangles, faces = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for length in np.unique(lengths[lengths >= 3]):
        group = np.flatnonzero(lengths == length)
        some = polygons[group]
        corners = (np.stack([*some]) if some.dtype == object else some).astype(np.int64)
        fan = np.broadcast_to(corners[:, :1], (len(group), length - 2)), corners[:, 1:-1], corners[:, 2:]
        triangles.append(np.stack(fan, -1).reshape(-1, 3))
        faces.append(np.repeat(group, length - 2))
    return np.concatenate(triangles), np.concatenate(faces)


def is_sound(part: Any) -> bool:
    """True if each corner has three numbers, and each triangle three existing corners."""
    vertices, faces = np.asarray(part.vertices), np.asarray(getattr(part, "faces", np.zeros((0, 3), np.int64)))
    threes = vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3
    return threes and not (len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)))


def joined(parts: list[Any]) -> Mesh:
    """One mesh from several, without triangles that have no area."""
    vertices = np.concatenate([np.asarray(part.vertices, np.float64) for part in parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([np.asarray(part.faces) + start for part, start in zip(parts, starts, strict=False)])
    a, b, c = vertices[faces].transpose(1, 0, 2)
    solid = np.linalg.norm(np.cross(b - a, c - a), axis=-1) > 0
    colours = np.concatenate([colours_of(part) for part in parts])
    return Mesh(vertices, faces[solid].astype(np.int64), colours)


def colours_of(part: Any) -> UInt8[np.ndarray, "vertex 3"]:
    """Vertex colours of a file: from vertices, a material or a texture; grey without any.

    Without texture coordinates a material's own colour is used.
    """
    try:
        visual = part.visual
        if visual.kind == "texture" and visual.uv is None:
            return np.broadcast_to(visual.material.main_color[:3], (len(part.vertices), 3)).astype(np.uint8)
        visual = visual if visual.kind in ("vertex", "face") else visual.to_color()
        found = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)
        if part.visual.defined and len(found) == len(part.vertices):
            return found
    except Exception:  # a missing texture must not prevent reading the shape
        pass
    return np.full((len(part.vertices), 3), DEFAULT_GREY, np.uint8)


def cloud(part: Any) -> Mesh:
    points = np.asarray(part.vertices, np.float64)
    colours = np.asarray(getattr(part, "colors", ()))
    if len(colours) != len(points):
        colours = np.full((len(points), 3), DEFAULT_GREY)
    return Mesh(points, np.zeros((0, 3), np.int64), colours[:, :3].astype(np.uint8))


def normals_of(path: Path) -> Float[np.ndarray, "point 3"] | None:
    """Unit normals of a point cloud; None without, or with any that is 0 or NaN."""
    if path.suffix.lower() != ".ply":
        return None
    table = read_vertices(path)["vertex"]
    if not {*NORMAL} <= {*plain_names(table)}:
        return None
    found = columns(table, NORMAL, np.float64)
    length = np.linalg.norm(found, axis=-1, keepdims=True)
    return found / length if (length > 0).all() and np.isfinite(length).all() else None


def name_of(file: Path, folder: Path) -> str:
    return file.stem if file == folder else str(file.relative_to(folder).with_suffix(""))
