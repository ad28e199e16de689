"""COLMAP models, binary or text, in the usual folders of programs."""

from __future__ import annotations

import contextlib
import re
import struct
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from ..camera.lens import (
    Division,
    EnhancedUnified,
    Equirectangular,
    FieldOfView,
    Fisheye,
    Lens,
    OpenCV,
    Pinhole,
    RadialThinPrism,
    ThinPrism,
)
from ..errors import LumigraphError
from ..files import exists, explained, is_file, read_bytes, read_text
from ..files.names import counted, natural
from ..files.reading import reading, reads
from ..system.library import pycolmap
from ..system.memory import free_memory
from .capture import Capture, Shot
from .finding import find_named
from .pictures import reductions, versions
from .points import SparsePoints, read_ply, read_points3d

BASES = (".", "colmap", "dense", "dense/0", "undistorted")  # folders in which programs leave sparse/ or sparse/0
PARTS = ("cameras", "images")  # of a whole model; points are in points3D of the same suffix, or in points3D.ply
MAX_SIDE = 10**5  # pixels
NUMBER = re.compile(r"[-+.\deE]+")
POINT_WORDS = 8  # of a line of points3D.txt before its track
IMAGE_WORDS = 10  # of a line of images.txt; the last is the name, and may have spaces
EXPECTED_FILES = {"COLMAP": ("sparse/0/cameras.*", "sparse/0/images.*")}

# COLMAP's models whose distortion begins the list of coefficients that the lenses here have.
PLANAR = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
ALIKE = {  # lenses here that take COLMAP's coefficients in its order
    "FOV": FieldOfView,
    "SIMPLE_DIVISION": Division,
    "DIVISION": Division,
    "RAD_TAN_THIN_PRISM_FISHEYE": RadialThinPrism,
}
THIN_PRISM, ENHANCED = "THIN_PRISM_FISHEYE", "EUCM"
PRISM_ORDER = [0, 1, 4, 5, 2, 3, 6, 7]  # of its k1 k2 p1 p2 k3 k4 sx1 sy1, for the lens here
FISHEYE = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")


def recognises(folder: Path) -> bool:
    return model_folder(folder) is not None


def model_folder(folder: Path) -> Path | None:
    """The model that is used of those in a folder."""
    return next(iter(model_folders(folder)), None)


def model_folders(folder: Path) -> list[Path]:
    """Whole models of the first place that has any, the one of most photographs first."""
    for base in BASES:
        for place in (folder / base / "sparse", folder / base):
            numbered = [one for one in place.iterdir() if one.name.isdecimal()] if place.is_dir() else []
            found = [one for one in (*sorted(numbered, key=lambda one: natural(one.name)), place) if suffix_of(one)]
            if found:
                return sorted(found, key=lambda one: -image_count(one))
    return []


def suffix_of(place: Path) -> str | None:
    """Suffix of the files of a whole model, rather one with points; None where there is none."""
    found = [x for x in (".bin", ".txt") if all(is_file(place / f"{part}{x}") for part in PARTS)]
    return max(found, key=lambda x: is_file(place / f"points3D{x}"), default=None)


def image_count(place: Path) -> int:
    """Number of photographs that a model places, by its list."""
    if suffix_of(place) == ".bin":
        with explained(place), open(place / "images.bin", "rb") as file:
            return int.from_bytes(file.read(8), "little")
    return sum(1 for _ in image_lines(read_text(place / "images.txt").splitlines()))


def image_lines(lines: Sequence[str]) -> Iterator[int]:
    """Numbers of the lines of images.txt that describe a photograph; each is followed by a line of its features, which
    some programs leave out."""
    number = 0
    while number < len(lines):
        if lines[number].strip() and not lines[number].startswith("#"):
            yield number
            number += 1 if has_features(lines, number) else 0
        number += 1


def has_features(lines: Sequence[str], number: int) -> bool:
    """True unless another photograph, whose line ends in a name, follows at once."""
    following = lines[number + 1].split()[-1:] if number + 1 < len(lines) else []
    return not following or NUMBER.fullmatch(following[0]) is not None


