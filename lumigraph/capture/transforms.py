"""transforms.json, as instant-ngp and nerfstudio write it: one file with a pose, and maybe a lens, for each photograph.

Its cameras look along -z with +y up (OpenGL). Published splits are nerfstudio's train_filenames, test_filenames and
val_filenames.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..errors import LumigraphError
from ..files import read_json
from ..lens import Equirectangular, Fisheye, Lens, OpenCV, Pinhole
from . import colmap
from .capture import Capture, Plane, Shot
from .pictures import EXIF_SIDEWAYS, find_file, measure, reductions, versions
from .points import SparsePoints, read_ply, similarity

LOOKED_FOR = "transforms.json (instant-ngp, nerfstudio)"
OPENCV_FROM_OPENGL = np.array([1.0, -1.0, -1.0])  # signs of the camera's axes
NGP_SCALE = 0.33  # instant-ngp's unit cube is 1 / 0.33 of the file's units wide

# Of a layer, what a frame may call its file: nerfstudio's name or instant-ngp's, and what annotated captures say.
PLANES = {
    "depth": ("depth_file_path", "depth_path"),
    "labels": ("labels_file_path", "semantics_path"),
    "normals": ("normals_file_path",),
}
FACTS = ("exposure", "boxes", "body")  # of a photograph
NOTHING = (1e10, 65504.0)  # depth that Blender writes where nothing is, in floats and in halves

Json = dict[str, Any]


def recognises(folder: Path) -> bool:
    return (folder / "transforms.json").is_file()


def read(folder: Path) -> Capture:
    """The capture in a folder.

    Raises LumigraphError for malformed JSON, frames without a usable pose, and unknown lenses.
    """
    path = folder / "transforms.json"
    whole = read_frames_file(path)
    splits = published_splits(whole)
    shots, missing = read_shots(path, whole)
    if splits:
        shots = [replace(shot, split=splits[shot.name]) for shot in shots if shot.name in splits]
        missing = [name for name in missing if name in splits]
    points = find_points(folder, whole, shots, missing)
    reach = None
    if points is None and "aabb_scale" in whole:
        reach = 0.5 * float(whole["aabb_scale"]) / float(whole.get("scale", NGP_SCALE))
    return Capture(
        str(folder),
        shots,
        None if points is None else points.positions,
        None if points is None else points.colours,
        None if points is None else points.sightings,
        missing,
        reach=reach,
        up=read_up(path, whole),
    )


def read_up(path: Path, whole: Json) -> tuple[float, float, float] | None:
    """Which way is up, where the file says so, as instant-ngp's may."""
    if "up" not in whole:
        return None
    try:
        x, y, z = (float(value) for value in whole["up"])
    except (TypeError, ValueError):
        x = y = z = math.nan
    if not 0 < math.hypot(x, y, z) < math.inf:
        raise LumigraphError(f'{path}: "up" should be three numbers, and is {whole["up"]!r}; correct it or remove it')
    return x, y, z


def read_frames_file(path: Path) -> Json:
    whole = read_json(path)
    if not isinstance(whole, dict) or not isinstance(whole.get("frames"), list):
        raise LumigraphError(f'{path} has no list called "frames"; it is not a file of camera poses')
    return whole


def read_shots(path: Path, whole: Json, split: str | None = None) -> tuple[list[Shot], list[str]]:
    """The photographs that a file lists and that exist, and the names of those that do not."""
    folder, shots, missing = path.parent, [], []
    for number, frame in enumerate(whole["frames"]):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise LumigraphError(f'{path}: frame {number} has no "file_path"; add it or remove the frame')
    names = [frame["file_path"] for frame in whole["frames"]]
    for name, frame, files in zip(names, whole["frames"], find_versions(folder, names), strict=True):
        if not files:
            missing.append(name)
            continue
        about, where = {**whole, **frame}, f"{path}: frame {name}"
        size = stated_size(about, where) or upright_size(files)
        shots.append(
            Shot(
                name=name,
                pose=read_pose(frame, where),
                lens=read_lens(about, size, where),
                size=size,
                image=files,
                mask=folder / about["mask_path"] if isinstance(about.get("mask_path"), str) else None,
                split=split,
                time=number_or_none(about, "time", where),
                planes=read_planes(path.parent, about, read_lens(about, size, where), where, missing),
                about={name: about[name] for name in FACTS if name in frame},
            )
        )
    return shots, missing


def read_planes(folder: Path, about: Json, lens: Lens, where: str, missing: list[str]) -> dict[str, Plane]:
    """Depth, labels and normals whose files a frame names; what it names and is not there joins `missing`."""
    found = {}
    for name, keys in PLANES.items():
        key = next((key for key in keys if isinstance(about.get(key), str)), None)
        if key is None:
            continue
        file = find_file(folder / about[key])
        if not file.is_file():
            missing.append(about[key])
        elif name == "depth":
            found[name] = depth_plane(file, key, about, lens, where)
        else:
            found[name] = Plane(file, {"labels": "index", "normals": "direction"}[name])
    return found


def depth_plane(file: Path, key: str, about: Json, lens: Lens, where: str) -> Plane:
    """Depth as nerfstudio stores it, thousandths of a unit unless the file says otherwise, or as instant-ngp does."""
    stated = number_or_none(about, "integer_depth_scale" if key == "depth_path" else "depth_unit_scale_factor", where)
    scale = stated if stated is not None else 1.0 if file.suffix.lower() == ".exr" else 1e-3
    along_ray = isinstance(lens, Equirectangular) or bool(about.get("is_euclidean_depth"))
    whole = file.suffix.lower() in (".png", ".tif", ".tiff")
    unknown, empty = ((0.0, 65535.0), ()) if whole else ((0.0,), NOTHING)
    return Plane(file, "distance" if along_ray else "z-depth", scale, unknown, empty)


