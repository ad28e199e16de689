"""Capture: photographs and metadata from a reader, before they become a Scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..camera.lens import Lens
from ..datasets.scene import GeographicOrigin
from ..datasets.skeleton import Skeleton
from ..datasets.tracks import BoxTrack
from ..datasets.world import BlockLabels
from ..errors import LumigraphError
from ..geometry import RIGID_TOLERANCE

MAX_COORDINATE = 1e8  # units of the source, from its origin; maps in metres reach 1e7
Pixels = np.ndarray  # uint8, (height, width, 3) or (height, width, 4); alpha last, colours not multiplied by it


@dataclass(frozen=True)
class PixelPlane:
    """Values of one layer of one photograph, from a reader. See `images.Layer`.

    values:   stored numbers, (height, width) or (height, width, channels), a function that returns them, or a file; of
              any size with the photograph's aspect ratio
    encoding: meaning of the numbers
    scale:    value of a stored 1, in the source's units for lengths
    unknown, empty, names: as in `Layer`
    dtype, channels: of a function's result
    identity: determines a function's result
    """

    values: Path | np.ndarray | Callable[[], np.ndarray]
    encoding: str
    scale: float = 1.0
    unknown: tuple[float, ...] = ()
    empty: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    dtype: np.dtype | None = None
    channels: int = 1
    identity: str | None = None


@dataclass(frozen=True)
class Shot:
    """One photograph with its camera.

    name:  unique within the capture, for warnings and reports; held-out views are chosen by its order
    pose:  camera-to-world, (3, 4), in the source's own frame and units; +x right, +y down, +z forward
    lens:  one lens, for a picture of `size`
    size:  (width, height) of the calibration; None for the picture's own size
    image: the pixels, or a function that returns them (it needs `size`), or files: the same photograph reduced
           1, 2, 4... times, {1: Path, ...}
    mask:  trusted pixels are non-zero; a file or (height, width) numbers
    alpha: a file, white for the object, black for empty background. It is multiplied by the picture's own alpha to give
           the opacity
    split: "train", "test" or "val" if the source publishes it. If no shot of a capture has one, every 8th by name is
           held out
    time:  time of exposure
    depths: (near, far) of this view, in the source's units
    planes: other per-pixel values by the layer's name
    about: other values of the photograph by name: numbers or arrays
    identity: determines the pixels, where `image` is a function, so that they can be cached; None otherwise
    """

    name: str
    pose: Float[np.ndarray, "3 4"]
    lens: Lens
    size: tuple[int, int] | None
    image: dict[int, Path] | Pixels | Callable[[], Pixels]
    mask: Path | np.ndarray | None = None
    alpha: Path | None = None
    split: str | None = None
    time: float | None = None
    depths: tuple[float, float] | None = None
    planes: dict[str, PixelPlane] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    identity: str | None = None


@dataclass(frozen=True)
class Capture:
    """Photographs with poses, and all metadata from a reader.

    source:   a folder, or "procedural:<name>"
    shots:    at least two
    points:   sparse points in the source's frame, from structure from motion; sightings is the number of photographs of
              each
    missing:  listed but missing files; the user is warned, and the rest is used

    Hints, for captures that know more than follows from cameras and points:
    bounds:   the box of interest ((x, y, z), (x, y, z)), source's frame and units
    reach:    half-size of the cube around the bounds' centre that contains everything, source's units
    near:     near distance of rays; the space in front is empty, source's units
    background: background colour
    up:       up direction, source's frame, any length
    around:   of a part of a larger capture, centre and half-size of its box of interest, source's frame and units
    origin:   of the source's frame on Earth; its axes then point east, north and up, in metres
    notes:    warnings for the user, one sentence each
    tracks:   boxes of moving rigid objects, source's frame and units, times as in `Shot.time`
    skeleton: bones of a character at all times, source's frame and units
    blocks:   of a block world, cubes with an edge of one unit of the source
    metric:   a unit of the source is a metre
    poseless: poses are unknown, and those of the shots mean nothing
    kept:     cache pictures even where they fit into memory, since they took long to make
    """

    source: str
    shots: list[Shot]
    points: Float[np.ndarray, "point 3"] | None = None
    point_colours: UInt8[np.ndarray, "point 3"] | None = None
    sightings: np.ndarray | None = None
    missing: list[str] = field(default_factory=list)
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    reach: float | None = None
    near: float | None = None
    background: tuple[float, float, float] | None = None
    up: tuple[float, float, float] | None = None
    around: tuple[tuple[float, float, float], float] | None = None
    origin: GeographicOrigin | None = None
    notes: list[str] = field(default_factory=list)
    tracks: tuple[BoxTrack, ...] = ()
    skeleton: Skeleton | None = None
    kept: bool = False
    blocks: BlockLabels | None = None
    poseless: bool = False
    metric: bool = False

    def with_points(self, kept: Bool[np.ndarray, " point"]) -> Capture:
        """The capture with only some of its points."""
        points, colours, sightings = (
            None if x is None else x[kept] for x in (self.points, self.point_colours, self.sightings)
        )
        return replace(self, points=points, point_colours=colours, sightings=sightings)


def checked_pose(shot: Shot, source: str) -> Float[np.ndarray, "3 4"]:
    """The pose with an exact rotation. Raises LumigraphError for a pose that is not rigid."""
    axes = shot.pose[:, :3]
    if (volume := np.linalg.det(axes)) > 0:  # a camera's own scale has no effect
        axes = axes / np.cbrt(volume)
    if not np.isfinite(shot.pose).all():
        fault = "holds NaN or infinite numbers"
    elif np.abs(shot.pose[:, 3]).max() > MAX_COORDINATE:
        fault = f"is {np.abs(shot.pose[:, 3]).max():.3g} units from the origin, and {MAX_COORDINATE:g} are the most"
    elif np.abs(axes.T @ axes - np.eye(3)).max() > RIGID_TOLERANCE:
        fault = "is not rigid, for its axes are not of unit length and at right angles"
    elif volume < 0:
        fault = "is mirrored"
    else:
        u, _, vt = np.linalg.svd(axes)
        return np.concatenate([u @ vt, shot.pose[:, 3:]], -1)
    raise LumigraphError(f"{source}: the pose of {shot.name} {fault}; correct it or remove that photograph")
