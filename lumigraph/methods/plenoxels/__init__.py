"""Plenoxels: a sparse grid of density and harmonics, no network (Fridovich-Keil and Yu 2022, arXiv 2112.05131)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...camera import Camera
from ...components.fields.spaces import NDC, Space, space_of
from ...components.fields.teacher import logit, teacher_of
from ...components.sampling.importance import importance
from ...components.sampling.occupancy_sampler import GridSchedule, OccupancyNumbers, OccupancySampler
from ...components.sampling.samplers import ProposalNumbers, sampler_for
from ...components.training.photometric import Exposure, Setting, backdrop, residuals
from ...components.training.regularizers import cauchy
from ...components.training.row_optimizers import LazyRMSprop
from ...components.training.schedules import falling
from ...datasets.scene import Batch, Frame, Scene
from ...errors import LumigraphError
from ...exchange.packing import Stored, most_important
from ...files.ranges import BatchSize, LearningRate, NonNegative, PositiveShare, Share, Steps, between, changed
from ...kernels import total_variation
from ...kernels.harmonic_grid import BANDS
from ...method import BaseConfig, Field, FieldMethod
from ...method.depth import DepthNumbers, depth_terms
from ...method.field import Colours, Densities, Directions, Points
from ...volume import composite, weights_of
from .sparse_voxels import Cells, SparseVoxels, VoxelRows

Resolution = Annotated[int, between(4, 1024)]
DensityRate = Annotated[float, between(1e-6, 1e4)]
INITIAL_DENSITY = 0.1  # density of all nodes at first, per unit of coordinates
WEIGHT_THRESHOLD = 5e-3  # least weight of a voxel in a picture, section 3.3; higher prunes more
TV_DENSITY = 1e-5  # weight of density's total variation, eq. 3; higher smooths
TV_HARMONICS = 1e-3  # weight of harmonics' total variation, eq. 3; higher smooths
DECAYED = 128 / 250  # the release's rates fall over 250 000 steps, of which 128 000 are taken
OPEN_TV_DENSITY = 5e-4  # the same of density where there is no bound, the release's
OPEN_TV_HARMONICS = 5e-3  # the same of harmonics where there is no bound


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers for synthetic scenes (section 3, and its release); `Plenoxels.preset` has a CPU's."""

    occupancy: OccupancyNumbers = OccupancyNumbers(
        samples_per_step=1 << 20,
        occupancy_resolution=256,
        occupancy_threshold=1e-2,
    )
    proposals: ProposalNumbers = ProposalNumbers()
    measured: DepthNumbers = DepthNumbers()
    occupancy_interval: Steps = 64  # steps between updates of the occupancy grid, of all its cells; more are faster
    base_resolution: Resolution = 256  # voxels per axis at first, section 3.3; more cost time early
    max_resolution: Resolution = 512  # voxels per axis in the end, by doublings; more give detail, cost memory
    open_base_resolution: Resolution = 128  # voxels per axis at first where there is no bound, the release's
    open_max_resolution: Resolution = 640  # voxels per axis in the end where there is no bound
    refine_until: Share = 0.3  # share of the budget at which the grid has its final resolution
    step_size: Annotated[float, between(0.05, 4)] = 0.5  # distance of samples in voxels; larger is faster, less exact
    rays_per_step: BatchSize = 5000  # rays in a step at most, section 4; more reduce noise, and cost time
    density_learning_rate: DensityRate = 30.0  # density's rate, for 256 voxels per axis; in proportion to these
    final_density_learning_rate: DensityRate = 30 * (0.05 / 30) ** DECAYED  # density's rate at the end of the budget
    density_delay: Share = 0.12  # share of the budget in which density's rate rises; longer settles colours first
    harmonics_learning_rate: LearningRate = 1e-2  # rate of the harmonics at first
    final_harmonics_learning_rate: LearningRate = 1e-2 * 5e-4**DECAYED  # rate of the harmonics at the end of the budget
    tv_share: PositiveShare = 0.01  # share of a step's nodes for total variation; more smooth more, and cost time
    tv_interval: Steps = 1  # steps between total variation terms; more are faster and smooth less
    sparsity: NonNegative = 1e-11  # weight of the Cauchy loss of density, eq. 4; higher empties more
    beta: NonNegative = 0.0  # weight of the beta loss of opacity, eq. 5, for captures without alpha; 0: off
    exposure_correction: Setting = "auto"  # learn a gain per photograph; auto: where exposures are found to differ

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        for name, (base, most) in {"": self.resolutions(False), "open-": self.resolutions(True)}.items():
            if base > most:
                raise LumigraphError(
                    f"A grid cannot begin finer than it ends: --{name}base-resolution {base:,} is above "
                    f"--{name}max-resolution {most:,}"
                )

    def resolutions(self, unbounded: bool) -> tuple[int, int]:
        """Voxels per axis, at first and in the end."""
        if unbounded:
            return self.open_base_resolution, self.open_max_resolution
        return self.base_resolution, self.max_resolution


