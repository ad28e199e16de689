"""Samplers: the choice between occupancy grid and proposals by the space, and the proposal sampler.

Proposals: samples along unbounded rays, by a proposal grid of density (Barron 2022, section 3.1). Every ray gets the
same number of samples. Loss terms keep the air clear: the distortion loss (Barron 2022, eq. 15), gradients scaled near
cameras (Philip 2023), and initially depth from plane sweeps over neighbouring photographs with clear air between
cameras.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from ...camera.rays import Rays
from ...datasets.scene import Frame, Scene
from ...exchange.packing import Stored
from ...files.ranges import NonNegative
from ...method import Field, Pass, Sampler
from ...method.field import Points as Places
from ...method.sampler import Density, RayCodes, codes_at
from ...volume import weights_of
from ..fields.hash_field import CPU_TABLE, TINY_TABLE
from ..fields.spaces import Space
from ..training.dense_points import Points, compile_sweep, seen_points
from ..training.regularizers import depth_loss, distortion_loss, places_between, scale_gradients
from ..training.row_optimizers import LazyAdam
from ..training.schedules import falling
from .occupancy_sampler import (
    MIN_WEIGHT,
    NGP_SCHEDULE,
    GridSchedule,
    OccupancyNumbers,
    OccupancySampler,
    StepNumbers,
    rows_of,
)
from .proposal import Proposal, proposal_loss

CELLS = 96  # of the proposal grid, along each axis
PROPOSAL_SAMPLES = 64  # samples of a ray in that grid
SAMPLES_PER_RAY = 24  # samples of a ray in the field
DISTORTION_WEIGHT = 0.01  # weight of the distortion loss (Barron 2022, eq. 15)
AIR_WEIGHT = 0.05  # weight of clear air between cameras in the first half of training
LEARNING_RATES = 0.1, 0.01  # of the proposal grid, at first and in the end
SWEEP_SHARE = 0.1  # share of a budget of seconds that plane sweeps may take
MAX_POINTS = 1 << 16  # surface points that are kept
DEPTH_RAYS = 128  # rays of a step with known depth
DEPTH_MARGIN = 0.005  # of distances t / (1 + t): accuracy of a surface point
DEPTH_UNTIL = 0.5  # share of the budget after which photographs alone supervise depth
NEAREST_OF = 1024  # surface points among which the nearest to a place is looked for
OUTLIERS = 0.02  # share of them that may be wrong, and nearer
CLEAR_SHARE = 0.5  # of the distance to the nearest surface, in which air is clear
CONE = 0.5  # deviation of rays through air from the ways to surfaces, of unit length
RAYS_PER_CHUNK = 4096  # rendered at once: the activations of their samples fit into a cache


@dataclass(frozen=True)
class ProposalNumbers:
    """A Config's numbers of the proposal sampler, for unbounded scenes."""

    sweep_weight: NonNegative = 0.03  # weight of plane-sweep depth at first, falling to 0; 0: off

    def further_bytes(self, frame: Frame, learning: bool) -> int:
        """Bytes of the proposal grid, in training with its gradient and moments."""
        return 4 * CELLS**3 * (4 if learning else 1) * frame.is_open


