"""Point clouds of opaque surfaces: back-projected depth of a scene's cameras, thinned evenly."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..camera import Camera
from ..camera.crop import Crop
from ..datasets.scene import Frame, GeographicOrigin
from ..depth_maps import DepthMap, SurfacePoints, Tolerance, render_depth_maps
from ..errors import LumigraphError
from ..files import write_bytes
from ..files.ply import write_rows
from ..geometry import is_far
from ..method import Method
from ..system.progress import counting, track
from ..system.work import at_work
from .loaded import Loaded
from .options import PointsOptions
from .surface import name_cut

CANDIDATES_PER_POINT = 4  # pixels that are considered for each point
MIN_COSINE = 0.2  # cosine between a surface's normal and the ray from which on its depth is trusted
DEPTH_TOLERANCE = 0.01  # of the distance from the camera: depths that agree
LAS_STEP = 1e-4  # of the distance between neighbours, to which coordinates are rounded
MIN_VIEWS = 2  # further cameras that must see a surface at the same place, where there are so many


@dataclass(frozen=True)
class PointCloud:
    """Points of surfaces, in the frame of their maker: scene or source.

    normals: unit length, towards the cameras
    colours: sRGB-encoded
    """

    positions: Float[np.ndarray, "point 3"]
    normals: Float[np.ndarray, "point 3"]
    colours: UInt8[np.ndarray, "point 3"]

    @property
    def spacing(self) -> float:
        """About the distance between neighbours."""
        return float(np.ptp(self.positions, axis=0).max()) / max(len(self.positions), 1) ** 0.5

    def in_source(self, frame: Frame) -> PointCloud:
        """From the scene's frame to that of the capture, in the unit of exports."""
        positions, normals = (torch.from_numpy(x) for x in (self.positions, self.normals))
        there = frame.to_export
        return PointCloud(there.points(positions).numpy(), there.directions(normals).numpy(), self.colours)


def export_points(loaded: Loaded, options: PointsOptions = PointsOptions()) -> PointCloud:
    """Points of what is loaded, in the frame of exports."""
    still, surveyors = loaded.still, loaded.opened.survey(loaded.cameras["train"])
    points = extract_points(still.without_floaters(), surveyors, options, still.crop)
    return points.in_source(loaded.frame)


@torch.no_grad()
@at_work()
def extract_points(
    method: Method, cameras: Camera, options: PointsOptions = PointsOptions(), crop: Crop | None = None
) -> PointCloud:
    """Points in the scene's frame, spread evenly over what the cameras see.

    crop: region of the points; None for everywhere
    A point stays if other cameras see a surface there too, and at most half as many look through it. Raises
    LumigraphError where nothing is solid.
    """
    method.eval()
    depth_maps = render_depth_maps(method.render, cameras, method.frame.background, options.views, options.size)
    good = [seen.solid & (seen.facing > MIN_COSINE) for seen in depth_maps]
    if crop is not None:
        every = sum(int(mask.sum()) for mask in good)
        for seen, mask in zip(depth_maps, good, strict=True):
            mask[mask.clone()] = crop.holds(seen.positions(mask))
        inside = sum(int(mask.sum()) for mask in good)
        name_cut(1 - inside / max(every, 1), "lies outside the crop", "a larger one holds more")
    share = min(1.0, CANDIDATES_PER_POINT * options.count / max(1, sum(int(x.sum()) for x in good)))
    chance = torch.Generator().manual_seed(0)
    found = []
    for seen, mask in zip(depth_maps, good, strict=True):
        found.append(seen.points(mask & (torch.rand(mask.shape, generator=chance) < share)))
    points = SurfacePoints.cat(found)
    points = points[confirmed(points.points, depth_maps)]
    kept = torch.cat([points.points, points.normals, points.colours], -1).double().numpy()
    if not len(kept):
        raise LumigraphError(
            "No two cameras agree on where anything solid is"
            f"{'' if crop is None else ' inside the crop'}, so there are no points; train for longer and try again"
        )
    with counting("Thinning points"):
        columns = thinned(kept, options.count)
    normals = columns[:, 3:6] / np.maximum(np.linalg.norm(columns[:, 3:6], axis=-1, keepdims=True), 1e-30)
    return PointCloud(columns[:, :3], normals, (columns[:, 6:] * 255).round().astype(np.uint8))