SOURCES = {  # of the numbers of `paper`; the others are ours
    "sxyu/svox2, opt/configs/syn.json (ee80e2c)": (
        "base_resolution max_resolution refine_until density_learning_rate harmonics_learning_rate tv_density "
        "tv_harmonics"
    ),
    "sxyu/svox2, opt/opt.py (ee80e2c)": (
        "initial_density rays_per_step final_density_learning_rate final_harmonics_learning_rate density_delay tv_share"
    ),
    "sxyu/svox2, opt/util/config_util.py (ee80e2c)": "step_size",
}


DELAYED = 0.01  # what the density's learning rate begins with, as a share
WEIGHT_DECAY = 0.9  # of a voxel's remembered weight, from one update of the occupancy grid to the next
OCCUPANCY_DECAY = 0.9  # share of a cell's density kept at each update of the occupancy grid
SCHEDULE = GridSchedule(
    begins=1e-9, early_steps=0, probes=1.0, decay=OCCUPANCY_DECAY
)  # the whole grid, but not in the first step
NOTE_INTERVAL = 4  # steps between those whose samples' weights are remembered for pruning
MIN_DENSITY = 1e-2  # density of a node at least, where another method is taken over: what is not above 0 learns nothing
EDGE = 1e-3  # opacities are kept so far from 0 and 1 in the beta loss


class HarmonicField(Field):
    """Density and spherical harmonics at the nodes of a sparse grid over a space's coordinates (section 3.1).

    touched: rows of the last evaluation with gradients, and a small table of them, to which gradients are confined
    """

    cheap_density: ClassVar[bool] = True
    joint: ClassVar[bool] = True

    def __init__(self, config: Config, frame: Frame, space: Space):
        super().__init__()
        self.config, self.space = config, space
        first, _ = config.resolutions(space.is_open)
        self.voxels = SparseVoxels(cells_of(space, first), INITIAL_DENSITY)
        self.touched: tuple[Tensor, VoxelRows]

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Points]:
        """Density, and as features the points' coordinates."""
        places = self.space.warp(points)
        return self.voxels.density_at(places).relu() * self.space.stretch(points), places

    def colour(self, features: Float[Tensor, "point 3"], directions: Directions, code: Tensor | None = None) -> Colours:
        return self.voxels.at(features, directions)[1].sigmoid()

    def forward(self, points: Points, directions: Directions, code: Tensor | None = None) -> tuple[Densities, Colours]:
        voxels: SparseVoxels | VoxelRows = self.voxels
        if torch.is_grad_enabled():
            rows = self.voxels.touched(self.space.warp(points))
            voxels = self.voxels.part(rows)
            self.touched = rows, voxels
        density, rgb = voxels.at(self.space.warp(points), directions)
        return density.relu() * self.space.stretch(points), rgb.sigmoid()

    @property
    def step_length(self) -> float:
        return self.config.step_size * 2 / int(self.voxels.cells.amax())

    def storage(self) -> dict[str, Stored]:
        """Harmonics by a codebook, density as whole numbers."""
        coded = {"voxels.density": Stored("scaled"), "voxels.harmonics": Stored("coded")}
        return coded | {"voxels.weights": Stored("nothing")}


