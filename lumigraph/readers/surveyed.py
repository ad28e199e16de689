"""Depth of photographs from measured geometry: a LiDAR's cloud, a mesh, another camera's depth."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import tempfile
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from .. import kernels
from ..camera import Camera
from ..camera.lens import Lens, Pinhole
from ..depth_maps import back_project
from ..errors import LumigraphError
from ..files import explained
from ..files.reading import reads
from ..geometry import evenly
from ..system.children import start_python
from ..system.memory import ask_for, free_memory
from . import meshes
from .capture import MAX_COORDINATE, Capture, PixelPlane, Shot
from .pictures import stat, upright_size

CLOUD_SUFFIXES = (".las", ".laz", ".e57")
OTHER_CLOUDS = (".pcd", ".xyz", ".pts", ".ptx", ".asc")  # that are known by name and not read
TABLES = (".txt", ".csv", ".dat")  # that may be clouds
CLOUD_COLUMNS = (3, 4, 6, 7, 9, 10)  # of positions, and maybe an intensity, a colour, a normal
SUFFIXES = (*CLOUD_SUFFIXES, *meshes.SUFFIXES)
POINT_BYTES = 200  # of memory for each point while a photograph sees the cloud
WORKER = Path(__file__).with_name("cloud_worker.py")
MIN_MEMORY, MAX_RATIO = 1 << 28, 200  # bytes of a worker for any file; bytes for each byte of a file
MIN_SECONDS, BYTES_PER_SECOND = 5, 1_000_000  # of a worker's processor, and of a file
FEW_THREADS = {
    "RAYON_NUM_THREADS": "4",
    "MALLOC_ARENA_MAX": "1",
    "RUST_BACKTRACE": "0",
}  # each thread reserves addresses
LIBRARIES = {".las": "laspy", ".laz": "laspy", ".e57": "pye57"}
PROBED, MIN_LINES = 4096, 8  # characters of a table, and lines in them
CELL = 3  # pixels along a square whose nearest point hides what is behind it
HIDDEN = 0.03  # of the distance of the nearest point around, behind which a point is hidden
SLOPE = 4.0  # tangent of the angle up to which a slanted surface does not hide itself
CHECKED_POINTS, CHECKED_VIEWS = 2000, 16  # sparse points and photographs by which a file's frame is checked
MAX_OFFSET = 0.05  # of the extent of sparse points, that their median distance from the file's may be
MIN_SEEN = 0.01  # share of a photograph's squares that show something of the file
UNIT_FACTORS = (1000.0, 100.0, 1 / 100.0, 1 / 1000.0)  # between metres, centimetres and millimetres


@dataclass(frozen=True)
class Surveyed:
    """Points, or the vertices of triangles, in the frame of the capture. faces: empty for a cloud"""

    points: Float[np.ndarray, "point 3"]
    faces: Int[np.ndarray, "face 3"]


def with_surveyed(capture: Capture, path: Path) -> Capture:
    """The capture with depth rendered from a cloud or a mesh, replacing any other.

    Raises LumigraphError for a file that cannot be read, and for one in another frame or unit than the capture.
    """
    found = read_surveyed(path)
    check_frame(capture, found, path)
    identity = f"{path.resolve()} {stat(path)}"

    def with_depth(shot: Shot) -> Shot:
        return replace(shot, planes=shot.planes | {"depth": depth_plane(shot, found, identity)})

    return replace(capture, shots=[with_depth(shot) for shot in capture.shots])


def is_cloud(path: Path) -> bool:
    """True for a file of points by its name, and for a table of numbers that may be points."""
    if path.is_dir() or path.suffix.lower() not in TABLES:
        return path.suffix.lower() in (*CLOUD_SUFFIXES, *OTHER_CLOUDS) and not path.is_dir()
    with explained(path), open(path, encoding="utf-8", errors="replace") as opened:
        _, *lines = opened.read(PROBED).splitlines()[:-1] or [""]  # after a line of titles, and not the cut one
    with contextlib.suppress(ValueError):
        widths = {len([float(x) for x in re.split(r"[,;\s]+", line.strip())]) for line in lines}
        return len(lines) >= MIN_LINES and len(widths) == 1 and widths <= {*CLOUD_COLUMNS}
    return False


def describe_cloud(path: Path) -> str:
    """Sentence on a cloud of points that is named where photographs are needed. Raises LumigraphError for a damaged
    one."""
    if path.suffix.lower() not in CLOUD_SUFFIXES:
        return (
            f"{path} is a cloud of points without photographs; convert it to .las or .ply, and it gives depth to "
            "photographs with poses: lumigraph train METHOD SCENE --depth-from FILE"
        )
    points = read_surveyed(path).points
    size = " x ".join(f"{side:.4g}" for side in np.ptp(points, axis=0))
    return (
        f"{path} is a cloud of {len(points):,} points, {size} large, without photographs; it gives depth to "
        f"photographs with poses: lumigraph train METHOD SCENE --depth-from {path}"
    )


@reads("cannot be read as a cloud", "export it once more")
def read_surveyed(path: Path) -> Surveyed:
    """Points or triangles of a file. Raises LumigraphError, naming the package to install if a library is missing."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise LumigraphError(f"{path} is neither a cloud nor a mesh; name a file of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise LumigraphError(f"{path} does not exist; check the path")
    if suffix in CLOUD_SUFFIXES:
        found = Surveyed(read_cloud(path), np.zeros((0, 3), np.int64))
    else:
        mesh = meshes.read_mesh(path)
        found = Surveyed(mesh.vertices, mesh.faces)
    finite = (np.abs(found.points) <= MAX_COORDINATE).all(-1)
    if not len(found.faces):
        found = replace(found, points=found.points[finite])
    if not finite.any():
        raise LumigraphError(f"{path} holds no points; name another file")
    ask_for(
        POINT_BYTES * len(found.points),
        torch.device("cpu"),
        f"{path} has {len(found.points):,} points, which",
        "thin it out in the program that made it",
    )
    return found


