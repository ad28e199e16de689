"""RGB-D captures in the layouts of NICE-SLAM (Zhu et al. 2022): Replica as iMAP's authors rendered it, and ScanNet.

Replica: traj.txt, one camera-to-world matrix (16 numbers, rows, OpenCV axes) a line; results/frame000000.jpg and
results/depth000000.png; cam_params.json in the folder or above it. ScanNet: frames/color/0.jpg, frames/depth/0.png,
frames/pose/0.txt (4x4, camera-to-world), frames/intrinsic/intrinsic_color.txt, or the same without frames/. Depth is
along the optical axis, 16 bits, 0 where nothing was measured; ScanNet's in millimetres. Where intrinsic_depth.txt
differs, depth is carried over to the camera of the colours. Lengths are metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ..camera.lens import Pinhole
from ..errors import LumigraphError
from ..files import read_json, read_text
from ..files.names import natural
from ..files.ranges import Positive, Side
from ..files.reading import reading
from .beside import with_depth_points
from .capture import Capture, PixelPlane, Shot
from .numbers import read_numbers
from .pictures import find_file, measure, readable, stat
from .seven_scenes import read_matrix
from .surveyed import registered

EXPECTED_FILES = {"Replica, as NICE-SLAM has it": ("traj.txt", "results/"), "ScanNet": ("color/", "depth/", "pose/")}
MILLIMETRES = 1e-3


@dataclass(frozen=True)
class ReplicaCamera:
    """Intrinsics, with pixel centres at whole numbers. scale: numbers of a depth picture to a metre"""

    w: Side
    h: Side
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    scale: Positive


@dataclass(frozen=True)
class ReplicaParameters:
    camera: ReplicaCamera


def recognises(folder: Path) -> bool:
    return is_replica(folder) or scannet(folder) is not None


def is_replica(folder: Path) -> bool:
    return (folder / "traj.txt").is_file() and (folder / "results").is_dir()


def scannet(folder: Path) -> Path | None:
    """The folder of ScanNet's pictures; None for another layout."""
    for place in (folder / "frames", folder):
        if all((place / name).is_dir() for name in ("color", "depth", "pose")):
            return place
    return None


def read(folder: Path) -> Capture:
    """The capture in a folder, without frames whose pose is not finite. Raises LumigraphError for malformed files."""
    return with_depth_points(read_replica(folder) if is_replica(folder) else read_scannet(folder))


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Pinhole:
    """Pinhole for a principal point that counts pixel centres at integers."""
    return Pinhole(torch.tensor([[fx, fy]]).float(), torch.tensor([[cx + 0.5, cy + 0.5]]).float())


def read_replica(folder: Path) -> Capture:
    places = [folder / "cam_params.json", folder.parent / "cam_params.json"]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise LumigraphError(f"{folder} has no cam_params.json, here or above; copy that of the data set to it")
    said = read_json(path, ReplicaParameters).camera
    lens, shots, missing = pinhole(said.fx, said.fy, said.cx, said.cy), [], []
    lines = [line.split() for line in read_text(folder / "traj.txt").splitlines() if line.strip()]
    for i, words in enumerate(lines):
        with reading(f"{folder / 'traj.txt'}, line {i + 1},", "is no 4x4 matrix", "correct it"):
            pose = np.array(words, np.float64).reshape(4, 4)
        picture, depth = find_file(folder / "results" / f"frame{i:06d}"), folder / "results" / f"depth{i:06d}.png"
        name = f"results/frame{i:06d}"
        if not picture.is_file():
            missing.append(name)
            continue
        planes = {"depth": PixelPlane(depth, "z-depth", 1 / said.scale, unknown=(0,))} if depth.is_file() else {}
        if np.isfinite(pose).all():
            shots.append(Shot(name, pose[:3], lens, (said.w, said.h), {1: picture}, planes=planes))
    return Capture(str(folder), shots, missing=missing, metric=True)


def read_scannet(folder: Path) -> Capture:
    place = scannet(folder)
    assert place is not None
    found = [place / "intrinsic" / "intrinsic_color.txt", place / "intrinsic_color.txt"]
    path = next((file for file in found if file.is_file()), None)
    if path is None:
        raise LumigraphError(f"{place} has no intrinsic/intrinsic_color.txt; export it with the pictures")
    camera = read_matrix(path, 4)
    lens = pinhole(camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2])
    own = path.with_name("intrinsic_depth.txt")
    depth_lens = pinhole(*read_matrix(own, 4)[[0, 1, 0, 1], [0, 1, 2, 2]]) if own.is_file() else None
    shots, missing = [], []
    for file in sorted((place / "pose").glob("*.txt"), key=lambda path: natural(path.name)):
        pose, picture, depth = read_matrix(file, 4), find_file(place / "color" / file.stem), None
        name = f"color/{file.stem}"
        if not picture.is_file():
            missing.append(name)
            continue
        depth = place / "depth" / f"{file.stem}.png"
        plane = PixelPlane(depth, "z-depth", MILLIMETRES, unknown=(0, 65535))
        size = measure(picture)[0]
        if depth_lens is not None and depth.is_file() and differ(depth_lens, measure(depth)[0], lens, size):
            values = partial(registered_file, depth, depth_lens, lens, size)
            identity = f"{depth.resolve()} {stat(depth)} registered"
            plane = PixelPlane(values, "distance", dtype=np.dtype(np.float32), identity=identity)
        if np.isfinite(pose).all():
            planes = {"depth": plane} if depth.is_file() else {}
            shots.append(Shot(name, pose[:3], lens, size, {1: picture}, planes=planes))
    return Capture(str(folder), shots, missing=missing, metric=True)


def differ(depth: Pinhole, depth_size: tuple[int, int], colour: Pinhole, size: tuple[int, int]) -> bool:
    """True if the two cameras' views differ by more than a pixel of the depth."""
    as_depth = colour.resized(torch.tensor([depth_size]) / torch.tensor([size]))
    assert isinstance(as_depth, Pinhole)
    edges = torch.tensor([[0.0, 0.0], list(map(float, depth_size))])
    seen = [(edges - lens.centre) / lens.focal * depth.focal for lens in (depth, as_depth)]
    return bool((seen[0] - seen[1]).abs().max() > 1)


def registered_file(path: Path, depth: Pinhole, colour: Pinhole, size: tuple[int, int]) -> np.ndarray:
    """Depth of a file, reprojected to the colour camera. Both have one position, as in ScanNet's export."""
    with readable(path):
        stored = read_numbers(path, "depth").astype(np.float64)
    metres = np.where((stored == 0) | (stored == 65535), np.nan, MILLIMETRES * stored)
    return registered(metres, depth, colour, size, np.eye(3, 4))