def confirmed(points: Float[Tensor, "point 3"], depth_maps: list[DepthMap]) -> Bool[Tensor, " point"]:
    """Mask of points with enough cameras that see a surface, and few that see through."""
    agree, through = torch.zeros(len(points), dtype=torch.int64), torch.zeros(len(points), dtype=torch.int64)
    for depth_map in track(depth_maps, "Comparing depth maps", len(depth_maps)):
        away = (points - depth_map.camera.position).norm(dim=-1)
        seen = depth_map.compare(points, Tolerance(DEPTH_TOLERANCE * float(away.median())))
        agree += seen.smooth & (seen.ahead.abs() < DEPTH_TOLERANCE * away)
        through += seen.ahead > DEPTH_TOLERANCE * away
    return (agree > min(MIN_VIEWS, len(depth_maps) - 1)) & (through <= agree / 2)


def thinned(columns: Float[np.ndarray, "point column"], count: int) -> Float[np.ndarray, "thinned column"]:
    """Means within grid cells of the least size that gives at most `count`. The first three columns are positions."""
    if len(columns) <= count:
        return columns
    low, extent = columns[:, :3].min(0), float(np.ptp(columns[:, :3], axis=0).max())
    small, large = extent / (1 << 20), 2 * extent
    while large > 1.01 * small:
        middle = float(np.sqrt(small * large))
        if len(np.unique(cells(columns, low, middle))) > count:
            small = middle
        else:
            large = middle
    _, cell, filled = np.unique(cells(columns, low, large), return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, column, len(filled)) for column in columns.T]
    return np.stack(sums, -1) / filled[:, None]


def cells(
    columns: Float[np.ndarray, "point column"], low: Float[np.ndarray, " 3"], size: float
) -> Int[np.ndarray, " point"]:
    """A number for the cell of space that each point lies in."""
    return ((columns[:, :3] - low) / size).astype(np.int64) @ np.array([1 << 42, 1 << 21, 1])


def write_points(path: Path, points: PointCloud, origin: GeographicOrigin | None = None) -> None:
    """A binary PLY file: x y z (float32, or float64 far from the origin), nx ny nz (float32), red green blue (bytes);
    or `las` by the ending.

    origin: of the points' frame on Earth, for a comment of a PLY file
    """
    if path.suffix.lower() != ".ply":
        write_bytes(path, las(path, points), "points")
        return
    floats, bytes_ = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    exact = "<f8" if is_far(points.positions, points.spacing) else "<f4"
    kinds = [*((name, exact) for name in floats[:3]), *((name, "<f4") for name in floats[3:])]
    rows = np.empty(len(points.positions), [*kinds, *((name, "u1") for name in bytes_)])
    values = np.concatenate([points.positions, points.normals, points.colours], -1)
    for name, column in zip((*floats, *bytes_), values.T, strict=True):
        rows[name] = column
    write_rows(
        path, "points", {"vertex": rows}, ["written by Lumigraph", *([] if origin is None else [origin.sentence])]
    )


def las(path: Path, points: PointCloud) -> bytes:
    """A LAS file, packed if the name ends in .laz: integers of 32 bits with a scale of a power of ten and an offset in
    doubles, colours of 16 bits, normals in extra dimensions. Raises LumigraphError without laspy."""
    try:
        import laspy
    except ImportError as fault:
        raise LumigraphError(f"{path} needs laspy; install it: pip install 'lumigraph[lidar]', or name .ply") from fault
    header = laspy.LasHeader(version="1.2", point_format=2)
    header.generating_software, header.offsets = "Lumigraph", np.median(points.positions, 0).round()
    largest = np.abs(points.positions - header.offsets).max()
    step = max(LAS_STEP * points.spacing, largest / np.iinfo(np.int32).max, np.finfo(np.float32).tiny)
    header.scales = np.full(3, 10.0 ** np.ceil(np.log10(step)))
    header.add_extra_dims([laspy.ExtraBytesParams(f"Normal{axis}", "f4") for axis in "XYZ"])
    made = laspy.LasData(header)
    made.x, made.y, made.z = points.positions.T
    made.red, made.green, made.blue = 257 * points.colours.T.astype(np.uint16)
    made.NormalX, made.NormalY, made.NormalZ = points.normals.T.astype(np.float32)
    made.write(held := io.BytesIO(), do_compress=path.suffix.lower() == ".laz")
    return held.getvalue()
