"""SNeRG: a field whose direction comes in once a pixel, baked into blocks of voxels (Hedman 2021, arXiv 2103.14645)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering, Samples
from ..color.blending import over
from ..components.clouds.dense_points import compile_sweep
from ..components.fields.baked_voxels import BakedVoxels, rounded
from ..components.fields.deferred import Deferred, HashDeferred, NetworkDeferred, ViewDependence
from ..components.fields.hash_field import TABLE_ON_A_CPU, TINY_TABLE, HashNumbers, check_levels
from ..components.fields.taken_over import taken_over
from ..components.sampling.carving import visual_hull
from ..components.sampling.coarse_to_fine import SAMPLES_OF_A_RAY, first_grid, keep_looking, lattice, stage
from ..components.sampling.marching import FIRST_RAYS, rays_for, reached
from ..components.sampling.occupancy import OccupancyGrid
from ..components.sampling.proposal import Proposed
from ..components.sampling.sightings import Sightings, smoothed
from ..components.sampling.spaces import Box, contraction_of, space_of
from ..components.sampling.unbounded import RAYS, OpenNumbers, Unbounded, rays_of, unbounded
from ..components.training.exchange import exchange
from ..components.training.fog import scaled_by_distance
from ..components.training.lazy_adam import LazyAdam
from ..components.training.photometric import backdrop, residuals
from ..components.training.schedules import falling, held
from ..components.training.sparsity import cauchy
from ..datasets.scene import Batch, Frame, Scene
from ..errors import LumigraphError, LumigraphWarning
from ..exchange.baked import Atlas
from ..files.ranges import (
    BatchSize,
    Layers,
    LearningRate,
    NonNegative,
    Octaves,
    PositiveShare,
    Seed,
    Share,
    Steps,
    Width,
    between,
)
from ..geometry import unit
from ..kernels.block_march import ALPHA, CHANNELS
from ..kernels.spherical_harmonics import K00
from ..method import RayMethod
from ..method.capabilities import HasField, can
from ..volume import composite, weights_of


@dataclass(frozen=True)
class Config(HashNumbers, OpenNumbers):
    """The paper's numbers, with where it gives them, but for huber_delta; `SNeRG.preset` has those of a plain CPU."""

    field: Literal["hash", "network"] = "network"  # field to bake: the paper's network, or a faster hash table
    view_width: Width = 16  # channels of the view-dependence network, section 4.2; wider is slower in a browser
    sparsity_weight: NonNegative = 1e-4  # lambda_s of eq. 8, section 4.2; higher gives emptier voxels
    deferred_share: Annotated[float, between(0.05, 0.99)] = 0.9  # share of the budget ahead of baking
    voxel_share: Share = 0.0  # share of the rest in which voxels learn too, then the small network alone; 0: none
    whole: bool = True  # bake an open capture whole, contracted; off: its box alone, for the published viewer
    resolution: Annotated[int, between(8, 2048)] = 1000  # voxels along the grid's longest side, section 5.1
    block_size: Annotated[int, between(4, 66)] = 32  # voxels along a block's side with its apron, section 5.1
    visibility_resolution: Annotated[int, between(8, 512)] = 256  # cells per axis that record visibility
    least_alpha: Share = 0.005  # alpha of a voxel below which it is empty, section 5.1; higher makes smaller files
    rays_per_step: BatchSize = 8192  # rays in a step after baking; more reduce noise, and cost time
    learning_rate: LearningRate = 5e-4  # Adam's learning rate of the field at first; higher: faster, may diverge
    final_learning_rate: LearningRate = 5e-6  # learning rate of the field at its end, reached exponentially
    decay_start: Annotated[float, between(0, 0.99)] = 0.0  # share of the field's stage before that rate falls
    view_learning_rate: LearningRate = 5e-4  # learning rate of the view-dependence network
    voxel_learning_rate: LearningRate = 0.01  # learning rate of voxels at first; a tenth of it at the end
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 18  # samples in a step of the field
    hidden_layers: Layers = 8  # hidden layers of the field's network; more cost time
    hidden_width: Width = 256  # channels of the field's hidden layers, section 4.1; wider costs memory and time
    transmittance_threshold: Share = 1e-3  # transmittance at which a ray terminates; higher is faster, less exact
    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 1024  # samples across the cube's diagonal, of the field
    cone_angle: Share = 1 / 256  # growth of the step with distance; higher takes fewer samples far away
    occupancy_resolution: Annotated[int, between(4, 512)] = 128  # cells per axis of the occupancy grid
    occupancy_threshold: NonNegative = 0.05  # optical thickness of a cell below which it is empty; higher skips more
    occupancy_interval: Steps = 16  # steps between updates of the occupancy grid; more are faster, less current
    occupancy_decay: Share = 0.95  # share of a cell's density kept at each update; higher forgets more slowly
    # Of the paper's network.
    skip_layer: Layers = 5  # layer whose activation the input is concatenated to again
    position_frequencies: Octaves = 10  # octaves of positions of the network; more give finer detail, and noise
    hash_weight_decay: NonNegative = 0.0  # decoupled weight decay of an object's table, towards a density of 1
    huber_delta: PositiveShare = 0.1  # residual at which the loss turns from squared to linear; 1: always squared
    seed: Seed = 0  # seed of all random numbers; another seed gives another run

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        check_levels(self)


