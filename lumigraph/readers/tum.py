"""RGB-D captures in the layout of TUM's benchmark (Sturm et al. 2012): rgb.txt, depth.txt and groundtruth.txt.

The lists have a time in seconds and a file on each line; the trajectory has a time, a position and a quaternion
(x, y, z, w) of the colour camera, camera-to-world. Entries are matched by nearest times. Depth is registered to the
colours: 16 bits, 5000 to a metre along the optical axis, 0 for unmeasured.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from ..camera.lens import Lens, OpenCV, Pinhole
from ..files import is_file, read_text
from ..files.reading import reading
from ..geometry import to_matrix
from .beside import with_depth_points
from .capture import Capture, PixelPlane, Shot

EXPECTED_FILES = {"TUM's RGB-D benchmark": ("rgb.txt", "groundtruth.txt")}
MAX_TIME_DIFFERENCE = 0.02  # seconds between two entries that belong together, as in the benchmark's own tools
DEPTH_PER_METRE = 5000  # in numbers of a depth picture
POSE_COLUMNS = 8  # of a trajectory
IMAGE_SIZE = (640, 480)
# What the benchmark publishes, with pixel centres at whole numbers, for the camera that a folder's name tells: focal
# length, centre, k1 k2 p1 p2 k3. A folder's own camera.txt has the same nine numbers, or the first four.
CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
DEFAULT_INTRINSICS = (525.0, 525.0, 319.5, 239.5)  # default of the cameras' drivers


def recognises(folder: Path) -> bool:
    return all((folder / name).is_file() for name in ("rgb.txt", "groundtruth.txt"))


def read(folder: Path) -> Capture:
    """The capture in a folder, without photographs that have no pose. Raises LumigraphError for malformed lists."""
    poses = read_rows(folder / "groundtruth.txt", POSE_COLUMNS)
    moments = np.array([float(row[0]) for row in poses])
    pictures = read_rows(folder / "rgb.txt", 2)
    depths = read_rows(folder / "depth.txt", 2) if (folder / "depth.txt").is_file() else []
    depth_moments = np.array([float(row[0]) for row in depths])
    lens, shots, missing = read_lens(folder), [], []
    for moment, name in pictures:
        pose, depth = nearest(moments, float(moment)), nearest(depth_moments, float(moment))
        if pose is None:
            continue
        if not is_file(folder / name):
            missing.append(name)
            continue
        planes = {}
        if depth is not None:
            path = folder / depths[depth][1]
            if is_file(path):
                planes["depth"] = PixelPlane(path, "z-depth", 1 / DEPTH_PER_METRE, unknown=(0, 65535))
            else:
                missing.append(depths[depth][1])
        shots.append(
            Shot(name, read_pose(poses[pose]), lens, IMAGE_SIZE, {1: folder / name}, time=float(moment), planes=planes)
        )
    given = {"groundtruth.txt": moments, "rgb.txt": np.array([float(row[0]) for row in pictures])}
    notes = [
        f"{folder / name}: moments go back {int((np.diff(times) < 0).sum())} times; pictures and poses are paired by "
        "the nearest moment, and pictures are taken in the order of their names"
        for name, times in given.items()
        if (np.diff(times) < 0).any()
    ]
    return with_depth_points(Capture(str(folder), shots, missing=missing, notes=notes, metric=True))


def read_rows(path: Path, columns: int) -> list[list[str]]:
    """Words of each line that is no comment."""
    rows = [line.split() for line in read_text(path).splitlines() if line.strip()[:1] not in ("", "#")]
    for row in rows:
        fault = f"holds {' '.join(row)[:200]!r}, where {columns} columns were looked for"
        with reading(path, fault, "correct that line"):
            numbers = [float(x) for x in (row[:columns] if columns > 2 else row[:1])]
            if len(row) < columns or not all(map(math.isfinite, numbers)):
                raise ValueError("a number is missing or not finite")
            if columns == POSE_COLUMNS and not any(numbers[4:]):
                raise ValueError("a quaternion of zero is no rotation")
    return [row[:columns] for row in rows]


def read_pose(row: list[str]) -> np.ndarray:
    x, y, z, qx, qy, qz, qw = map(float, row[1:])
    rotation = to_matrix(torch.tensor([[qw, qx, qy, qz]], dtype=torch.float64))[0].numpy()
    return np.concatenate([rotation, [[x], [y], [z]]], -1)


def read_lens(folder: Path) -> Lens:
    path = folder / "camera.txt"
    numbers: tuple[float, ...] = next(
        (c for name, c in CAMERAS.items() if name in folder.resolve().name), DEFAULT_INTRINSICS
    )
    if path.is_file():
        remedy = "write fx fy cx cy, and where it bends k1 k2 p1 p2 k3, as OpenCV has them"
        with reading(path, "is no camera", remedy):
            numbers = tuple(float(x) for x in read_text(path).split())
            if len(numbers) not in (4, 9):
                raise ValueError(f"it has {len(numbers)} numbers")
    fx, fy, cx, cy, *bends = numbers
    focal, centre = torch.tensor([[fx, fy]]), torch.tensor([[cx + 0.5, cy + 0.5]])
    return OpenCV(focal, centre, torch.tensor([[*bends, 0.0, 0.0, 0.0]])) if bends else Pinhole(focal, centre)


def nearest(moments: np.ndarray, moment: float) -> int | None:
    """Index of the nearest time, if within the tolerance."""
    if not len(moments):
        return None
    found = int(np.abs(moments - moment).argmin())
    return found if abs(moments[found] - moment) <= MAX_TIME_DIFFERENCE else None
