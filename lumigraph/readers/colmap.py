"""COLMAP models, binary or text, in the usual folders of programs."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ..camera.lens import Equirectangular, Fisheye, Lens, OpenCV, Pinhole
from ..errors import LumigraphError
from ..files import exists, read_bytes, read_text
from ..files.names import natural
from ..files.reading import reading, reads
from ..system.library import pycolmap
from ..system.memory import free_memory
from .capture import Capture, Shot
from .pictures import reductions, versions
from .points import SparsePoints, read_points3d

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap", ".")
MAX_SIDE = 10**5  # pixels
EXPECTED_FILES = "sparse/0 with cameras, images and points3D, .bin or .txt (COLMAP)"

# COLMAP's models whose distortion begins the list of coefficients that the lenses here have.
PLANAR = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")


def recognises(folder: Path) -> bool:
    return model_folder(folder) is not None


def model_folder(folder: Path) -> Path | None:
    """The first of the usual folders with a complete model."""
    for place in MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            if all((folder / place / f"{part}{suffix}").is_file() for part in ("cameras", "images", "points3D")):
                return folder / place
    return None


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for a damaged model, other cameras, and missing images."""
    place = model_folder(folder)
    assert place is not None
    model = read_model(place)
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: natural(image.name))
    names = [image.name for image in images]
    folders = reductions(folder / "images") or reductions(folder / "input") or {1: folder}
    shots, missing = [], []
    lenses = {k: (read_lens(camera, place), (camera.width, camera.height)) for k, camera in model.cameras.items()}
    for image, files in zip(images, versions(folders, names), strict=True):
        if not files:
            missing.append(image.name)
            continue
        lens, size = lenses[image.camera_id]
        pose = image.cam_from_world().inverse().matrix()
        shots.append(Shot(image.name, pose, lens, size, files))
    if not shots and names:
        raise LumigraphError(
            f"{folders[min(folders)]} holds none of the {len(names)} photographs that {place} lists, "
            f"such as {names[0]}; put them into {folder / 'images'}"
        )
    return Capture(str(folder), shots, missing=missing, **vars(read_points(place, model)))


@reads("holds no readable COLMAP model", "make or copy it again")
def read_model(place: Path) -> pycolmap.Reconstruction:
    """Read a model with pycolmap. Raises LumigraphError for an incomplete or damaged one."""
    if (place / "images.bin").is_file():
        check_whole(place)
        read_points3d(place / "points3D.bin")
    else:
        check_text(place / "images.txt")
    model = pycolmap.Reconstruction(place)
    if (place / "cameras.bin").is_file():
        wanted = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
        if (place / "cameras.bin").stat().st_size < wanted:
            raise ValueError("cameras.bin ends early")
    return model


def check_whole(place: Path) -> None:
    """Walk through a binary model before reading it: with a list length beyond the file's end, pycolmap would allocate
    all memory or run for hours.

    Raises LumigraphError for a truncated list, and for an invalid rotation.
    """
    for name, walk in (("images.bin", walk_images), ("frames.bin", walk_frames), ("rigs.bin", walk_rigs)):
        path = place / name
        if not exists(path):
            continue
        data = read_bytes(path, free_memory())
        with reading(path, "is truncated", "make or copy the model again"):
            if walk(data, path) > len(data):
                raise ValueError("it ends early")


def walk_images(data: bytes, path: Path) -> int:
    """Per image an id, a pose of seven numbers, a camera, a zero-terminated name, and a list of (x, y, point). Returns
    the offset of the list's end, as the other walks do."""
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        quaternion = struct.unpack_from("<4d", data, offset + 4)
        name_ends = data.index(b"\0", offset + 64)
        check_turn(quaternion, data[offset + 64 : name_ends].decode("utf-8", "replace"), path)
        (features,) = struct.unpack_from("<Q", data, name_ends + 1)
        offset = name_ends + 9 + 24 * features
    return offset


def walk_frames(data: bytes, path: Path) -> int:
    """Walk frames: an id and its rig's, a pose of seven numbers, and a list of (sensor's kind, sensor, image)."""
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        check_turn(struct.unpack_from("<4d", data, offset + 8), "a frame", path)
        (images,) = struct.unpack_from("<I", data, offset + 64)
        offset += 68 + 16 * images
    return offset


def walk_rigs(data: bytes, path: Path) -> int:
    """Walk rigs: an id and a number of sensors: the first, then others, each with a pose or without."""
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        (sensors,), offset = struct.unpack_from("<I", data, offset + 4), offset + 8
        offset += 8 if sensors else 0
        for _ in range(sensors - 1):
            (posed,) = struct.unpack_from("<B", data, offset + 8)
            offset += 65 if posed else 9
    return offset


def check_turn(quaternion: Sequence[float], name: str, path: Path) -> None:
    if not any(quaternion):
        raise LumigraphError(f"{path}: the quaternion of {name} is zero, which is no rotation; make the model again")


def check_text(path: Path) -> None:
    """Check the rotations of images.txt, in every second line."""
    lines = iter(read_text(path).splitlines())
    for line in lines:
        words = line.split()
        if words and not words[0].startswith("#"):
            next(lines, "")
            with contextlib.suppress(ValueError):  # pycolmap says what is wrong with it
                check_turn([float(word) for word in words[1:5]] or [1.0], words[-1], path)


def poses_of(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Camera-to-world pose (3, 4) of each placed photograph, by its name."""
    return {i.name: i.cam_from_world().inverse().matrix() for i in model.images.values() if i.has_pose}


def read_points(place: Path, model: pycolmap.Reconstruction) -> SparsePoints:
    if (place / "images.bin").is_file():
        return read_points3d(place / "points3D.bin")  # much quicker than asking the model for each
    found = list(model.points3D.values())
    return SparsePoints(
        np.array([p.xyz for p in found], np.float64).reshape(-1, 3),
        np.array([p.color for p in found], np.uint8).reshape(-1, 3),
        np.array([p.track.length() for p in found], np.int64),
    )


def read_lens(camera: pycolmap.Camera, place: Path) -> Lens:
    kind, p = camera.model.name, torch.tensor(camera.params, dtype=torch.float32)
    if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
        raise LumigraphError(
            f"{place}: camera {camera.camera_id} has pictures of {camera.width}x{camera.height} pixels; make or copy "
            "the model again"
        )
    if kind == "EQUIRECTANGULAR":
        return Equirectangular(torch.tensor([[camera.width, camera.height]], dtype=torch.float32))
    if kind not in PLANAR and kind not in FISHEYE:
        raise LumigraphError(
            f"{place}: camera {camera.camera_id} has model {kind}, which no lens here follows; "
            f"run COLMAP's image_undistorter and use its folder"
        )
    parts = camera.focal_length_idxs(), camera.principal_point_idxs(), camera.extra_params_idxs()
    focal, centre, bends = (p[None, list(part)] for part in parts)
    focal = focal.expand(1, 2).contiguous()
    if kind in FISHEYE:
        return Fisheye(focal, centre, torch.nn.functional.pad(bends, (0, 4 - bends.shape[1])))
    if not bends.any():
        return Pinhole(focal, centre)
    return OpenCV(focal, centre, torch.nn.functional.pad(bends, (0, 8 - bends.shape[1])))
