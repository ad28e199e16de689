"""Motion in .ply files: Spacetime Gaussians (Li et al. 2024, arXiv 2312.16812), and a folder of one cloud a frame.

Spacetime: trbf_center c and trbf_scale, of whose exponential s opacity falls off as exp(-((t - c) / s)^2); motion_0..8,
the coefficients of t - c, its square and its cube along x, y and z; omega_0..3, the quaternion's change. The clip lasts
from 0 to 1.
"""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import LumigraphError, LumigraphWarning
from ..files.names import counted, natural
from ..files.ply import columns, read_header, read_rows
from ..gaussians.cloud import Gaussians, joined
from ..gaussians.moving import MovingGaussians
from . import ply
from .checks import without_unsound

MOTION, OMEGA = [f"motion_{i}" for i in range(9)], [f"omega_{i}" for i in range(4)]
SPACETIME = ["trbf_center", "trbf_scale", *MOTION]
SECONDS = 3.0  # of a clip of Spacetime Gaussians, whose files do not say how long it lasts
FRAMES_PER_SECOND = 30.0  # of a folder of clouds
VISIBLE = 3.0  # deviations from the middle in which a Gaussian is seen
PIECES = 8  # spans of a Gaussian that does not move evenly
EVEN = 0.1  # error of even motion, as a share of a Gaussian's largest deviation, below which it has one span
NUMBERED = re.compile(r"(.*?)(\d+)")  # name of a frame's file, without suffix
SAME_COLOUR = 0.05  # median difference of harmonics between frames below which Gaussians are the same ones


def has_motion(path: Path) -> bool:
    """True for a file of Spacetime Gaussians."""
    return path.suffix.lower() == ".ply" and path.is_file() and {*SPACETIME} <= {*_names(path)}


def is_sequence(folder: Path) -> bool:
    """True for a folder of numbered clouds of Gaussians."""
    files = frames_of(folder)
    return len(files) > 1 and all({*ply.OPACITY, *ply.ROTATION} <= {*_names(path)} for path in (files[0], files[-1]))


def _names(path: Path) -> list[str]:
    """Properties of a file's vertices; none of a file that is damaged."""
    try:
        return read_header(path).properties.get("vertex", [])
    except LumigraphError:
        return []


def frames_of(folder: Path) -> list[Path]:
    """Files of a folder that are all called alike but for a number, in its order; none if others lie there."""
    files = sorted(folder.glob("*.ply"), key=lambda path: natural(path.name)) if folder.is_dir() else []
    names = [NUMBERED.fullmatch(path.stem) for path in files]
    return files if files and all(names) and len({match[1] for match in names if match}) == 1 else []


def read_spacetime(path: Path) -> MovingGaussians:
    """A clip of Spacetime Gaussians of SECONDS. Raises LumigraphError for a file that is damaged."""
    cloud, kept = without_unsound(ply.read(path, moving=True), path)
    rows = read_rows(path, ["vertex"])["vertex"]
    rows = rows if kept is None else rows[kept.numpy()]
    centre, scale = (torch.from_numpy(np.array(columns(rows, [name])[:, 0])) for name in SPACETIME[:2])
    motion = torch.from_numpy(np.array(columns(rows, MOTION))).view(-1, 3, 3)
    omega = torch.zeros_like(cloud.quaternions)
    if {*OMEGA} <= {*(rows.dtype.names or ())}:
        omega = torch.from_numpy(np.array(columns(rows, OMEGA)))
    deviation = scale.exp() / math.sqrt(2)
    begin, end = (centre - VISIBLE * deviation).clamp(0, 1), (centre + VISIBLE * deviation).clamp(0, 1)

    def moved(t: Float[Tensor, " gaussian"]) -> Float[Tensor, "gaussian 3"]:
        away = (t - centre)[:, None]
        return motion[:, 0] * away + motion[:, 1] * away**2 + motion[:, 2] * away**3

    middle = moved((begin + end) / 2) - (moved(begin) + moved(end)) / 2
    uneven = middle.norm(dim=-1) > EVEN * cloud.log_scales.exp().amax(-1)
    uneven |= (omega.norm(dim=-1) * (end - begin)) > EVEN * cloud.quaternions.norm(dim=-1)
    pieces = torch.where(uneven, PIECES, 1) * (end > begin)
    source = torch.repeat_interleave(torch.arange(len(cloud)), pieces)
    number = torch.arange(len(source)) - (pieces.cumsum(0) - pieces)[source]
    length = ((end - begin) / pieces.clamp(min=1))[source]
    first = begin[source] + number * length
    last = first + length
    centre, motion, omega = centre[source], motion[source], omega[source]
    ends = moved(first), moved(last)
    velocity = (ends[1] - ends[0]) / (last - first)[:, None]
    whole = cloud[source]
    middles = centre  # of the fade; even motion goes on from there
    some = replace(
        whole,
        means=whole.means + ends[0] + velocity * (middles - first)[:, None],
        quaternions=whole.quaternions + omega * ((first + last) / 2 - centre)[:, None],
    )
    return MovingGaussians(some, 1.0, velocity, middles, first, last, deviation[source]).lasting(SECONDS)


def read_sequence(folder: Path) -> MovingGaussians:
    """A folder of one cloud a frame. Gaussians that are the same in each move evenly from frame to frame; others are
    there until the next one."""
    files = frames_of(folder)
    clouds = [without_unsound(ply.read(path), path)[0] for path in files]
    duration = len(files) / FRAMES_PER_SECOND
    following = follow(clouds)
    if not following:
        text = f"{folder} has {counted(len(files), 'cloud')} of other Gaussians each, so nothing moves between frames"
        warnings.warn(text, LumigraphWarning, stacklevel=2)
    parts = []
    for i, cloud in enumerate(clouds):
        begin, end = i / FRAMES_PER_SECOND, (i + 1) / FRAMES_PER_SECOND
        velocities = torch.zeros_like(cloud.means, dtype=torch.float32)
        if following and i + 1 < len(clouds):
            velocities = (clouds[i + 1].means - cloud.means).float() * FRAMES_PER_SECOND
        times = [torch.full((len(cloud),), value) for value in (begin, begin, end, math.inf)]
        parts.append((cloud, velocities, *times))
    tensors = [torch.cat(values) for values in zip(*(times for _, *times in parts), strict=True)]
    return MovingGaussians(joined(clouds), duration, *tensors)


def follow(clouds: list[Gaussians]) -> bool:
    """True if Gaussian i of each cloud is the same one."""
    if len({(len(cloud), cloud.harmonics.shape[1]) for cloud in clouds}) > 1:
        return False
    first, second = clouds[0], clouds[1]
    return float((first.harmonics - second.harmonics).abs().median()) < SAME_COLOUR
