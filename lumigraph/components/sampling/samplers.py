"""The choice of a sampler: an occupancy grid for bounded scenes, proposals for scenes without bounds."""

from __future__ import annotations

from typing import Any

from ...datasets.scene import Frame
from ...method import Sampler
from .occupancy_sampler import NGP_SCHEDULE, GridSchedule, OccupancyNumbers, OccupancySampler
from .proposal_sampler import ProposalNumbers, ProposalSampler
from .spaces import Space


def sampler_for(
    frame: Frame,
    space: Space,
    occupancy: OccupancyNumbers,
    proposals: ProposalNumbers,
    schedule: GridSchedule = NGP_SCHEDULE,
    *,
    open_samples: int | None = None,
    max_rays: int | None = None,
    **bounded: Any,
) -> Sampler:
    """A sampler that suits a space.

    open_samples: samples of a step in a scene without bounds; None for as many as in others
    max_rays:     rays of a step at most
    bounded:      further arguments of an `OccupancySampler`
    """
    if space.is_open:
        return ProposalSampler(space, proposals, open_samples or occupancy.samples_per_step, max_rays)
    return OccupancySampler(frame, space, occupancy, schedule, max_rays=max_rays, **bounded)
