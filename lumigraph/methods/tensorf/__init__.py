"""TensoRF: a scene as sums of products of planes and lines, or of lines alone (Chen et al. 2022, arXiv 2203.09517)."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...camera import Camera
from ...components.fields.layers import MLP
from ...components.fields.spaces import Space, space_of
from ...components.fields.teacher import distil, teacher_of
from ...components.sampling.importance import importance
from ...components.sampling.occupancy_sampler import GridSchedule, OccupancyNumbers, OccupancySampler, Stage
from ...components.sampling.samplers import ProposalNumbers, sampler_for
from ...components.training.photometric import backdrop, residuals
from ...components.training.row_optimizers import LazyAdam, exchange
from ...components.training.schedules import falling
from ...datasets.scene import Batch, Frame, Scene
from ...errors import LumigraphError
from ...exchange.packing import Stored, most_important
from ...files.ranges import BatchSize, LearningRate, NonNegative, Share, Steps, Width, between, changed
from ...kernels import factor_grid, spherical_harmonics
from ...kernels.factor_grid import Factors
from ...method import BaseConfig, Field, FieldMethod, seeded
from ...method.depth import DepthNumbers, depth_terms
from ...method.field import Colours, Densities, Directions, Points
from ...volume import composite
from .factorised import FactorGrid, nodes_in, truncate

Resolution = Annotated[int, between(4, 2048)]  # nodes per axis of a cube with as many nodes
Components = Annotated[int, between(1, 1024)]  # of each factor


TV_DENSITY_WEIGHT = 0.02  # weight of density's total variation, in the open
TV_APPEARANCE_WEIGHT = 0.02  # weight of appearance's total variation, in the open
DENSITY_SCALE = 25.0  # factor behind the softplus, the code's; higher learns density faster
APPEARANCE_FEATURES = 27  # P, outputs of the basis matrix B, section 5
DIRECTION_FREQUENCIES = 2  # octaves of the directions' encoding, the code's
SH_BANDS = 3  # spherical-harmonics bands, with --shading sh; more cost time

NETWORK_LEARNING_RATE = 1e-3  # rate of basis matrix and network at first, section 5
FINAL_LEARNING_RATE = 2e-3  # rate of planes and lines at the end of the budget; the others fall alike


@dataclass(frozen=True)
class Config(BaseConfig):
    """VM-192 as the paper and its code for Blender's scenes have it; `TensoRF.preset` says what a plain CPU does."""

    occupancy: OccupancyNumbers = OccupancyNumbers(samples_per_step=1 << 20, occupancy_threshold=0.005)
    proposals: ProposalNumbers = ProposalNumbers()
    measured: DepthNumbers = DepthNumbers()
    factors: Literal["vm", "cp"] = "vm"  # factorisation, section 3: vm, planes and lines, or cp, lines alone, smaller
    density_components: Components = 16  # components of each density factor, section 5: 3 x 16 of 192
    appearance_components: Components = 48  # components of each appearance factor, section 5: 3 x 48 of 192
    initial_resolution: Resolution = 128  # nodes per axis at first, section 5; more cost time early
    final_resolution: Resolution = 300  # nodes per axis in the end, section 5; more give detail, cost memory
    open_final_resolution: Resolution = 640  # the same where there is no bound, the code's for forward-facing
    shading: Literal["mlp", "sh"] = "mlp"  # colour from features: a network, or spherical harmonics, section 4.1
    hidden_width: Width = 128  # channels of the network's two hidden layers, section 5; wider costs time
    feature_frequencies: Annotated[int, between(0, 10)] = 2  # octaves of the features' encoding, the code's
    density_shift: Annotated[float, between(-30, 30)] = -7.0  # shift ahead of the softplus; higher begins denser
    step_ratio: Annotated[float, between(0.05, 8)] = 0.5  # sample distance over node distance; larger is faster
    rays_per_step: BatchSize = 4096  # rays in a step at most, section 5; more reduce noise, and cost time
    open_samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 17  # the same where there is no bound
    weight_threshold: Share = 1e-4  # weight of a sample below which it gets no colour, the code's; higher: faster
    l1_weight: NonNegative = 8e-5  # weight of the L1 norm of an object's density factors, the code's; higher: sparser
    final_l1_weight: NonNegative = 4e-5  # the same once the box has shrunk, the code's
    tv_interval: Steps = 1  # steps between these terms, whose weight is multiplied by it; more are faster
    learning_rate: LearningRate = 0.02  # rate of planes and lines until the last upsampling, section 5

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.initial_resolution > min(self.final_resolution, self.open_final_resolution):
            raise LumigraphError(
                f"A grid only becomes finer: --initial-resolution {self.initial_resolution:,} is above "
                f"--final-resolution {self.final_resolution:,} or "
                f"--open-final-resolution {self.open_final_resolution:,}"
            )

    def finest(self, unbounded: bool) -> int:
        """Final number of nodes per axis, as a cube's."""
        return self.open_final_resolution if unbounded else self.final_resolution