def read_cloud(path: Path) -> Float[np.ndarray, "point 3"]:
    """Points of a LiDAR's file, read by `cloud_worker.py` with limits of memory and time by its size. Raises ValueError
    with the reason if that fails."""
    library, size = LIBRARIES[path.suffix.lower()], path.stat().st_size
    if find_spec(library) is None:
        raise LumigraphError(f"{path} needs {library} to be read; install it: pip install 'lumigraph[lidar]'")
    memory = min(max(MIN_MEMORY, MAX_RATIO * size), free_memory())
    seconds = MIN_SECONDS + size // BYTES_PER_SECOND
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "points.npy"
        words = [str(WORKER), str(path.absolute()), str(result), str(memory), str(seconds)]
        pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        environment = os.environ | FEW_THREADS
        with start_python(words, signal.SIGKILL, **pipes, text=True, errors="replace", env=environment) as worker:
            try:
                said = worker.communicate()[1].splitlines()
            except BaseException:
                worker.kill()
                raise
        if worker.returncode:
            reason = said[-1] if said and worker.returncode > 0 else "its numbers contradict its size"
            raise ValueError(reason)
        return np.load(result, allow_pickle=False)


def check_frame(capture: Capture, found: Surveyed, path: Path) -> None:
    """Raise LumigraphError for a file in another frame or unit: sparse points lie elsewhere, or no camera sees it."""
    points = found.points if not len(found.faces) else samples(found)
    if capture.points is not None and len(capture.points) > 10:
        chosen = np.random.default_rng(0).permutation(len(capture.points))[:CHECKED_POINTS]
        sparse = capture.points[chosen]
        extent = float(np.linalg.norm(np.subtract(*np.quantile(sparse, [0.9, 0.1], axis=0))))

        def offset(factor: float) -> float:
            return float(np.median(cKDTree(points * factor).query(sparse)[0])) / max(extent, 1e-12)

        if (share := offset(1.0)) > MAX_OFFSET:
            better = [factor for factor in UNIT_FACTORS if offset(factor) < MAX_OFFSET]
            remedy = f"scale it by {better[0]:g}" if better else "register it to the capture's frame and unit"
            raise LumigraphError(
                f"{path} lies in another frame than {capture.source}: its points are {100 * share:.3g} % of the "
                f"scene's extent away from the sparse points; {remedy} first"
            )
    elif not any(is_seen(shot, points) for shot in evenly(capture.shots, CHECKED_VIEWS)):
        raise LumigraphError(
            f"{path} lies in another frame than {capture.source}: no photograph sees it; register it to the capture's "
            "frame and unit first"
        )


