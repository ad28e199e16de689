"""Occupancy sampler: samples in occupied cells of a grid, with early termination (Müller 2022, appendix E)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...camera.rays import Rays, Samples
from ...datasets.scene import Frame, Scene
from ...exchange.packing import Stored
from ...files.ranges import NonNegative, Share, between
from ...method import Features, Field, Pass, Sampler
from ...method.sampler import Density, RayCodes, codes_at
from ...volume import visible_weights, weights_of
from ..fields.spaces import Space
from .occupancy import OccupancyGrid, visual_hull

FIRST_RAYS = 256  # rays of the first step, before the number of samples per ray is known
MIN_RAYS = 64  # rays of a step
MAX_GROWTH = 1.5  # factor by which the number of rays may grow from one step to the next
OCCUPANCY_INTERVAL = 16  # steps between updates of the occupancy grid, E.2
OCCUPANCY_DECAY = 0.95  # share of a cell's density kept at each update, E.2
EARLY_INTERVAL = 4  # steps between updates of the whole grid in the first steps
CELLS_PER_SAMPLE = 4  # cells updated at most, for each sample of a step
MIN_RESOLUTION = 4  # cells per axis
MIN_WEIGHT = 5e-4  # weight in a ray's colour up to which a rendering omits a sample


@dataclass(frozen=True)
class OccupancyNumbers:
    """A Config's numbers of the occupancy grid and of the samples in its cells; the paper's (Müller 2022)."""

    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 18  # samples in a step; more cost memory and time
    transmittance_threshold: Share = 1e-4  # transmittance at which a ray terminates, E.1; higher is faster, less exact
    occupancy_resolution: Annotated[int, between(4, 512)] = 128  # cells per axis and cascade, E.2; more skip more
    occupancy_threshold: NonNegative = 0.05  # optical thickness of a cell below which it is empty, E.2; higher: faster

    def further_bytes(self, frame: Frame, learning: bool) -> int:
        """Bytes of the refined grid, of a bounded scene."""
        return 0 if frame.is_open else OccupancyGrid.bytes_of(1.0, self.occupancy_resolution)


@dataclass(frozen=True)
class StepNumbers:
    """A Config's numbers of the steps along a ray, for fields without a grid (Müller 2022, appendix E.1)."""

    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 1024  # samples across the diagonal, E.1; fewer are faster

    @property
    def cone_angle(self) -> float:
        """Growth of the step with distance in the open: 1 / 256 for the paper's steps, appendix E.1."""
        return 4 / self.steps_per_diagonal


class Stage(NamedTuple):
    """Stage of a schedule from a share of the budget on: factors on `occupancy_resolution` and `steps_per_diagonal`."""

    begins: float
    cells: float
    steps: float = 1.0


@dataclass(frozen=True)
class GridSchedule:
    """Schedule of an occupancy grid's updates.

    stages:      resolution of the grid and of the steps along rays, from coarse to fine
    begins:      share of the budget before which no cell is empty
    early_steps: steps in which the whole grid is updated, every EARLY_INTERVAL steps
    probes:      share of all cells, drawn at random, that an update visits besides occupied ones; 1 for all cells
    max_cells:   cells that an update visits at most; None for CELLS_PER_SAMPLE of each sample
    interval:    steps between updates
    decay:       share of a cell's density that is kept at each update
    """

    stages: tuple[Stage, ...] = (Stage(0.0, 1.0),)
    begins: float = 0.0
    early_steps: int = 32
    probes: float = 0.02
    max_cells: int | None = None
    interval: int = OCCUPANCY_INTERVAL
    decay: float = OCCUPANCY_DECAY

    def stage(self, progress: float) -> Stage:
        """The stage at a share of the budget, in [0, 1]."""
        return max(stage for stage in self.stages if stage.begins <= progress)


NGP_SCHEDULE = GridSchedule(
    (Stage(0.0, 1 / 4, 1 / 4), Stage(0.04, 1 / 2, 1 / 2), Stage(0.12, 1, 2 / 3), Stage(0.75, 1, 1))
)


