"""SNeRG: a field whose direction comes in once a pixel, baked into blocks of voxels (Hedman 2021, arXiv 2103.14645)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ...camera import Camera
from ...camera.rays import Look, Rays, Rendering
from ...color.blending import over
from ...components.fields.hash_field import CPU_LEVELS, TINY_LEVELS, TableNumbers
from ...components.fields.spaces import Box, contraction_of, space_of
from ...components.fields.teacher import teacher_of
from ...components.sampling.occupancy_sampler import OCCUPANCY_INTERVAL, OccupancyNumbers, StepNumbers
from ...components.sampling.samplers import CPU_HASH, TINY_HASH, ProposalNumbers, sampler_for
from ...components.training.photometric import backdrop, huber, residuals
from ...components.training.regularizers import cauchy
from ...components.training.row_optimizers import LazyAdam, exchange
from ...components.training.schedules import falling, hold_and_decay
from ...datasets.scene import Batch, Frame, Scene
from ...errors import LumigraphError, LumigraphWarning
from ...exchange.baked import Atlas
from ...files.ranges import (
    BatchSize,
    Layers,
    LearningRate,
    NonNegative,
    PositiveShare,
    Share,
    Width,
    between,
    changed,
)
from ...geometry import unit
from ...kernels.block_march import ALPHA, CHANNELS
from ...kernels.spherical_harmonics import K00
from ...method import BaseConfig, FieldMethod, Pass, seeded
from ...method.capabilities import HasField, can
from ...method.field import Colours, Densities, Directions, Points
from ...volume import composite, weights_of
from .baked_voxels import BakedVoxels, VisibilityGrid, rounded, smoothed
from .deferred_field import Deferred, DeferredField, Geometry, HashDeferred, NetworkDeferred, ViewDependence

POSITION_FREQUENCIES = 10  # octaves of positions of the network


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, with where it or its release gives them; `SNeRG.preset` has those of a plain CPU."""

    table: TableNumbers = TableNumbers()
    occupancy: OccupancyNumbers = OccupancyNumbers(transmittance_threshold=1e-3)
    steps: StepNumbers = StepNumbers()
    proposals: ProposalNumbers = ProposalNumbers()
    field: Literal["hash", "network"] = "network"  # field to bake: the paper's network, or a faster hash table
    view_width: Width = 16  # channels of the view-dependence network, section 4.2; wider is slower in a browser
    sparsity_weight: NonNegative = 1e-7  # lambda_s of eq. 8: 1e-4 over a ray's 1024 samples; higher: emptier voxels
    deferred_share: Annotated[float, between(0.05, 0.99)] = 0.9  # share of the budget ahead of baking
    voxel_share: Share = 0.0  # share of the rest in which voxels learn too, then the small network alone; 0: none
    whole: bool = True  # bake an open capture whole, contracted; off: its box alone, for the published viewer
    resolution: Annotated[int, between(8, 2048)] = 1000  # voxels along the grid, section 5.1, at most two for a pixel
    block_size: Annotated[int, between(4, 66)] = 32  # voxels along a block's side with its apron, section 5.1
    visibility_resolution: Annotated[int, between(8, 512)] = 256  # cells per axis that record visibility
    least_alpha: Share = 0.005  # alpha of a voxel below which it is empty, section 5.1; higher makes smaller files
    rays_per_step: BatchSize = 8192  # rays in a step after baking; more reduce noise, and cost time
    learning_rate: LearningRate = 5e-4  # Adam's learning rate of the field at first; higher: faster, may diverge
    final_learning_rate: LearningRate = 5e-6  # learning rate of the field at its end, reached exponentially
    decay_start: Annotated[float, between(0, 0.99)] = 0.0  # share of the field's stage before that rate falls
    view_learning_rate: LearningRate = 5e-4  # learning rate of the view-dependence network
    voxel_learning_rate: LearningRate = 0.01  # learning rate of voxels at first; a tenth of it at the end
    hidden_layers: Layers = 8  # hidden layers of the field's network; more cost time
    hidden_width: Width = 512  # channels of the field's hidden layers, the release's; wider costs memory and time
    # Of the paper's network.
    hash_weight_decay: NonNegative = 0.0  # decoupled weight decay of an object's table, towards a density of 1
    huber_delta: PositiveShare = 1.0  # residual at which the loss turns from squared to linear; 1: always squared


