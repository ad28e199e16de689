"""Geometry of a field on a grid: surface points, normals, and light that reaches them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import conv1d, grid_sample

from ...camera.rays import Samples
from ...datasets.scene import Frame
from ...exchange.packing import Stored
from ...geometry import unit
from ...method import Part
from ...volume import weights_of
from .loops import transmittance

MARGIN = 2  # cells around the box of interest
POINTS_PER_CHUNK = 1 << 17  # at which density is evaluated together
STEP = 0.7  # of a cell, along rays to lights
STOP = 6.0  # optical thickness at which nothing is left
LIFT = 2.0  # cells above a surface at which rays to lights begin
FOG = 0.3  # optical thickness of a cell up to which it is taken for fog and left out
BLUR = 1.4  # standard deviation in cells of the solid that normals are the slope of
MIN_SLOPE = 1e-3  # of the solid over two cells
SOLID = 4.0  # cells of a density's optical thickness that make a solid
SURFACE_SHARE = 0.25  # share of a ray's opacity at which its surface is; half lies behind the true one


class SurfaceGrid(Part):
    """Density of a scene in cubic cells of its box of interest, and blurred occupancy.

    extinction: mean density of each cell, per scene unit
    solid:      blurred filled share of each cell
    """

    extinction: Tensor
    solid: Tensor
    low: Tensor

    def __init__(self, frame: Frame, resolution: int):
        super().__init__()
        low, high = (torch.tensor(corner) for corner in frame.bounds)
        self.cell = float((high - low).max()) / resolution
        shape = [math.ceil(float(x) / self.cell) + 2 * MARGIN for x in high - low]
        middle = 0.5 * (low + high)
        self.register_buffer("low", middle - 0.5 * self.cell * torch.tensor(shape, dtype=torch.float32))
        self.register_buffer("extinction", torch.zeros(shape))
        self.register_buffer("solid", torch.zeros(shape))
        self._marching: tuple[np.ndarray, np.ndarray] | None = None

    @staticmethod
    def bytes_of(frame: Frame, resolution: int) -> int:
        low, high = frame.bounds
        side = max(b - a for a, b in zip(low, high, strict=True)) / resolution
        return 8 * math.prod(math.ceil((b - a) / side) + 2 * MARGIN for a, b in zip(low, high, strict=True))

    @torch.no_grad()
    def fill(self, density: Callable[[Tensor], Tensor], chance: torch.Generator, samples: int = 2) -> None:
        """Sample a field's density at random points of each cell."""
        index = torch.stack(torch.meshgrid(*(torch.arange(n) for n in self.extinction.shape), indexing="ij"), -1)
        for part, cells in zip(
            torch.arange(self.extinction.numel()).split(POINTS_PER_CHUNK),
            index.reshape(-1, 3).split(POINTS_PER_CHUNK),
            strict=True,
        ):
            passed = torch.zeros(len(cells))
            for _ in range(samples):
                places = (cells + torch.rand(len(cells), 3, generator=chance)).to(self.low) * self.cell + self.low
                passed += torch.exp(-density(places) * self.cell).cpu() / samples
            thickness = -passed.clamp_min(1e-6).log()
            self.extinction.view(-1)[part] = (torch.where(thickness > FOG, thickness, 0) / self.cell).to(self.low)
        self._marching = None
        self.solid.copy_(blurred(1 - torch.exp(-SOLID * self.cell * self.extinction), BLUR))

    def at(self, grid: Float[Tensor, "x y z"], points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Trilinear values of a grid."""
        size = torch.tensor(grid.shape, device=points.device)
        places = ((points - self.low) / (0.5 * self.cell * size) - 1).flip(-1)
        return grid_sample(grid[None, None], places[None, None, None], align_corners=False)[0, 0, 0, 0]

    def normals(self, points: Float[Tensor, "point 3"], eyes: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Outward unit normals: minus the gradient of blurred occupancy; towards the eye where that is zero."""
        steps = self.cell * torch.eye(3, device=points.device)
        each = [self.at(self.solid, points + step) - self.at(self.solid, points - step) for step in steps]
        slope = torch.stack(each, -1)
        return unit(torch.where(slope.norm(dim=-1, keepdim=True) > MIN_SLOPE, -slope, eyes))

    @torch.no_grad()
    def visibility(
        self,
        points: Float[Tensor, "point 3"],
        normals: Float[Tensor, "point 3"],
        directions: Float[Tensor, "light 3"],
    ) -> Float[Tensor, "point light"]:
        """Transmittance from each surface point to lights at infinity, 0 below the horizon."""
        starts = points + LIFT * self.cell * normals
        if points.is_cuda:
            return self.marched(starts, normals, directions)
        out = torch.empty(len(points), len(directions))
        given = (x.float().contiguous().numpy() for x in (starts, normals, directions))
        if self._marching is None:
            # Whole steps to the nearest matter, so that a ray passes them at once.
            away = (distance_transform_edt((self.extinction == 0).numpy()) - 2) / STEP
            thickness = self.extinction * (STEP * self.cell)
            self._marching = thickness.numpy(), away.clip(0, 255).astype(np.uint8)
        cell, step, stop = (np.float32(x) for x in (self.cell, STEP, STOP))
        transmittance(*self._marching, self.low.numpy(), cell, step, stop, *given, out.numpy())
        return out

    def marched(
        self,
        starts: Float[Tensor, "point 3"],
        normals: Float[Tensor, "point 3"],
        directions: Float[Tensor, "light 3"],
    ) -> Float[Tensor, "point light"]:
        """Transmittance by equal steps, exp(-sum sigma d): the definition of `loops.transmittance`."""
        step = STEP * self.cell
        size = torch.tensor(self.extinction.shape, device=starts.device)
        count = math.ceil(float(size.float().norm()) / STEP)
        tau = torch.zeros(len(starts), len(directions), device=starts.device)
        places = (starts[:, None] - self.low) / self.cell + 0.5 * STEP * directions
        going = (normals @ directions.T) > 0
        above = going.clone()
        for _ in range(count):
            inside = going & ((places >= 0) & (places < size)).all(-1)
            x, y, z = places.long().clamp(min=torch.zeros_like(size), max=size - 1).unbind(-1)
            tau += torch.where(inside & (tau < STOP), self.extinction[x, y, z] * step, 0)
            going, places = inside, places + STEP * directions
        return torch.exp(-tau) * above

    def storage(self) -> dict[str, Stored]:
        return {"extinction": Stored("half"), "solid": Stored("half")}


def blurred(grid: Float[Tensor, "x y z"], deviation: float) -> Float[Tensor, "x y z"]:
    """Gaussian blur along all axes."""
    reach = math.ceil(3 * deviation)
    offsets = torch.arange(-reach, reach + 1, device=grid.device)
    kernel = torch.exp(-0.5 * (offsets / deviation) ** 2)
    kernel = (kernel / kernel.sum())[None, None]
    for axis in range(3):
        lines = grid.movedim(axis, -1)
        grid = conv1d(lines.reshape(-1, 1, lines.shape[-1]), kernel, padding=reach).view_as(lines).movedim(-1, axis)
    return grid


def surface_distance(
    samples: Samples, density: Float[Tensor, " sample"]
) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
    """Distance at which a share of each ray's opacity is reached, infinite without any, and the opacity."""
    weights = weights_of(samples, density).double()
    passed = torch.nn.functional.pad(weights.cumsum(0), (1, 0))
    begin, end = samples.ray_starts[:-1], samples.ray_starts[1:]
    opacity = passed[end] - passed[begin]
    wanted = passed[begin] + SURFACE_SHARE * opacity
    first = (torch.searchsorted(passed, wanted) - 1).clamp(min=begin).minimum((end - 1).clamp(min=begin))
    hit = (end > begin) & (opacity > 1e-3)
    first = torch.where(hit, first, 0)
    if not len(weights):
        return torch.full_like(opacity, torch.inf).float(), opacity.float()
    share = (wanted - passed[first]) / weights[first].clamp_min(1e-12)
    distance = samples.t_start[first] + share.clamp(0, 1).float() * samples.length[first]
    return torch.where(hit, distance, torch.inf), opacity.float()