SOURCES = {  # of the numbers of `paper`; the others are ours
    "apchenstu/TensoRF, configs/lego.txt (6a1e23b)": (
        "factors density_components appearance_components initial_resolution final_resolution shading "
        "feature_frequencies direction_frequencies rays_per_step weight_threshold l1_weight final_l1_weight"
    ),
    "apchenstu/TensoRF, opt.py (6a1e23b)": (
        "appearance_features hidden_width density_scale step_ratio learning_rate final_learning_rate "
        "network_learning_rate"
    ),
}


# Shares of the budget at which the grid becomes finer: steps 2000, 3000, 4000, 5500 and 7000 of 30 000, section 5.
UPSAMPLINGS = (1 / 15, 1 / 10, 2 / 15, 11 / 60, 7 / 30)
SCHEDULE = GridSchedule((Stage(0.0, 1 / 4), Stage(0.03, 1 / 2), Stage(0.1, 1)), max_cells=1 << 18)
SAMPLES_PER_POINT = 4  # samples of a step for each point that a step of distillation learns from
SAMPLES_PER_RAY = 32  # of a typical ray, once empty space is known


class TensorField(Field):
    """Density and colour in the unit cube that spans a box of the space's coordinates (section 4.1).

    box:   in the space's coordinates: the grid's extent
    stage: number of times that the grid has become finer
    """

    box: Tensor
    stage: Tensor

    def __init__(self, config: Config, frame: Frame, space: Space):
        super().__init__()
        c = config
        self.config, self.space = c, space
        whole = ((-1.0,) * 3, (1.0,) * 3) if space.is_open else frame.bounds
        nodes = nodes_in(torch.tensor(whole, device="cpu"), c.initial_resolution)
        self.density_grid = FactorGrid(c.factors, nodes, c.density_components)
        self.appearance_grid = FactorGrid(c.factors, nodes, c.appearance_components)
        products = Factors(c.factors, nodes).products * c.appearance_components
        features = APPEARANCE_FEATURES if c.shading == "mlp" else 3 * SH_BANDS**2
        self.basis = nn.Linear(products, features, bias=False)  # B of eq. 6
        if c.shading == "mlp":
            inputs = features * (1 + 2 * c.feature_frequencies) + 3 * (1 + 2 * DIRECTION_FREQUENCIES)
            self.network = MLP(inputs + 1, c.hidden_width, c.hidden_width, 3)
        self.register_buffer("box", torch.tensor(whole))
        self.register_buffer("stage", torch.tensor(0))

    @property
    def grids(self) -> dict[str, FactorGrid]:
        return {"density_grid": self.density_grid, "appearance_grid": self.appearance_grid}

    @property
    def others(self) -> list[nn.Parameter]:
        """Parameters other than planes and lines: the basis matrix and the network."""
        return [x for module in (self.basis, getattr(self, "network", None)) if module for x in module.parameters()]

    def places(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Points in the grid's cube."""
        low, high = self.box
        return (self.space.warp(points) - low) / (high - low)

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Points]:
        """Density: softplus of the sum over all components (eq. 5); 0 outside the box. Features: places in the cube."""
        c, places = self.config, self.places(points)
        inside = ((places > 0) & (places < 1)).all(-1)  # points before the plane of a forward capture are on it
        total = self.density_grid(places, summed=True)[:, 0]
        density = DENSITY_SCALE * nn.functional.softplus(total + c.density_shift) * inside
        return density * self.space.stretch(points) if self.space.is_open else density, places

    def colour(self, features: Float[Tensor, "point 3"], directions: Directions, code: Tensor | None = None) -> Colours:
        """S(B [products], d) (eq. 6); in memory one feature of all samples after another, as networks read them."""
        return self.shade((self.basis.weight @ self.appearance_grid(features).t()).t(), directions)

    def shade(
        self, features: Float[Tensor, "sample feature"], directions: Float[Tensor, "sample 3"]
    ) -> Float[Tensor, "sample 3"]:
        """S: colour of features along directions."""
        c = self.config
        if c.shading == "sh":
            harmonics = spherical_harmonics(directions, SH_BANDS)
            return torch.sigmoid((features.view(len(features), 3, -1) * harmonics[:, None]).sum(-1))
        encoded = octaves(features.t(), c.feature_frequencies), octaves(directions.t(), DIRECTION_FREQUENCIES)
        constant = torch.ones_like(features.t()[:1])  # in place of biases
        return torch.sigmoid(self.network(torch.cat([*encoded, constant]).t()))

    @property
    def step_length(self) -> float:
        extent = (self.box[1] - self.box[0]).double().cpu()
        nodes = self.density_grid.nodes.double().cpu()
        return self.config.step_ratio * float((extent / (nodes - 1)).mean())

    @property
    def min_weight(self) -> float:
        return self.config.weight_threshold if self.stage else 0.0  # on the first grid nothing has much weight yet

    def storage(self) -> dict[str, Stored]:
        """Factors as whole numbers, basis and network as halves."""
        tables = {f"{name}.table" for name in self.grids}
        return {x: Stored("scaled" if x in tables else "half") for x, _ in self.named_parameters()}