SOURCES = {  # of the numbers of `paper`; the others are ours
    "google-research/google-research, snerg/configs/blender.yaml (2b41834)": (
        "hidden_width sparsity_weight learning_rate final_learning_rate resolution"
    ),
    "google-research/google-research, snerg/nerf/utils.py (1a69739)": (
        "field hidden_layers position_frequencies view_width block_size least_alpha"
    ),
    "google-research/google-research, snerg/train.py (2b41834)": "huber_delta",
    "google-research/google-research, snerg/snerg/eval_and_refine.py (35a5be2)": "voxel_share",
}


FIELD, VOXELS, ATLAS = 0, 1, 2  # stages
TAUGHT_VOXEL_SHARE = 0.7  # least share of the rest of the budget in which voxels of a teacher learn: they have no
# features yet
SKIP_LAYER = 5  # layer of the network whose activation the input is concatenated to again
VOXELS_PER_PIXEL = 2  # voxels along the grid, for each pixel of a photograph's longer side, at most
SLAB_VOXELS = 1 << 22  # voxels of a slab that is baked together
POINTS_PER_CHUNK = 1 << 18  # points at which a field is evaluated together
SOLID_OPACITY = 0.9  # opacity from which on a pixel of an open capture shows baked voxels, not what lies beyond


class RaySum(NamedTuple):
    """Composited sums along each ray, without a background."""

    diffuse: Float[Tensor, "ray 3"]
    opacity: Float[Tensor, " ray"]
    features: Float[Tensor, "ray 4"]
    distance: Float[Tensor, " ray"]  # times opacity


class VoxelParameters(nn.Module):
    """Trainable voxel values, empty before and after training."""

    grows = ("values",)

    def __init__(self):
        super().__init__()
        self.values = nn.Parameter(torch.zeros(0, CHANNELS), requires_grad=False)