class OccupancySampler(Sampler):
    """Samples in occupied cells. A first pass without gradients applies early termination; the field is evaluated with
    gradients only at the remaining samples, because most are occluded.

    numbers, schedule: of the grid
    steps:             lengths of steps along rays; None for those of the field's own grid
    samples_per_ray:   samples of a typical ray after empty space is known
    max_rays:          largest number of rays of a step
    adapts:            whether the number of rays adapts to the number of samples per ray
    sampled_share:     share of each ray, around its middle, sampled in training
    """

    rays_per_step: Tensor

    def __init__(
        self,
        frame: Frame,
        space: Space,
        numbers: OccupancyNumbers,
        schedule: GridSchedule,
        steps: StepNumbers | None = None,
        samples_per_ray: int = 24,
        max_rays: int | None = None,
        adapts: bool = True,
    ):
        super().__init__()
        self.frame, self.space, self.numbers, self.schedule, self.steps = frame, space, numbers, schedule, steps
        self.samples_per_ray, self.max_rays, self.adapts = samples_per_ray, max_rays or numbers.samples_per_step, adapts
        first = max(MIN_RESOLUTION, int(numbers.occupancy_resolution * schedule.stages[0].cells))
        self.grid = OccupancyGrid(frame.reach, first)
        self.register_buffer("rays_per_step", torch.tensor(min(FIRST_RAYS, self.max_rays) if adapts else self.max_rays))
        self.step_share, self.sampled_share, self.stale = 1.0, 1.0, False

    @property
    def batch_size(self) -> int:  # type: ignore[override]
        return int(self.rays_per_step)

    @property
    def expected_rays(self) -> float:  # type: ignore[override]
        return (
            min(self.max_rays, self.numbers.samples_per_step / self.samples_per_ray) if self.adapts else self.max_rays
        )

    def sample(
        self, rays: Rays, field: Field, code: RayCodes | None = None, generator: torch.Generator | None = None
    ) -> list[Pass]:
        jitter = None if generator is None else torch.rand(len(rays), generator=generator).to(rays.origins.device)
        code_of = code if field.deforms else None
        samples = self.grid.sample(rays, self.frame.near, *self._step(field), jitter=jitter)
        if generator is not None and self.sampled_share < 1:
            samples = samples.keep(self._in_the_middle(rays, samples))
        if generator is None and not (torch.is_grad_enabled() or field.joint or field.cheap_density):
            return [self._visible(rays, samples, field, code_of)]
        samples, evaluated = reached(rays, samples, field, code_of, self.numbers.transmittance_threshold)
        points, directions = samples.along(rays)
        of_samples = None if code_of is None else codes_at(samples.ray_index, code_of)
        if generator is not None:
            self.evaluated = evaluated
        if field.joint:
            density, rgb = field(points, directions, of_samples)
            return [Pass("samples", samples, density, (), directions, rgb=rgb, evaluated=evaluated)]
        density, features = field.geometry(points, of_samples)
        if field.cheap_density or field.min_weight is None:
            return [Pass("samples", samples, density, features, directions, evaluated=evaluated)]
        coloured = (weights_of(samples, density.detach()) > field.min_weight).nonzero()[:, 0]
        features, directions = rows_of(features, coloured), directions.index_select(0, coloured)
        return [Pass("samples", samples, density, features, directions, coloured, evaluated=evaluated)]

    def _visible(self, rays: Rays, found: Samples, field: Field, code: RayCodes | None) -> Pass:
        """A pass for rendering: geometry is evaluated once, front to back until a ray terminates. Samples of at most
        MIN_WEIGHT are left out, so those behind them get that weight."""
        points, directions = found.along(rays)
        codes = None if code is None else codes_at(found.ray_index, code)
        places, evaluated = torch.zeros(len(found), dtype=torch.int64, device=points.device), 0
        densities, features = list[Tensor](), list[Features]()

        def thickness_of(asked: Int[Tensor, " asked"]) -> Float[Tensor, " asked"]:
            nonlocal evaluated
            places[asked] = torch.arange(evaluated, evaluated + len(asked), device=asked.device)
            evaluated += len(asked)
            own = None if codes is None else codes.index_select(0, asked)
            density, feature = field.geometry(points.index_select(0, asked), own)
            densities.append(density)
            features.append(feature)
            return density * found.length.index_select(0, asked)

        kept = visible_weights(found, thickness_of, self.numbers.transmittance_threshold) > MIN_WEIGHT
        if not densities:
            thickness_of(places.new_zeros(0))  # no points, of the right widths
        chosen = kept.nonzero()[:, 0]
        rows, seen = places.index_select(0, chosen), found.keep(kept)
        density = torch.cat(densities).index_select(0, rows)
        return Pass(
            "samples",
            seen,
            density,
            rows_of(joined(features), rows),
            directions.index_select(0, chosen),
            evaluated=evaluated,
        )

    def _step(self, field: Field) -> tuple[float, float]:
        """Length of a step in scene units, and its growth with distance (appendix E.1)."""
        if self.steps is None:
            return field.step_length, 0.0
        step = 2 * math.sqrt(3) / int(self.steps.steps_per_diagonal * self.step_share)
        return step, self.steps.cone_angle / self.step_share if self.frame.is_open else 0.0

    def _in_the_middle(self, rays: Rays, samples: Samples) -> Bool[Tensor, " sample"]:
        near, far = self.space.interval(rays)
        ray, half = samples.ray_index, 0.5 * self.sampled_share * (far - near)
        return (samples.t - (0.5 * (near + far))[ray]).abs() < half[ray]

    # Training

    def begin(self, method: Any, data: Any, seconds: float) -> None:
        """Mark the cells outside the visual hull as empty, unless poses are optimised."""
        if isinstance(data, Scene) and data.images.has_alpha and not self.frame.is_open and not method.moves_cameras:
            self.grid.rule_out(visual_hull(data, self.numbers.occupancy_resolution)[None])

    def begin_from(self, teacher: Any, chance: torch.Generator) -> None:
        n = self.numbers
        if not self.frame.is_open:
            held = teacher.occupied(self.space, n.occupancy_resolution, n.occupancy_threshold, chance)
            self.grid.rule_out(held[None])

    def settle(self, density: Density, chance: torch.Generator) -> None:
        self.grid.update(density, self.numbers.occupancy_threshold, chance)

    def release(self) -> None:
        for name in self.grid.grows:
            setattr(self.grid, name, getattr(self.grid, name)[:, :1, :1, :1].clone())

    def before_step(self, method: Any, step: int, progress: float) -> None:
        """Refine the grid when its next stage begins, and update it when due (appendix E.2)."""
        n, schedule = self.numbers, self.schedule
        stage = schedule.stage(progress)
        self.step_share = stage.steps
        if progress < schedule.begins:
            return
        while self.grid.resolution < n.occupancy_resolution * stage.cells:
            self.grid.refine()
            self.stale = True
        early = step < schedule.early_steps
        if self.stale or step % (EARLY_INTERVAL if early else schedule.interval) == 0:
            whole = self.stale or early or schedule.probes >= 1
            share, budget = (1.0, None) if whole else (schedule.probes, self._max_cells)
            chance = method.random(~step)
            density = method.density_in_training(chance)
            self.grid.update(density, n.occupancy_threshold, chance, schedule.decay, share, budget)
            self.stale = False

    @property
    def _max_cells(self) -> int:
        return self.schedule.max_cells or self.numbers.samples_per_step * CELLS_PER_SAMPLE

    def after_step(self, method: object, step: int) -> None:
        """Set the next step's number of rays to evaluate about `samples_per_step` samples, for constant time and memory
        of steps (section 5.4)."""
        if self.adapts:
            wanted, rays = self.numbers.samples_per_step, int(self.rays_per_step)
            count = min(max(rays * wanted / max(self.evaluated, 1), MIN_RAYS), MAX_GROWTH * rays, wanted)
            self.rays_per_step.fill_(min(int(count), self.max_rays))

    def storage(self) -> dict[str, Stored]:
        """Storage: rendering needs only the mask of occupied cells."""
        return {"grid.density": Stored("nothing"), "grid.possible": Stored("nothing", fill=1.0)}


