"""Input of segmentation: small photographs in superpixels, and the region of space for an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from skimage.color import rgb2lab
from skimage.segmentation import slic
from torch import Tensor

from ...camera import Camera

MAX_SIDE = 400  # pixels of the longer side
SUPERPIXELS = 1500  # of a picture (SLIC, Achanta 2012)
COMPACTNESS = 8.0
GRID_SIDE = 56  # cells along each side of the searched cube
MIN_VIEW_SHARE = 0.7  # share of the views whose picture must contain a cell of the object
MIN_LEVEL_COSINE = 0.9  # between a table's normal and up
MIN_TABLE_SHARE = 0.06  # of the points nearby that lie on a table
MAX_BELOW_SHARE = 0.1  # of the points nearby that may lie below a table
TABLE_THICKNESS = 0.015  # of the cube's half-size
RANSAC_TRIALS = 500  # of three points each (RANSAC, Fischler and Bolles 1981)


@dataclass
class ObjectView:
    """A small photograph in superpixels.

    lab:     colours in CIELAB
    patches: superpixel number of each pixel
    colours: mean colour of each superpixel
    edges:   pairs of adjacent superpixels
    lengths: of each pair's common border, in pixels
    """

    name: str
    camera: Camera
    lab: Float[np.ndarray, "height width 3"]
    patches: Int[np.ndarray, "height width"] = field(init=False)
    colours: Float[np.ndarray, "patch 3"] = field(init=False)
    sizes: Float[np.ndarray, " patch"] = field(init=False)
    edges: Int[np.ndarray, "edge 2"] = field(init=False)
    lengths: Float[np.ndarray, " edge"] = field(init=False)

    def __post_init__(self) -> None:
        # SLIC scales what it is given to [0, 1]; compactness is meant for CIELAB's own units.
        compact = COMPACTNESS / float(np.ptp(self.lab))
        self.patches = slic(
            self.lab, SUPERPIXELS, compact, max_num_iter=5, start_label=0, convert2lab=False, channel_axis=2
        )
        count = int(self.patches.max()) + 1
        self.sizes = np.bincount(self.patches.ravel(), minlength=count).astype(np.float64)
        self.colours = np.stack([self.mean(self.lab[..., k]) for k in range(3)], -1)
        across = np.stack([self.patches[:, :-1].ravel(), self.patches[:, 1:].ravel()], -1)
        down = np.stack([self.patches[:-1].ravel(), self.patches[1:].ravel()], -1)
        pairs = np.sort(np.concatenate([across, down]), -1)
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        self.edges, lengths = np.unique(pairs, axis=0, return_counts=True)
        self.lengths = lengths.astype(np.float64)

    @staticmethod
    def of(name: str, camera: Camera, rgb: Float[torch.Tensor, "height width 3"]) -> ObjectView:
        """A view of a photograph of any size."""
        share = min(1.0, MAX_SIDE / max(rgb.shape[:2]))
        small = camera.resized(share)
        width, height = small.size[0].tolist()
        shrunk = torch.nn.functional.interpolate(rgb.permute(2, 0, 1)[None].float(), (height, width), mode="area")[
            0
        ].permute(1, 2, 0)
        return ObjectView(name, small, rgb2lab(shrunk.clamp(0, 1).numpy()))

    def mean(self, values: Float[np.ndarray, "height width"]) -> Float[np.ndarray, " patch"]:
        """The mean of pixels' values in each superpixel."""
        return np.bincount(self.patches.ravel(), values.ravel(), len(self.sizes)) / self.sizes

    def at(
        self, points: Float[torch.Tensor, "point 3"]
    ) -> tuple[Int[np.ndarray, "point 2"], Bool[np.ndarray, " point"]]:
        """(row, column) of points, clamped to the picture, and a mask of those inside."""
        places, inside = self.camera.locate(points)
        return places.numpy(), inside.numpy()

    def shadow(self, points: Float[torch.Tensor, "point 3"], size: float) -> Float[np.ndarray, "height width"]:
        """Coverage of each pixel by cubes of side `size` at points: about 1 inside, 0 outside."""
        places, inside = self.at(points)
        hit = np.zeros(self.lab.shape[:2])
        hit[tuple(places[inside].T)] = 1.0
        radius = self.pixels(points, size)
        grown = ndimage.maximum_filter(hit, size=2 * int(np.ceil(radius)) + 1)
        closed = ndimage.minimum_filter(grown, size=2 * int(np.floor(0.5 * radius)) + 1)
        return ndimage.gaussian_filter(closed, 0.5 * radius)

    def pixels(self, points: Float[torch.Tensor, "point 3"], size: float) -> float:
        """Size of a length at the mean of points, in pixels."""
        middle = points.mean(0)
        ends, _ = self.camera.project(torch.stack([middle, middle + size * self.camera.pose[0, :, 0]]))
        return max(1.0, float((ends[1] - ends[0]).norm()))


