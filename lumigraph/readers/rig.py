"""Rigs of static cameras, in the layouts in which benchmarks of moving scenes are published.

    poses_bounds.npy, cam00/ or cam00/images/   Neural 3D Video, Meet Room: a row of LLFF's table for each camera
    models.json, camera_0001/                   Google Immersive: fisheyes
    intri.yml, extri.yml, images/00/            ENeRF-Outdoor, EasyMocap
    cameras_parameters.txt, NAME_FRAME_CAMERA   Technicolor: a line for each camera by number
    train_meta.json, test_meta.json, ims/       Panoptic Sports (Luiten 2023)

Moments are numbers of frames. Where the papers hold out a camera, it is the test split. Films in the place of folders
are opened by `lumigraph capture FOLDER --moving`, which takes these poses.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import LumigraphError
from ..files import is_file, read_json, read_text
from ..files.names import natural
from ..files.ranges import typed
from ..files.reading import reading
from . import llff
from .capture import Capture, Shot
from .pictures import list_images, stem, upright_size
from .transforms import Json, Posed, read_lens, read_pose

EXPECTED_FILES = {
    "a rig, beside its cameras' folders or films": ("poses_bounds.npy",),
    "Google's immersive films": ("models.json",),
    "EasyMocap": ("intri.yml", "extri.yml"),
    "a rig of Technicolor": ("cameras_parameters.txt",),
    "Dynamic 3D Gaussians": ("train_meta.json", "ims/"),
}
TABLE, MODELS, INTRINSICS, EXTRINSICS = "poses_bounds.npy", "models.json", "intri.yml", "extri.yml"
PARAMETERS, METADATA = "cameras_parameters.txt", "train_meta.json"
HELD_OUT = {TABLE: 0, MODELS: 0, PARAMETERS: 10}  # cameras of the published test views, by order
FILM_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi")
MATRIX = re.compile(
    r"^(K|dist|Rot|R|T)_(\S+):\s*!!opencv-matrix\s+rows:.*\s+cols:.*\s+dt:.*\s+data:\s*\[([^\]]*)\]", re.M
)
FRAME = re.compile(r".*?(\d+)_(\d+)")  # number of the frame and of the camera


def recognises(folder: Path) -> bool:
    if is_file(folder / METADATA) and (folder / "ims").is_dir():
        return True
    return calibration(folder) is not None and (len(pictures(folder)) > 1 or len(films(folder)) > 1)


def calibration(folder: Path) -> str | None:
    """Name of the file with the cameras; None without one."""
    found = (name for name in (MODELS, EXTRINSICS, PARAMETERS, TABLE) if is_file(folder / name))
    return next(found, None)


def films(folder: Path) -> list[Path]:
    """Films of the cameras, in the folder or in its `videos`."""
    found = [x for place in (folder, folder / "videos") for x in sorted(place.glob("*.*")) if x.is_file()]
    return [path for path in found if path.suffix.lower() in FILM_SUFFIXES]


def pictures(folder: Path) -> dict[str, list[Path]]:
    """Pictures of each camera in the order of time, cameras by name."""
    if is_file(folder / PARAMETERS):
        found: dict[str, list[tuple[int, Path]]] = {}
        for name in list_images(folder):
            if (match := FRAME.fullmatch(stem(name))) is not None:
                found.setdefault(match[2], []).append((int(match[1]), folder / name))
        return {camera: [path for _, path in sorted(found[camera])] for camera in sorted(found)}
    base = folder / "images" if is_file(folder / EXTRINSICS) else folder
    places = sorted((x for x in base.iterdir() if x.is_dir()), key=lambda x: natural(x.name)) if base.is_dir() else []
    inner = {x.name: x / "images" if (x / "images").is_dir() else x for x in places}
    if is_file(folder / TABLE):
        inner = {name: place for name, place in inner.items() if name.startswith("cam")}
    listed = {name: sorted(list_images(place), key=natural) for name, place in inner.items()}
    return {name: [inner[name] / x for x in names] for name, names in listed.items() if names}


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for films, and for cameras without a pose."""
    if is_file(folder / METADATA):
        return Capture(str(folder), list(panoptic(folder)))
    found, name = pictures(folder), calibration(folder)
    if len(found) < 2:
        raise LumigraphError(
            f"{folder} holds {len(films(folder))} films of cameras whose poses are in {name}; write their frames, with "
            f"these poses: lumigraph capture {folder} --moving"
        )
    cameras, shots = cameras_of(folder, list(found)), []
    held_out = list(found)[min(HELD_OUT[name], len(found) - 1)] if name in HELD_OUT else None
    for camera, files in found.items():
        if camera not in cameras:
            raise LumigraphError(f"{folder / str(name)} has no camera {camera}, whose pictures are there; restore it")
        about = typed(Posed, cameras[camera] | {"file_path": camera}, f"{folder / str(name)}: {camera}")
        size = (round(about.w), round(about.h)) if about.w and about.h else upright_size({1: files[0]})
        pose, lens = read_pose(about, camera), read_lens(about, size, camera)
        split = None if held_out is None else "test" if camera == held_out else "train"
        for moment, path in enumerate(files):
            shots.append(Shot(f"{camera}/{path.name}", pose, lens, size, {1: path}, split=split, time=float(moment)))
    return Capture(str(folder), shots)


