"""Instant-NGP: a scene in a multiresolution hash table and two tiny networks (Müller et al. 2022, arXiv 2201.05989)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from .. import kernels
from ..components.activations import truncated_exp
from ..components.carving import visual_hull
from ..components.corrections import Exposure, PoseRefinement
from ..components.lazy_adam import LazyAdam
from ..components.occupancy import OccupancyGrid
from ..components.perceptron import Perceptron
from ..components.schedules import set_learning_rate
from ..method import RayMethod
from ..rays import Look, Rays, Rendering, Samples
from ..scene import Batch, Frame, Scene
from ..volume import composite, visible


@dataclass(frozen=True)
class Config:
    """The paper's numbers, with where it gives them; `InstantNGP.preset` says what a plain CPU does otherwise."""

    levels: int = 16  # L, table 1
    features: int = 2  # F, table 1
    log2_entries: int = 19  # log2 T, table 1: 14 to 24
    coarsest: int = 16  # N_min, table 1
    finest: int = 2048  # N_max for a scene of reach 1; grows with the reach (section 5.4)
    width: int = 64  # neurons per hidden layer, section 5.4
    density_layers: int = 1  # hidden layers, section 5.4
    colour_layers: int = 2  # hidden layers, section 5.4
    geometry_features: int = 16  # from the density network to the colour network, section 5.4
    direction_bands: int = 4  # of spherical harmonics, section 5.4
    samples_per_step: int = 1 << 18  # section 5.4: batches are sized by samples, not by rays
    lattice: int = 1024  # steps across the diagonal of the unit cascade, appendix E.1
    growth: float = 1 / 256  # of a step with distance in unbounded scenes, appendix E.1
    stop: float = 1e-4  # transmittance at which a ray is spent, appendix E.1
    occupancy: int = 128  # cells per axis and cascade, appendix E.2
    cell_thickness: float = 0.05  # optical thickness across a cell below which it is empty; E.2's threshold at n = 128
    grid_every: int = 16  # steps between looks at the occupancy grid, appendix E.2
    grid_decay: float = 0.95  # of what it remembers, appendix E.2
    learning_rate: float = 1e-2  # section 4
    last_learning_rate: float = 1e-3  # at the end of the budget
    hold: float = 0.3  # share of the budget before the learning rate begins to fall
    table_decay: float = 0.0  # decoupled weight decay of the table; of objects only, for it pulls density towards 1
    huber: float = 0.1  # residual at which the loss turns from square to linear
    exposure: bool = False  # learn a gain per photograph
    refine_cameras: bool = False  # learn a correction of each photograph's pose
    seed: int = 0


# Coarse to fine: share of the budget from which on, and which part of the Config's occupancy and lattice.
STAGES = ((0.0, 1 / 4, 1 / 4), (0.04, 1 / 2, 1 / 2), (0.12, 1, 2 / 3), (0.75, 1, 1))
LOOKS = 4  # at the grid at most, for each sample of a step
PROBES = 0.02  # share of all cells looked at again at random, in case something has grown there
BATCH_GROWTH = 1.5  # rays per step at most, from one step to the next


