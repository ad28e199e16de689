"""The choice of a sampler: an occupancy grid for bounded scenes, proposals for scenes without bounds."""

from __future__ import annotations

from typing import Any

from ...datasets.scene import Frame
from ...method import Sampler
from ..fields.hash_field import CPU_TABLE, TINY_TABLE
from .occupancy_sampler import NGP_SCHEDULE, GridSchedule, OccupancyNumbers, OccupancySampler, StepNumbers
from .proposal_sampler import ProposalNumbers, ProposalSampler
from .spaces import Space

# Numbers of a Config for a plain CPU, which learn most in a minute (docs/methods/instant_ngp.md), and for tests.
CPU_OCCUPANCY = OccupancyNumbers(samples_per_step=1 << 15, transmittance_threshold=1e-3, occupancy_threshold=0.15)
CPU_HASH: dict[str, Any] = {"table": CPU_TABLE, "occupancy": CPU_OCCUPANCY, "steps": StepNumbers(384, 1 / 96)}
TINY_OCCUPANCY = OccupancyNumbers(samples_per_step=2048, occupancy_resolution=16)
TINY_HASH: dict[str, Any] = {"table": TINY_TABLE, "occupancy": TINY_OCCUPANCY, "steps": StepNumbers(128)}


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


def sampling_bytes(frame: Frame, config: Any, learning: bool) -> int:
    """`Method.further_bytes` of a coordinate network, or of a hash table with its grids, by the names in its Config:
    activations that a step keeps for its gradients. With a mask the number of samples is not known beforehand."""
    if getattr(config, "field", "hash" if hasattr(config, "table") else "network") == "network":
        masked = hasattr(config, "mask") and config.mask.occupancy_resolution > 0
        kept = config.network.activation_bytes(config.rays.samples_per_step, config.hidden_width)
        return 0 if masked else kept * learning
    width = getattr(config, "table_width", config.hidden_width)
    kept = config.table.activation_bytes(config.occupancy.samples_per_step, width)
    return kept * learning + sum(x.further_bytes(frame, learning) for x in (config.occupancy, config.proposals))