@torch.no_grad()
def reached(
    rays: Rays, found: Samples, field: Field, code: Float[Tensor, "ray code"] | None, stop: float
) -> tuple[Samples, int]:
    """Samples before termination, and the number of density evaluations for that, without gradients.

    A field with cheap density is evaluated at all samples at once, and those of at most its least weight are left
    out. Others are evaluated along each ray front to back until it terminates (see `volume.visible_weights`).
    stop: transmittance at which a ray terminates
    """
    points, _ = found.along(rays)
    codes = None if code is None else codes_at(found.ray_index, code)
    if field.cheap_density:
        return found.keep(weights_of(found, field.density(points, codes), stop) > (field.min_weight or 0.0)), len(found)
    length, evaluated = found.length, 0

    def thickness_of(asked: Int[Tensor, " asked"]) -> Float[Tensor, " asked"]:
        nonlocal evaluated
        evaluated += len(asked)
        own = None if codes is None else codes.index_select(0, asked)
        return field.density(points.index_select(0, asked), own) * length.index_select(0, asked)

    seen = visible_weights(found, thickness_of, stop) > 0
    return found.keep(seen), evaluated


def joined(parts: list[Features]) -> Features:
    """Concatenate features of sets of points, in the layout of `rows_of`."""
    if isinstance(parts[0], tuple):
        return tuple(torch.cat([x.t() for x in each], 1).t() for each in zip(*parts, strict=True))
    return torch.cat([x.t() for x in parts if isinstance(x, Tensor)], 1).t()


def rows_of(features: Features, rows: Int[Tensor, " row"]) -> Features:
    """Some rows of features, in feature-major layout, as networks return and read them."""
    if isinstance(features, tuple):
        return tuple(x.t().index_select(1, rows).t() for x in features)
    return features.t().index_select(1, rows).t()
