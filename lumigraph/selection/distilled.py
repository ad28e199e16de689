"""Distillation: features of photographs on points of a scene, averaged over all pixels by compositing weights.

    f_i = sum_p w_ip F_p / sum_p w_ip        w_ip: share of Gaussian or voxel i in the colour of pixel p

That mean minimises the squared error of composited features for each point alone, as training does in ISRF (Goel 2023,
section 3.1), in one pass over the photographs. The sum of weights tells which points are observed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ..camera import Camera
from ..datasets.scene import Frame, Photograph
from ..errors import LumigraphError
from ..gaussians import Gaussians
from ..gaussians.splatting import splat, view_of
from ..method.capabilities import HasGaussians, HasLooks, can, needs
from ..system.progress import counting
from ..volume import weights_of

Describe = Callable[[Float[Tensor, "height width 3"]], Float[Tensor, "height width feature"]]
NEAR_PLANE_SCALE = 0.1  # of the scene's near distance, in front of which no Gaussian is drawn
MAX_SIDE = 400  # pixels of a photograph's longer side
CHANNELS = 4  # values that one pass of the rasteriser composites: three colours and a depth
MIN_WEIGHT = 0.05  # pixels; a point with less in all photographs together was not seen
GRID_CELLS = 96  # voxels along the longest side of the box of interest, for fields
NEIGHBOURS = 12  # of each point, in its graph
RAYS = 8192  # of a field, rendered at once


@dataclass(frozen=True)
class SelectionGrid:
    """Voxels in the frame of a method: the lower corner, the length of an edge, and the number along each axis."""

    lower: tuple[float, float, float]
    edge: float
    size: tuple[int, int, int]

    @staticmethod
    def over(frame: Frame, cells: int = GRID_CELLS) -> SelectionGrid:
        """Cubes that cover the box of interest."""
        (a, b, c), upper = frame.bounds
        sides = [high - low for low, high in zip((a, b, c), upper, strict=True)]
        edge = max(sides) / cells
        nx, ny, nz = (max(1, math.ceil(side / edge - 1e-6)) for side in sides)
        return SelectionGrid((a, b, c), edge, (nx, ny, nz))

    @property
    def count(self) -> int:
        return math.prod(self.size)

    def index(self, points: Float[Tensor, "point 3"]) -> tuple[Int[Tensor, " point"], Bool[Tensor, " point"]]:
        """Number of the voxel that holds each point, and whether one does."""
        cell = ((points - points.new_tensor(self.lower)) / self.edge).floor().long()
        size = torch.tensor(self.size, device=points.device)
        inside = ((cell >= 0) & (cell < size)).all(-1)
        x, y, z = torch.where(inside[:, None], cell, 0).unbind(-1)
        return (x * size[1] + y) * size[2] + z, inside

    def middles(self, index: Int[Tensor, " voxel"]) -> Float[Tensor, "voxel 3"]:
        """Middles of voxels by their numbers."""
        _, ny, nz = self.size
        place = torch.stack([index // (ny * nz), index // nz % ny, index % nz], -1)
        return torch.tensor(self.lower) + self.edge * (place + 0.5)


@dataclass(frozen=True)
class Distilled:
    """Points of a scene with features.

    positions: of Gaussians, or centres of observed voxels
    features:  zero for unobserved points
    seen:      weight over all photographs, in pixels
    grid:      of a field's voxels; None for Gaussians
    voxels:    numbers of the points in the grid
    """

    positions: Float[Tensor, "point 3"]
    features: Float[Tensor, "point feature"]
    seen: Float[Tensor, " point"]
    grid: SelectionGrid | None = None
    voxels: Int[Tensor, " point"] | None = None

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def is_seen(self) -> Bool[Tensor, " point"]:
        """Mask of observed points; the colour of others is a guess."""
        return self.seen >= MIN_WEIGHT

    @cached_property
    def graph(self) -> tuple[Int[np.ndarray, "point neighbour"], Float[np.ndarray, "point neighbour"]]:
        """Nearest observed neighbours of each observed point, as indices into the observed ones, and distances."""
        positions = self.positions[self.is_seen].numpy()
        count = min(NEIGHBOURS + 1, len(positions))
        distances, neighbours = cKDTree(positions).query(positions, count, workers=-1)
        return neighbours.reshape(len(positions), -1)[:, 1:], distances.reshape(len(positions), -1)[:, 1:]

    @cached_property
    def nearest_seen(self) -> Int[np.ndarray, " point"]:
        """Index, among the observed points, of the nearest to each point; its own if observed."""
        seen = self.is_seen
        found = np.zeros(len(self), np.int64)
        found[seen.numpy()] = np.arange(int(seen.sum()))
        if not seen.all():
            tree = cKDTree(self.positions[seen].numpy())
            found[~seen.numpy()] = tree.query(self.positions[~seen].numpy(), workers=-1)[1]
        return found

    def spread(self, chosen: Bool[Tensor, " seen"]) -> Bool[Tensor, " point"]:
        """Extend a choice among observed points to all: a hidden one follows the nearest observed one."""
        return chosen[torch.from_numpy(self.nearest_seen)]


@torch.no_grad()
@counting("Distilling features")
def distil_features(
    method: Any, photographs: Sequence[Photograph], describe: Describe, max_side: int = MAX_SIDE
) -> Distilled:
    """Features of photographs on a method's Gaussians, or on voxels of its field.

    Raises LumigraphError for a method that is neither, and where the photographs see nothing of it.
    """
    small = [x.reduced(max(1, math.ceil(max(x.rgb.shape[:2]) / max_side))) for x in photographs]
    weigher = weigher_of(method)
    total = weight = None
    for photograph in small:
        features = describe(photograph.before(method.frame.background))
        both = torch.cat([features, torch.ones_like(features[..., :1])], -1)
        sums = weigher.sums(photograph.camera, both)
        total = sums if total is None else total + sums
    assert total is not None, "no photographs"
    weight = total[:, -1]
    if not bool((weight >= MIN_WEIGHT).any()):
        raise LumigraphError("The photographs see nothing of the scene; are these the ones it was trained on?")
    features = total[:, :-1] / weight.clamp_min(MIN_WEIGHT)[:, None]
    return weigher.distilled(torch.where((weight >= MIN_WEIGHT)[:, None], features, 0.0), weight)


class CloudWeigher:
    """Sums over pixels of values times the weights of Gaussians."""

    def __init__(self, gaussians: Gaussians, near: float):
        self.gaussians, self.near = gaussians, near

    def sums(self, camera: Camera, values: Float[Tensor, "height width channel"]) -> Float[Tensor, "gaussian channel"]:
        """sum_p w_ip V_p: the derivative, by each Gaussian's value, of a picture's product with the values. One forward
        and one backward pass of the rasteriser give four channels."""
        cloud = replace(self.gaussians, harmonics=self.gaussians.harmonics[:, :1])
        with torch.no_grad():
            seen = splat(cloud, view_of(camera, self.near).to(cloud.means.device), 1)
        found = []
        for some in values.to(cloud.means.device).split(CHANNELS, -1):
            some = torch.nn.functional.pad(some, (0, CHANNELS - some.shape[-1]))
            vectors = torch.zeros(len(cloud), 3, device=some.device, requires_grad=True)
            numbers = torch.zeros(len(cloud), device=some.device, requires_grad=True)
            with torch.enable_grad():
                rgb, number, _ = seen.composited(vectors, numbers, 1e-4)
                product = (rgb * some[..., :3]).sum() + (number * some[..., 3]).sum()
                a, b = torch.autograd.grad(product, (vectors, numbers))
            found.append(torch.cat([a, b[:, None]], -1))
        return torch.cat(found, -1)[:, : values.shape[-1]].cpu()

    def distilled(self, features: Float[Tensor, "gaussian feature"], seen: Float[Tensor, " gaussian"]) -> Distilled:
        return Distilled(self.gaussians.means.detach().cpu(), features, seen)

    @torch.no_grad()
    def shown(self, camera: Camera, values: Float[Tensor, " gaussian"]) -> Float[Tensor, "height width"]:
        """A number of each Gaussian, composited: sum_i w_ip x_i."""
        cloud = replace(self.gaussians, harmonics=self.gaussians.harmonics[:, :1])
        seen = splat(cloud, view_of(camera, self.near).to(cloud.means.device), 1)
        device = cloud.means.device
        return seen.composited(torch.zeros(len(cloud), 3, device=device), values.to(device), 1e-4)[1].cpu()


class FieldWeigher:
    """Sums over pixels of values times the weights of samples in each voxel."""

    def __init__(self, method: Any, cells: int = GRID_CELLS):
        self.method, self.grid = method, SelectionGrid.over(method.frame, cells)

    def _weights(self, camera: Camera) -> Any:
        """Chunks of rays: the first one, the ray, voxel and weight of each sample inside the grid."""
        rays = camera.rays(camera.pixels()).to(self.method.device)
        for begin in range(0, len(rays), RAYS):
            some = rays[begin : begin + RAYS]
            look = self.method.looks(some)[-1]
            points, _ = look.samples.along(some)
            index, inside = self.grid.index(points)
            weights = weights_of(look.samples, look.density)
            ray = look.samples.ray_index
            yield begin, ray[inside].cpu() + begin, index[inside].cpu(), weights[inside].cpu()

    @torch.no_grad()
    def sums(self, camera: Camera, values: Float[Tensor, "height width channel"]) -> Float[Tensor, "voxel channel"]:
        """sum_p w_vp V_p, with w_vp the weights of pixel p's samples in voxel v."""
        flat = values.flatten(0, 1)
        found = torch.zeros(self.grid.count, flat.shape[-1])
        for _, ray, index, weights in self._weights(camera):
            found.index_add_(0, index, weights[:, None] * flat[ray])
        return found

    def distilled(self, features: Float[Tensor, "voxel feature"], seen: Float[Tensor, " voxel"]) -> Distilled:
        kept = (seen >= MIN_WEIGHT).nonzero()[:, 0]
        return Distilled(self.grid.middles(kept), features[kept], seen[kept], self.grid, kept)

    @torch.no_grad()
    def shown(self, camera: Camera, values: Float[Tensor, " voxel"]) -> Float[Tensor, "height width"]:
        """A number of each voxel, composited."""
        width, height = camera.size[0].tolist()
        found = torch.zeros(width * height)
        for _, ray, index, weights in self._weights(camera):
            found.index_add_(0, ray, weights * values[index])
        return found.view(height, width)


Weigher = CloudWeigher | FieldWeigher


@torch.no_grad()
def weigher_of(method: Any) -> Weigher:
    """The weights of a method's points in a picture. Raises LumigraphError for one with neither Gaussians nor looks."""
    if can(method, HasGaussians):
        return CloudWeigher(method.gaussians(), NEAR_PLANE_SCALE * method.frame.near)
    return FieldWeigher(needs(method, HasLooks))
