"""Frames of a depth camera without poses, for tracking: all have the first one's pose, in a box around it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..datasets.images.layer import known
from ..errors import LumigraphError
from ..files.names import natural
from ..files.ranges import Count, Positive
from .beside import DEPTH_KINDS, read_plane, settled
from .capture import Capture, Shot, checked_pose

EXTENT_FACTOR = 1.5  # half-size of the box, times the distance of the farthest surface in the first frame
FAR_QUANTILE = 0.98  # of that frame's depth: the farthest surface
NEAR = 0.1  # distance in the source's unit within which nothing is, if it is metres
RANGE = (0.05, 50.0)  # metres: median depth of the first frame that a depth camera can have
HOLD_OUT, FIRST_HELD_OUT = 8, 4  # every 8th frame is held out, beginning with this one: the first is never
TRUE_POSE = "true_pose"  # of `Shot.about`: what the source says, in its own frame


@dataclass(frozen=True)
class Unposed:
    """Options of a recording without poses.

    extent: half-size of the box around the first camera, metres; None follows from the first frame's depth
    frames: number of leading frames to use; None for all
    """

    extent: Positive | None = None
    frames: Count | None = None


def unposed(capture: Capture, options: Unposed) -> Capture:
    """The frames in order without their poses, which become `true_pose`, for evaluation alone.

    Raises LumigraphError for frames without depth, and for depth whose unit is not metres.
    """
    shots = [shot for shot in capture.shots if shot.split in (None, "train")]  # others are of another path
    shots = sorted(shots, key=lambda shot: (shot.time or 0.0, natural(shot.name)))[: options.frames]
    lacking = [shot.name for shot in shots if "depth" not in shot.planes]
    if lacking:
        which = "no depth" if len(lacking) == len(shots) else f"no depth for {lacking[0]}"
        raise LumigraphError(
            f"{capture.source} has {which}; tracking needs the frames of a depth camera, so add the depth, or find "
            "the poses of photographs by `lumigraph capture`"
        )
    depth = first_depth(shots[0])
    if not len(depth):
        raise LumigraphError(f"{capture.source}: {shots[0].name} measured no depth; begin with a frame that did")
    middle = float(np.median(depth))
    low, high = RANGE
    if not low < middle < high:
        raise LumigraphError(
            f"{capture.source}: the median depth of {shots[0].name} is {middle:.4g}, and a depth camera's lies between "
            f"{low:g} and {high:g} metres; its unit is another, such as millimetres, so correct the scale of depth"
        )
    half = options.extent or EXTENT_FACTOR * float(np.quantile(depth, FAR_QUANTILE))
    centre = shots[0].pose[:, 3]
    box = tuple((centre - half).tolist()), tuple((centre + half).tolist())
    placed = [
        replace(
            shot,
            pose=shots[0].pose,
            split="test" if i % HOLD_OUT == FIRST_HELD_OUT else "train",
            about=shot.about | ({} if capture.poseless else {TRUE_POSE: checked_pose(shot, capture.source)}),
        )
        for i, shot in enumerate(shots)
    ]
    return replace(
        capture,
        poseless=False,
        shots=placed,
        points=None,
        point_colours=None,
        sightings=None,
        bounds=box,
        reach=None,
        near=NEAR,
    )


def first_depth(shot: Shot) -> Float[np.ndarray, " pixel"]:
    """Measured depth of a shot, in the source's unit."""
    plane = settled(shot.planes["depth"], "depth")
    assert plane.encoding in DEPTH_KINDS and shot.size is not None and plane.dtype is not None
    stored = read_plane(plane, "depth", plane.dtype, shot.size, np.eye(3))
    depth = plane.scale * stored[known(stored, plane.unknown, 1)].astype(np.float64)
    return depth[np.isfinite(depth)]
