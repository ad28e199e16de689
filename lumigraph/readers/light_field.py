"""Light fields: pictures of a planar grid of parallel cameras, by their file names (Levoy and Hanrahan 1996).

    out_03_12_-381.909271_1103.376221.png   row, column and position (y, x): the gantry of the Stanford archive
    name_03_12.png                          row and column of a complete grid
    input_Cam000.png ... and parameters.cfg   row by row, with the lens and the baseline: HCI's benchmark

Columns go right, rows go down. Pictures are rectified: points of the focal plane have the same pixel in all. Where the
files lack its distance and the field of view, `lightfield.json` may give them:
{"field_of_view": degrees across, "plane_distance": in units of the positions}.
"""

from __future__ import annotations

import configparser
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch

from ..camera.lens import Pinhole
from ..errors import LumigraphError
from ..files import read_json, read_text
from ..files.ranges import Positive, between
from ..files.reading import reading
from .capture import Capture, Shot
from .pictures import list_images, measure

EXPECTED_FILES = {"pictures of a grid named as in the Stanford light field archive, or by row and column": ()}
GANTRY = re.compile(r".*?(\d+)_(\d+)_(-?\d+\.\d+)_(-?\d+\.\d+)_?")
GRID = re.compile(r"(?P<name>.*?)_?(\d+)[_x](\d+)")
HCI, PARAMETERS, ABOUT = re.compile(r"input_Cam(\d+)"), "parameters.cfg", "lightfield.json"
MIN_PICTURES = 4
MAX_RATIO = 2  # of rows and columns of a grid by names alone; what is longer is cameras' frames in a row
PLANE_DISTANCE = 4.0  # of the focal plane, in widths of the grid, where nothing says it
DEPTHS = (0.5, 4.0)  # nearest and farthest, in distances of the focal plane


@dataclass(frozen=True)
class GridAbout:
    """Contents of `lightfield.json`. plane_distance: in the unit of the file names, or in cells of a grid"""

    field_of_view: Annotated[float, between(1, 150)] = 40.0
    plane_distance: Positive | None = None


def recognises(folder: Path) -> bool:
    return places(folder) is not None


def places(folder: Path) -> dict[Path, tuple[float, float]] | None:
    """Position (x, y) of each picture's camera, x to the right and y down; None for another layout."""
    files = [folder / name for name in list_images(folder)]
    if len(files) < MIN_PICTURES:
        return None
    if (folder / PARAMETERS).is_file():
        numbers = {file: HCI.fullmatch(file.stem) for file in files}
        numbered = {file: int(match[1]) for file, match in numbers.items() if match}
        side = math.isqrt(len(numbered))
        if side > 1 and sorted(numbered.values()) == list(range(side * side)):
            return {file: (float(n % side), float(n // side)) for file, n in numbered.items()}
    gantry = {file: GANTRY.fullmatch(file.stem) for file in files}
    if all(gantry.values()):
        found = {file: tuple(float(x) for x in match.groups()) for file, match in gantry.items() if match}
        table = np.array([*found.values()])
        # Rows and columns count along y and x, whichever way these grow.
        y, x = (
            np.sign(np.polyfit(table[:, k], table[:, k + 2], 1)[0]) or 1 if np.ptp(table[:, k]) else 1 for k in (0, 1)
        )
        return {file: (x * row[3], y * row[2]) for file, row in found.items()}
    grid = {file: GRID.fullmatch(file.stem) for file in files}
    if all(grid.values()) and len({match["name"] for match in grid.values() if match}) == 1:
        cells = {file: (float(match[3]), float(match[2])) for file, match in grid.items() if match}
        columns, rows = ({cell[k] for cell in cells.values()} for k in (0, 1))
        short, long = sorted((len(columns), len(rows)))
        if 1 < short and long <= MAX_RATIO * short and len(set(cells.values())) == short * long:
            return cells
    return None


def read(folder: Path) -> Capture:
    """Cameras on a plane, with shifted lens centres, so that points of the focal plane have the same pixel."""
    found = places(folder)
    if found is None:
        raise LumigraphError(f"{folder} holds no complete grid of pictures; name them out_ROW_COLUMN_Y_X.png")
    unit, focal_share, distance = lens_of(folder, found)
    middle = np.mean([*found.values()], 0)
    shots = []
    for file, place in found.items():
        (width, height), (x, y) = measure(file)[0], (place - middle) * unit
        focal = focal_share * max(width, height)
        centre = torch.tensor([[width / 2 + focal * x / distance, height / 2 + focal * y / distance]]).float()
        pose = np.concatenate([np.eye(3), [[x], [y], [0.0]]], -1)
        lens = Pinhole(torch.full((1, 2), focal), centre)
        near, far = (share * distance for share in DEPTHS)
        shots.append(Shot(file.stem, pose, lens, (width, height), {1: file}, depths=(near, far)))
    stated = any((folder / name).is_file() for name in (PARAMETERS, ABOUT)) or GANTRY.fullmatch(next(iter(found)).stem)
    note = (
        f"{folder} is read as a light field, by the names of its files alone; if it is none: lumigraph capture {folder}"
    )
    return Capture(str(folder), shots, up=(0.0, -1.0, 0.0), notes=[] if stated else [note])


def lens_of(folder: Path, found: dict[Path, tuple[float, float]]) -> tuple[float, float, float]:
    """Length of a unit of the positions, focal length in longer sides of a picture, distance of the focal plane."""
    if (folder / PARAMETERS).is_file():
        fault = "lacks focal_length_mm, sensor_size_mm, baseline_mm or focus_distance_m"
        with reading(folder / PARAMETERS, fault, "restore it from the data set"):
            said = configparser.ConfigParser()
            said.read_string(read_text(folder / PARAMETERS))
            lens, rig = said["intrinsics"], said["extrinsics"]
            focal = float(lens["focal_length_mm"]) / float(lens["sensor_size_mm"])
            return float(rig["baseline_mm"]) / 1000, focal, float(rig["focus_distance_m"])
    about = read_json(folder / ABOUT, GridAbout) if (folder / ABOUT).is_file() else GridAbout()
    width = max(np.ptp([*found.values()], 0))
    return 1.0, 0.5 / math.tan(math.radians(about.field_of_view / 2)), about.plane_distance or PLANE_DISTANCE * width
