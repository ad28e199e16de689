"""Photographs stored in a method as bytes, with a depth map of each."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from ...camera import Camera
from ...camera.camera import PIXEL_RADIUS
from ...camera.lens import OpenCV, Pinhole
from ...datasets.scene import Scene, Vector
from ...depth_maps.patch_match import padded
from ..fields.kept_photographs import Kept, KeptPhotographs
from .depth import Geometry, complete_depths, depth_camera, flattened, shape

EDGE_RATIO = 1.05  # of distances within a triangle, above which one surface ends before another
NOTHING = 1e9  # distance where nothing is, in tables for kernels
TURN_WEIGHT = 1.0  # of the turn between two cameras' axes, beside their distance in units of the scene's depth
FLAT_LIMIT = math.tan(math.radians(89.0))


@dataclass(frozen=True)
class DepthGrid:
    """Visible surface of one photograph, as triangles between the pixels of its depth map.

    faces: of neighbouring pixels at about the same distance
    """

    vertices: Float[Tensor, "vertex 3"]
    confidence: Float[Tensor, "vertex 1"]
    faces: Int[Tensor, "face 3"]


@dataclass
class ViewTables:
    """Photographs as input of `kernels.blend_views`.

    pictures: colours over the background, and alpha if photographs have it
    """

    cameras: Camera
    pictures: UInt8[Tensor, "view rows columns channel"]
    depths: Float[Tensor, "view depth_rows depth_columns"]
    sizes: Int[Tensor, "view 4"]
    poses: Float[Tensor, "view 3 4"]
    lenses: Float[Tensor, "view 13"]
    middle: Float[Tensor, ""]
    grids: dict[int, DepthGrid] = field(default_factory=dict)

    def nearest(self, camera: Camera, count: int) -> list[int]:
        """Photographs sorted by distance from a camera, in depths of the scene, and rotation between."""
        apart = (self.cameras.position - camera.position).norm(dim=-1) / self.middle
        if isinstance(camera.lens, Pinhole | OpenCV):
            apart = apart + TURN_WEIGHT * (1 - self.cameras.forward @ camera.forward[0])
        return apart.argsort()[:count].tolist()


class KeptViews(nn.Module):
    """Photographs as bytes, cameras, and two numbers for each pixel of their depth maps: distance and confidence.

    depth_size: largest longer side of a depth map, pixels
    """

    def __init__(self, depth_size: int):
        super().__init__()
        self.depth_size = depth_size
        self.photographs = KeptPhotographs(2)
        self.alpha = Kept(torch.empty(0, dtype=torch.uint8))
        self._tables: ViewTables | None = None

    def __bool__(self) -> bool:
        return bool(self.photographs)

    def keep(self, scene: Scene, geometry: Geometry, mesh_file: str, background: Vector, seconds: float) -> None:
        """Store the training photographs, and compute their depth."""
        taken = [flattened(scene.photograph(int(i))) for i in scene.splits["train"]]
        depths = complete_depths(scene, taken, geometry, self.depth_size, mesh_file, seconds)
        device = self.photographs.pixels.rows.device
        self.photographs = KeptPhotographs.of(taken, background, 2).to(device)
        alphas = [x.alpha.mul(255).round().byte().flatten() for x in taken if x.alpha is not None]
        if len(alphas) == len(taken):
            self.alpha.rows = torch.cat(alphas).to(device)
        rows = [torch.stack([one.distance, one.confidence], -1).view(-1, 2) for one in depths]
        self.photographs.found.rows = torch.cat(rows).to(device)
        self._tables = None

    @property
    def tables(self) -> ViewTables:
        """Tables of the stored photographs, on their device."""
        kept = self.photographs
        if self._tables is None or self._tables.pictures.device != kept.pixels.rows.device:
            self._tables = self._made()
        return self._tables

    def _made(self) -> ViewTables:
        kept = self.photographs
        device, cameras = kept.pixels.rows.device, kept.cameras()
        grids = [depth_camera(cameras[i], self.depth_size) for i in range(len(cameras))]
        parts = kept.found.rows.split([int(grid.size.prod()) for grid in grids])
        distances = [part[:, 0].view(shape(grid)) for part, grid in zip(parts, grids, strict=True)]
        usable = [torch.where(x.isnan(), 0, x.clamp_max(NOTHING)) for x in distances]
        pictures = kept.pixels.rows.split([3 * int(size.prod()) for size in cameras.size])
        sides = cameras.size.tolist()
        shaped = [x.view(h, w, 3) for x, (w, h) in zip(pictures, sides, strict=True)]
        if len(self.alpha.rows):
            alphas = self.alpha.rows.split([w * h for w, h in sides])
            shaped = [torch.cat([x, a.view(*x.shape[:2], 1)], -1) for x, a in zip(shaped, alphas, strict=True)]
        turn = cameras.pose[:, :, :3].mT
        poses = torch.cat([turn, -turn @ cameras.pose[:, :, 3:]], -1)
        sizes = torch.cat([cameras.size, torch.cat([grid.size for grid in grids])], 1)
        middle = torch.stack([x[x.isfinite()].median() for x in distances if x.isfinite().any()]).median()
        lenses = torch.stack([lens_row(cameras[i]) for i in range(len(cameras))])
        pixels, depths, sizes, poses, lenses, middle = (
            x.to(device).contiguous() for x in (padded(shaped), padded(usable), sizes, poses, lenses, middle)
        )
        return ViewTables(cameras.to(device), pixels, depths, sizes, poses, lenses, middle)

    def grid(self, i: int) -> DepthGrid:
        """Visible surface of one photograph."""
        tables = self.tables
        if i not in tables.grids:
            width, height = tables.sizes[i, 2:].tolist()
            camera = depth_camera(tables.cameras[i], self.depth_size)
            first = int(tables.sizes[:i, 2:].prod(-1).sum())
            rows = self.photographs.found.rows[first : first + width * height]
            tables.grids[i] = depth_grid(camera, rows[:, 0].view(height, width), rows[:, 1:])
        return tables.grids[i]


def depth_grid(camera: Camera, distance: Float[Tensor, "height width"], confidence: Tensor) -> DepthGrid:
    """Two triangles between any four neighbouring pixels on one surface."""
    height, width = distance.shape
    distance = continued(distance)
    places = camera.rays(camera.pixels()).at(distance.flatten().nan_to_num(0.0, 0.0))
    index = torch.arange(height * width, device=distance.device, dtype=torch.int32).view(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = torch.stack([torch.stack([a, c, b], -1), torch.stack([d, b, c], -1)]).view(-1, 3)
    at = distance.flatten()[faces.long()]
    one = at.isfinite().all(-1) & (at.amax(-1) < EDGE_RATIO * at.amin(-1))
    return DepthGrid(places, confidence.contiguous(), faces[one].contiguous())


def continued(distance: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Distances of a surface extrapolated by one pixel into empty space: alpha has its edge more exactly."""
    there = distance.isfinite()
    stacked = torch.stack([torch.where(there, distance, 0), there.float()])[None]
    total, share = avg_pool2d(stacked, 3, 1, 1)[0]
    return torch.where(distance.isposinf() & (share > 0), total / share.clamp_min(1e-6), distance)


def lens_row(camera: Camera) -> Float[Tensor, " 13"]:
    """Parameters of a flat lens for `kernels.blend_views`."""
    lens = camera.lens
    if isinstance(lens, OpenCV):
        return torch.cat([lens.focal[0], lens.centre[0], lens.distortion[0], lens.fold[0]])
    return torch.cat([lens.focal[0], lens.centre[0], torch.zeros(8), torch.tensor([FLAT_LIMIT])])  # type: ignore[attr-defined]


def focal_length(camera: Camera) -> float:
    """Focal length at the centre of a picture, in pixels: the inverse of the angle of a pixel."""
    middle = camera.rays(camera.size[:1].float() / 2)
    return PIXEL_RADIUS / float(middle.radius[0])