class Plenoxels(FieldMethod):
    """A sparse grid in occupied cells. Its values belong to nodes in the coordinates of a `Space`: an object as it is,
    a forward-facing capture in normalised device coordinates, anything else contracted into a ball."""

    Config = Config
    network: HarmonicField

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        self.network = HarmonicField(c, frame, space)
        schedule = replace(SCHEDULE, interval=c.occupancy_interval)
        self.sampler = sampler_for(
            frame, space, c.occupancy, c.proposals, schedule, max_rays=c.rays_per_step, adapts=False
        )
        learns_gains = c.exposure_correction != "no"
        self.exposure = Exposure(frame.image_count, c.exposure_correction, "harmonics") if learns_gains else None
        self._table: LazyRMSprop | None = None

    @property
    def voxels(self) -> SparseVoxels:
        return self.network.voxels

    @classmethod
    def cpu_preset(cls) -> Any:
        return changed(Config(), samples_per_step=1 << 16, transmittance_threshold=1e-3, occupancy_threshold=0.02,
            base_resolution=128, max_resolution=192, open_base_resolution=64, open_max_resolution=192, refine_until=0.4,
            step_size=1.0, rays_per_step=4096, tv_share=0.1, tv_interval=8, sparsity=0.0, density_learning_rate=40.0,
            final_density_learning_rate=4.0, density_delay=0.2, harmonics_learning_rate=0.15,
            final_harmonics_learning_rate=0.02, occupancy_resolution=128, occupancy_interval=16)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """A grid of three sizes with every loss, within some twenty quick steps."""
        return changed(Config(), occupancy_resolution=16, occupancy_interval=4, base_resolution=8, max_resolution=32,
            open_base_resolution=8, open_max_resolution=32, refine_until=0.5, step_size=1.0, rays_per_step=128,
            tv_share=0.5, tv_interval=2, density_learning_rate=60.0, final_density_learning_rate=10.0,
            density_delay=0.1, harmonics_learning_rate=0.2, final_harmonics_learning_rate=0.05, sparsity=1e-5,
            beta=1e-4, exposure_correction="yes")  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        _, last = config.resolutions(frame.is_open)
        grown = SparseVoxels.bytes_of(cells_of(space_of(frame), last), learning)
        return super().further_bytes(frame, config, learning) + grown

    # Compression

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """Share of each voxel in one picture; see `components.sampling.importance`."""

        def lookup(points: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 1"]:
            return self.voxels.density_at(self.network.space.warp(points))[:, None]

        (shares,) = importance(self, camera, lookup, [self.voxels.density])
        return {"network.voxels.harmonics": shares[:, 0]}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Prune the least important voxels."""
        weights = importance["network.voxels.harmonics"]
        kept = most_important(weights, 1 - share)
        self.voxels.keep(kept)
        return {"network.voxels.harmonics": weights[kept]}

    # Training

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        if isinstance(self.sampler, OccupancySampler) and data.images.has_alpha:
            self.voxels.rebuild(self.sampler.grid.possible[0], self.cells, self._table)

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Density and harmonics of the teacher at occupied nodes of the finest grid."""
        known, c, chance, space = teacher_of(teacher, cameras), self.config, self.random(3), self.network.space
        n = c.occupancy
        occupied = known.occupied(space, n.occupancy_resolution, n.occupancy_threshold, chance)
        cells = cells_of(space, c.resolutions(space.is_open)[1])
        self.voxels.rebuild(occupied.to(self.device), cells, self._table)
        points = space.unwarp(self.voxels.places.cpu())
        stretch = space.stretch(points)
        density = known.density_around(points, 2 / max(cells) / stretch, chance) / stretch
        self.voxels.density.copy_(density.clamp_min(MIN_DENSITY)[:, None])
        dense = self.voxels.dense(n.occupancy_threshold * max(cells) / 2)
        self.voxels.rebuild(dense, cells, self._table)
        points = space.unwarp(self.voxels.places.cpu())
        self.voxels.harmonics.copy_(known.harmonics(points, BANDS, logit).flatten(1))
        if self.sampler.is_open:
            self.sampler.begin_from(known, chance)
        self.sampler.settle(self.density, chance)

    @property
    def cells(self) -> Cells:
        x, y, z = self.voxels.cells.tolist()
        return x, y, z

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        config, generator, is_open = self.config, self.random(step), self.sampler.is_open
        (samples,), terms = self.learn(batch.rays, generator)
        look, (rows, part) = samples.look(self.network), self.network.touched
        if not is_open and step % NOTE_INTERVAL == 0:
            places = self.network.space.warp(look.samples.along(batch.rays)[0])
            self.voxels.note(places, weights_of(look.samples, look.density.detach()))
        background = backdrop(batch, self.background, generator, is_open)
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background, self.exposure)
        self.figures |= {"voxels": len(self.voxels), "touched": len(rows)}
        terms |= {"colour": residual.square().mean()}
        terms |= depth_terms(config, batch.extra, rendering.depth, rendering.opacity)
        if config.sparsity:
            terms["sparsity"] = config.sparsity * cauchy(look.density, len(batch))
        if step % config.tv_interval == 0:
            drawn = torch.rand(len(rows), generator=generator).to(rows.device) < config.tv_share
            chosen = self.voxels.numbers[rows[drawn]].long()
            bounded = TV_DENSITY, TV_HARMONICS
            weights = (OPEN_TV_DENSITY, OPEN_TV_HARMONICS) if is_open else bounded
            for name, weight in zip(("density", "harmonics"), weights, strict=True):
                if weight:
                    terms[f"tv_{name}"] = weight * total_variation(chosen, part.nodes, getattr(part, name))
        if config.beta and batch.alpha is None:
            terms["beta"] = config.beta * undecided(rendering.opacity)
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        density = {"params": [self.voxels.density], "name": "density"}
        harmonics = {"params": [self.voxels.harmonics], "name": "harmonics"}
        self._table = LazyRMSprop([density, harmonics])
        return [self._table, *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        """Exponential decay; the density's rate has a warm-up (the release's delayed rates). It is proportional to the
        resolution, because density times a voxel's size gives opacity."""
        c, share = self.config, self._resolution(progress) / 256
        up = math.sin(0.5 * math.pi * min(1.0, progress / c.density_delay)) if c.density_delay else 1.0
        density = c.density_learning_rate, c.final_density_learning_rate
        return {
            "density": share * (DELAYED + (1 - DELAYED) * up) * falling(*density, progress),
            "harmonics": falling(c.harmonics_learning_rate, c.final_harmonics_learning_rate, progress),
        }

    def before_step(self, step: int, progress: float) -> None:
        c, sampler = self.config, self.sampler
        wanted = cells_of(self.network.space, self._resolution(progress))
        if wanted > self.cells:
            self.voxels.rebuild(self._kept(), wanted, self._table)
            if isinstance(sampler, OccupancySampler):
                sampler.grid.density.zero_()
                sampler.stale = True
        if step % c.occupancy_interval == 0:
            self.voxels.weights *= WEIGHT_DECAY
        super().before_step(step, progress)

    def _kept(self) -> Bool[Tensor, "x y z"]:
        """Cells that are not pruned. Where there is no bound, a step's few long rays leave most nodes without a known
        weight; there a voxel goes that would stop less light than the threshold, as in the release."""
        least = WEIGHT_THRESHOLD
        if not self.sampler.is_open:
            return self.voxels.important(least)
        return self.voxels.dense(least * int(self.voxels.cells.amax()) / 2)

    def _resolution(self, progress: float) -> int:
        """Voxels per axis at a share of the budget: doubled at equal intervals up to `refine_until`."""
        c = self.config
        first, last = c.resolutions(self.sampler.is_open)
        doublings = math.ceil(math.log2(last / first))
        done = doublings if progress >= c.refine_until else int(doublings * progress / c.refine_until)
        return min(first << done, last)


def cells_of(space: Space, resolution: int) -> Cells:
    """Voxels along each axis. A forward-facing capture has few depths and many pixels."""
    if isinstance(space, NDC):
        return resolution + resolution // 2, resolution + resolution // 2, resolution // 2
    return resolution, resolution, resolution


def undecided(opacity: Float[Tensor, " ray"]) -> Tensor:
    """Mean of log(T) + log(1 - T), smallest for transmittances of 0 or 1 (eq. 5)."""
    light = (1 - opacity).clamp(EDGE, 1 - EDGE)
    return (light.log() + (1 - light).log()).mean()
