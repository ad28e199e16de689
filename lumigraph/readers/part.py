"""Parts of a large capture, each a scene with its own frame; and camera positions without pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from ..camera import Camera
from ..camera.lens import Pinhole
from ..errors import LumigraphError
from ..files.ranges import Point, Positive
from .assemble import HOLD_OUT, in_order
from .capture import Capture, Shot, checked_pose
from .normalise import upright_of

MAX_POINT_RADII = 16.0  # radii of a part within which sparse points are kept: beyond is the sky


@dataclass(frozen=True)
class CapturePart:
    """Some photographs of a capture, and the region that they show.

    photographs: their names; those held out of the whole capture are held out here
    centre, radius: of the region, in the source's frame and units
    """

    photographs: list[str]
    centre: Point
    radius: Positive


def part_of(capture: Capture, part: CapturePart) -> Capture:
    """The capture with only these photographs, and a box of interest of that radius around that centre. Raises
    LumigraphError for missing photographs."""
    shots = {shot.name: shot for shot in with_splits(capture.shots)}
    if lost := [name for name in part.photographs if name not in shots]:
        raise LumigraphError(
            f"{capture.source} lacks {len(lost)} of the {len(part.photographs)} photographs of a block, such as "
            f"{lost[0]}; restore them"
        )
    chosen = [shots[name] for name in part.photographs]
    reach = capture.reach
    if reach is not None and capture.bounds is not None:  # of the whole, from its middle
        reach += float(np.linalg.norm(np.mean(capture.bounds, 0) - part.centre))
    found = replace(capture, shots=chosen, missing=[], bounds=None, reach=reach, around=(part.centre, part.radius))
    if capture.points is None:
        return found
    return found.with_points(np.linalg.norm(capture.points - part.centre, axis=-1) < MAX_POINT_RADII * part.radius)


def with_splits(shots: list[Shot]) -> list[Shot]:
    """The photographs with their splits: as published, else every 8th by name is held out."""
    if any(shot.split for shot in shots):
        return shots
    purposes = {shot.name: "train" if i % HOLD_OUT else "test" for i, shot in enumerate(in_order(shots, None))}
    return [replace(shot, split=purposes[shot.name]) for shot in shots]


@dataclass(frozen=True)
class Places:
    """Camera positions; photograph i is names[i] in the split splits[i].

    positions, forwards: in the source's frame and units; viewing direction, unit length
    upright:   the rotation to +z up
    """

    names: list[str]
    splits: list[str | None]
    positions: Float[np.ndarray, "photograph 3"]
    forwards: Float[np.ndarray, "photograph 3"]
    upright: Float[np.ndarray, "3 3"]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def ground(self) -> Float[np.ndarray, "photograph 2"]:
        """Positions seen from above."""
        return (self.positions @ self.upright.T)[:, :2]


def places_of(capture: Capture) -> Places:
    """Camera positions by name, 2 before 10. Raises LumigraphError without photographs, and for invalid poses."""
    shots = with_splits(in_order(capture.shots, None))
    if not shots:
        raise LumigraphError(f"{capture.source} has no photograph with a pose; add some")
    poses = np.stack([checked_pose(shot, capture.source) for shot in shots])
    away = poses[:, :, 3].mean(0)  # single precision is for what is near the origin
    near = np.concatenate([poses[:, :, :3], poses[:, :, 3:] - away[:, None]], -1)
    lens = Pinhole(torch.ones(len(shots), 2), torch.ones(len(shots), 2))
    cameras = Camera(torch.from_numpy(near).float(), lens, torch.ones(len(shots), 2, dtype=torch.int64))
    return Places(
        [shot.name for shot in shots],
        [shot.split for shot in shots],
        poses[:, :, 3],
        poses[:, :, 2],
        upright_of(capture, cameras),
    )
