"""transforms.json, as instant-ngp and nerfstudio write it: one file with a pose, and maybe a lens, for each photograph.

Its cameras look along -z with +y up (OpenGL). Published splits are nerfstudio's train_filenames, test_filenames and
val_filenames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from ..camera.lens import Equirectangular, Fisheye, Lens, OpenCV, Pinhole
from ..datasets.scene import GeographicOrigin
from ..errors import LumigraphError
from ..files import is_file, read_json
from ..files.ranges import Coordinate, Name, Point, Positive, Row, between, typed
from ..files.reading import reading, reads
from . import colmap
from .capture import Capture, PixelPlane, Shot
from .pictures import find_file, reductions, upright_size, versions
from .points import SparsePoints, read_ply, similarity

RESULT_FILE = "capture.json"  # of a folder that `lumigraph capture` made
EXPECTED_FILES = "transforms.json (instant-ngp, nerfstudio)"
OPENCV_FROM_OPENGL = np.array([1.0, -1.0, -1.0])  # signs of the camera's axes
NGP_SCALE = 0.33  # instant-ngp's unit cube is 1 / 0.33 of the file's units wide
MAX_FACT_NUMBERS = 10_000  # numbers per fact of one photograph

# Of a layer, what a frame may call its file: nerfstudio's name or instant-ngp's, and what annotated captures say.
PLANES = {
    "depth": ("depth_file_path", "depth_path"),
    "labels": ("labels_file_path", "semantics_path"),
    "normals": ("normals_file_path",),
}
FACTS = ("exposure", "boxes", "body")  # of a photograph
BLENDER_EMPTY_DEPTHS = (1e10, 65504.0)  # depth that Blender writes for background pixels, in floats and in halves

Json = dict[str, Any]
Across = Annotated[float, between(1, 1e5)]  # pixels
Focal = Annotated[float, between(1e-2, 1e7)]  # pixels
Centre = Annotated[float, between(-1e7, 1e7)]  # pixels
Bend = Annotated[float, between(-1e4, 1e4)]
Angle = Annotated[float, between(1e-6, 3.14159)]  # radians


@dataclass(frozen=True)
class Whole:
    """Fields of a file besides lenses. Paths may lead anywhere: many captures name ../images, some absolute paths."""

    frames: list[Json]
    aabb_scale: Positive | None = None
    scale: Positive = NGP_SCALE
    up: Point | None = None
    ply_file_path: Name | None = None
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None


@dataclass(frozen=True)
class GpsRecord:
    """Field `gps` of capture.json: whether the axes point east, north and up, in metres, and their origin."""

    used: bool = False
    origin: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Made:
    """Fields of capture.json: source of a scene, method of its creation, warnings, photographs without a pose with the
    reason, and its position on Earth."""

    sources: list[str] = field(default_factory=list)
    key: str = ""
    warnings: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    gps: GpsRecord | None = None

    @property
    def origin(self) -> GeographicOrigin | None:
        """Origin of the frame on Earth, if GPS has determined it."""
        if self.gps is None or not self.gps.used or self.gps.origin is None:
            return None
        return GeographicOrigin(*self.gps.origin)


@dataclass(frozen=True)
class Posed:
    """A frame, with the file's fields for all frames as defaults."""

    file_path: Name
    transform_matrix: list[Row]
    w: Across | None = None
    h: Across | None = None
    camera_model: str = "OPENCV"
    is_fisheye: bool | float | None = None
    fl_x: Focal | None = None
    fl_y: Focal | None = None
    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
    cx: Centre | None = None
    cy: Centre | None = None
    k1: Bend | None = None
    k2: Bend | None = None
    k3: Bend | None = None
    k4: Bend | None = None
    k5: Bend | None = None
    k6: Bend | None = None
    p1: Bend | None = None
    p2: Bend | None = None
    time: Coordinate | None = None
    mask_path: Name | None = None
    depth_file_path: Name | None = None
    depth_path: Name | None = None
    labels_file_path: Name | None = None
    semantics_path: Name | None = None
    normals_file_path: Name | None = None
    depth_unit_scale_factor: Positive | None = None
    integer_depth_scale: Positive | None = None
    is_euclidean_depth: bool | float | None = None


def recognises(folder: Path) -> bool:
    return (folder / "transforms.json").is_file()


