"""TensoRF: a scene as sums of products of planes and lines, or of lines alone (Chen et al. 2022, arXiv 2203.09517)."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ..camera import Camera
from ..components.clouds.dense_points import compile_sweep
from ..components.fields.factorised import FactorGrid, nodes_in
from ..components.fields.mlp import MLP
from ..components.fields.taken_over import taken_over
from ..components.fields.truncation import truncate
from ..components.sampling.carving import visual_hull
from ..components.sampling.importance import importance
from ..components.sampling.marching import FIRST_RAYS, rays_for, reached
from ..components.sampling.occupancy import OccupancyGrid
from ..components.sampling.spaces import Box, space_of
from ..components.sampling.unbounded import OpenNumbers, Unbounded, unbounded
from ..components.training.distillation import distil
from ..components.training.exchange import exchange
from ..components.training.lazy_adam import LazyAdam
from ..components.training.photometric import backdrop, residuals
from ..components.training.schedules import falling
from ..errors import LumigraphError
from ..kernels import factor_grid, spherical_harmonics
from ..kernels.factor_grid import Factors
from ..method import RayMethod
from ..packing import Stored, most_important
from ..ranges import BatchSize, LearningRate, NonNegative, Positive, Seed, Share, Steps, Width, between
from ..rays import Look, Rays, Rendering
from ..scene import Batch, Frame, Scene
from ..volume import composite, weights_of

Resolution = Annotated[int, between(4, 2048)]  # nodes per axis of a cube with as many nodes
Components = Annotated[int, between(1, 1024)]  # of each factor


@dataclass(frozen=True)
class Config(OpenNumbers):
    """VM-192 as the paper and its code for Blender's scenes have it; `TensoRF.preset` says what a plain CPU does."""

    factors: Literal["vm", "cp"] = "vm"  # planes and lines, or lines alone, section 3
    density_components: Components = 16  # of each factor: 3 x 16 of 192, section 5
    appearance_components: Components = 48  # of each factor: 3 x 48 of 192, section 5
    initial_resolution: Resolution = 128  # section 5
    final_resolution: Resolution = 300  # section 5
    open_final_resolution: Resolution = 640  # where there is no bound, the code's for forward-facing captures
    appearance_features: Annotated[int, between(1, 256)] = 27  # P, that the basis matrix B gives, section 5
    shading: Literal["mlp", "sh"] = "mlp"  # features become colours by a network, or are harmonics, section 4.1
    sh_bands: Annotated[int, between(1, 4)] = 3  # of harmonics, where they are colours
    hidden_width: Width = 128  # of the network's two hidden layers, section 5
    feature_frequencies: Annotated[int, between(0, 10)] = 2  # octaves of the features' encoding, the code's
    direction_frequencies: Annotated[int, between(0, 10)] = 2  # octaves of the directions' encoding, the code's
    density_shift: Annotated[float, between(-30, 30)] = -7.0  # before the softplus; under the code's -10 L1 wins here
    density_scale: Positive = 25.0  # after it, the code's
    step_ratio: Annotated[float, between(0.05, 8)] = 0.5  # of a sample to the distance of nodes, the code's
    rays_per_step: BatchSize = 4096  # section 5; at most
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 20  # that these rays may meet in occupied cells
    open_samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 17  # the same where there is no bound
    transmittance_threshold: Share = 1e-4  # at which a ray is spent
    weight_threshold: Share = 1e-4  # weight of a sample below which it gets no colour, the code's
    l1_weight: NonNegative = 8e-5  # of objects, of density's factors, the code's
    final_l1_weight: NonNegative = 4e-5  # once the box has shrunk, the code's
    tv_density_weight: NonNegative = 0.02  # of captures without bounds, the code's 1.0 for forward-facing ones
    tv_appearance_weight: NonNegative = 0.02  # the same, of appearance
    tv_interval: Steps = 1  # steps between looks at the total variation, each as much stronger
    occupancy_resolution: Annotated[int, between(4, 512)] = 128  # cells per axis and cascade
    occupancy_threshold: NonNegative = 0.005  # optical thickness across a cell below which it is empty
    occupancy_interval: Steps = 16  # steps between updates of the occupancy grid
    occupancy_decay: Share = 0.95  # of the densities it remembers
    learning_rate: LearningRate = 0.02  # of planes and lines, section 5
    network_learning_rate: LearningRate = 1e-3  # of basis matrix and network, section 5
    final_learning_rate: LearningRate = 2e-3  # of planes and lines at the end of the budget; the others fall alike
    seed: Seed = 0

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.initial_resolution > min(self.final_resolution, self.open_final_resolution):
            raise LumigraphError(
                f"A grid only becomes finer: --initial-resolution {self.initial_resolution:,} is above "
                f"--final-resolution {self.final_resolution:,} or "
                f"--open-final-resolution {self.open_final_resolution:,}"
            )

    def finest(self, unbounded: bool) -> int:
        """Nodes per axis in the end, as a cube's."""
        return self.open_final_resolution if unbounded else self.final_resolution


