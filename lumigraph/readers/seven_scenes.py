"""RGB-D captures in the layout of 7-Scenes (Shotton et al. 2013), which 3DMatch and others share.

frame-000000.color.png (or .jpg), frame-000000.depth.png and frame-000000.pose.txt, here or in folders seq-01, seq-02...
Poses are 4x4, camera-to-world, of the depth camera, in metres. Depth is along the optical axis: 16 bits, millimetres, 0
and 65535 where nothing was measured. camera-intrinsics.txt has a 3x3 matrix; without one the data set's own is taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from ..camera.lens import Pinhole
from ..files import read_text
from ..files.reading import reading
from .beside import with_depth_points
from .capture import Capture, PixelPlane, Shot
from .pictures import find_file, measure

EXPECTED_FILES = {"7-Scenes, 3DMatch": ("frame-*.color.*", "frame-*.pose.txt")}
POSE_SUFFIX = ".pose.txt"
KINECT_INTRINSICS = np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]])  # as published with 7-Scenes


def recognises(folder: Path) -> bool:
    return next(poses(folder), None) is not None


def poses(folder: Path) -> Iterator[Path]:
    """Files of poses, in the folder and in those of its sequences."""
    for pattern in (f"frame-*{POSE_SUFFIX}", f"seq-*/frame-*{POSE_SUFFIX}"):
        yield from sorted(folder.glob(pattern))


def read(folder: Path) -> Capture:
    """The capture in a folder, without frames of lost tracking. Raises LumigraphError for files without a matrix."""
    matrix = folder / "camera-intrinsics.txt"
    camera = read_matrix(matrix, 3) if matrix.is_file() else KINECT_INTRINSICS
    lens = Pinhole(
        torch.tensor([[camera[0, 0], camera[1, 1]]]).float(), torch.tensor([[camera[0, 2], camera[1, 2]]]).float()
    )
    shots, missing = [], []
    for path in poses(folder):
        pose, stem = read_matrix(path, 4), path.name.removesuffix(POSE_SUFFIX)
        picture, depth = find_file(path.with_name(f"{stem}.color")), path.with_name(f"{stem}.depth.png")
        name = picture.relative_to(folder).as_posix()
        if not picture.is_file():
            missing.append(name)
            continue
        if not np.isfinite(pose).all():
            continue
        planes = {"depth": PixelPlane(depth, "z-depth", 1e-3, unknown=(0, 65535))} if depth.is_file() else {}
        shots.append(Shot(name, pose[:3], lens, measure(picture)[0], {1: picture}, planes=planes))
    return with_depth_points(Capture(str(folder), shots, missing=missing, metric=True))


def read_matrix(path: Path, size: int) -> np.ndarray:
    with reading(path, f"holds no {size}x{size} matrix", "correct or remove it"):
        return np.array(read_text(path).split(), np.float64).reshape(size, size)
