"""Sparse points in files beside photographs: PLY, COLMAP's points3D.bin, and models in another frame."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from ..errors import LumigraphError
from ..files import read_bytes
from ..files.ply import columns, plain_names, read_header, read_rows
from ..files.reading import reads
from ..system.memory import free_memory

COLOURS = ["red", "green", "blue"]
POSITION_TOLERANCE = 0.02  # of their spread, within which two sets of camera positions belong to one capture


@dataclass(frozen=True)
class SparsePoints:
    """Positions, colours, and numbers of sightings; fields of `Capture`."""

    points: Float[np.ndarray, "point 3"]
    point_colours: UInt8[np.ndarray, "point 3"]
    sightings: np.ndarray


def read_ply(path: Path) -> SparsePoints:
    """Vertices with x, y, z and, if present, red, green, blue, and sightings (number of photographs)."""
    vertex = read_vertices(path)["vertex"]
    positions, colours = np.array(columns(vertex, "xyz", np.float64)), colours_of(vertex)
    if colours is None:
        colours = np.full(positions.shape, 128, np.uint8)
    has_sightings = "sightings" in plain_names(vertex)
    sightings = np.array(vertex["sightings"]) if has_sightings else np.full(len(positions), 2)
    return SparsePoints(positions, colours, sightings)


def read_vertices(path: Path, *further: str) -> dict[str, np.ndarray]:
    """Vertices of a PLY file, and further elements if any. Raises LumigraphError without x, y and z."""
    header = read_header(path)
    if not {*"xyz"} <= {*header.properties.get("vertex", [])}:
        raise LumigraphError(f"{path} has no vertices with x, y and z; name another file")
    return read_rows(path, ["vertex", *further], header)


def colours_of(rows: np.ndarray) -> UInt8[np.ndarray, "row 3"] | None:
    """red, green and blue of a PLY file's rows, maybe as diffuse_red or r: integers up to 255 or to 65535, or floats
    up to 1 or to 255. None without them."""
    here = {*plain_names(rows)}
    forms = COLOURS, [f"diffuse_{name}" for name in COLOURS], [*"rgb"]
    names = next((x for x in forms if {*x} <= here), None)
    if names is None:
        return None
    found = np.stack([rows[name] for name in names], -1)
    if found.dtype.kind in "ui" and found.max(initial=0) > 255:
        found = np.rint(found / 257)
    if found.dtype.kind == "f":
        found = np.nan_to_num(found * (1 if found.max(initial=0) > 1 else 255)).round()
    return found.clip(0, 255).astype(np.uint8)


@reads("is truncated", "restore or remove it")
def read_points3d(path: Path) -> SparsePoints:
    """COLMAP's points3D.bin: per point an id, x y z, r g b, an error, and a track of (image, feature)."""
    data = read_bytes(path, free_memory())
    (count,), offset = struct.unpack_from("<Q", data), 8
    positions, colours, sightings = [], [], []
    for _ in range(count):
        _, x, y, z, r, g, b, _, track = struct.unpack_from("<Q3d3BdQ", data, offset)
        positions.append((x, y, z))
        colours.append((r, g, b))
        sightings.append(track)
        offset += 51 + 8 * track
        if offset > len(data):
            raise ValueError("it ends early")
    return SparsePoints(
        np.array(positions).reshape(-1, 3), np.array(colours, np.uint8).reshape(-1, 3), np.array(sightings)
    )


def similarity(source: Float[np.ndarray, "point 3"], target: Float[np.ndarray, "point 3"]) -> np.ndarray | None:
    """The 4x4 least-squares similarity from source to target points. None for a residual above 2% of their spread, or
    too few points."""
    if len(source) < 4 or min(np.ptp(source), np.ptp(target)) == 0:
        return None
    matrix = umeyama(source, target)
    left = ((target - source @ matrix[:3, :3].T - matrix[:3, 3]) ** 2).sum()
    return matrix if left <= POSITION_TOLERANCE**2 * ((target - target.mean(0)) ** 2).sum() else None


def umeyama(source: Float[np.ndarray, "point 3"], target: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "4 4"]:
    """The 4x4 least-squares similarity from source to target points (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    matrix = np.eye(4)
    matrix[:3, :3] = (s * np.diag(sign)).sum() / (a**2).sum() * (u @ sign @ vt)
    matrix[:3, 3] = target.mean(0) - matrix[:3, :3] @ source.mean(0)
    return matrix
