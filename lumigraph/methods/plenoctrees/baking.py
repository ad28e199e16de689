"""Baking a field into an octree: visible cells, their density and harmonics (Yu 2021, section 4).

A teacher is anything with density and colour at points. If it samples along rays, only cells with samples are baked: a
field's density in cells without samples is untrained.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import max_pool3d

from ...camera import Camera
from ...camera.rays import Rays
from ...errors import LumigraphError
from ...kernels import composite
from ...system.memory import free_on, gigabytes
from ...volume import weights_of
from .leaves import Leaves, codes_of

MAX_CELLS = 128  # along each axis of the lattice that a teacher's samples mark, at most
MAX_MARKING_RAYS = 1 << 17  # rays that mark it, at most
RAYS_PER_CHUNK = 1 << 13  # rays asked at once
POINTS_PER_CHUNK = 1 << 18  # points asked at once
RAYS_PER_CELL = 32  # rays that look, for each cell of one face of the cube
MAX_RAYS = 1 << 22
MIN_TRANSMITTANCE = 1e-6  # share of light that a leaf lets through

Density = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]
Geometry = Callable[[Float[Tensor, "point 3"]], tuple[Float[Tensor, " point"], Float[Tensor, "point harmonic"]]]


@dataclass(frozen=True)
class Baking:
    """Numbers of baking.

    depth:     levels of the octree
    points:    random points of a leaf over which density and harmonics are averaged
    threshold: compositing weight that a leaf must have in some view
    near:      distance from a camera at which its rays begin
    """

    depth: int
    points: int
    threshold: float
    near: float


@torch.no_grad()
def bake(
    leaves: Leaves,
    density: Density,
    mask: Bool[Tensor, "x y z"] | None,
    cameras: Camera,
    numbers: Baking,
    generator: torch.Generator,
) -> None:
    """Fill leaves with a field's density, within the cameras' view; harmonics come after.

    density: at points, per scene unit
    mask:    possibly occupied cells of a lattice over [-1, 1]^3; None for all
    Raises LumigraphError if nothing is visible, or if so deep an octree exceeds memory.
    """
    leaves.low, leaves.size = tight_cube(mask, leaves.low.device)
    codes = dense_cells(density, leaves, mask, numbers)
    fill(leaves, codes)
    averaged_density(leaves, density, numbers.points, generator)
    leaves.keep(seen(leaves, cameras, numbers, generator))
    if not len(leaves):
        raise LumigraphError("No camera sees anything dense in this field, so no octree can be made; train it longer")


def random_rays(cameras: Camera, count: int, generator: torch.Generator) -> Rays:
    """Rays through random places on random pictures."""
    index = torch.randint(len(cameras), (count,), generator=generator)
    pixels = torch.rand(count, 2, generator=generator) * cameras.size.cpu()[index]
    return cameras.rays(pixels.to(cameras.pose), index.to(cameras.pose.device))


def met(teacher: Any, cameras: Camera, numbers: Baking, generator: torch.Generator) -> Bool[Tensor, "x y z"]:
    """Cells of a lattice over [-1, 1]^3 with weight of a teacher's samples, and neighbouring ones."""
    n = min(MAX_CELLS, 1 << numbers.depth)
    marks = torch.zeros(n**3, dtype=torch.bool, device=teacher.device)
    for _ in range(0, min(RAYS_PER_CELL << 2 * numbers.depth, MAX_MARKING_RAYS), RAYS_PER_CHUNK):
        rays = random_rays(cameras, RAYS_PER_CHUNK, generator).to(teacher.device)
        look = teacher.looks(rays)[-1]
        points = look.samples.along(rays)[0][weights_of(look.samples, look.density) > numbers.threshold]
        x, y, z = ((points * 0.5 + 0.5) * n).long().clamp(0, n - 1).unbind(-1)
        marks[(x * n + y) * n + z] = True
    around = max_pool3d(marks.view(1, 1, n, n, n).float(), 3, 1, 1)
    return around[0, 0] > 0


def tight_cube(
    mask: Bool[Tensor, "x y z"] | None, device: torch.device
) -> tuple[Float[Tensor, " xyz"], Float[Tensor, ""]]:
    """Corner and side of the smallest cube around all marked cells; the whole lattice for an empty or missing mask."""
    if mask is None or not mask.any():
        return torch.full((3,), -1.0, device=device), torch.tensor(2.0, device=device)
    places, cell = mask.nonzero(), 2 / len(mask)
    low, high = places.amin(0) * cell - 1, (places.amax(0) + 1) * cell - 1
    size = (high - low).max()
    return (low + high - size) / 2, size


