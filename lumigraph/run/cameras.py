"""cameras.json: where a run's photographs were taken from, so that films need no photographs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ..camera import Camera
from ..camera.lens import Lens
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..files import read_json
from ..files.ranges import Coordinate, Row, Side
from ..geometry import RIGID_TOLERANCE

MAX_PIXELS = 10**9  # of one picture


@dataclass(frozen=True)
class Cameras:
    """Contents of the file: one row per camera, and row numbers by split. lens: see `Lens.to_json`."""

    names: list[str]
    splits: dict[str, list[int]]
    pose: list[tuple[Row, Row, Row]]
    lens: dict[str, Any]
    size: list[tuple[Side, Side]]
    time: list[Coordinate] | None = None


def to_json(scene: Scene) -> dict[str, Any]:
    camera = scene.cameras.to("cpu")
    return {
        "names": list(scene.names),
        "splits": {name: index.tolist() for name, index in scene.splits.items()},
        "pose": camera.pose.tolist(),
        "lens": camera.lens.to_json(),
        "size": camera.size.tolist(),
        "time": None if camera.time is None else camera.time.tolist(),
    }


def read(path: Path) -> Cameras:
    """Read the file. Raises LumigraphError, naming it, if its rows are inconsistent."""
    said = read_json(path, Cameras)
    count = len(said.pose)
    rows = {"names": len(said.names), "size": len(said.size), "time": count if said.time is None else len(said.time)}
    if wrong := [f"{number} of {name}" for name, number in rows.items() if number != count]:
        raise LumigraphError(f"{path} has {count} poses, but {', '.join(wrong)}; restore it from a copy")
    if not said.splits.get("train") or any(i not in range(count) for index in said.splits.values() for i in index):
        raise LumigraphError(f"{path} has splits that name other cameras than its {count}, or none to learn from")
    if any(width * height > MAX_PIXELS for width, height in said.size):
        raise LumigraphError(f"{path} has pictures of more than {MAX_PIXELS:,} pixels; correct their size")
    return said


def cameras(path: Path, photographs: int) -> dict[str, Camera]:
    """Cameras by split. photographs: how many there are; further cameras took smaller copies of the same ones.

    Raises LumigraphError, naming the file, for what are no cameras.
    """
    said, lens = (found := read(path)), Lens.from_json(found.lens, path)
    pose = torch.tensor(said.pose)
    axes = pose[:, :, :3].double()
    if len(lens) != len(pose) or float((axes @ axes.mT - torch.eye(3)).abs().max()) > RIGID_TOLERANCE:
        raise LumigraphError(f"{path} has poses that are not rigid, or not a lens for each; restore it from a copy")
    time = None if said.time is None else torch.tensor(said.time)
    camera = Camera(pose, lens, torch.tensor(said.size), time, torch.arange(len(pose)) % max(photographs, 1))
    return {name: camera[torch.tensor(index, dtype=torch.int64)] for name, index in said.splits.items()}