class ProposalSampler(Sampler):
    """Samples by a proposal grid of density.

    surface, surface_from: points on surfaces, and each one's camera position
    stands:                those positions, each once
    progress:              spent share of the budget
    """

    is_open: ClassVar[bool] = True
    grows: ClassVar[tuple[str, ...]] = ("surface", "surface_from")
    rays_per_chunk = RAYS_PER_CHUNK
    surface: Tensor
    surface_from: Tensor

    def __init__(self, space: Space, numbers: ProposalNumbers, samples_per_step: int, max_rays: int | None = None):
        super().__init__()
        self.numbers, self.progress = numbers, 1.0
        rays = max(1, math.ceil(samples_per_step / SAMPLES_PER_RAY))
        self.batch_size = self.expected_rays = min(rays, max_rays or rays)
        self.proposal = Proposal(space, CELLS, PROPOSAL_SAMPLES, SAMPLES_PER_RAY)
        for name in self.grows:
            self.register_buffer(name, torch.zeros(0, 3))

    def sample(
        self, rays: Rays, field: Field, code: RayCodes | None = None, generator: torch.Generator | None = None
    ) -> list[Pass]:
        if generator is None and not torch.is_grad_enabled():
            return [self._visible(rays, field, code)]
        jitter = None
        if generator is not None:
            jitter = torch.rand(len(rays), 2, generator=generator).to(rays.origins.device)
        proposals = self.proposal.sample(rays, jitter)
        samples = proposals.samples
        points, directions = samples.along(rays)
        own = codes_at(samples.ray_index, code) if code is not None and field.deforms else None
        rgb = None
        if field.joint:
            density, rgb = field(points, directions, own)
            features: Any = ()
        else:
            density, features = field.geometry(points, own)
        count, scale = len(samples), None
        if generator is not None:
            (density,) = scale_gradients(samples.t, density)
            scale = partial(_scaled, samples.t)
        return [Pass("samples", samples, density, features, directions, None, rgb, count, scale, proposals)]

    def _visible(self, rays: Rays, field: Field, code: Float[Tensor, "ray code"] | None) -> Pass:
        """A pass for rendering: samples of at most MIN_WEIGHT are left out, so those behind them get that weight."""
        samples = self.proposal.places(rays)
        points, directions = samples.along(rays)
        own = codes_at(samples.ray_index, code) if code is not None and field.deforms else None
        density, features = field.geometry(points, own)
        kept = weights_of(samples, density) > MIN_WEIGHT
        rows = kept.nonzero()[:, 0]
        features, directions = rows_of(features, rows), directions.index_select(0, rows)
        seen, count = samples.keep(kept), len(samples)
        return Pass("samples", seen, density.index_select(0, rows), features, directions, evaluated=count)

    def terms(self, density: Density, last: Pass, generator: torch.Generator) -> dict[str, Tensor]:
        """Proposal loss, distortion loss, and with known surfaces the depth loss of additional rays and the opacity of
        air between cameras."""
        weights = weights_of(last.samples, last.density)
        terms = {"proposal": proposal_loss(last.proposals, weights)}
        terms["distortion"] = DISTORTION_WEIGHT * distortion_loss(last.samples, weights)
        weight = self.numbers.sweep_weight * (1 - self.progress / DEPTH_UNTIL)
        if weight > 0 and len(self.surface):
            chosen = torch.randint(len(self.surface), (DEPTH_RAYS,), generator=generator).to(self.surface.device)
            origins = places_between(self.surface_from[chosen], self.stands, generator)
            ways = self.surface[chosen] - origins
            error, missed = self._depth_error(density, origins, ways, generator)
            terms["depth"] = weight * error
            terms["air"] = AIR_WEIGHT * self._stopped_by_air(density, origins, ways, generator)
            terms["proposal"] = terms["proposal"] + missed * (DEPTH_RAYS / len(last.proposals.edges))
        return terms

    def _depth_error(
        self, density_at: Density, origins: Places, ways: Places, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """`depth_loss` of rays to surfaces, and their proposal loss.

        Origins are between two cameras: air that is clear along the photographs' rays may be fog from the side.
        """
        distance = ways.norm(dim=-1)
        rays = Rays(origins, ways / distance[:, None], torch.zeros_like(distance))
        proposals = self.proposal.sample(rays, torch.rand(DEPTH_RAYS, 2, generator=generator).to(distance))
        samples = proposals.samples
        (density,) = scale_gradients(samples.t, density_at(samples.along(rays)[0]))
        weights = weights_of(samples, density)
        return depth_loss(samples, weights, distance, DEPTH_MARGIN), proposal_loss(proposals, weights)

    def _stopped_by_air(
        self, density_at: Density, origins: Places, ways: Places, generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Opacity of the air half way from between cameras to the nearest surface, around the directions to surfaces;
        from the density at one random position of each ray."""
        some = torch.randint(len(self.surface), (NEAREST_OF,), generator=generator).to(self.surface.device)
        nearest = torch.cdist(origins, self.surface[some]).quantile(OUTLIERS, dim=1)
        aside = CONE * torch.randn(ways.shape, generator=generator).to(ways)
        directions = normalize(normalize(ways, dim=-1) + aside, dim=-1)
        clear = CLEAR_SHARE * nearest
        t = clear * torch.rand(len(ways), generator=generator).to(ways)
        return -torch.expm1(-clear * density_at(origins + t[:, None] * directions)).mean()

    @cached_property
    def stands(self) -> Float[Tensor, "camera 3"]:
        return self.surface_from.unique(dim=0)

    @property
    def few_view_priors(self) -> tuple[str, ...]:
        return ("plane-sweep depth", "clear air between cameras") if len(self.surface) else ()

    # Training

    def compile_begin(self) -> None:
        compile_sweep()

    def begin(self, method: Any, data: Scene, seconds: float) -> None:
        """Find points on surfaces by plane sweeps, unless poses are optimised."""
        if not self.numbers.sweep_weight or method.moves_cameras:
            return
        found = some(seen_points(data, SWEEP_SHARE * seconds), method.random(1))
        self.surface, self.surface_from = (x.to(self.surface) for x in (found.positions, found.origins))
        sparse = self.surface[:0] if data.points is None else data.points.to(self.surface)
        if len(points := torch.cat([self.surface, sparse])):
            self.proposal.begin(points)

    def begin_from(self, teacher: Any, chance: torch.Generator) -> None:
        known = teacher.surface
        points, origins = (x[:: max(1, len(x) // MAX_POINTS)] for x in (known.points, known.origins))
        self.surface, self.surface_from = points.to(self.surface), origins.to(self.surface)
        if len(self.surface):
            self.proposal.begin(self.surface)

    def before_step(self, method: object, step: int, progress: float) -> None:
        self.progress = progress
        self.proposal.anneal(1.0 if len(self.surface) else progress)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [LazyAdam([{"params": [self.proposal.grid.values], "name": "proposal"}], LEARNING_RATES[0])]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        return {"proposal": falling(*LEARNING_RATES, progress)}

    def storage(self) -> dict[str, Stored]:
        """Storage: rendering needs only the proposal grid."""
        return {"proposal.grid.values": Stored("half"), "surface": Stored("nothing"), "surface_from": Stored("nothing")}


def _scaled(t: Float[Tensor, " sample"], values: Float[Tensor, "sample _"]) -> Float[Tensor, "sample _"]:
    return scale_gradients(t, values)[0]


def some(points: Points, generator: torch.Generator) -> Points:
    """A random subset of at most MAX_POINTS points."""
    if len(points.positions) <= MAX_POINTS:
        return points
    chosen = torch.randperm(len(points.positions), generator=generator)[:MAX_POINTS]
    rows = {name: getattr(points, name)[chosen] for name in ("positions", "colours", "sizes", "origins")}
    return Points(**rows, share=points.share)


# Numbers of a Config for a plain CPU, which learn most in a minute (docs/methods/instant_ngp.md), and for tests.
CPU_OCCUPANCY = OccupancyNumbers(samples_per_step=1 << 15, transmittance_threshold=1e-3, occupancy_threshold=0.15)
CPU_HASH: dict[str, Any] = {"table": CPU_TABLE, "occupancy": CPU_OCCUPANCY, "steps": StepNumbers(384)}
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
    """Sampler for a space.

    open_samples: samples of a step in an unbounded scene; None for as many as in others
    max_rays:     largest number of rays of a step
    bounded:      further arguments of an `OccupancySampler`
    """
    if space.is_open:
        return ProposalSampler(space, proposals, open_samples or occupancy.samples_per_step, max_rays)
    return OccupancySampler(frame, space, occupancy, schedule, max_rays=max_rays, **bounded)


def sampling_bytes(frame: Frame, config: Any, learning: bool) -> int:
    """`Method.further_bytes` of a coordinate network, or of a hash table with its grids, by the names in its Config:
    activations that a step keeps for its gradients. With a mask the number of samples is not known beforehand."""
    c = getattr(config, "backbone", config)
    if getattr(c, "field", "hash" if hasattr(c, "table") else "network") == "network":
        masked = hasattr(config, "mask") and config.mask.occupancy_resolution > 0
        samples = getattr(config, "rays", None) or c.occupancy
        kept = c.network.activation_bytes(samples.samples_per_step, c.hidden_width)
        return 0 if masked else kept * learning
    kept = c.table.activation_bytes(c.occupancy.samples_per_step, getattr(c, "table_width", c.hidden_width))
    return kept * learning + sum(x.further_bytes(frame, learning) for x in (c.occupancy, c.proposals))