FIELD, VOXELS, ATLAS = 0, 1, 2  # stages
TAUGHT = 0.7  # share of the budget in which voxels learn at least, that were made of another method: they have no
# features yet
SLAB = 1 << 22  # voxels that are looked at together when baking
PART = 1 << 18  # of them, that a field is asked about together
SOLID = 0.9  # opacity from which on a pixel of an open capture shows what is baked, rather than what lies beyond


class Found(NamedTuple):
    """What lies along rays in the field. asked: at how many places it was; proposed: of open captures, where to"""

    samples: Samples
    density: Float[Tensor, " sample"]
    diffuse: Float[Tensor, "sample 3"]
    features: Float[Tensor, "sample 4"]
    asked: int
    proposed: Proposed | None


class Summed(NamedTuple):
    """What came together along each ray, with nothing behind it."""

    diffuse: Float[Tensor, "ray 3"]
    opacity: Float[Tensor, " ray"]
    features: Float[Tensor, "ray 4"]
    distance: Float[Tensor, " ray"]  # times opacity


class Tuned(nn.Module):
    """Values of voxels while they learn, none before and after."""

    grows = ("values",)

    def __init__(self):
        super().__init__()
        self.values = nn.Parameter(torch.zeros(0, CHANNELS), requires_grad=False)


