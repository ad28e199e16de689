"""Sparse points that lie beside photographs: PLY files, COLMAP's points3D.bin, and models in another frame."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plyfile
from jaxtyping import Float, UInt8

from ..errors import LumigraphError
from ..files import read_bytes
from ..files.reading import reads
from ..system.memory import free_memory

POSITION_TOLERANCE = 0.02  # of their spread, within which two sets of camera positions belong to one capture


@dataclass(frozen=True)
class SparsePoints:
    """Positions, colours, and how many photographs saw each; fields of `Capture`."""

    points: Float[np.ndarray, "point 3"]
    point_colours: UInt8[np.ndarray, "point 3"]
    sightings: np.ndarray


def read_ply(path: Path) -> SparsePoints:
    """Vertices with x, y, z and, where they have them, red, green, blue, and sightings (in how many photographs)."""
    try:
        vertex = plyfile.PlyData.read(io.BytesIO(read_bytes(path, free_memory())))["vertex"]
        positions = np.stack([np.asarray(vertex[k], np.float64) for k in "xyz"], -1)
        names = {p.name for p in vertex.properties}
        if names >= {"red", "green", "blue"}:
            colours = np.stack([np.asarray(vertex[k]) for k in ("red", "green", "blue")], -1)
            if colours.dtype != np.uint8:
                colours = (colours * 255).round().clip(0, 255).astype(np.uint8)
        else:
            colours = np.full(positions.shape, 128, np.uint8)
        sightings = np.array(vertex["sightings"]) if "sightings" in names else np.full(len(positions), 2)
    except Exception as fault:
        raise LumigraphError(f"{path} cannot be read as a point cloud ({fault}); restore or remove it") from fault
    return SparsePoints(positions, colours, sightings)


@reads("is truncated", "restore or remove it")
def read_points3d(path: Path) -> SparsePoints:
    """COLMAP's points3D.bin by itself: per point an id, x y z, r g b, an error, and a track of (image, feature)."""
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
    """The 4x4 similarity that takes source points onto target points, least squares (Umeyama 1991). None where they do
    not agree to 2% of their spread, or are too few to tell."""
    if len(source) < 4:
        return None
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    spread_a, spread_b = (a**2).sum(), (b**2).sum()
    if min(spread_a, spread_b) == 0:
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = (s * np.diag(sign)).sum() / spread_a * (u @ sign @ vt)
    matrix[:3, 3] = target.mean(0) - matrix[:3, :3] @ source.mean(0)
    left = ((b - a @ matrix[:3, :3].T) ** 2).sum()
    return matrix if left <= POSITION_TOLERANCE**2 * spread_b else None