def find_versions(folder: Path, names: list[str]) -> list[dict[int, Path]]:
    """Each photograph's own file, and reduced ones where it lies in `images` and there are images_2, images_4..."""
    files = [find_file(folder / name) for name in names]
    found = [{1: path} if path.is_file() else {} for path in files]
    inside = [i for i, path in enumerate(files) if path.parent == folder / "images"]
    for i, more in zip(inside, versions(reductions(folder / "images"), [files[i].name for i in inside]), strict=True):
        found[i] |= more
    return found


def upright_size(files: dict[int, Path]) -> tuple[int, int]:
    (width, height), orientation = measure(files[min(files)])
    width, height = width * min(files), height * min(files)
    return (height, width) if orientation in EXIF_SIDEWAYS else (width, height)


def read_pose(frame: Json, where: str) -> np.ndarray:
    try:
        pose = np.array(frame["transform_matrix"], np.float64)
        assert pose.shape in ((4, 4), (3, 4))
    except (KeyError, ValueError, TypeError, AssertionError) as fault:
        raise LumigraphError(
            f"{where} has no 4x4 transform_matrix of numbers; correct it or remove the frame"
        ) from fault
    pose = pose[:3].copy()
    pose[:, :3] *= OPENCV_FROM_OPENGL
    return pose


def number_or_none(about: Json, key: str, where: str) -> float | None:
    value = about.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise LumigraphError(f'{where} has "{key}": {value!r}, which is no number; correct it')
    return float(value)


def stated_size(about: Json, where: str) -> tuple[int, int] | None:
    width, height = (number_or_none(about, key, where) for key in "wh")
    if width is None or height is None:
        return None
    if width < 1 or height < 1:
        raise LumigraphError(f"{where} has a picture of {width:g}x{height:g} pixels; correct w and h")
    return round(width), round(height)


def read_lens(about: Json, size: tuple[int, int], where: str) -> Lens:
    def get(key: str, otherwise: float | None = None) -> float:
        value = number_or_none(about, key, where)
        if value is None and otherwise is None:
            raise LumigraphError(f'{where} has neither "fl_x" nor "camera_angle_x"; add the focal length in pixels')
        return otherwise if value is None else value  # type: ignore[return-value]

    width, height = size
    model = "OPENCV_FISHEYE" if about.get("is_fisheye") else str(about.get("camera_model", "OPENCV")).upper()
    if model in ("EQUIRECTANGULAR", "SPHERICAL"):
        return Equirectangular(row(width, height))
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV_FISHEYE"):
        raise LumigraphError(
            f"{where} has camera_model {model}; only PINHOLE, OPENCV, OPENCV_FISHEYE and EQUIRECTANGULAR are known, "
            f"so undistort the photographs first"
        )
    focal_x = focal_from_angle(about, "camera_angle_x", width, where) if about.get("fl_x") is None else get("fl_x")
    focal_y = get("fl_y", focal_from_angle(about, "camera_angle_y", height, where) or focal_x)
    focal_x = get("fl_x", focal_x)
    if min(focal_x, focal_y) <= 0:
        raise LumigraphError(f"{where} has focal length {focal_x:g} x {focal_y:g}; it must be positive")
    focal, centre = row(focal_x, focal_y), row(get("cx", width / 2), get("cy", height / 2))
    if model == "OPENCV_FISHEYE":
        return Fisheye(focal, centre, row(*(get(f"k{i}", 0) for i in (1, 2, 3, 4))))
    bends = [get(key, 0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    if model == "OPENCV" and any(bends):
        return OpenCV(focal, centre, row(*bends))
    return Pinhole(focal, centre)


def focal_from_angle(about: Json, key: str, pixels: int, where: str) -> float | None:
    angle = number_or_none(about, key, where)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise LumigraphError(f'{where} has "{key}": {angle:g}, which is no field of view in radians; correct it')
    return 0.5 * pixels / math.tan(0.5 * angle)


def row(*numbers: float) -> torch.Tensor:
    return torch.tensor([numbers], dtype=torch.float32)


def published_splits(whole: Json) -> dict[str, str]:
    """nerfstudio's lists of file names, as name to split."""
    lists = {split: whole.get(f"{split}_filenames") for split in ("train", "val", "test")}
    if not any(lists.values()):
        return {}
    if not lists["test"]:
        lists["test"], lists["val"] = lists["val"], None
    return {name: split for split, names in lists.items() for name in names or []}


def find_points(folder: Path, whole: Json, shots: list[Shot], missing: list[str]) -> SparsePoints | None:
    """The points a file names, else those of a COLMAP model of the same photographs, turned into this file's frame."""
    if isinstance(name := whole.get("ply_file_path"), str):
        if (folder / name).is_file():
            return read_ply(folder / name)
        missing.append(name)
    place = colmap.model_folder(folder)
    if place is None:
        return None
    positions = {Path(s.name).stem: s.pose[:, 3] for s in shots}
    model = colmap.read_model(place)
    found = {Path(name).stem: position for name, position in colmap.positions(model).items()}
    both = sorted(positions.keys() & found.keys())
    matrix = similarity(np.array([found[k] for k in both]), np.array([positions[k] for k in both]))
    if matrix is None:
        return None
    points = colmap.read_points(place, model)
    return SparsePoints(points.positions @ matrix[:3, :3].T + matrix[:3, 3], points.colours, points.sightings)