@dataclass(frozen=True)
class TablePlane:
    """A plane below the object: points with normal . x > height are above it."""

    normal: Float[Tensor, " 3"]
    height: float

    def above(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Height of points above the plane, scene units."""
        return points @ self.normal - self.height


@dataclass(frozen=True)
class Region:
    """Candidate cells of the object.

    cells: their centres
    size:  their side
    table: supporting plane, if found in the points
    """

    cells: Float[Tensor, "cell 3"]
    size: float
    table: TablePlane | None

    def holds(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        """Mask of the points that lie in one of the cells."""
        if not len(points):
            return torch.zeros(0, dtype=torch.bool)
        low = self.cells.amin(0) - 0.5 * self.size
        filled = torch.zeros((GRID_SIDE + 2,) * 3, dtype=torch.bool)
        filled[((self.cells - low) / self.size).long().unbind(-1)] = True
        index = ((points - low) / self.size).floor().long()
        inside = ((index >= 0) & (index < GRID_SIDE)).all(-1)
        return inside & filled[index.clamp(0, GRID_SIDE + 1).unbind(-1)]


def find_region(views: Sequence[ObjectView], points: Float[Tensor, "point 3"] | None) -> Region:
    """Cells of [-1, 1]^3 visible in most pictures and above the table, if sparse points show one."""
    size = 2 / GRID_SIDE
    axis = torch.linspace(-1 + 0.5 * size, 1 - 0.5 * size, GRID_SIDE)
    cells = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    seen = np.mean([view.at(cells)[1] for view in views], 0)
    cells = cells[torch.from_numpy(seen) >= MIN_VIEW_SHARE]
    table = None if points is None else find_table(points)
    if table is not None:
        cells = cells[table.above(cells) > 0.5 * TABLE_THICKNESS]
    return Region(cells, size, table)


def find_table(points: Float[Tensor, "point 3"]) -> TablePlane | None:
    """Horizontal plane with most nearby points on it and hardly any below; None without one."""
    near = points[points.abs().amax(-1) < 1.5].double()
    if len(near) < 50:
        return None
    chance = torch.Generator().manual_seed(0)
    three = near[torch.randint(0, len(near), (RANSAC_TRIALS, 3), generator=chance)]
    normals = torch.linalg.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    normals = normals * normals[:, 2:].sign()
    heights = (normals * three[:, 0]).sum(-1)
    away = near @ normals.T - heights
    on, below = (away.abs() < TABLE_THICKNESS).double().mean(0), (away < -2 * TABLE_THICKNESS).double().mean(0)
    score = torch.where((normals[:, 2] > MIN_LEVEL_COSINE) & (below < MAX_BELOW_SHARE), on, 0.0)
    best = int(score.argmax())
    if score[best] < MIN_TABLE_SHARE:
        return None
    some = near[away[:, best].abs() < TABLE_THICKNESS]
    middle = some.mean(0)
    normal = torch.linalg.svd(some - middle, full_matrices=False).Vh[2]
    normal = normal * normal[2].sign()
    return TablePlane(normal.float(), float(normal @ middle))
