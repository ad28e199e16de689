"""Density control: changes of the number and the positions of Gaussians after steps."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from ...errors import LumigraphWarning
from ...files.ranges import NonNegative, Share, between
from ...system.memory import room_for
from .addition import Addition, Step, TrainingViews
from .cloud import Cloud
from .interval_schedule import IntervalSchedule, intervals

PRUNE_OPACITY = 0.005  # below which a Gaussian is pruned or relocated (Kerbl 2023 and Kheradmand 2024)
MIN_CAP = 120_000  # Gaussians that a budget of few steps may have, where the cap follows the budget
BYTES_PER_GAUSSIAN = 4096  # lower bound while it learns: itself, its gradient and moments, its share of a picture
REFINE_EVERY = 100  # steps between density control, section 5.2; or the share below, if sooner
REFINE_EVERY_SHARE = 0.1  # share of the budget between density control, if that is sooner
REFINE_FROM = 500  # step at which density control starts, section 5.2; or the share below, if sooner
REFINE_FROM_SHARE = 0.15  # share of the budget at which density control starts, if sooner


@dataclass(frozen=True)
class RefineNumbers:
    """Options of density control."""

    max_gaussians: Annotated[int, between(0, 100_000_000)] = 0  # Gaussians at most; more cost time; 0: as memory allows
    gaussians_per_step: NonNegative = 0.0  # of the budget, at most, beyond 120,000; 0: the cap follows no budget
    cap_ramp: bool = False  # raise the cap evenly until refine_until, with adaptive, so that early steps are quick
    refine_until: Share = 0.5  # share of the budget at which it ends, section 7.1: 15 000 of 30 000 steps


class DensityControl(Addition, ABC):
    """Strategy of density control; it may `rebuild` the cloud after a step, and has its state in buffers.

    initial_count: initial number of Gaussians
    """

    initial_count: Tensor

    def __init__(self, refine: RefineNumbers):
        super().__init__()
        self.refining = refine
        self.schedule = IntervalSchedule(REFINE_EVERY, REFINE_EVERY_SHARE)
        self.register_buffer("initial_count", torch.tensor(0))
        self.warned = False

    @abstractmethod
    def finish(self, step: Step) -> None:
        """Change the cloud where that is due."""

    def begin_cloud(self, cloud: Cloud, views: TrainingViews, chance: torch.Generator) -> None:
        self.initial_count.fill_(len(cloud))

    def follows_errors(self, progress: float) -> bool:
        """True if a step at this share of the budget is to have `Step.explained`."""
        return False

    def due(self, step: int, progress: float) -> bool:
        """True if the cloud may change after this step; called once a step."""
        ended = self.schedule.due(step, progress)
        return ended and intervals(step, progress, REFINE_FROM, REFINE_FROM_SHARE) >= 1

    def allowed(self, steps: float = 0.0) -> float:
        """Maximum number of Gaussians by the Config in a budget of `steps` steps; infinite without `max_gaussians`."""
        n = self.refining
        by_budget = max(MIN_CAP, n.gaussians_per_step * steps) if n.gaussians_per_step else math.inf
        return min(n.max_gaussians or math.inf, by_budget)

    def max_count(self, cloud: Cloud, steps: float = 0.0) -> int:
        """Cap on the number of Gaussians: `allowed`, or as many as fit into free memory."""
        fit = len(cloud) + room_for(BYTES_PER_GAUSSIAN, cloud.means.device)
        return int(min(self.allowed(steps), fit))

    def warn_full(self, cloud: Cloud, steps: float = 0.0) -> None:
        """Warn, once, of a cloud at its cap."""
        if not self.warned:
            self.warned = True
            allowed, why = self.allowed(steps), "memory is short"
            if len(cloud) >= 0.95 * allowed:
                by_option = allowed == self.refining.max_gaussians
                why = "--max-gaussians says so" if by_option else "a budget of more steps would allow more"
            warnings.warn(f"The cloud stops growing at {len(cloud):,} Gaussians, for {why}", LumigraphWarning, 2)