class SNeRG(RayMethod):
    """A field learns from photographs; its values are baked into voxels; the small network learns on with those."""

    Config = Config
    rays_per_step: Tensor
    stage: Tensor
    began: Tensor
    of_another: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            hashed = config.field == "hash"
            self.network = HashDeferred(config, self.space, frame.reach) if hashed else NetworkDeferred(config)
            self.view = ViewDependence(config.view_width)
        self.unbounded = unbounded(frame, self.space, config)
        self.occupancy = first_grid(config, frame.reach)
        self.lattice = lattice(config, frame.reach)
        contracted = contraction_of(frame) if config.whole and frame.reach > 1 else None
        self.baked_in = contracted or Box(frame.bounds, frame.near)  # the space that voxels lie in
        self.sightings = Sightings(config.visibility_resolution * (2 if contracted else 1))
        self.voxels, self.tuned = BakedVoxels(config.block_size - 2, contracted), Tuned()
        first = rays_of(config.samples_per_step, config) if self.unbounded else FIRST_RAYS
        self.register_buffer("rays_per_step", torch.tensor(first))
        self.register_buffer("stage", torch.tensor(FIELD))
        self.register_buffer("began", torch.tensor(-1.0))  # share of the budget at which it was baked; -1 before
        self.register_buffer("of_another", torch.tensor(False))  # whether it was made of another method
        self._lazy: LazyAdam | None = None
        self._adam: torch.optim.Adam | None = None
        if self.unbounded:
            self.rays_per_chunk = RAYS

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU a hash table with Instant-NGP's numbers there, fewer voxels in smaller
        blocks, and voxels that learn on after baking."""
        if device.type == "cuda":
            return Config()
        return Config(
            field="hash",
            deferred_share=0.6,
            voxel_share=0.8,
            resolution=400,
            visibility_resolution=128,
            rays_per_step=4096,
            learning_rate=2e-2,
            final_learning_rate=1e-3,
            decay_start=0.3,
            view_learning_rate=5e-3,
            hidden_layers=2,
            hidden_width=32,
            **TABLE_ON_A_CPU,
            hash_weight_decay=0.3,
            huber_delta=0.3,
            samples_per_step=1 << 15,
            steps_per_diagonal=384,
            cone_angle=1 / 96,
            occupancy_threshold=0.15,
        )

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table, a grid of three sizes and a few thousand voxels, in all stages within some twenty steps."""
        return Config(
            field="hash",
            deferred_share=0.6,
            voxel_share=0.6,
            resolution=32,
            block_size=8,
            visibility_resolution=16,
            rays_per_step=512,
            learning_rate=2e-2,
            final_learning_rate=2e-3,
            view_learning_rate=5e-3,
            hidden_layers=1,
            hidden_width=16,
            **TINY_TABLE,
            samples_per_step=2048,
            steps_per_diagonal=128,
            occupancy_resolution=16,
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        open_air = config.whole and frame.reach > 1  # whose far surroundings are a thick shell
        surface = (20 if open_air else 3) * config.resolution**2  # voxels, of what fills its box at least
        voxels = surface * (6 + CHANNELS + 4 + 4 * CHANNELS * (4 if learning and config.voxel_share else 1))
        grids = OccupancyGrid.bytes_of(frame.reach, config.occupancy_resolution) + Unbounded.bytes_of(frame, learning)
        kept = 4 * config.samples_per_step * config.hidden_layers * config.hidden_width
        return voxels + grids + kept * learning

    # The field

    def _deferred(self, points: Float[Tensor, "point 3"]) -> Deferred:
        """What the field has at points of the scene; density per scene unit."""
        found = self.network(self.space.warp(points))
        return found._replace(density=found.density * self.space.stretch(points))

    def _found(self, rays: Rays, jitter: Float[Tensor, "ray 2"] | None = None) -> Found:
        """jitter: in training, in [0, 1)"""
        proposed = None
        if self.unbounded:
            proposed = self.unbounded.proposal.sample(rays, jitter)
            samples, asked = proposed.samples, len(proposed.samples)
        else:
            moved = None if jitter is None else jitter[:, 0]
            found = self.occupancy.sample(rays, self.frame.near, *self.lattice, jitter=moved)
            stop = self.config.transmittance_threshold
            samples, asked = reached(rays, found, lambda points: self._deferred(points).density, stop)
        density, diffuse, features = self._deferred(samples.along(rays)[0])
        if self.unbounded and jitter is not None:
            density, diffuse, features = scaled_by_distance(samples.t, density, diffuse, features)
        return Found(samples, density, diffuse, features, asked, proposed)

    @staticmethod
    def _sum(found: Found) -> Summed:
        seen = composite(found.samples, found.density, found.diffuse, features=found.features)
        distance = torch.where(seen.depth.isfinite(), seen.depth, 0) * seen.opacity
        return Summed(seen.rgb, seen.opacity, seen.extra["features"], distance)

    # The baked voxels

    @property
    def _bounded(self) -> bool:
        """Whether voxels hold only a part of what there is."""
        return self.frame.reach > 1 and self.voxels.space is None

    @property
    def _values(self) -> Float[Tensor, "voxel 8"]:
        """Of voxels: as they are learnt, or as eight bits tell them."""
        return self.tuned.values if self.stage == VOXELS else self.voxels.values

    def _marched(self, rays: Rays) -> Summed:
        totals, distance = self.voxels.march(rays, self._values, self.frame.near, self.config.transmittance_threshold)
        return Summed(totals[:, :ALPHA], totals[:, ALPHA], totals[:, ALPHA + 1 :], distance)

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
        """Be an atlas, whose blocks and network are of one's own sizes, and nothing else."""
        places, levels = (x.to(self.device) for x in atlas.voxels())
        size = atlas.block * torch.tensor(atlas.index.shape, device=self.device)
        self.voxels.hold(places, atlas.low.to(self.device), atlas.voxel, size)
        self.voxels.levels = levels
        self.view.take(atlas.network)
        self.stage.fill_(ATLAS)
        self._release()

    # A pixel

    def _pixel(
        self, seen: Summed, directions: Float[Tensor, "ray 3"], background: Float[Tensor, "#ray 3"]
    ) -> Rendering:
        """Diffuse colour, and what the network adds for a direction (eq. 6); see `baked.ViewNetwork`."""
        hit = (seen.opacity > 0).nonzero()[:, 0]  # elsewhere the network need not be asked
        said = self.view(directions[hit], seen.diffuse[hit], seen.features[hit])
        added = torch.zeros_like(seen.diffuse).index_copy(0, hit, said)
        rgb = over(seen.diffuse + seen.opacity[:, None] * added, seen.opacity, background)
        depth = torch.where(seen.opacity > 1e-3, seen.distance / seen.opacity.clamp_min(1e-3), torch.inf)
        return Rendering(rgb, depth, seen.opacity)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        seen = self._sum(self._found(rays)) if self.stage == FIELD else self._marched(rays)
        return self._pixel(seen, rays.directions, background)

    def looks(self, rays: Rays) -> list[Look]:
        """Samples with the colour that they add to their ray's pixel: the network's share is the whole ray's."""
        if self.stage == FIELD:
            found = self._found(rays)
            samples, density, diffuse, seen = found.samples, found.density, found.diffuse, self._sum(found)
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
            return self._deferred(points).density
        return self._density_of(self.voxels.at(points, self._values)[:, ALPHA], points)

    def _density_of(self, alpha: Float[Tensor, " point"], points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        return self.voxels.density(alpha, self.voxels.length(points, self.voxels.edge))

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions if nothing is before or behind."""
        if self.stage == FIELD:
            density, diffuse, features = self._deferred(points)
        else:
            values = self.voxels.at(points, self._values)
            alpha = values[:, ALPHA]
            density = self._density_of(alpha, points)
            diffuse, features = (values / alpha.clamp_min(1e-4)[:, None]).split([ALPHA, 1, CHANNELS - 4], -1)[::2]
        return density, (diffuse + self.view(directions, diffuse, features)).clamp(0, 1)

    # Learning

    def rays_in_a_step(self, data: Scene) -> float:
        c = self.config
        return c.samples_per_step / (c.samples_per_ray if self.unbounded else SAMPLES_OF_A_RAY)

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        rays = int(self.rays_per_step) if self.stage == FIELD else self.config.rays_per_step
        return data.sample_rays(rays, generator).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator = self.random(step)
        opaque = self.unbounded is not None and (int(self.stage) == FIELD or not self._bounded)
        background = backdrop(batch, self.background, generator, opaque)
        if self.stage == FIELD:
            seen, terms = self._learn(batch, generator)
        else:
            seen, terms = self._marched(batch.rays), {}
            self.figures = {"rays": len(batch)}
        rendering = self._pixel(seen, batch.rays.directions, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background)
        if self._bounded and self.stage > FIELD:  # what lies beyond the box is not there to be learnt
            solid = seen.opacity.detach() > SOLID
            residual = residual * solid.repeat(len(residual) // len(solid))[:, None]  # before two backgrounds, maybe
        delta = self.config.huber_delta
        huber = nn.functional.huber_loss(residual, torch.zeros_like(residual), delta=delta) / delta
        return {"huber": huber, **terms}

    def _learn(self, batch: Batch, generator: torch.Generator) -> tuple[Summed, dict[str, Tensor]]:
        """What the field has along rays, and what that costs beside colours (eq. 8), by name."""
        found = self._found(batch.rays, torch.rand(len(batch), 2, generator=generator).to(self.device))
        self.figures |= {"rays": len(batch), "samples": found.asked, "visible_samples": len(found.samples)}
        weights = weights_of(found.samples, found.density.detach())
        self.sightings.note(self.baked_in.warp(found.samples.along(batch.rays)[0]), weights)
        terms = {}
        if weight := self.config.sparsity_weight:
            terms["sparsity"] = weight * cauchy(found.density, len(batch))
        if self.unbounded and found.proposed:
            density = found.density
            terms |= self.unbounded.terms(
                lambda points: self._deferred(points).density, found.proposed, density, generator
            )
        return self._sum(found), terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, tables = self.config, self.network.tables
        own = {id(table) for table in tables}
        layers = [x for x in self.network.parameters() if id(x) not in own]
        common: dict[str, Any] = {"lr": c.learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        decay = c.hash_weight_decay if self.frame.reach == 1 else 0.0
        field = [{"params": tables, "name": "field", "weight_decay": decay}] if tables else []
        self._lazy = LazyAdam([*field, {"params": [self.tuned.values], "name": "voxels"}], **common)
        groups: list[dict[str, Any]] = [
            {"params": layers, "name": "field"},
            {"params": [*self.view.parameters()], "name": "view"},
        ]
        self._adam = torch.optim.Adam(groups, foreach=True, **common)
        optimizers: list[torch.optim.Optimizer] = [self._lazy, self._adam]
        return [*optimizers, self.unbounded.optimizer()] if self.unbounded else optimizers

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c, spent = self.config, self._spent(progress)
        return {
            "field": held(
                c.learning_rate, c.final_learning_rate, step, min(1.0, progress / c.deferred_share), c.decay_start
            ),
            "view": falling(c.view_learning_rate, 0.1 * c.view_learning_rate, spent),
            "voxels": falling(c.voxel_learning_rate, 0.1 * c.voxel_learning_rate, spent / max(self._voxel_share, 1e-9)),
            "proposal": Unbounded.rate(progress),
        }

    @property
    def _voxel_share(self) -> float:
        """Of the budget after baking, in which voxels learn."""
        return max(self.config.voxel_share, TAUGHT) if self.of_another else self.config.voxel_share

    def _spent(self, progress: float) -> float:
        """Share of the budget after baking that is spent."""
        return 0.0 if self.began < 0 else (progress - float(self.began)) / max(1 - float(self.began), 1e-9)

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        if scene.images.has_alpha and self.frame.reach == 1:
            self.occupancy.rule_out(visual_hull(scene, self.config.occupancy_resolution)[None])
        if self.unbounded:
            if self._bounded:
                warnings.warn(BOUNDED, LumigraphWarning, stacklevel=2)
            self.unbounded.begin(scene, seconds, self.random(1))

    def rehearse_begin(self) -> None:
        if self.unbounded:
            compile_sweep()

    def before_step(self, step: int, progress: float) -> None:
        c = self.config
        if self.stage == FIELD and progress >= c.deferred_share:
            self._bake(self._deferred)
        if self.stage > FIELD and self.began < 0:
            self.began.fill_(progress)
        if self.stage == VOXELS and self._spent(progress) >= self._voxel_share:
            self._drop_hidden()
            self.voxels.settle(self.tuned.values.detach())
            self._exchange(self.tuned, "values", self.tuned.values[:0])
            self.stage.fill_(ATLAS)
        if self.stage > FIELD:
            return
        spent = progress / c.deferred_share
        if self.unbounded:
            self.unbounded.before_step(spent)
        else:
            self.lattice = lattice(c, self.frame.reach, stage(spent).steps)
            density_at: Callable = lambda points: self._deferred(points).density  # noqa: E731
            keep_looking(self.occupancy, density_at, c, step, spent, self.random(~step))
        if step % c.occupancy_interval == 0:
            self.sightings.forget()

    def after_step(self, step: int) -> None:
        if self.stage == VOXELS:
            self.tuned.values.data.clamp_(0, 1)
        elif self.stage == FIELD and not self.unbounded:
            rays = rays_for(self.config.samples_per_step, int(self.rays_per_step), self.figures["samples"])
            self.rays_per_step.fill_(rays)

    # Baking

    @torch.no_grad()
    def _bake(self, field: Callable[[Float[Tensor, "point 3"]], Deferred]) -> None:
        """Hold a field's values at the voxels that rays see, instead of the field (section 5.1)."""
        c, seen = self.config, self.sightings.seen
        low, edge, size = self._grid(seen)
        wide = 2.0 if self.voxels.space else 1.0  # what the grid is in coordinates of its space
        places, values = [], []
        for first, last in slabs(*size.tolist()):
            axes = torch.arange(first, last), torch.arange(int(size[1])), torch.arange(int(size[2]))
            x, y, z = (
                self.sightings.along((low[axis] + (places.to(low) + 0.5) * edge) / wide)
                for axis, places in enumerate(axes)
            )
            there = seen[x][:, y][:, :, z].nonzero()
            there[:, 0] += first
            for part in there.split(PART):
                points = self.baked_in.unwarp((low + (part + 0.5) * edge) / wide)
                density, diffuse, features = field(points)
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
        """Leave out voxels that no training ray met while they learnt, once more rays came by than there are others."""
        known = self._lazy.state.get(self.tuned.values) if self._lazy else None
        if not known:
            return
        met = (known["square"] > 0).any(1)
        if 0 < int(met.sum()) < int(known["step"]) * self.config.rays_per_step:
            voxels, (low, edge, size) = self.voxels, (self.voxels.low, float(self.voxels.edge), self.voxels.size)
            voxels.hold(voxels.places[met], low, edge, size)
            self._exchange(self.tuned, "values", self.tuned.values[met])

    def _grid(self, seen: Tensor) -> tuple[Float[Tensor, " 3"], float, Tensor]:
        """Corner, side of a voxel, and voxels along each axis, of the grid around all that rays see: within the box of
        interest, or all that there is, contracted."""
        cells = seen.nonzero()
        if not len(cells):
            raise LumigraphError("There is nothing to bake: no ray sees anything in the box of interest; train longer")
        if self.voxels.space:
            count = -(-self.config.resolution // self.voxels.block) * self.voxels.block
            return self.background.new_full((3,), -2.0), 4 / count, torch.full((3,), count, device=self.device)
        low, high = (x * (2 / len(seen)) - 1 for x in (cells.amin(0), cells.amax(0) + 1))
        if self.frame.reach > 1:
            bounds = torch.tensor(self.frame.bounds, device=low.device)
            low, high = torch.maximum(low, bounds[0]), torch.minimum(high, bounds[1])
        edge = float((high - low).max()) / self.config.resolution
        return low, edge, ((high - low) / edge - 1e-3).ceil().long()

    def _release(self) -> None:
        """Let go of what was for the field alone."""
        for module in self.network.modules():
            for name in getattr(module, "grows", ()):
                self._exchange(module, name, getattr(module, name)[:0])
        for name in OccupancyGrid.grows:
            setattr(self.occupancy, name, getattr(self.occupancy, name)[:, :1, :1, :1].clone())
        self.sightings.release()

    def _exchange(self, module: nn.Module, name: str, values: Tensor) -> None:
        """A parameter of another size."""
        old = getattr(module, name)
        mine = [x for x in (self._lazy, self._adam) if x and any(old is p for g in x.param_groups for p in g["params"])]
        exchange(module, name, values.detach().clone(), mine[0] if mine else None)

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Take over density where cameras see a teacher's surfaces, and as diffuse colour what is seen there along the
        mean of their directions. What depends on direction, features and network find out in what is learnt from then
        on.

        Raises LumigraphError where cameras see nothing solid.
        """
        known, n = taken_over(teacher, cameras), self.sightings.resolution
        points, origins = (x.to(self.device) for x in (known.surface.points, known.surface.origins))
        seen = self.baked_in.warp(points)
        self.sightings.note(seen, seen.new_ones(len(seen)))
        inside = self.sightings.inside(seen)
        ways = torch.zeros(n**3, 3, device=self.device)
        ways.index_add_(0, self.sightings.cells(seen[inside]), unit(points - origins)[inside])
        ways = smoothed(ways.view(n, n, n, 3)).reshape(-1, 3)

        def field(points: Float[Tensor, "point 3"]) -> Deferred:
            if can(teacher, HasField):
                density, rgb = teacher.field(points, unit(ways[self.sightings.cells(self.baked_in.warp(points))]))
            else:
                density = known.density(points.cpu()).to(self.device)
                rgb = K00 * known.harmonics(points.cpu(), 1, lambda rgb: rgb)[:, 0].to(self.device)
            return Deferred(density, rgb.clamp(0, 1), points.new_zeros(len(points), CHANNELS - 4))

        self._bake(field)
        self.of_another.fill_(True)


def slabs(x: int, y: int, z: int) -> Iterator[tuple[int, int]]:
    """From where to where along x parts of a grid go that can be looked at together."""
    thick = max(1, SLAB // (y * z))
    for first in range(0, x, thick):
        yield first, min(x, first + thick)


BOUNDED = (
    "SNeRG bakes what lies in the box of interest, as `lumigraph info` tells it; what lies beyond is learnt "
    "beside it until then, and afterwards shows as the plain background; --whole bakes all"
)