class SNeRG(FieldMethod):
    """A field is trained on photographs; its values are baked into voxels; the small network is trained further with
    those.

    began:      share of the budget at which the field was baked; -1 before
    of_another: whether the voxels were baked from another method
    longest_side: pixels of the largest photograph; 0 while unknown. Voxels need not be much finer than it
    """

    Config = Config
    taught_steps = 800
    network: DeferredField
    stage: Tensor
    began: Tensor
    of_another: Tensor
    longest_side: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        with seeded(c.seed):
            if c.field == "hash":
                self.network = HashDeferred(c.table, c.hidden_layers, c.hidden_width, space, frame.reach)
            else:
                layers = c.hidden_layers, c.hidden_width, SKIP_LAYER
                self.network = NetworkDeferred(POSITION_FREQUENCIES, *layers, space)
            self.view = ViewDependence(c.view_width)
        self.sampler = sampler_for(frame, space, c.occupancy, c.proposals, steps=c.steps)
        contracted = contraction_of(frame) if c.whole and frame.is_open else None
        self.voxel_space = contracted or Box(frame.bounds, frame.near)
        cells = c.visibility_resolution * (2 if contracted else 1)
        self.visibility = VisibilityGrid(cells, OCCUPANCY_INTERVAL)
        self.voxels, self.tuned = BakedVoxels(c.block_size - 2, contracted), VoxelParameters()
        self.register_buffer("stage", torch.tensor(FIELD))
        self.register_buffer("began", torch.tensor(-1.0))
        self.register_buffer("of_another", torch.tensor(False))
        self.register_buffer("longest_side", torch.tensor(0))
        self._lazy: LazyAdam | None = None
        self._adam: torch.optim.Adam | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table, fewer voxels in smaller blocks, and voxels that learn on after baking."""
        return Config(**CPU_HASH | {"table": CPU_LEVELS}, field="hash", hidden_layers=2, hidden_width=32,
            learning_rate=2e-2, final_learning_rate=1e-3, decay_start=0.3, view_learning_rate=5e-3, deferred_share=0.6,
            voxel_share=0.8, resolution=400, visibility_resolution=128, rays_per_step=4096, hash_weight_decay=0.3,
            huber_delta=0.3, sparsity_weight=1e-4)  # fmt: skip

    @classmethod
    def taught_preset(cls, device: torch.device) -> Any:
        """A lower learning rate: voxels start close to their values, and with few rays for each, 0.01 adds noise."""
        return replace(cls.preset(device), voxel_learning_rate=0.003)

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table, a grid of three sizes and a few thousand voxels, in all stages within some twenty steps."""
        return changed(Config(**TINY_HASH | {"table": TINY_LEVELS}), transmittance_threshold=1e-3, field="hash",
            hidden_layers=1, hidden_width=16, rays_per_step=512, learning_rate=2e-2, final_learning_rate=2e-3,
            view_learning_rate=5e-3, visibility_resolution=16, deferred_share=0.6, voxel_share=0.6, resolution=32,
            block_size=8, huber_delta=0.1, sparsity_weight=1e-4)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        open_air = config.whole and frame.is_open  # whose far surroundings are a thick shell
        surface = (20 if open_air else 3) * config.resolution**2  # voxels, of what fills its box at least
        voxels = surface * (6 + CHANNELS + 4 + 4 * CHANNELS * (4 if learning and config.voxel_share else 1))
        kept = 4 * config.occupancy.samples_per_step * config.hidden_layers * config.hidden_width
        return super().further_bytes(frame, config, learning) + voxels + kept * learning

    # The field

    @staticmethod
    def _sum(found: Pass) -> RaySum:
        diffuse, features = (found.scale(x) if found.scale else x for x in found.features)
        seen = composite(found.samples, found.density, diffuse, features=features)
        distance = torch.where(seen.depth.isfinite(), seen.depth, 0) * seen.opacity
        return RaySum(seen.rgb, seen.opacity, seen.extra["features"], distance)

    # The baked voxels

    @property
    def _bounded(self) -> bool:
        """True if voxels cover only the box of interest of an open capture."""
        return self.sampler.is_open and self.voxels.space is None

    @property
    def _values(self) -> Float[Tensor, "voxel 8"]:
        """Values of voxels: trainable ones, or of eight bits."""
        return self.tuned.values if self.stage == VOXELS else self.voxels.values

    def _marched(self, rays: Rays) -> RaySum:
        totals, distance = self.voxels.march(
            rays, self._values, self.frame.near, self.config.occupancy.transmittance_threshold
        )
        return RaySum(totals[:, :ALPHA], totals[:, ALPHA], totals[:, ALPHA + 1 :], distance)

    def atlas(self) -> Atlas:
        """The scene as an atlas, in the scene's frame. Raises LumigraphError while there is none yet."""
        if self.stage == FIELD:
            raise LumigraphError(
                f"This run is not baked yet, as it will be after {self.config.deferred_share:.0%} of its budget; "
                f"`lumigraph resume` trains it on"
            )
        levels = rounded(self.tuned.values) if self.stage == VOXELS else self.voxels.levels
        return self.voxels.atlas(levels, self.view)

    @torch.no_grad()
    def take(self, atlas: Atlas) -> None:
        """Load baked voxels and the view-dependence network, of the same sizes; drop the field."""
        places, levels = (x.to(self.device) for x in atlas.voxels())
        size = atlas.block * torch.tensor(atlas.index.shape, device=self.device)
        self.voxels.hold(places, atlas.low.to(self.device), atlas.voxel, size)
        self.voxels.levels = levels
        self.view.take(atlas.network)
        self.stage.fill_(ATLAS)
        self._release()

    # A pixel

    def _pixel(
        self, seen: RaySum, directions: Float[Tensor, "ray 3"], background: Float[Tensor, "#ray 3"]
    ) -> Rendering:
        """Diffuse colour, and what the network adds for a direction (eq. 6); see `baked.ViewNetwork`."""
        hit = (seen.opacity > 0).nonzero()[:, 0]  # elsewhere the network need not be asked
        said = self.view(directions[hit], seen.diffuse[hit], seen.features[hit])
        added = torch.zeros_like(seen.diffuse).index_copy(0, hit, said)
        rgb = over(seen.diffuse + seen.opacity[:, None] * added, seen.opacity, background)
        depth = torch.where(seen.opacity > 1e-3, seen.distance / seen.opacity.clamp_min(1e-3), torch.inf)
        return Rendering(rgb, depth, seen.opacity)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        field = self.stage == FIELD
        seen = self._sum(self.sampler.sample(rays, self.network)[-1]) if field else self._marched(rays)
        return self._pixel(seen, rays.directions, background)

    def looks(self, rays: Rays) -> list[Look]:
        """Samples with the colour that they add to their ray's pixel: the network's share is the whole ray's."""
        if self.stage == FIELD:
            (found,) = self.sampler.sample(rays, self.network)
            samples, density, diffuse, seen = found.samples, found.density, found.features[0], self._sum(found)
        else:
            samples, values = self.voxels.samples(rays, self._values, self.frame.near)
            alpha = values[:, ALPHA]
            density, diffuse = self.voxels.density(alpha, samples.length), values[:, :ALPHA] / alpha[:, None]
            seen = self._marched(rays)
        added = self.view(rays.directions, seen.diffuse, seen.features)
        return [Look("samples", samples, density, diffuse + added[samples.ray_index])]

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        if self.stage == FIELD:
            return super().density(points)
        return self._density_of(self.voxels.at(points, self._values)[:, ALPHA], points)

    def _density_of(self, alpha: Float[Tensor, " point"], points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        return self.voxels.density(alpha, self.voxels.length(points, self.voxels.edge))

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions if nothing is before or behind."""
        if self.stage == FIELD:
            density, (diffuse, features) = self.network.geometry(points)
        else:
            values = self.voxels.at(points, self._values)
            alpha = values[:, ALPHA]
            density = self._density_of(alpha, points)
            diffuse, features = (values / alpha.clamp_min(1e-4)[:, None]).split([ALPHA, 1, CHANNELS - 4], -1)[::2]
        return density, (diffuse + self.view(directions, diffuse, features)).clamp(0, 1)

    # Learning

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        rays = self.sampler.batch_size if self.stage == FIELD else self.config.rays_per_step
        return data.sample_rays(rays, generator).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator = self.random(step)
        opaque = self.sampler.is_open and (int(self.stage) == FIELD or not self._bounded)
        background = backdrop(batch, self.background, generator, opaque)
        if self.stage == FIELD:
            seen, terms = self._learn_field(batch.rays, generator)
        else:
            seen, terms = self._marched(batch.rays), {}
            self.figures = {"rays": len(batch)}
        rendering = self._pixel(seen, batch.rays.directions, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background)
        if self._bounded and self.stage > FIELD:  # what lies beyond the box is not there to be learnt
            solid = seen.opacity.detach() > SOLID_OPACITY
            residual = residual * solid.repeat(len(residual) // len(solid))[:, None]  # before two backgrounds, maybe
        return {"huber": huber(residual, self.config.huber_delta), **terms}

    def _learn_field(self, rays: Rays, generator: torch.Generator) -> tuple[RaySum, dict[str, Tensor]]:
        """Sums along rays through the field, and the loss terms beside colours (eq. 8) by name."""
        (found,), terms = self.learn(rays, generator)
        points, _ = found.samples.along(rays)
        self.visibility.record(self.voxel_space.warp(points), weights_of(found.samples, found.density.detach()))
        if weight := self.config.sparsity_weight:
            terms["sparsity"] = weight * cauchy(found.density, len(rays))
        return self._sum(found), terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, tables = self.config, self.network.tables
        own = {id(table) for table in tables}
        layers = [x for x in self.network.parameters() if id(x) not in own]
        common: dict[str, Any] = {"lr": c.learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        decay = 0.0 if self.sampler.is_open else c.hash_weight_decay
        field = [{"params": tables, "name": "field", "weight_decay": decay}] if tables else []
        self._lazy = LazyAdam([*field, {"params": [self.tuned.values], "name": "voxels"}], **common)
        groups: list[dict[str, Any]] = [
            {"params": layers, "name": "field"},
            {"params": [*self.view.parameters()], "name": "view"},
        ]
        self._adam = torch.optim.Adam(groups, foreach=True, **common)
        return [self._lazy, self._adam, *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c, spent = self.config, self._spent(progress)
        over = min(1.0, progress / c.deferred_share)
        return {
            "field": hold_and_decay(c.learning_rate, c.final_learning_rate, step, over, c.decay_start),
            "view": falling(c.view_learning_rate, 0.1 * c.view_learning_rate, spent),
            "voxels": falling(c.voxel_learning_rate, 0.1 * c.voxel_learning_rate, spent / max(self._voxel_share, 1e-9)),
        }

    @property
    def _voxel_share(self) -> float:
        """Share of the budget after baking in which voxels learn."""
        return max(self.config.voxel_share, TAUGHT_VOXEL_SHARE) if self.of_another else self.config.voxel_share

    def _spent(self, progress: float) -> float:
        """Share of the budget after baking that is spent."""
        return 0.0 if self.began < 0 else (progress - float(self.began)) / max(1 - float(self.began), 1e-9)

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        if self._bounded:
            warnings.warn(BOUNDED_WARNING, LumigraphWarning, stacklevel=2)
        self.longest_side.fill_(data.cameras.size.max())
        super().begin(data, seconds)

    def before_step(self, step: int, progress: float) -> None:
        c = self.config
        if self.stage == FIELD and progress >= c.deferred_share:
            self._bake(self.network.geometry)
        if self.stage > FIELD and self.began < 0:
            self.began.fill_(progress)
        if self.stage == VOXELS and self._spent(progress) >= self._voxel_share:
            self._drop_hidden()
            self.voxels.settle(self.tuned.values.detach())
            self._exchange(self.tuned, "values", self.tuned.values[:0])
            self.stage.fill_(ATLAS)
        if self.stage == FIELD:
            super().before_step(step, progress / c.deferred_share)

    def after_step(self, step: int) -> None:
        if self.stage == VOXELS:
            self.tuned.values.data.clamp_(0, 1)
        elif self.stage == FIELD:
            super().after_step(step)

    # Baking

    @torch.no_grad()
    def _bake(self, geometry: Geometry) -> None:
        """Bake a field's values at visible voxels, replacing the field (section 5.1)."""
        c, visible = self.config, self.visibility.visible
        low, edge, size = self._grid(visible)
        wide = 2.0 if self.voxels.space else 1.0  # of the grid in coordinates of its space
        places, values = [], []
        for first, last in slabs(*size.tolist()):
            axes = torch.arange(first, last), torch.arange(int(size[1])), torch.arange(int(size[2]))
            x, y, z = (
                self.visibility.along((low[axis] + (places.to(low) + 0.5) * edge) / wide)
                for axis, places in enumerate(axes)
            )
            there = visible[x][:, y][:, :, z].nonzero()
            there[:, 0] += first
            for part in there.split(POINTS_PER_CHUNK):
                points = self.voxel_space.unwarp((low + (part + 0.5) * edge) / wide)
                density, (diffuse, features) = geometry(points)
                alpha = 1 - torch.exp(-density * self.voxels.length(points, edge))
                kept = alpha >= c.least_alpha
                alpha = alpha[kept, None]
                places.append(part[kept])
                values.append(torch.cat([alpha * diffuse[kept], alpha, alpha * features[kept]], -1))
        if not sum(map(len, places)):
            raise LumigraphError(
                "There is nothing to bake: no voxel is denser than --least-alpha; train longer, or lower it"
            )
        self.voxels.hold(torch.cat(places), low, edge, size)
        self._exchange(self.tuned, "values", torch.cat(values))
        self.stage.fill_(VOXELS)
        self._release()

    @torch.no_grad()
    def _drop_hidden(self) -> None:
        """Prune voxels without a training ray, once there were more rays than voxels with one."""
        known = self._lazy.state.get(self.tuned.values) if self._lazy else None
        if not known:
            return
        met = (known["square"] > 0).any(1)
        if 0 < int(met.sum()) < int(known["step"]) * self.config.rays_per_step:
            voxels, (low, edge, size) = self.voxels, (self.voxels.low, float(self.voxels.edge), self.voxels.size)
            voxels.hold(voxels.places[met], low, edge, size)
            self._exchange(self.tuned, "values", self.tuned.values[met])

    def _grid(self, visible: Bool[Tensor, "x y z"]) -> tuple[Float[Tensor, " 3"], float, Tensor]:
        """Corner, side of a voxel, and voxels along each axis, of the grid around all that rays see: within the box of
        interest, or all that there is, contracted."""
        cells = visible.nonzero()
        if not len(cells):
            raise LumigraphError("There is nothing to bake: no ray sees anything in the box of interest; train longer")
        resolution, longest = self.config.resolution, int(self.longest_side)
        resolution = min(resolution, VOXELS_PER_PIXEL * longest) if longest else resolution
        if self.voxels.space:
            count = -(-resolution // self.voxels.block) * self.voxels.block
            return self.background.new_full((3,), -2.0), 4 / count, torch.full((3,), count, device=self.device)
        low, high = (x * (2 / len(visible)) - 1 for x in (cells.amin(0), cells.amax(0) + 1))
        if self.sampler.is_open:
            bounds = torch.tensor(self.frame.bounds, device=low.device)
            low, high = torch.maximum(low, bounds[0]), torch.minimum(high, bounds[1])
        edge = float((high - low).max()) / resolution
        return low, edge, ((high - low) / edge - 1e-3).ceil().long()

    def _release(self) -> None:
        """Drop what the field alone needs."""
        for module in self.network.modules():
            for name in getattr(module, "grows", ()):
                self._exchange(module, name, getattr(module, name)[:0])
        self.sampler.release()
        self.visibility.release()

    def _exchange(self, module: nn.Module, name: str, values: Tensor) -> None:
        """Replace a parameter by one of another size."""
        old = getattr(module, name)
        mine = [x for x in (self._lazy, self._adam) if x and any(old is p for g in x.param_groups for p in g["params"])]
        exchange(module, name, values.detach().clone(), mine[0] if mine else None)

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Bake a teacher's density at visible surfaces, and as diffuse colour its colour along their mean viewing
        direction. View-dependent features and network are trained afterwards.

        Raises LumigraphError if cameras see no surface.
        """
        self.longest_side.fill_(cameras.size.max())
        known, grid = teacher_of(teacher, cameras), self.visibility
        points, origins = (x.to(self.device) for x in (known.surface.points, known.surface.origins))
        seen = self.voxel_space.warp(points)
        grid.record(seen, seen.new_ones(len(seen)))
        inside, n = grid.inside(seen), grid.resolution
        ways = torch.zeros(n**3, 3, device=self.device)
        ways.index_add_(0, grid.cells(seen[inside]), unit(points - origins)[inside])
        ways = smoothed(ways.view(n, n, n, 3)).reshape(-1, 3)

        def geometry(points: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, " point"], Deferred]:
            if can(teacher, HasField):
                density, rgb = teacher.field(points, unit(ways[grid.cells(self.voxel_space.warp(points))]))
            else:
                density = known.density(points.cpu()).to(self.device)
                rgb = K00 * known.harmonics(points.cpu(), 1, lambda rgb: rgb)[:, 0].to(self.device)
            return density, (rgb.clamp(0, 1), points.new_zeros(len(points), CHANNELS - 4))

        self._bake(geometry)
        self.of_another.fill_(True)


def slabs(x: int, y: int, z: int) -> Iterator[tuple[int, int]]:
    """Ranges along x of parts of a grid that fit into a chunk."""
    thick = max(1, SLAB_VOXELS // (y * z))
    for first in range(0, x, thick):
        yield first, min(x, first + thick)


BOUNDED_WARNING = (
    "SNeRG bakes what lies in the box of interest, as `lumigraph info` tells it; what lies beyond is learnt "
    "beside it until then, and afterwards shows as the plain background; --whole bakes all"
)
