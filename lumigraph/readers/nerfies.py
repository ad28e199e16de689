"""Captures of dynamic scenes, as Nerfies and HyperNeRF publish them (Park et al. 2021).

dataset.json has the ids of photographs and the split, DyCheck's splits/train.json and splits/val.json another one;
metadata.json the time of each, as a frame number;
camera/ID.json a camera; scene.json the near and far distance, in units of its `scale`; rgb/2x/ID.png the photograph at
half size; points.npy points of the static background.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch

from ..camera.lens import OpenCV
from ..errors import LumigraphError
from ..files import is_file, read_json
from ..files.ranges import Coordinate, Name, Point, Positive, Side, between, typed
from ..files.reading import reading
from .capture import Capture, Shot
from .numbers import load_array
from .pictures import find_file

EXPECTED_FILES = {"Nerfies, HyperNeRF": ("dataset.json", "metadata.json", "camera/")}
GREY = 128  # of points, whose colours are not in the files

Focal = Annotated[float, between(1e-2, 1e7)]  # pixels
Bend = Annotated[float, between(-1e4, 1e4)]


@dataclass(frozen=True)
class PhotographList:
    """Fields of dataset.json: ids of all photographs, and of test photographs."""

    ids: list[Name]
    train_ids: list[Name] = field(default_factory=list)
    val_ids: list[Name] = field(default_factory=list)


@dataclass(frozen=True)
class SplitRecord:
    """Fields of splits/train.json and splits/val.json, as DyCheck (Gao 2022) publishes them."""

    frame_names: list[Name]


@dataclass(frozen=True)
class PhotographRecord:
    """Fields of a photograph in metadata.json. HyperNeRF's `time_id` takes precedence over Nerfies' `warp_id`."""

    warp_id: Coordinate | None = None
    time_id: Coordinate | None = None

    @property
    def time(self) -> float | None:
        return self.warp_id if self.time_id is None else self.time_id


@dataclass(frozen=True)
class SceneRecord:
    """Fields of scene.json."""

    scale: Positive = 1.0
    near: Positive | None = None
    far: Positive | None = None


@dataclass(frozen=True)
class CameraRecord:
    """Fields of camera/ID.json. orientation: rows are the camera's axes in the world; +y down, +z forward"""

    orientation: tuple[Point, Point, Point]
    position: Point
    focal_length: Focal
    principal_point: tuple[Coordinate, Coordinate]
    image_size: tuple[Side, Side]
    pixel_aspect_ratio: Positive = 1.0
    radial_distortion: tuple[Bend, Bend, Bend] = (0.0, 0.0, 0.0)
    tangential_distortion: tuple[Bend, Bend] = (0.0, 0.0)

    @property
    def pose(self) -> np.ndarray:
        return np.concatenate([np.array(self.orientation).T, np.array(self.position)[:, None]], 1)

    @property
    def lens(self) -> OpenCV:
        (k1, k2, k3), (p1, p2) = self.radial_distortion, self.tangential_distortion
        focal = self.focal_length, self.focal_length * self.pixel_aspect_ratio
        numbers = focal, self.principal_point, (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
        return OpenCV(*(torch.tensor([x], dtype=torch.float32) for x in numbers))


def recognises(folder: Path) -> bool:
    return all(is_file(folder / name) for name in ("dataset.json", "metadata.json")) and (folder / "camera").is_dir()


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for malformed JSON and for photographs without a time."""
    listed = read_json(folder / "dataset.json", PhotographList)
    path = folder / "metadata.json"
    moments = {name: typed(PhotographRecord, about, f"{path}: {name}") for name, about in read_json(path).items()}
    place = read_json(folder / "scene.json", SceneRecord) if is_file(folder / "scene.json") else SceneRecord()
    near, far = (None if x is None else x / place.scale for x in (place.near, place.far))
    sizes = sorted((int(f.name[:-1]), f) for f in (folder / "rgb").glob("*x") if f.name[:-1].isdecimal())
    testing, learning = set(listed.val_ids), set(listed.train_ids) or set(listed.ids) - set(listed.val_ids)
    published = [folder / "splits" / f"{split}.json" for split in ("train", "val")]
    if all(map(is_file, published)):
        learning, testing = (set(read_json(file, SplitRecord).frame_names) for file in published)
    shots, missing = [], []
    for name in listed.ids:
        files = {factor: find_file(place / name) for factor, place in sizes}
        files = {factor: file for factor, file in files.items() if is_file(file)}
        record = folder / "camera" / f"{name}.json"
        if not files or not is_file(record):
            missing.append(name)
            continue
        if name not in moments or moments[name].time is None:
            raise LumigraphError(f'{path} has neither "warp_id" nor "time_id" of {name}; add its moment')
        camera = read_json(record, CameraRecord)
        shots.append(
            Shot(
                name,
                camera.pose,
                camera.lens,
                camera.image_size,
                files,
                split="test" if name in testing else "train" if name in learning else "val",
                time=moments[name].time,
                depths=None if near is None or far is None else (near, far),
            )
        )
    if not testing:
        shots = [replace(shot, split=None) for shot in shots]
    points = read_points(folder / "points.npy")
    colours = None if points is None else np.full(points.shape, GREY, np.uint8)
    return Capture(str(folder), shots, points, colours, missing=missing, near=near)


def read_points(path: Path) -> np.ndarray | None:
    """Points of the background; None where there is no such file. Raises LumigraphError for other arrays."""
    if not is_file(path):
        return None
    with reading(path, "is no array of 3 numbers to a point", "restore or remove it"):
        points = np.array(load_array(path)).astype(np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"it has shape {points.shape}")
        return points