def dense_cells(
    density: Density, leaves: Leaves, mask: Bool[Tensor, "x y z"] | None, numbers: Baking
) -> Int[Tensor, " cell"]:
    """Codes of the smallest cells that a camera could see: marked by the mask, and with an opacity across one side of
    at least the threshold. Coarse cells are subdivided level by level."""
    device, size = leaves.low.device, float(leaves.size)
    place = torch.zeros(1, 3, dtype=torch.int64, device=device)
    octants = torch.cartesian_prod(*[torch.arange(2, device=device)] * 3)
    for level in range(1, numbers.depth + 1):
        ask_for_cells(8 * len(place), leaves.basis, numbers.depth, level, device)
        place = (2 * place[:, None] + octants).flatten(0, 1)
        if mask is not None:
            place = place[overlapping(mask, leaves.low + place * (size / 2**level), size / 2**level)]
    side = size / 2**numbers.depth
    found = []
    for some in place.split(POINTS_PER_CHUNK):
        stopped = 1 - torch.exp(-density(leaves.low + (some + 0.5) * side) * side)
        found.append(some[stopped > numbers.threshold])
    return codes_of(torch.cat(found), numbers.depth)


def overlapping(mask: Bool[Tensor, "x y z"], low: Float[Tensor, "cell 3"], side: float) -> Bool[Tensor, " cell"]:
    """Mask of the cubes that overlap a marked cell."""
    n, total = len(mask), torch.nn.functional.pad(mask.int().cumsum(0).cumsum(1).cumsum(2), (1, 0, 1, 0, 1, 0))
    first = ((low * 0.5 + 0.5) * n + 1e-4).floor().long().clamp(0, n)
    last = (((low + side) * 0.5 + 0.5) * n - 1e-4).ceil().long().clamp(0, n)
    count = torch.zeros(len(low), dtype=total.dtype, device=low.device)
    for corner in range(8):
        bits = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=low.device)
        x, y, z = torch.where(bits == 1, last, first).unbind(-1)
        count += total[x, y, z] * (1 if int(bits.sum()) % 2 else -1)
    return count > 0


def ask_for_cells(cells: int, basis: int, depth: int, level: int, device: torch.device) -> None:
    """Raise LumigraphError if so many cells of a level exceed memory, with the depth that fits."""
    needed = Leaves.bytes_of(cells, basis, learning=True)
    if needed > (free := free_on(device)):
        raise LumigraphError(
            f"An octree of depth {depth} would need {gigabytes(needed)} of memory for its level {level} alone, and "
            f"{gigabytes(free)} are free; give --octree-depth {max(level - 1, 1)}, which fits"
        )


def fill(leaves: Leaves, codes: Int[Tensor, " row"]) -> None:
    """Leaves of these codes, with empty values."""
    leaves.codes = codes.sort()[0].int()
    leaves.densities = nn.Parameter(torch.zeros(len(codes), 1, device=codes.device))
    leaves.harmonics = nn.Parameter(torch.zeros(len(codes), 3 * leaves.basis, device=codes.device))


def points_in(
    centres: Float[Tensor, "row 3"], side: Float[Tensor, " row"], count: int, generator: torch.Generator
) -> Float[Tensor, "row count 3"]:
    """Random points of cells."""
    shifts = torch.rand(len(centres), count, 3, generator=generator).to(centres) - 0.5
    return centres[:, None] + shifts * side[:, None, None]


def averaged_density(leaves: Leaves, density: Density, count: int, generator: torch.Generator) -> None:
    """Density of each leaf with the same opacity across its side as the field has on average over random points."""
    centres, side = leaves.centres
    for rows in torch.arange(len(leaves), device=centres.device).split(max(POINTS_PER_CHUNK // count, 1)):
        points = points_in(centres[rows], side[rows], count, generator)
        thickness = density(points.flatten(0, 1)).view(len(rows), count) * side[rows, None]
        passing = torch.exp(-thickness).mean(1).clamp_min(MIN_TRANSMITTANCE)
        leaves.densities.data[rows, 0] = -passing.log() / side[rows]


def seen(leaves: Leaves, cameras: Camera, numbers: Baking, generator: torch.Generator) -> Bool[Tensor, " row"]:
    """Mask of the leaves with enough weight on some of many random rays through all pictures."""
    most = torch.zeros(len(leaves), device=leaves.codes.device)
    for _ in range(0, min(RAYS_PER_CELL << 2 * numbers.depth, MAX_RAYS), RAYS_PER_CHUNK):
        rays = random_rays(cameras, RAYS_PER_CHUNK, generator).to(most.device)
        found = leaves.crossed(rays, numbers.near, numbers.threshold)
        tau = leaves.densities[found.rows, 0].relu() * (found.t_end - found.t_start)
        weights = composite(tau, tau[:, None], found.ray_starts)[2]
        most.scatter_reduce_(0, found.rows, weights, "amax")
    return most > numbers.threshold


def averaged_harmonics(leaves: Leaves, geometry: Geometry, count: int, generator: torch.Generator) -> None:
    """Harmonics of each leaf: mean over random points, weighted by density."""
    centres, side = leaves.centres
    for rows in torch.arange(len(leaves), device=centres.device).split(max(POINTS_PER_CHUNK // count, 1)):
        points = points_in(centres[rows], side[rows], count, generator)
        density, found = geometry(points.flatten(0, 1))
        weights = (density.view(len(rows), count, 1) + 1e-6).double()
        mean = (weights * found.view(len(rows), count, -1)).sum(1) / weights.sum(1)
        leaves.harmonics.data[rows] = mean.float()