@reads()
def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for malformed JSON, unusable poses, and unknown lenses."""
    path = folder / "transforms.json"
    whole, plain = read_frames_file(path)
    splits = published_splits(whole)
    shots, missing = read_shots(path, plain)
    if splits:
        shots = [replace(shot, split=splits[shot.name]) for shot in shots if shot.name in splits]
        missing = [name for name in missing if name in splits]
    points = find_points(folder, whole, shots, missing)
    reach = None
    if points is None and whole.aabb_scale is not None:
        reach = 0.5 * whole.aabb_scale / whole.scale
    if whole.up is not None and not any(whole.up):
        raise LumigraphError(f'{path}: "up" points nowhere; correct it or remove it')
    cloud = {} if points is None else vars(points)
    made = read_json(folder / RESULT_FILE, Made) if (folder / RESULT_FILE).is_file() else Made()
    folded = [f"{folder}: {warning}" for warning in made.warnings if "folded" in warning]
    return Capture(
        str(folder), shots, missing=missing, reach=reach, up=whole.up, origin=made.origin, notes=folded, **cloud
    )


def read_frames_file(path: Path) -> tuple[Whole, Json]:
    """Contents of a file: parsed fields of the whole file, and raw JSON."""
    plain = read_json(path)
    return typed(Whole, plain, path), plain


def read_shots(path: Path, whole: Json, split: str | None = None) -> tuple[list[Shot], list[str]]:
    """Photographs of a file that exist, and the names of missing ones.

    whole: raw JSON of the file. Its lens fields are defaults for every frame
    """
    folder, shots, missing = path.parent, [], []
    shared = {name: value for name, value in whole.items() if name != "frames"}
    said = [typed(Posed, shared | frame, f"{path}: {called(frame, i)}") for i, frame in enumerate(whole["frames"])]
    names = [about.file_path for about in said]
    for name, frame, about, files in zip(names, whole["frames"], said, find_versions(folder, names), strict=True):
        if not files:
            missing.append(name)
            continue
        where = f"{path}: {called(frame)}"
        stated = None if about.w is None or about.h is None else (round(about.w), round(about.h))
        size = stated or upright_size(files)
        lens = read_lens(about, size, where)
        shots.append(
            Shot(
                name=name,
                pose=read_pose(about, where),
                lens=lens,
                size=size,
                image=files,
                mask=None if about.mask_path is None else folder / about.mask_path,
                split=split,
                time=about.time,
                planes=read_planes(folder, about, lens, missing),
                about={name: fact(frame[name], name, where) for name in FACTS if frame.get(name) is not None},
            )
        )
    return shots, missing


def called(frame: Json, number: int = 0) -> str:
    """A frame's display name."""
    return f"frame {frame.get('file_path', number)}"


def fact(value: Any, name: str, where: str) -> np.ndarray:
    """Value of a photograph: a number, or a small array of them. Raises LumigraphError for anything else."""
    with reading(where, f'has "{name}", which is no number and no array of them', "correct it"):
        numbers = np.asarray(value, np.float64)
    if numbers.size > MAX_FACT_NUMBERS:
        raise LumigraphError(f'{where} has "{name}" of {numbers.size} numbers; {MAX_FACT_NUMBERS} are the most')
    return numbers


def read_planes(folder: Path, about: Posed, lens: Lens, missing: list[str]) -> dict[str, PixelPlane]:
    """Depth, labels and normals of the files that a frame names; missing ones are added to `missing`."""
    found = {}
    for kind, keys in PLANES.items():
        key = next((key for key in keys if getattr(about, key) is not None), None)
        if key is None:
            continue
        name = getattr(about, key)
        file = find_file(folder / name)
        if not is_file(file):
            missing.append(name)
        elif kind == "depth":
            found[kind] = depth_plane(file, key, about, lens)
        else:
            found[kind] = PixelPlane(file, {"labels": "index", "normals": "direction"}[kind])
    return found


def depth_plane(file: Path, key: str, about: Posed, lens: Lens) -> PixelPlane:
    """Depth as nerfstudio stores it, thousandths of a unit by default, or as instant-ngp does."""
    stated = about.integer_depth_scale if key == "depth_path" else about.depth_unit_scale_factor
    scale = stated if stated is not None else 1.0 if file.suffix.lower() == ".exr" else 1e-3
    along_ray = isinstance(lens, Equirectangular) or bool(about.is_euclidean_depth)
    whole = file.suffix.lower() in (".png", ".tif", ".tiff")
    unknown, empty = ((0.0, 65535.0), ()) if whole else ((0.0,), BLENDER_EMPTY_DEPTHS)
    return PixelPlane(file, "distance" if along_ray else "z-depth", scale, unknown, empty)