def image_folders(folder: Path, place: Path, names: Sequence[str]) -> dict[int, Path]:
    """Folders of the photographs of a model, by how many times they are reduced: `images` or `input` beside it or up to
    two folders above, else the one folder of the scene that has the first name."""
    above = [one for one in (folder, *place.parents) if one == folder or folder in one.parents]
    for base in (*above, folder.parent, folder.parent.parent):
        for name in ("images", "input"):
            if found := reductions(base / name):
                return found
    holding = [one for one in folder.iterdir() if names and is_file(one / names[0])]
    return {1: holding[0] if len(holding) == 1 else folder}


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for a damaged model, a camera model our lenses cannot follow, and
    absent image folders."""
    place, *others = model_folders(folder)
    model = read_model(place)
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: natural(image.name))
    names = [image.name for image in images]
    folders = image_folders(folder, place, names)
    shots, missing = [], []
    lenses = {k: (read_lens(camera, place), (camera.width, camera.height)) for k, camera in model.cameras.items()}
    for image, files in zip(images, versions(folders, names), strict=True):
        if not files and is_file(named := find_named(folders[min(folders)], image.name)):
            files = {1: named}
        if not files:
            missing.append(image.name)
            continue
        lens, size = lenses[image.camera_id]
        pose = image.cam_from_world().inverse().matrix()
        shots.append(Shot(image.name, pose, lens, size, files))
    if not shots and names:
        raise LumigraphError(
            f"{folders[min(folders)]} holds none of the {len(names)} photographs that {place} lists: looked for "
            f"{names[0]} and its end there and in {folder}; put the photographs into {folder / 'images'}"
        )
    notes = [about_models(place, others)] if others else []
    points = read_points(place, model)
    cloud = vars(points) if len(points.points) else {}
    return Capture(str(folder), shots, missing=missing, notes=notes, **cloud)


def about_models(place: Path, others: Sequence[Path]) -> str:
    """A sentence on the models that are not used."""
    rest = ", ".join(f"{counted(image_count(other), 'photograph')} in {other.name}" for other in others)
    return (
        f"{place.parent} has {1 + len(others)} models, each with a frame of its own; the largest, {place.name}, is "
        f"used, without {rest}"
    )


@reads("holds no readable COLMAP model", "make or copy it again")
def read_model(place: Path) -> pycolmap.Reconstruction:
    """Read a model with pycolmap. Raises LumigraphError for an incomplete or damaged one."""
    binary = suffix_of(place) == ".bin"
    if binary:
        check_whole(place)
    else:
        check_text(place / "images.txt")
    model = read_binary_model(place) if binary else read_text_model(place)
    if binary:
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
    """Look at the rotations of images.txt."""
    lines = read_text(path).splitlines()
    for number in image_lines(lines):
        words = lines[number].split(maxsplit=IMAGE_WORDS - 1)
        with contextlib.suppress(ValueError):  # pycolmap says what is wrong with it
            check_turn([float(word) for word in words[1:5]] or [1.0], words[-1], path)


def read_binary_model(place: Path) -> pycolmap.Reconstruction:
    """A binary model, also one without points, as exporters leave out what they do not have; and one whose rigs and
    frames are those of another state, as programs leave them that know images alone. Each image has its pose."""
    if is_file(place / "points3D.bin"):
        read_points3d(place / "points3D.bin")
        with contextlib.suppress(IndexError, ValueError):
            return pycolmap.Reconstruction(place)
    with tempfile.TemporaryDirectory() as whole:
        for path in (place / f"{name}.bin" for name in (*PARTS, "points3D") if is_file(place / f"{name}.bin")):
            (Path(whole) / path.name).symlink_to(path.resolve())
        if not is_file(place / "points3D.bin"):
            (Path(whole) / "points3D.bin").write_bytes(bytes(8))
        return pycolmap.Reconstruction(whole)


def read_text_model(place: Path) -> pycolmap.Reconstruction:
    """A model as text, without rigs and frames, for each image has its pose. A name is the rest of its line, spaces and
    all, which pycolmap ends at the first. A comma is a decimal point, as programs write it in some countries."""
    names: dict[str, str] = {}
    bare = False
    with tempfile.TemporaryDirectory() as plain:
        for path in (place / f"{name}.txt" for name in (*PARTS, "points3D") if is_file(place / f"{name}.txt")):
            lines = read_text(path).splitlines()
            for number in image_lines(lines) if path.name == "images.txt" else ():
                *numbers, name = lines[number].split(maxsplit=IMAGE_WORDS - 1)
                names[f"{number}.png"] = name.strip()
                bare = bare or not has_features(lines, number)
                lines[number] = " ".join([*numbers, f"{number}.png"]) + ("" if has_features(lines, number) else "\n")
            if bare and path.name == "points3D.txt":  # tracks of features that are not there
                lines = [" ".join(line.split()[:POINT_WORDS]) for line in lines if not line.startswith("#")]
            (Path(plain) / path.name).write_text("\n".join(lines).replace(",", ".") + "\n\n")
        (Path(plain) / "points3D.txt").touch()
        model = pycolmap.Reconstruction(plain)
    for image in model.images.values():
        image.name = names[image.name]
    return model


def poses_of(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Camera-to-world pose (3, 4) of each placed photograph, by its name."""
    return {i.name: i.cam_from_world().inverse().matrix() for i in model.images.values() if i.has_pose}


def read_points(place: Path, model: pycolmap.Reconstruction) -> SparsePoints:
    if suffix_of(place) == ".bin" and is_file(place / "points3D.bin"):
        return read_points3d(place / "points3D.bin")  # much quicker than asking the model for each
    if not model.points3D and is_file(place / "points3D.ply"):
        return read_ply(place / "points3D.ply")
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
    if kind not in (*PLANAR, *FISHEYE, *ALIKE, THIN_PRISM, ENHANCED):
        raise LumigraphError(
            f"{place}: camera {camera.camera_id} has model {kind}, which no lens here follows; "
            f"run COLMAP's image_undistorter and use its folder"
        )
    parts = camera.focal_length_idxs(), camera.principal_point_idxs(), camera.extra_params_idxs()
    focal, centre, bends = (p[None, list(part)] for part in parts)
    focal = focal.expand(1, 2).contiguous()
    if kind == THIN_PRISM:
        return ThinPrism(focal, centre, bends[:, PRISM_ORDER])
    if kind == ENHANCED:
        return EnhancedUnified(focal, centre, *bends.split(1, 1))
    if kind in ALIKE:
        return ALIKE[kind](focal, centre, bends)
    if kind in FISHEYE:
        return Fisheye(focal, centre, torch.nn.functional.pad(bends, (0, 4 - bends.shape[1])))
    if not bends.any():
        return Pinhole(focal, centre)
    return OpenCV(focal, centre, torch.nn.functional.pad(bends, (0, 8 - bends.shape[1])))