def octaves(x: Float[Tensor, "input sample"], count: int) -> Float[Tensor, "feature sample"]:
    """x, and sines and cosines of 1, 2, 4 ... times x, as the paper's code encodes features and directions."""
    angles = [2.0**k * x for k in range(count)]
    return torch.cat([x, *(a.sin() for a in angles), *(a.cos() for a in angles)])


class TensoRF(FieldMethod):
    """Density at all samples in occupied cells; colours where a sample has weight."""

    Config = Config
    network: TensorField

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        with seeded(c.seed):
            self.network = TensorField(c, frame, space)
        numbers, rays = (frame, space, c.occupancy, c.proposals, SCHEDULE), c.rays_per_step
        open_samples = c.open_samples_per_step
        self.sampler = sampler_for(*numbers, open_samples=open_samples, max_rays=rays, samples_per_ray=SAMPLES_PER_RAY)
        self._optimizer: torch.optim.Optimizer | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        return changed(Config(), samples_per_step=1 << 17, transmittance_threshold=1e-3, occupancy_threshold=0.05,
            initial_resolution=96, final_resolution=200, open_final_resolution=320, appearance_components=16,
            hidden_width=64, feature_frequencies=0, density_shift=-8.0, open_samples_per_step=1 << 15, step_ratio=1.0,
            weight_threshold=1e-3, l1_weight=0.0, final_l1_weight=0.0, tv_interval=8)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Few components and nodes, all upsamplings, a grid of three sizes, within some twenty quick steps."""
        return changed(
            Config(), samples_per_step=4096, occupancy_resolution=16, initial_resolution=8, final_resolution=16,
            open_final_resolution=16, density_components=4, appearance_components=6,
            hidden_width=16, feature_frequencies=1, density_shift=-3.0, step_ratio=1.0,
            rays_per_step=256, learning_rate=0.05)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Growth of the factors, and the samples that a step keeps."""
        box = torch.tensor(((-1.0,) * 3, (1.0,) * 3) if frame.is_open else frame.bounds, device="cpu")
        resolutions = config.initial_resolution, config.finest(frame.is_open)
        first, last = (Factors(config.factors, nodes_in(box, n)).rows for n in resolutions)
        width = config.density_components + config.appearance_components
        grown = 4 * (last - first) * width * (4 if learning else 1)
        step = 4 * config.occupancy.samples_per_step * 32
        return super().further_bytes(frame, config, learning) + grown + step * learning

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        """Shrink the grid's box to the visual hull of photographs with alpha."""
        super().begin(data, seconds)
        if not self.sampler.is_open and data.images.has_alpha:
            self._shrink()
            self._resample(self.config.initial_resolution, self.network.box, fresh=self.random(0))

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator, c, network = self.random(step), self.config, self.network
        (samples,), terms = self.learn(batch.rays, generator)
        look = samples.look(network)
        background = backdrop(batch, self.background, generator, self.sampler.is_open)
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background)
        terms |= {"colour": residual.square().mean()}
        terms |= depth_terms(c, batch.extra, rendering.depth, rendering.opacity)
        if not self.sampler.is_open:
            if weight := c.final_l1_weight if network.stage else c.l1_weight:
                terms["l1"] = weight * network.density_grid.sparsity()
        elif step % c.tv_interval == 0:
            weights = {"tv_density": TV_DENSITY_WEIGHT, "tv_appearance": TV_APPEARANCE_WEIGHT}
            for grid, (name, weight) in zip(network.grids.values(), weights.items(), strict=True):
                if weight:
                    terms[name] = c.tv_interval * weight * grid.variation()
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, network = self.config, self.network
        group = {"params": network.others, "scale": NETWORK_LEARNING_RATE / max(c.learning_rate, 1e-12)}
        tables = [grid.table for grid in network.grids.values()]
        self._optimizer = LazyAdam(tables, c.learning_rate, betas=(0.9, 0.99))
        others = torch.optim.Adam([group], c.learning_rate, betas=(0.9, 0.99), foreach=True)
        return [self._optimizer, others, *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> float:
        """Constant until the final resolution, then exponential decay."""
        c, last = self.config, UPSAMPLINGS[-1]
        return falling(c.learning_rate, FINAL_LEARNING_RATE, max(0.0, progress - last) / (1 - last))

    def before_step(self, step: int, progress: float) -> None:
        stage, network = bisect_right(UPSAMPLINGS, progress), self.network
        if stage > int(network.stage):
            old = network.box.clone()
            if not int(network.stage):
                self._shrink()
            self._resample(self._resolution(stage), old)
            network.stage.fill_(stage)
        super().before_step(step, progress)

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """The finest grid, in a box around the teacher's occupied region, distilled from it at points."""
        known, c, chance, network = teacher_of(teacher, cameras), self.config, self.random(3), self.network
        self.sampler.begin_from(known, chance)
        self._shrink()
        self._resample(c.finest(self.sampler.is_open), network.box, fresh=self.random(0))
        network.stage.fill_(len(UPSAMPLINGS))
        grids = [grid.table for grid in network.grids.values()]
        optimizers = [
            LazyAdam(grids, c.learning_rate, betas=(0.9, 0.99)),
            torch.optim.Adam(network.others, NETWORK_LEARNING_RATE, betas=(0.9, 0.99)),
        ]
        points = c.occupancy.samples_per_step // SAMPLES_PER_POINT
        distil(self.field, known, network.space, optimizers, points, chance, self.device)
        self.sampler.settle(self.density, chance)

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """Share of each node of planes and lines in one picture, by its interpolation weights."""
        network, factors = self.network, self.network.density_grid.factors
        ones = torch.ones(factors.rows, 1, device=self.device, requires_grad=True)

        def lookup(points: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 1"]:
            return factor_grid(network.places(points), ones, factors, True)

        (shares,) = importance(self, camera, lookup, [ones])
        return {f"network.{name}.table": shares[:, 0] for name in network.grids}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Set the least important nodes to zero, and the least important components; see `truncate`."""
        network = self.network
        for name, grid in network.grids.items():
            grid.table[~most_important(importance[f"network.{name}.table"], 1 - share)] = 0.0
        truncate(network.density_grid, share)
        products = network.appearance_grid.factors.products
        truncate(network.appearance_grid, share, network.basis.weight.norm(dim=0).view(products, -1))
        return importance

    def _resolution(self, stage: int) -> int:
        """Resolution of a stage, linear in its logarithm from the first to the last (section 5)."""
        first, last = self.config.initial_resolution, self.config.finest(self.sampler.is_open)
        return round(first * (last / first) ** (stage / len(UPSAMPLINGS)))

    def _shrink(self) -> None:
        """Shrink an object's box to the occupied cells, if there are any."""
        if isinstance(self.sampler, OccupancySampler):
            box = self.network.box
            found = self.sampler.grid.box.to(box)
            low, high = torch.maximum(found[0], box[0]), torch.minimum(found[1], box[1])
            if bool((high > low).all()):
                self.network.box = torch.stack([low, high])

    def _resample(self, resolution: int, old: Float[Tensor, "2 3"], fresh: torch.Generator | None = None) -> None:
        """Resample the grids to a resolution in the present box, by interpolation from the old box, or at random. The
        optimizer restarts, as in the code."""
        box = self.network.box
        nodes = nodes_in(box, resolution)
        low, high = (box - old[0]) / (old[1] - old[0])
        for grid in self.network.grids.values():
            if fresh is None:
                table = grid.resampled(nodes, (low, high))
            else:
                shape = Factors(grid.kind, nodes).rows, grid.table.shape[1]
                table = 0.1 * torch.randn(shape, generator=fresh)
            exchange(grid, "table", table, self._optimizer)
            grid.nodes = torch.tensor(nodes, device=grid.nodes.device)