def find_versions(folder: Path, names: list[str]) -> list[dict[int, Path]]:
    """Files of each photograph: its own, and reduced ones if it is in `images` and there are images_2, images_4..."""
    files = [find_file(folder / name) for name in names]
    found = [{1: path} if is_file(path) else {} for path in files]
    inside = [i for i, path in enumerate(files) if path.parent == folder / "images"]
    for i, more in zip(inside, versions(reductions(folder / "images"), [files[i].name for i in inside]), strict=True):
        found[i] |= more
    return found


def read_pose(about: Posed, where: str) -> np.ndarray:
    if len(about.transform_matrix) not in (3, 4):
        raise LumigraphError(f"{where} has no 4x4 transform_matrix of numbers; correct it or remove the frame")
    pose = np.array(about.transform_matrix[:3], np.float64)
    pose[:, :3] *= OPENCV_FROM_OPENGL
    return pose


def read_lens(about: Posed, size: tuple[int, int], where: str) -> Lens:
    width, height = size
    model = "OPENCV_FISHEYE" if about.is_fisheye else about.camera_model.upper()
    if model in ("EQUIRECTANGULAR", "SPHERICAL"):
        return Equirectangular(row(width, height))
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV_FISHEYE"):
        raise LumigraphError(
            f"{where} has camera_model {model}; only PINHOLE, OPENCV, OPENCV_FISHEYE and EQUIRECTANGULAR are known, "
            f"so undistort the photographs first"
        )
    focal_x = about.fl_x or focal_from_angle(about.camera_angle_x, width)
    if focal_x is None:
        raise LumigraphError(f'{where} has neither "fl_x" nor "camera_angle_x"; add the focal length in pixels')
    focal_y = about.fl_y or focal_from_angle(about.camera_angle_y, height) or focal_x
    centre_x, centre_y = (half if x is None else x for x, half in ((about.cx, width / 2), (about.cy, height / 2)))
    focal, centre = row(focal_x, focal_y), row(centre_x, centre_y)
    if model == "OPENCV_FISHEYE":
        return Fisheye(focal, centre, row(*(getattr(about, f"k{i}") or 0.0 for i in (1, 2, 3, 4))))
    bends = [getattr(about, key) or 0.0 for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    if model == "OPENCV" and any(bends):
        return OpenCV(focal, centre, row(*bends))
    return Pinhole(focal, centre)


def focal_from_angle(angle: float | None, pixels: int) -> float | None:
    return None if angle is None else 0.5 * pixels / math.tan(0.5 * angle)


def row(*numbers: float) -> torch.Tensor:
    return torch.tensor([numbers], dtype=torch.float32)


def published_splits(whole: Whole) -> dict[str, str]:
    """nerfstudio's lists of file names, as name to split."""
    lists = {"train": whole.train_filenames, "val": whole.val_filenames, "test": whole.test_filenames}
    if not any(lists.values()):
        return {}
    if not lists["test"]:
        lists["test"], lists["val"] = lists["val"], None
    return {name: split for split, names in lists.items() for name in names or []}


def find_points(folder: Path, whole: Whole, shots: list[Shot], missing: list[str]) -> SparsePoints | None:
    """The points a file names, else those of the photographs' COLMAP model, in this file's frame."""
    if (name := whole.ply_file_path) is not None:
        if is_file(folder / name):
            return read_ply(folder / name)
        missing.append(name)
    place = colmap.model_folder(folder)
    if place is None:
        return None
    positions = {Path(s.name).stem: s.pose[:, 3] for s in shots}
    model = colmap.read_model(place)
    found = {Path(name).stem: pose[:, 3] for name, pose in colmap.poses_of(model).items()}
    both = sorted(positions.keys() & found.keys())
    matrix = similarity(np.array([found[k] for k in both]), np.array([positions[k] for k in both]))
    if matrix is None:
        return None
    cloud = colmap.read_points(place, model)
    return replace(cloud, points=cloud.points @ matrix[:3, :3].T + matrix[:3, 3])