def cameras_of(folder: Path, names: Sequence[str]) -> dict[str, Json]:
    """Cameras of a rig by name, as frames of a transforms.json. names: of films or folders, in order. Raises
    LumigraphError for a damaged file, and for a table of another number of cameras."""
    name = calibration(folder)
    path = folder / str(name)
    with reading(path, "does not hold the cameras that its name promises", "restore it from the data set"):
        if name == MODELS:
            return {one["name"]: immersive(one) for one in read_json(path)}
        if name == EXTRINSICS:
            return easymocap(folder)
        if name == PARAMETERS:
            lines = [line.split() for line in read_text(path).splitlines()[1:] if line.strip()]
            table = [technicolor(np.array(line, np.float64)) for line in lines]
        else:
            table = [forward(line) for line in llff.read_table(path)]
    if name == PARAMETERS and all(x.isdecimal() and int(x) < len(table) for x in names):
        return {x: table[int(x)] for x in names}
    if len(table) != len(names):
        raise LumigraphError(f"{path} has {len(table)} cameras, and there are {len(names)} of them; restore the others")
    return dict(zip(names, table, strict=True))


def posed(
    pose: np.ndarray, focal: Sequence[float] | np.ndarray, centre: Sequence[float] | np.ndarray, **more: Any
) -> Json:
    """A frame of a transforms.json. pose: camera-to-world, +y down and +z forward"""
    matrix = np.vstack([pose, [0, 0, 0, 1]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    (fx, fy), (cx, cy) = map(list, (map(float, focal), map(float, centre)))
    return {"transform_matrix": matrix.tolist(), "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy} | more


def inverse(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Camera-to-world of a rotation and a translation from the world to the camera."""
    return np.concatenate([rotation.T, -rotation.T @ translation.reshape(3, 1)], 1)


def forward(line: np.ndarray) -> Json:
    pose, size = llff.camera_of(line)
    width, height, focal = map(float, size)
    return posed(pose, (focal, focal), (width / 2, height / 2), w=width, h=height)


def immersive(one: Json) -> Json:
    rotation = Rotation.from_rotvec(one["orientation"]).as_matrix()  # from the world to the camera
    focal, bends = one["focal_length"], one["radial_distortion"]
    pose = np.concatenate([rotation.T, np.reshape(one["position"], (3, 1))], 1)
    model = "OPENCV_FISHEYE" if one.get("projection_type", "fisheye") == "fisheye" else "OPENCV"
    size = {"w": one["width"], "h": one["height"], "camera_model": model, "k1": bends[0], "k2": bends[1]}
    return posed(pose, (focal, focal * one.get("pixel_aspect_ratio", 1.0)), one["principal_point"], **size)


def technicolor(line: np.ndarray) -> Json:
    """focal length, centre ..., and at last quaternion w x y z and translation from the world to the camera"""
    rotation = Rotation.from_quat(line[[-6, -5, -4, -7]]).as_matrix()
    return posed(inverse(rotation, line[-3:]), (line[0], line[0]), line[1:3])


def easymocap(folder: Path) -> dict[str, Json]:
    found: dict[str, dict[str, np.ndarray]] = {}
    for file in (INTRINSICS, EXTRINSICS):
        for kind, camera, numbers in MATRIX.findall(read_text(folder / file)):
            found.setdefault(camera, {})[kind] = np.array(numbers.replace(",", " ").split(), np.float64)
    cameras = {}
    for camera, one in found.items():
        rotation = one["Rot"].reshape(3, 3) if "Rot" in one else Rotation.from_rotvec(one["R"]).as_matrix()
        k, bends = one["K"].reshape(3, 3), dict(zip(("k1", "k2", "p1", "p2", "k3"), one["dist"].tolist(), strict=False))
        cameras[camera] = posed(
            inverse(rotation, one["T"]), k[[0, 1], [0, 1]], k[:2, 2], camera_model="OPENCV", **bends
        )
    return cameras


def panoptic(folder: Path) -> Iterator[Shot]:
    """Shots of the lists, which have intrinsics and world-to-camera for each camera at each moment."""
    for split in ("train", "test"):
        path = folder / f"{split}_meta.json"
        said = read_json(path) if split == "train" or is_file(path) else {"fn": []}
        with reading(path, "does not hold cameras by moment", "restore it from the data set"):
            for moment, names in enumerate(said["fn"]):
                for i, name in enumerate(names):
                    k, matrix = (np.array(said[key][moment][i], np.float64) for key in ("k", "w2c"))
                    frame = posed(inverse(matrix[:3, :3], matrix[:3, 3]), k[[0, 1], [0, 1]], k[:2, 2], file_path=name)
                    about, size = typed(Posed, frame, path), (int(said["w"]), int(said["h"]))
                    lens, files = read_lens(about, size, name), {1: folder / "ims" / name}
                    yield Shot(name, read_pose(about, name), lens, size, files, split=split, time=float(moment))
