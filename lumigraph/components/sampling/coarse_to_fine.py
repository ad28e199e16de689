"""Coarse to fine: how a hash field's occupancy grid and the lattice along its rays become finer with the budget."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from .occupancy import OccupancyGrid


class Stage(NamedTuple):
    """From a share of the budget on: which part of occupancy_resolution, and which of steps_per_diagonal."""

    begins: float
    cells: float
    steps: float


class Lattice(NamedTuple):
    """Where samples may begin along a ray: the length of a step in scene units, and its growth with distance."""

    step: float
    growth: float


STAGES = Stage(0.0, 1 / 4, 1 / 4), Stage(0.04, 1 / 2, 1 / 2), Stage(0.12, 1, 2 / 3), Stage(0.75, 1, 1)
OFTEN, AT_FIRST = 4, 32  # steps between looks at the grid, and until which step
LOOKS = 4  # cells updated at most, for each sample of a step
PROBES = 0.02  # share of all cells updated at random, in case something has grown there
SAMPLES_OF_A_RAY = 24  # that a ray needs, about, once empty space is known


def stage(progress: float) -> Stage:
    """The stage at a share of the budget, in [0, 1]."""
    return max(stage for stage in STAGES if stage.begins <= progress)


def first_grid(config: Any, reach: float) -> OccupancyGrid:
    """The coarse grid that training begins with. config: see `keep_looking`."""
    return OccupancyGrid(reach, max(4, int(config.occupancy_resolution * STAGES[0].cells)))


def lattice(config: Any, reach: float, share: float = 1.0) -> Lattice:
    """The lattice along rays (Müller 2022, appendix E.1).

    config: has steps_per_diagonal and cone_angle; objects, of reach 1, have steps of equal length
    share:  of the steps; below 1 both are coarser by as much
    """
    step = 2 * math.sqrt(3) / int(config.steps_per_diagonal * share)
    return Lattice(step, config.cone_angle / share if reach > 1 else 0.0)


def keep_looking(
    grid: OccupancyGrid,
    density_at: Callable[[Float[Tensor, "sample 3"]], Float[Tensor, " sample"]],
    config: Any,
    step: int,
    progress: float,
    generator: torch.Generator,
) -> None:
    """Ahead of a training step refine the grid if it is time, and look at it if that is due (appendix E.2).

    density_at: per scene unit
    config:     has occupancy_resolution, occupancy_threshold, occupancy_interval, occupancy_decay, samples_per_step
    progress:   share of the budget that is spent, in [0, 1]
    """
    finer = False
    while grid.resolution < config.occupancy_resolution * stage(progress).cells:
        grid.refine()
        finer = True
    if finer or step % (OFTEN if step < AT_FIRST else config.occupancy_interval) == 0:
        share, budget = (1.0, None) if finer or step < AT_FIRST else (PROBES, config.samples_per_step * LOOKS)
        grid.update(density_at, config.occupancy_threshold, generator, config.occupancy_decay, share, budget)
