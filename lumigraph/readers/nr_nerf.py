"""Captures of one moving camera, as NR-NeRF publishes them (Tretschk et al. 2021): precomputed.json beside images.

Each pose is a 3x5 matrix: the camera's right, up and backward axes, its position, and (height, width, focal length) in
pixels. Each row of `bds` is the nearest and farthest depth of a photograph. The moment of a photograph is its number.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..camera.lens import Pinhole
from ..errors import LumigraphError
from ..files import is_file, read_json
from ..files.ranges import Coordinate
from .capture import Capture, Shot
from .pictures import list_images

EXPECTED_FILES = {"NR-NeRF": ("precomputed.json",)}
PoseRow = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class Precomputed:
    """Fields of precomputed.json, those in use."""

    poses: list[tuple[PoseRow, PoseRow, PoseRow]]
    bds: list[tuple[Coordinate, Coordinate]]


def recognises(folder: Path) -> bool:
    return is_file(folder / "precomputed.json")


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for malformed JSON, and unequal numbers of poses and images."""
    path = folder / "precomputed.json"
    found = read_json(path, Precomputed)
    names = list_images(folder / "images")
    if not len(names) == len(found.poses) == len(found.bds):
        raise LumigraphError(
            f"{path} has {len(found.poses)} poses and {len(found.bds)} depths, and there are {len(names)} images; "
            f"restore the images"
        )
    shots = []
    for number, (name, rows, depths) in enumerate(zip(names, found.poses, found.bds, strict=True)):
        right, up, backward, position, (height, width, focal) = np.array(rows).T
        if not (min(height, width) >= 1 and focal > 0):
            raise LumigraphError(f"{path} has no usable size or focal length of image {name}; make or copy it again")
        lens = Pinhole(torch.full((1, 2), float(focal)), torch.tensor([[width / 2, height / 2]]).float())
        pose, size = np.stack([right, -up, -backward, position], -1), (round(width), round(height))
        shots.append(Shot(name, pose, lens, size, {1: folder / "images" / name}, time=float(number), depths=depths))
    return Capture(str(folder), shots)
