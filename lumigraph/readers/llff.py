"""LLFF captures (Mildenhall et al. 2019): poses_bounds.npy, one row of 17 numbers for each image in order of name.

A row has a 3x5 matrix and the nearest and farthest depth seen. The matrix's columns are the camera's down, right and
backward axes, its position, and (height, width, focal length) in pixels. Lens distortion is not in it; it is read from
the COLMAP model of the capture, if that is in the folder.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch

from ..camera.lens import Lens, OpenCV, Pinhole
from ..errors import LumigraphError
from ..files.reading import reading
from .capture import Capture, Shot
from .numbers import load_array
from .pictures import list_images, reductions, versions
from .points import read_points3d

EXPECTED_FILES = {"LLFF": ("poses_bounds.npy",)}
SIMPLE_RADIAL = 2  # COLMAP's number of the lens that LLFF's own script asks for
CAMERA_RECORD = struct.Struct("<QiiQQ4d")  # how many, id, model, width, height; focal length, centre and bend
OTHER_VIEWS = "mv_images"  # of NVIDIA's dynamic scenes (Yoon 2020), whose images/ have a moment each
FOCAL_TOLERANCE = 1e-3  # share of the focal length by which two cameras may differ


def recognises(folder: Path) -> bool:
    return (folder / "poses_bounds.npy").is_file()


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for an array of another shape, and for a number of rows that
    differs from that of images."""
    path = folder / "poses_bounds.npy"
    table = read_table(path)
    folders = reductions(folder / "images")
    listed = {place: list_images(place) for place in folders.values()}
    names = next((names for names in listed.values() if len(names) == len(table)), None)
    if names is None:
        found = ", ".join(f"{len(names)} in {place.name}" for place, names in listed.items()) or "no folder of images"
        raise LumigraphError(f"{path} has poses of {len(table)} images, but there are {found}; restore the images")
    moving = (folder / OTHER_VIEWS).is_dir()
    shots: list[Shot] = []
    bend = bend_of(folder / "sparse/0/cameras.bin")
    for name, files, line in zip(names, versions(folders, names), table, strict=True):
        (pose, (width, height, focal)), depths = camera_of(line), line[15:]
        if not (np.isfinite(line).all() and 1 <= min(height, width) and max(height, width) <= 1e5 and focal > 0):
            raise LumigraphError(f"{path} has no usable numbers for image {name}; make or copy it again")
        size = (round(width), round(height))
        lens = lens_of(width, height, focal, bend)
        moment = float(len(shots)) if moving else None
        shots.append(Shot(name, pose, lens, size, files, time=moment, depths=(float(depths[0]), float(depths[1]))))
    cloud = folder / "sparse/0/points3D.bin"
    points = vars(read_points3d(cloud)) if cloud.is_file() else {}
    note = f"{folder / OTHER_VIEWS}, views of other cameras, is not read; each photograph is of its own moment"
    return Capture(str(folder), shots, notes=[note] if moving else [], **points)


def read_table(path: Path) -> np.ndarray:
    """All rows of a file. Raises LumigraphError for an array of another shape."""
    with reading(path, "is not LLFF's table of 17 numbers for each image", "make or copy it again"):
        table = np.array(load_array(path))
        if table.ndim != 2 or table.shape[1] != 17 or table.dtype.kind != "f":
            raise ValueError(f"it has shape {table.shape} of {table.dtype}")
        return table.astype(np.float64)


def camera_of(line: np.ndarray) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Camera-to-world (3, 4) of a row, and (width, height, focal length) in pixels."""
    down, right, backward, position, (height, width, focal) = line[:15].reshape(3, 5).T
    return np.stack([right, down, -backward, position], -1), (width, height, focal)


def lens_of(width: float, height: float, focal: float, bend: tuple[float, float] | None) -> Lens:
    """A pinhole, or a lens with radial distortion if known for the same focal length, in widths."""
    focals, centre = torch.tensor([[focal, focal]]).float(), torch.tensor([[width / 2, height / 2]]).float()
    if bend is None or abs(bend[0] * width / focal - 1) > FOCAL_TOLERANCE:
        return Pinhole(focals, centre)
    distortion = torch.zeros(1, 8)
    distortion[0, 0] = bend[1]
    return OpenCV(focals, centre, distortion)


def bend_of(path: Path) -> tuple[float, float] | None:
    """Focal length, in widths, and radial distortion of the one camera in a COLMAP file; None for others."""
    data = path.read_bytes() if path.is_file() else b""
    if len(data) != CAMERA_RECORD.size:
        return None
    count, _, model, width, _, focal, _, _, bend = CAMERA_RECORD.unpack(data)
    return (focal / width, bend) if count == 1 and model == SIMPLE_RADIAL and width and bend else None