class Field(nn.Module):
    """Density from position, colour from position and direction (figure 3 and section 5.4)."""

    def __init__(self, config: Config, reach: float):
        super().__init__()
        self.reach, self.bands = reach, config.direction_bands
        finest = int(config.finest * reach)
        self.levels = kernels.HashLevels(config.levels, config.features, config.log2_entries, config.coarsest, finest)
        self.table = nn.Parameter(torch.empty(self.levels.offsets[-1], config.features).uniform_(-1e-4, 1e-4))
        hidden = [config.width] * config.density_layers
        self.density_network = Perceptron(config.levels * config.features, *hidden, config.geometry_features)
        hidden = [config.width] * config.colour_layers
        self.colour_network = Perceptron(config.geometry_features + self.bands**2, *hidden, 3)

    def encode(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample width"]:
        return kernels.hash_encode(points * (0.5 / self.reach) + 0.5, self.table, self.levels)

    def density(
        self, encoded: Float[Tensor, "sample width"]
    ) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample geometry"]]:
        """Density per scene unit, and what the colour network wants to know of each place."""
        geometry = self.density_network(encoded)
        return truncated_exp(geometry[:, 0]), geometry

    def colour(
        self, geometry: Float[Tensor, "sample geometry"], directions: Float[Tensor, "sample 3"]
    ) -> Float[Tensor, "sample 3"]:
        """sRGB-encoded colour."""
        harmonics = kernels.spherical_harmonics(directions, self.bands)
        return torch.sigmoid(self.colour_network(torch.cat([geometry.t(), harmonics.t()]).t()))


class InstantNGP(RayMethod):
    """The occupancy grid says where to look, a first look says what is hidden, the second learns from the rest."""

    Config = Config
    rays_per_step: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.field = Field(config, frame.reach)
        self.exposure = Exposure(frame.image_count) if config.exposure else None
        self.poses = PoseRefinement(frame.image_count) if config.refine_cameras else None
        self.occupancy = OccupancyGrid(frame.reach, max(4, int(config.occupancy * STAGES[0][1])))
        self._set_lattice(1.0)
        self.register_buffer("rays_per_step", torch.tensor(256))
        self._optimizers: list[torch.optim.Optimizer] = []
        self._figures: dict[str, float] = {}

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU, what learns most in a minute: half as many levels with twice the
        features, smaller tables and networks, a wider step and a smaller batch."""
        if device.type == "cuda":
            return Config()
        return Config(
            levels=8,
            features=4,
            log2_entries=17,
            finest=512,
            width=32,
            samples_per_step=1 << 15,
            lattice=384,
            stop=1e-3,
            growth=1 / 96,
            cell_thickness=0.15,
            learning_rate=2e-2,
            table_decay=0.3,
            huber=0.3,
        )

    def begin(self, scene: Scene) -> None:
        if scene.images.has_alpha and self.frame.reach == 1:
            self.occupancy.rule_out(visual_hull(scene, self.config.occupancy)[None])

    def batch(self, scene: Scene, generator: torch.Generator) -> Batch:
        return scene.sample_rays(int(self.rays_per_step), generator).to(self.device)

    def render_rays(
        self, rays: Rays, background: Float[Tensor, "#ray 3"], jitter: Float[Tensor, " ray"] | None = None
    ) -> Rendering:
        (look,) = self.looks(rays, jitter)
        return composite(look.samples, look.density, look.rgb, background)

    def looks(self, rays: Rays, jitter: Float[Tensor, " ray"] | None = None) -> list[Look]:
        step = 2 * math.sqrt(3) / self.lattice
        found = self.occupancy.sample(rays, self.frame.near, step, self.growth, jitter=jitter)
        samples = found.keep(self._visible(rays, found))
        points, directions = samples.along(rays)
        density, geometry = self.field.density(self.field.encode(points))
        rgb = self.field.colour(geometry, directions)
        self._figures |= {"rays": len(rays), "visible_samples": len(samples)}
        return [Look("samples", samples, density, rgb)]

    @torch.no_grad()
    def _visible(self, rays: Rays, found: Samples) -> Bool[Tensor, " sample"]:
        """A first look, for most samples lie behind what their ray sees."""
        ray, t, length = found.ray_index, found.t, found.length
        asked_in_all = 0

        def thickness_of(asked: Tensor) -> Tensor:
            nonlocal asked_in_all
            asked_in_all += len(asked)
            on = ray[asked]
            return self.density(rays.origins[on] + t[asked][:, None] * rays.directions[on]) * length[asked]

        seen = visible(found, thickness_of, self.config.stop)
        self._figures["samples"] = asked_in_all
        return seen

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator = self.random(step)
        jitter = torch.rand(len(batch), generator=generator).to(self.device)
        rays = batch.rays
        background = self.background
        if batch.alpha is not None:  # a random colour behind each ray, so that only opacity can imitate opacity
            background = torch.rand(len(batch), 3, generator=generator).to(self.device)
        if self.poses:
            rays = self.poses(rays)
        rendering = self.render_rays(rays, background, jitter)
        rgb = rendering.rgb
        if self.exposure and rays.image_index is not None:  # the gain is the scene's, not the background's
            behind = (1 - rendering.opacity)[:, None] * background
            rgb = self.exposure(rgb - behind, rays.image_index) + behind
        residual = rgb - batch.before(background)
        self._figures["mse"] = float(residual.detach().square().mean())
        if batch.alpha is not None:  # and before the opposite colour, where only what opacity lacks looks different
            lacking = (batch.alpha - rendering.opacity)[:, None]
            residual = torch.cat([residual, residual + lacking * (1 - 2 * background)])
        # Divided by delta, so that the linear part has slope 1.
        delta = self.config.huber
        return {"huber": nn.functional.huber_loss(residual, torch.zeros_like(residual), delta=delta) / delta}

    def optimizers(self) -> list[torch.optim.Optimizer]:
        networks = [*self.field.density_network.parameters(), *self.field.colour_network.parameters()]
        groups: list[dict[str, Any]] = [{"params": networks, "scale": 1.0}]
        groups += [{"params": [*x.parameters()], "scale": 0.05} for x in (self.exposure, self.poses) if x]
        common = {"lr": self.config.learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        decay = self.config.table_decay if self.frame.reach == 1 else 0.0
        table = LazyAdam([self.field.table], weight_decay=decay, **common)
        self._optimizers = [table, torch.optim.Adam(groups, foreach=True, **common)]
        return self._optimizers

    def before_step(self, step: int, progress: float) -> None:
        self._set_learning_rate(step, progress)
        _, cells, lattice = max(stage for stage in STAGES if stage[0] <= progress)
        self._set_lattice(lattice)
        finer = False
        while self.occupancy.resolution < self.config.occupancy * cells:
            self.occupancy.refine()
            finer = True
        if finer or step % (4 if step < 32 else self.config.grid_every) == 0:
            share, budget = (1.0, None) if finer or step < 32 else (PROBES, self.config.samples_per_step * LOOKS)
            thickness, decay = self.config.cell_thickness, self.config.grid_decay
            self.occupancy.update(self.density, thickness, self.random(~step), decay, share, budget)

    def after_step(self, step: int) -> None:
        """So many rays next time as should give the wanted number of samples."""
        rays = int(self.rays_per_step)
        wanted = rays * self.config.samples_per_step / max(self._figures["samples"], 1)
        self.rays_per_step.fill_(int(min(max(wanted, 64), BATCH_GROWTH * rays, self.config.samples_per_step)))

    def density(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """Density per scene unit."""
        return self.field.density(self.field.encode(points))[0]

    def statistics(self) -> dict[str, float]:
        return self._figures

    def _set_lattice(self, share: float) -> None:
        """Coarser, in both its steps and their growth with distance, where the share is below 1."""
        self.lattice = int(self.config.lattice * share)
        self.growth = self.config.growth / share if self.frame.reach > 1 else 0.0

    def _set_learning_rate(self, step: int, progress: float) -> None:
        """Twenty steps of warm-up, then constant, then an exponential fall (section 4 decays likewise)."""
        c = self.config
        fall = max(0.0, progress - c.hold) / (1 - c.hold)
        rate = c.learning_rate * (c.last_learning_rate / c.learning_rate) ** fall * min(1.0, (step + 1) / 20)
        set_learning_rate(self._optimizers, rate)