def is_seen(shot: Shot, points: Float[np.ndarray, "point 3"]) -> bool:
    """True if a photograph shows points in more than single squares of it."""
    size = size_of(shot)
    camera = camera_of(shot.pose, shot.lens, size)
    places, inside = camera.locate(torch.from_numpy(points - shot.pose[:, 3]).float())
    cells = torch.unique(places[inside] // max(1, min(size) // 16), dim=0)
    return len(cells) > MIN_SEEN * 16 * 16


def samples(mesh: Surveyed) -> Float[np.ndarray, "point 3"]:
    """Points on a mesh, uniformly by area."""
    random, (a, b, c) = np.random.default_rng(0), mesh.points[mesh.faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    chosen = random.choice(len(area), 100_000, p=area / area.sum())
    u, v = random.random((2, len(chosen), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def depth_plane(shot: Shot, found: Surveyed, identity: str) -> PixelPlane:
    read = partial(seen_depth, shot.pose, shot.lens, size_of(shot), found)
    about = f"{identity} {shot.pose.tolist()} {shot.lens.to_json()}"
    return PixelPlane(read, "distance", dtype=np.dtype(np.float32), identity=about)


def size_of(shot: Shot) -> tuple[int, int]:
    if shot.size is not None:
        return shot.size
    assert isinstance(shot.image, dict)
    return upright_size(shot.image)


def camera_of(pose: Float[np.ndarray, "3 4"], lens: Lens, size: tuple[int, int]) -> Camera:
    """A camera at the origin with a photograph's rotation, since map coordinates may be large."""
    turn = torch.from_numpy(np.concatenate([pose[:, :3], np.zeros((3, 1))], 1)).float()
    return Camera(turn[None], lens, torch.tensor([size]))


def seen_depth(
    pose: Float[np.ndarray, "3 4"], lens: Lens, size: tuple[int, int], found: Surveyed
) -> Float[np.ndarray, "height width"]:
    """Distance along each pixel's ray to the surveyed geometry, NaN without any."""
    camera = camera_of(pose, lens, size)
    points = torch.from_numpy(found.points - pose[:, 3]).float()
    if len(found.faces) and isinstance(lens, Pinhole):
        return mesh_depth(camera, points, torch.from_numpy(found.faces)).numpy()
    if len(found.faces):
        points = torch.from_numpy(samples(found) - pose[:, 3]).float()
    return cloud_depth(camera, points).numpy()


def mesh_depth(camera: Camera, points: Float[Tensor, "point 3"], faces: Int[Tensor, "face 3"]) -> Tensor:
    """Distance along each pixel's ray of the nearest triangle."""
    width, height = camera.size[0].tolist()
    local = points @ camera.pose[0, :, :3]
    assert isinstance(camera.lens, Pinhole)
    pixels = local[:, :2] * camera.lens.focal[0] + local[:, 2:] * camera.lens.centre[0]
    corners = torch.cat([pixels, local[:, 2:]], -1)
    _, depth, number = kernels.rasterize_mesh(corners, torch.zeros(len(points), 1), faces, (width, height))
    cosine = (camera.rays(camera.pixels()).directions @ camera.forward[0]).view(height, width)
    return torch.where(number >= 0, depth / cosine, torch.nan)


def cloud_depth(camera: Camera, points: Float[Tensor, "point 3"]) -> Float[Tensor, "height width"]:
    """Distance of the nearest point in each pixel, NaN without one. Points behind the nearest one in a neighbourhood of
    pixel squares are hidden, since a cloud has gaps:

        d > d_nearest (1 + 0.03 + SLOPE alpha),    alpha the angle from a square's middle to the end of the next one

    points: relative to the camera, which is at the origin
    """
    width, height = camera.size[0].tolist()
    middle = camera.size[0] / 2
    one, beside = camera.rays(torch.stack([middle, middle + torch.tensor([1.0, 0.0])])).directions
    behind = 1 + HIDDEN + SLOPE * 1.5 * CELL * float((one - beside).norm())
    places, inside = camera.locate(points)
    places, away = places[inside], points[inside].norm(dim=-1)
    rows, columns = -(-height // CELL), -(-width // CELL)
    cell = places[:, 0] // CELL * columns + places[:, 1] // CELL
    nearest = torch.full((rows * columns,), torch.inf).scatter_reduce(0, cell, away, "amin")
    around = -torch.nn.functional.max_pool2d(-nearest.view(1, rows, columns), 3, 1, 1).flatten()
    seen = away <= behind * around[cell]
    pixel = places[seen, 0] * width + places[seen, 1]
    depth = torch.full((height * width,), torch.inf).scatter_reduce(0, pixel, away[seen], "amin")
    return torch.where(depth.isfinite(), depth, torch.nan).view(height, width)


def registered(
    stored: Float[np.ndarray, "height width"], lens: Lens, shot_lens: Lens, size: tuple[int, int], shift: np.ndarray
) -> Float[np.ndarray, "height width"]:
    """Reproject depth along the axis of a depth camera to distance of the colour camera; NaN for unknown.

    stored: metres, NaN for unmeasured; lens: of the depth camera; shift: 3x4, from its frame to the other's
    size:   of the photograph; the result has the resolution of the depth
    """
    height, width = stored.shape
    depth = torch.from_numpy(stored.astype(np.float32)).flatten()
    camera = Camera(torch.eye(3, 4)[None], lens, torch.tensor([[width, height]]))
    known = depth.isfinite() & (depth > 0)
    points = back_project(camera, camera.pixels()[known], depth[known], along_axis=True)
    turn, place = torch.from_numpy(shift).float().split([3, 1], -1)
    colours = camera_of(np.eye(3, 4), shot_lens, size).resized(width / size[0])
    return cloud_depth(colours, points @ turn.T + place[:, 0]).numpy()
