"""Marching through a grid over a space's coordinates, a share of a voxel at a time, past what is known to be empty."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ...rays import Rays, Samples
from ...scene import Frame
from .forward_march import march_forward
from .occupancy import OccupancyGrid
from .spaces import NDC, Space, space_of

# Share of the budget before anything counts as empty where there is no bound. At first all density is alike: cells
# below its mean, which `OccupancyGrid.update` leaves out, would be half of the scene, by chance, and for good.
UNSETTLED = 0.15
FOG = 0.25  # optical thickness along a whole ray, at most, that may be skipped there

Density = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]


def reach_of(frame: Frame) -> float:
    """Half-size of the cube that rays march through: the scene's own, or that of normalised device coordinates."""
    return 1.0 if isinstance(space_of(frame), NDC) else frame.reach


def empty_below(frame: Frame, thickness: float, resolution: int) -> float:
    """Optical thickness below which a cell is skipped: less than what is asked for where there is no bound. There a ray
    passes as many cells as lie along an axis, and what all of them stop is a good part of what is seen at first."""
    return thickness if frame.reach <= 1 else min(thickness, FOG / resolution)


def march(
    space: Space,
    occupancy: OccupancyGrid,
    rays: Rays,
    near: float,
    step: float,
    growth: float,
    jitter: Float[Tensor, " ray"] | None = None,
) -> Samples:
    """Samples in the occupied cells of a grid of `reach_of(frame)`; their distances are the scene's.

    step:   in coordinates. Near the middle of a scene, one of its units is `space.stretch` of them
    growth: of steps with distance, where space is contracted; voxels of an object and steps in normalised device
            coordinates stay as they are
    jitter: in [0, 1), moves each ray's lattice by that share of a step
    """
    if isinstance(space, NDC):
        return march_forward(space, occupancy, rays, step, jitter)
    middle = float(space.stretch(torch.zeros(1, 3, device=rays.origins.device)))
    return occupancy.sample(rays, near, step / middle, growth, jitter=jitter)


def asked_by_cells(space: Space, density: Density, of_coordinates: Density) -> Density:
    """The density for that grid to look at: per scene unit at points, or per unit of coordinates where its cells are
    those of normalised device coordinates."""
    return of_coordinates if isinstance(space, NDC) else density