# Shares of the budget at which the grid becomes finer: steps 2000, 3000, 4000, 5500 and 7000 of 30 000, section 5.
UPSAMPLINGS = (1 / 15, 1 / 10, 2 / 15, 11 / 60, 7 / 30)
# The occupancy grid's, and which part of its resolution it has from there on.
MASKS = ((0.0, 1 / 4), (0.03, 1 / 2), (0.1, 1))
LOOKS = 1 << 18  # cells updated at most
PROBES = 0.02  # share of all cells updated at random, in case something has grown there
TAUGHT = 4  # samples of a step for each point that a step of distillation learns from
SAMPLES_OF_A_RAY = 32  # that a ray meets, about, once empty space is known


GRIDS = ("density_grid", "appearance_grid")


class Field(nn.Module):
    """Density and colour at places of the unit cube (section 4.1)."""

    def __init__(self, config: Config, nodes: tuple[int, int, int]):
        super().__init__()
        c = config
        self.config = c
        self.density_grid = FactorGrid(c.factors, nodes, c.density_components)
        self.appearance_grid = FactorGrid(c.factors, nodes, c.appearance_components)
        products = Factors(c.factors, nodes).products * c.appearance_components
        features = c.appearance_features if c.shading == "mlp" else 3 * c.sh_bands**2
        self.basis = nn.Linear(products, features, bias=False)  # B of eq. 6
        if c.shading == "mlp":
            inputs = features * (1 + 2 * c.feature_frequencies) + 3 * (1 + 2 * c.direction_frequencies)
            self.network = MLP(inputs + 1, c.hidden_width, c.hidden_width, 3)

    def density(self, places: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """Density per unit of the coordinates: softplus of the sum over all components (eq. 5)."""
        c = self.config
        return c.density_scale * nn.functional.softplus(self.density_grid(places, summed=True)[:, 0] + c.density_shift)

    def colour(
        self, places: Float[Tensor, "sample 3"], directions: Float[Tensor, "sample 3"]
    ) -> Float[Tensor, "sample 3"]:
        """sRGB-encoded colour S(B [products], d) (eq. 6)."""
        return self.shade(self.features(places), directions)

    def features(self, places: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample feature"]:
        """B [products]; in memory one feature of all samples after another, as the network likes them."""
        return (self.basis.weight @ self.appearance_grid(places).t()).t()

    def shade(
        self, features: Float[Tensor, "sample feature"], directions: Float[Tensor, "sample 3"]
    ) -> Float[Tensor, "sample 3"]:
        """S: features become a colour seen along directions."""
        c = self.config
        if c.shading == "sh":
            harmonics = spherical_harmonics(directions, c.sh_bands)
            return torch.sigmoid((features.view(len(features), 3, -1) * harmonics[:, None]).sum(-1))
        encoded = octaves(features.t(), c.feature_frequencies), octaves(directions.t(), c.direction_frequencies)
        constant = torch.ones_like(features.t()[:1])  # in place of biases
        return torch.sigmoid(self.network(torch.cat([*encoded, constant]).t()))


def octaves(x: Float[Tensor, "input sample"], count: int) -> Float[Tensor, "feature sample"]:
    """x, and sines and cosines of 1, 2, 4 ... times x, as the paper's code encodes features and directions."""
    angles = [2.0**k * x for k in range(count)]
    return torch.cat([x, *(a.sin() for a in angles), *(a.cos() for a in angles)])


class TensoRF(RayMethod):
    """Density at all samples in occupied cells; colours where a sample has weight."""

    Config = Config
    rays_per_chunk = 4096
    box: Tensor
    stage: Tensor
    rays_per_step: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame)
        whole = frame.bounds if isinstance(self.space, Box) else ((-1.0,) * 3, (1.0,) * 3)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = Field(config, nodes_in(torch.tensor(whole, device="cpu"), config.initial_resolution))
        self.register_buffer("box", torch.tensor(whole))  # in the space's coordinates: where the grid is
        self.register_buffer("stage", torch.tensor(0))  # how often the grid has become finer
        self.register_buffer("rays_per_step", torch.tensor(min(FIRST_RAYS, config.rays_per_step)))
        self.unbounded = unbounded(frame, self.space, config)
        self.occupancy = OccupancyGrid(1.0, max(4, int(config.occupancy_resolution * MASKS[0][1])))
        self._optimizer: torch.optim.Optimizer | None = None

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU, what learns most in a minute."""
        if device.type == "cuda":
            return Config()
        return Config(
            density_components=16,
            appearance_components=16,
            initial_resolution=96,
            final_resolution=200,
            open_final_resolution=320,
            hidden_width=64,
            feature_frequencies=0,
            rays_per_step=4096,
            samples_per_step=1 << 17,
            open_samples_per_step=1 << 15,
            step_ratio=1.0,
            density_shift=-8.0,
            l1_weight=0.0,
            final_l1_weight=0.0,
            tv_interval=8,
            occupancy_threshold=0.05,
            transmittance_threshold=1e-3,
            weight_threshold=1e-3,
        )

    @classmethod
    def smallest(cls) -> Any:
        """Few components and nodes, all upsamplings, a grid of three sizes, within some twenty quick steps."""
        return Config(
            density_components=4,
            appearance_components=6,
            initial_resolution=8,
            final_resolution=16,
            open_final_resolution=16,
            appearance_features=8,
            hidden_width=16,
            feature_frequencies=1,
            direction_frequencies=1,
            density_shift=-3.0,
            step_ratio=1.0,
            rays_per_step=256,
            samples_per_step=4096,
            occupancy_resolution=16,
            learning_rate=0.05,
            network_learning_rate=1e-2,
            final_learning_rate=5e-3,
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """What the factors grow by, the occupancy grid, and what a step keeps of its samples."""
        box = torch.tensor(frame.bounds if frame.reach <= 1 else ((-1.0,) * 3, (1.0,) * 3), device="cpu")
        resolutions = config.initial_resolution, config.finest(frame.reach > 1)
        first, last = (Factors(config.factors, nodes_in(box, n)).rows for n in resolutions)
        width = config.density_components + config.appearance_components
        step = 4 * config.samples_per_step * 32
        grown = 4 * (last - first) * width * (4 if learning else 1)
        grids = OccupancyGrid.bytes_of(1.0, config.occupancy_resolution) + Unbounded.bytes_of(frame, learning)
        return grids + grown + step * learning

    def rays_in_a_step(self, data: Scene) -> float:
        c = self.config
        samples = c.samples_per_ray if self.unbounded else SAMPLES_OF_A_RAY
        return min(c.rays_per_step, self._samples / samples)

    @property
    def _samples(self) -> int:
        """That a step asks about, at most."""
        return self.config.open_samples_per_step if self.unbounded else self.config.samples_per_step

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        """Where photographs say what is transparent, the grid's box is that of the visual hull from the beginning."""
        if scene.images.has_alpha and self.frame.reach == 1:
            self.occupancy.rule_out(visual_hull(scene, self.config.occupancy_resolution)[None])
            self._shrink()
            self._resample(self.config.initial_resolution, self.box, fresh=self.random(0))
        if self.unbounded:
            self.unbounded.begin(scene, seconds, self.random(1))

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """The finest grid, in a box around what the teacher holds, taught by it at points."""
        known, c, chance = taken_over(teacher, cameras), self.config, self.random(3)
        if self.frame.reach == 1:
            occupied = known.occupied(self.space, c.occupancy_resolution, c.occupancy_threshold, chance)
            self.occupancy.rule_out(occupied[None])
            self._shrink()
        self._resample(c.finest(self.unbounded is not None), self.box, fresh=self.random(0))
        self.stage.fill_(len(UPSAMPLINGS))
        grids = [grid.table for grid in (self.network.density_grid, self.network.appearance_grid)]
        tables = {id(x) for x in grids}
        networks = [x for x in self.network.parameters() if id(x) not in tables]
        optimizers = [
            LazyAdam(grids, c.learning_rate, betas=(0.9, 0.99)),
            torch.optim.Adam(networks, c.network_learning_rate, betas=(0.9, 0.99)),
        ]
        distil(self.field, known, self.space, optimizers, c.samples_per_step // TAUGHT, chance, self.device)
        if self.unbounded:
            self.unbounded.begin_at(known.surface.points, known.surface.origins)
        else:
            self.occupancy.update(self.density, c.occupancy_threshold, chance)

    def rehearse_begin(self) -> None:
        if self.unbounded:
            compile_sweep()

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        return data.sample_rays(int(self.rays_per_step), generator).to(self.device)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        (look,) = self.looks(rays)
        return composite(look.samples, look.density, look.rgb, background)

    def looks(self, rays: Rays) -> list[Look]:
        return [self.unbounded.look(self.field, rays) if self.unbounded else self._march(rays)]

    def _march(self, rays: Rays, jitter: Float[Tensor, " ray"] | None = None) -> Look:
        c = self.config
        found = self.occupancy.sample(rays, self.frame.near, self._step(), jitter=jitter)
        samples, asked = reached(rays, found, self.density, c.transmittance_threshold)
        ray = samples.ray_index
        towards = rays.directions.index_select(0, ray)
        points = rays.origins.index_select(0, ray) + samples.t[:, None] * towards
        places, inside = self._places(points)
        density = self._density(points, places, inside)
        least = c.weight_threshold if self.stage else 0.0  # on the first grid nothing has much weight yet
        heavy = weights_of(samples, density.detach()) > least
        coloured = heavy.nonzero()[:, 0]
        rgb = self.network.colour(places.index_select(0, coloured), towards.index_select(0, coloured))
        rgb = rgb.new_zeros(len(samples), 3).index_copy(0, coloured, rgb)
        self.figures |= {"rays": len(rays), "samples": asked, "visible_samples": len(samples)}
        self.figures["coloured_samples"] = len(coloured)
        return Look("samples", samples, density, rgb)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator, c = self.random(step), self.config
        jitter = torch.rand(len(batch), 2 if self.unbounded else 1, generator=generator).to(self.device)
        background = backdrop(batch, self.background, generator, self.frame.reach > 1)
        further = dict[str, Tensor]()
        if self.unbounded:
            look, proposed = self.unbounded.learn(self.field, batch.rays, jitter)
            further = self.unbounded.terms(self.density, proposed, look.density, generator)
            self.figures |= {"rays": len(batch), "samples": len(look.samples)}
        else:
            look = self._march(batch.rays, jitter[:, 0])
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background)
        terms = {"colour": residual.square().mean(), **further}
        if self.frame.reach <= 1:
            if weight := c.final_l1_weight if self.stage else c.l1_weight:
                terms["l1"] = weight * self.network.density_grid.sparsity()
        elif step % c.tv_interval == 0:
            grids = self.network.density_grid, self.network.appearance_grid
            weights = c.tv_density_weight, c.tv_appearance_weight
            for name, grid, weight in zip(("tv_density", "tv_appearance"), grids, weights, strict=True):
                if weight:
                    terms[name] = c.tv_interval * weight * grid.variation()
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, grids = self.config, (self.network.density_grid, self.network.appearance_grid)
        tables = [grid.table for grid in grids]
        known = {id(x) for x in tables}
        networks = [x for x in self.network.parameters() if id(x) not in known]
        group = {"params": networks, "scale": c.network_learning_rate / max(c.learning_rate, 1e-12)}
        self._optimizer = LazyAdam(tables, c.learning_rate, betas=(0.9, 0.99))
        optimizers = [self._optimizer, torch.optim.Adam([group], c.learning_rate, betas=(0.9, 0.99), foreach=True)]
        return [*optimizers, self.unbounded.optimizer()] if self.unbounded else optimizers

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        """Constant until the grid is as fine as it gets, then exponential decay."""
        c, last = self.config, UPSAMPLINGS[-1]
        rate = falling(c.learning_rate, c.final_learning_rate, max(0.0, progress - last) / (1 - last))
        return {"": rate, "proposal": Unbounded.rate(progress)}

    def before_step(self, step: int, progress: float) -> None:
        stage = bisect_right(UPSAMPLINGS, progress)
        if stage > int(self.stage):
            old = self.box.clone()
            if not int(self.stage):
                self._shrink()
            self._resample(self._resolution(stage), old)
            self.stage.fill_(stage)
        if self.unbounded:
            self.unbounded.before_step(progress)
        else:
            self._look_around(step, progress)

    def after_step(self, step: int) -> None:
        """Set the next step's number of rays so that they meet at most about `samples_per_step` samples."""
        rays = rays_for(self._samples, int(self.rays_per_step), self.figures["samples"])
        self.rays_per_step.fill_(min(rays, self.config.rays_per_step))

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        places, inside = self._places(points)
        return self._density(points, places, inside), self.network.colour(places, directions)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self._density(points, *self._places(points))

    def storage(self) -> dict[str, Stored]:
        """Factors as whole numbers, basis and network as halves; of the grid, marks alone are needed for pictures."""
        grids = {f"network.{name}.table": Stored("scaled") for name in GRIDS}
        others = [name for name, _ in self.named_parameters() if name not in grids]
        nothing = {"occupancy.density": Stored("nothing"), "occupancy.possible": Stored("nothing", fill=1.0)}
        if self.unbounded:
            nothing |= self.unbounded.storage()
        return grids | dict.fromkeys(others, Stored("half")) | nothing

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """How much each node of planes and lines adds to one picture, by its share in interpolating there."""
        factors = self.network.density_grid.factors
        ones = torch.ones(factors.rows, 1, device=self.device, requires_grad=True)

        def lookup(points: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 1"]:
            return factor_grid(self._places(points)[0], ones, factors, True)

        (shares,) = importance(self, camera, lookup, [ones])
        return {f"network.{name}.table": shares[:, 0] for name in GRIDS}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Set the least important nodes to zero, and the least important components; see `truncate`."""
        network = self.network
        for name, grid in zip(GRIDS, (network.density_grid, network.appearance_grid), strict=True):
            grid.table[~most_important(importance[f"network.{name}.table"], 1 - share)] = 0.0
        truncate(network.density_grid, share)
        products = network.appearance_grid.factors.products
        truncate(network.appearance_grid, share, network.basis.weight.norm(dim=0).view(products, -1))
        return importance

    def _places(self, points: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, "point 3"], Bool[Tensor, " point"]]:
        """Where in the grid's cube points are, and which are in it."""
        coordinates = self.space.warp(points)
        low, high = self.box
        places = (coordinates - low) / (high - low)
        return places, ((places > 0) & (places < 1)).all(-1)  # what lies before the plane of a forward capture is on it

    def _density(
        self, points: Float[Tensor, "point 3"], places: Float[Tensor, "point 3"], inside: Bool[Tensor, " point"]
    ) -> Float[Tensor, " point"]:
        density = self.network.density(places) * inside
        return density if isinstance(self.space, Box) else density * self.space.stretch(points)

    def _step(self) -> float:
        """Length of a sample in the coordinates."""
        extent = (self.box[1] - self.box[0]).double().cpu()
        nodes = self.network.density_grid.nodes.double().cpu()
        return self.config.step_ratio * float((extent / (nodes - 1)).mean())

    def _resolution(self, stage: int) -> int:
        """Evenly in the logarithm from the first resolution to the last (section 5)."""
        first, last = self.config.initial_resolution, self.config.finest(self.unbounded is not None)
        return round(first * (last / first) ** (stage / len(UPSAMPLINGS)))

    def _shrink(self) -> None:
        """Make an object's box as small as the cells that hold something; if none does, leave it."""
        if isinstance(self.space, Box):
            found = self.occupancy.box.to(self.box)
            low, high = torch.maximum(found[0], self.box[0]), torch.minimum(found[1], self.box[1])
            if bool((high > low).all()):
                self.box = torch.stack([low, high])

    def _resample(self, resolution: int, old: Float[Tensor, "2 3"], fresh: torch.Generator | None = None) -> None:
        """Give the grids a resolution in the present box; its nodes are between those that they have in the old box, or
        random ones. The optimizer begins anew with them, as the code does."""
        nodes = nodes_in(self.box, resolution)
        low, high = (self.box - old[0]) / (old[1] - old[0])
        for grid in (self.network.density_grid, self.network.appearance_grid):
            if fresh is None:
                table = grid.resampled(nodes, (low, high))
            else:
                shape = Factors(grid.kind, nodes).rows, grid.table.shape[1]
                table = 0.1 * torch.randn(shape, generator=fresh)
            exchange(grid, "table", table, self._optimizer)
            grid.nodes = torch.tensor(nodes, device=grid.nodes.device)

    def _look_around(self, step: int, progress: float) -> None:
        """Update the occupancy grid, which becomes finer in the beginning."""
        c = self.config
        wanted, finer = c.occupancy_resolution * max(x for x in MASKS if x[0] <= progress)[1], False
        while self.occupancy.resolution < wanted:
            self.occupancy.refine()
            finer = True
        if finer or step % (4 if step < 32 else c.occupancy_interval) == 0:
            share, budget = (1.0, None) if finer or step < 32 else (PROBES, LOOKS)
            generator = self.random(~step)
            self.occupancy.update(self.density, c.occupancy_threshold, generator, c.occupancy_decay, share, budget)
