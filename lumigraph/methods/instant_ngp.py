"""Instant-NGP: a scene in a multiresolution hash table and two tiny networks (Müller et al. 2022, arXiv 2201.05989)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..camera import Camera
from ..components.clouds.dense_points import compile_sweep
from ..components.fields.hash_field import (
    CALM,
    ON_A_CPU,
    TINY,
    HashField,
    HashNumbers,
    bytes_kept,
    check_levels,
)
from ..components.fields.taken_over import taken_over
from ..components.sampling.carving import visual_hull
from ..components.sampling.coarse_to_fine import SAMPLES_OF_A_RAY, first_grid, keep_looking, lattice, stage
from ..components.sampling.importance import importance
from ..components.sampling.marching import FIRST_RAYS, rays_for, reached
from ..components.sampling.occupancy import OccupancyGrid
from ..components.sampling.spaces import Box, space_of
from ..components.sampling.unbounded import RAYS, OpenNumbers, Unbounded, rays_of, unbounded
from ..components.training.coarse_to_fine import band_weights
from ..components.training.corrections import Setting
from ..components.training.distillation import distil
from ..components.training.exposed import Exposed
from ..components.training.lazy_adam import LazyAdam
from ..components.training.photometric import backdrop, residuals
from ..components.training.pose_refinement import PoseRefinement
from ..components.training.schedules import held
from ..method import RayMethod
from ..packing import Stored, most_important
from ..ranges import Layers, LearningRate, NonNegative, PositiveShare, Seed, Share, Steps, Width, between
from ..rays import Look, Rays, Rendering
from ..scene import Batch, Frame, Scene
from ..volume import composite


@dataclass(frozen=True)
class Config(HashNumbers, OpenNumbers):
    """The paper's numbers, with where it gives them; `InstantNGP.preset` says what a plain CPU does otherwise."""

    hidden_width: Width = 64  # neurons per hidden layer, section 5.4
    density_layers: Layers = 1  # hidden layers, section 5.4
    colour_layers: Layers = 2  # hidden layers, section 5.4
    geometry_features: Annotated[int, between(1, 256)] = 16  # from density to colour network, section 5.4
    sh_bands: Annotated[int, between(1, 4)] = 4  # of spherical harmonics, section 5.4
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 18  # section 5.4: not rays
    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 1024  # of the unit cascade, appendix E.1
    cone_angle: Share = 1 / 256  # growth of steps with distance, E.1
    transmittance_threshold: Share = 1e-4  # at which a ray is spent, appendix E.1
    occupancy_resolution: Annotated[int, between(4, 512)] = 128  # cells per axis and cascade, appendix E.2
    occupancy_threshold: NonNegative = 0.05  # optical thickness across a cell below which it is empty; E.2's at n = 128
    occupancy_interval: Steps = 16  # steps between updates of the occupancy grid, appendix E.2
    occupancy_decay: Share = 0.95  # of the densities it remembers, appendix E.2
    learning_rate: LearningRate = 1e-2  # section 4
    final_learning_rate: LearningRate = 1e-3  # at the end of the budget
    decay_start: Annotated[float, between(0, 0.99)] = 0.3  # share of the budget before the learning rate falls
    hash_weight_decay: NonNegative = 0.0  # of the table, decoupled; of objects only, for it pulls density towards 1
    huber_delta: PositiveShare = 0.1  # residual at which the loss turns from square to linear
    contraction: bool = True  # of open captures (Barron 2022), with proposals; or section 5.4's cascades around them
    exposure_correction: Setting = "auto"  # learn a gain per photograph; auto: where they are found to differ
    refine_cameras: bool = False  # learn where each photograph was taken from, coarse to fine (Lin 2021, BARF)
    pose_learning_rate: LearningRate = 5e-4  # radians by which a step moves a picture, with refine_cameras
    match_photographs: bool = True  # with refine_cameras, begin where features that photographs share say
    seed: Seed = 0

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        check_levels(self)


class InstantNGP(Exposed, RayMethod):  # type: ignore[override]  # what is accepted
    """Rays are sampled in occupied cells; a first pass without gradients drops hidden samples, a second one learns.

    Open captures are contracted, and sampled where a grid proposes; see `components.sampling.unbounded`.
    """

    Config = Config
    rays_per_step: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame) if config.contraction else Box(frame.bounds, frame.near)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = HashField(config, self.space, frame.reach)
        self.unbounded = unbounded(frame, self.space, config) if config.contraction else None
        if self.unbounded:
            self.rays_per_chunk = RAYS
        self.sampled = 1.0  # share of each ray of an object, around its middle, that is sampled in training
        self.joined = 1.0  # how far the finer levels have joined the coarsest in training
        self.expose(frame, config.exposure_correction)
        refining, rate = config.refine_cameras, config.pose_learning_rate
        self.poses = PoseRefinement(frame.image_count, rate) if refining else None
        self.occupancy = first_grid(config, frame.reach)
        self.lattice = lattice(config, frame.reach)
        first = rays_of(config.samples_per_step, config) if self.unbounded else FIRST_RAYS
        self.register_buffer("rays_per_step", torch.tensor(first))

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU, what learns most in a minute: half as many levels with twice the
        features, smaller tables and networks, a wider step and a smaller batch."""
        if device.type == "cuda":
            return Config()
        return Config(
            **ON_A_CPU,
            hash_weight_decay=0.3,
            huber_delta=0.3,
        )

    @classmethod
    def smallest(cls) -> Any:
        """Tiny tables and networks with both corrections and a grid of three sizes, within some twenty quick steps."""
        return Config(
            **TINY,
            exposure_correction="yes",
            refine_cameras=True,
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        grids = OccupancyGrid.bytes_of(frame.reach, config.occupancy_resolution) + Unbounded.bytes_of(frame, learning)
        return grids + bytes_kept(config) * learning

    def rays_in_a_step(self, data: Scene) -> float:
        c = self.config
        return c.samples_per_step / (c.samples_per_ray if self.unbounded else SAMPLES_OF_A_RAY)

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        self.tell_exposed(scene)
        if self.poses:  # silhouettes seen from wrong poses would carve what is there
            self.poses.find(scene, self.config.match_photographs)
        elif scene.images.has_alpha and self.frame.reach == 1:
            self.occupancy.rule_out(visual_hull(scene, self.config.occupancy_resolution)[None])
        if self.unbounded and not self.poses:
            self.unbounded.begin(scene, seconds, self.random(1))

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Table and networks, taught at points by the teacher."""
        known, c, chance = taken_over(teacher, cameras), self.config, self.random(3)
        networks = [*self.network.density_network.parameters(), *self.network.colour_network.parameters()]
        optimizers = [
            LazyAdam([self.network.table], c.learning_rate),
            torch.optim.Adam(networks, c.learning_rate, eps=1e-15),
        ]
        distil(self.field, known, self.space, optimizers, c.samples_per_step, chance, self.device)
        if self.unbounded:
            self.unbounded.begin_at(known.surface.points, known.surface.origins)
            return
        if self.frame.reach == 1:
            occupied = known.occupied(self.space, c.occupancy_resolution, c.occupancy_threshold, chance)
            self.occupancy.rule_out(occupied[None])
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
        if not self.unbounded:
            return [self._march(rays)]
        if torch.is_grad_enabled():
            return [self.unbounded.look(self.field, rays)]
        return [self.unbounded.glance(self._geometry, self._colours, rays)]

    def _march(self, rays: Rays, jitter: Float[Tensor, " ray"] | None = None) -> Look:
        found = self.occupancy.sample(rays, self.frame.near, *self.lattice, jitter=jitter)
        if self.sampled < 1 and jitter is not None:
            near, far = self.space.interval(rays)
            aside = (found.t - (0.5 * (near + far))[found.ray_index]).abs()
            found = found.keep(aside < (0.5 * self.sampled * (far - near))[found.ray_index])
        samples, asked = reached(rays, found, self.density, self.config.transmittance_threshold)
        points, directions = samples.along(rays)
        density, rgb = self.field(points, directions)
        self.figures |= {"rays": len(rays), "samples": asked, "visible_samples": len(samples)}
        return Look("samples", samples, density, rgb)

    def look_to_learn(self, rays: Rays, generator: torch.Generator) -> tuple[Look, dict[str, Tensor]]:
        """A step's look along rays, at random places, and what it costs beside colours, by name."""
        if not self.unbounded:
            return self._march(rays, torch.rand(len(rays), generator=generator).to(self.device)), {}
        jitter = torch.rand(len(rays), 2, generator=generator).to(self.device)
        look, proposed = self.unbounded.learn(self.field, rays, jitter)
        self.figures |= {"rays": len(rays), "samples": len(look.samples)}
        return look, self.unbounded.terms(self.density, proposed, look.density, generator)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator = self.random(step)
        rays = self.poses(batch.rays) if self.poses else batch.rays
        look, terms = self.look_to_learn(rays, generator)
        background = backdrop(batch, self.background, generator, opaque=self.unbounded is not None)
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background, self.gains)
        return {"huber": huber(residual, self.config.huber_delta), **terms}

    def optimizers(self) -> list[torch.optim.Optimizer]:
        networks = [*self.network.density_network.parameters(), *self.network.colour_network.parameters()]
        groups: list[dict[str, Any]] = [{"params": networks, "scale": CALM if self.unbounded else 1.0}]
        if self.exposure:
            groups.append({"params": [*self.exposure.parameters()], "scale": 0.05})
        common = {"lr": self.config.learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        decay = self.config.hash_weight_decay if self.frame.reach == 1 else 0.0
        table = LazyAdam([self.network.table], weight_decay=decay, **common)
        optimizers = [table, torch.optim.Adam(groups, foreach=True, **common)]
        if self.unbounded:
            optimizers.append(self.unbounded.optimizer())
        return [*optimizers, self.poses.optimizer()] if self.poses else optimizers

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        """Twenty steps of warm-up, then constant, then exponential decay (section 4 decays likewise)."""
        c = self.config
        rate = held(c.learning_rate, c.final_learning_rate, step, progress, c.decay_start)
        rates = {"": rate, "proposal": Unbounded.rate(progress)}
        return rates | {"poses": self.poses.rate(progress)} if self.poses else rates

    def before_step(self, step: int, progress: float) -> None:
        if self.poses:
            self.poses.progress.fill_(progress)
        if self.unbounded:
            self.unbounded.before_step(progress)
            return
        self.lattice = lattice(self.config, self.frame.reach, stage(progress).steps)
        keep_looking(self.occupancy, self.density, self.config, step, progress, self.random(~step))

    def after_step(self, step: int) -> None:
        """Set the next step's number of rays so that they give about `samples_per_step` samples."""
        if self.unbounded:
            return
        rays = rays_for(self.config.samples_per_step, int(self.rays_per_step), self.figures["samples"])
        self.rays_per_step.fill_(rays)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        density, geometry = self._geometry(points)
        return density, self._colours(geometry, directions)

    def density(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """Density per scene unit."""
        return self._geometry(points)[0]

    def _geometry(
        self, points: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point feature"]]:
        density, geometry = self.network.density(self._encoded(points))
        return density * self.space.stretch(points), geometry

    def _colours(
        self, geometry: Float[Tensor, "point feature"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        return self.exposed(self.network.colour(geometry, directions))

    def _encoded(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample width"]:
        """The network's input; while poses are refined, of as many levels as have joined."""
        weights = self.poses.weights(self.config.levels) if self.poses else None
        if self.joined < 1 and weights is None:
            weights = band_weights(self.config.levels, self.joined, 0.0, 1.0).to(self.device)
        return self.network.encode(self.space.warp(points), weights)

    def storage(self) -> dict[str, Stored]:
        """The table as whole numbers, the networks as halves; of the grid, marks alone are needed for pictures."""
        networks = [name for name, _ in self.named_parameters() if "_network." in name]
        return {
            "network.table": Stored("scaled"),
            **dict.fromkeys(networks, Stored("half")),
            "occupancy.density": Stored("nothing"),
            "occupancy.possible": Stored("nothing", fill=1.0),
            **(self.unbounded.storage() if self.unbounded else {}),
        }

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """How much each entry of the table adds to one picture; see `components.sampling.importance`."""
        (shares,) = importance(self, camera, self._encoded, [self.network.table])
        return {"network.table": shares.mean(-1)}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Set the least important entries of the table to zero."""
        self.network.table[~most_important(importance["network.table"], 1 - share)] = 0.0
        return importance

    def refined(self, cameras: Camera) -> Camera:
        return self.poses.refined(cameras) if self.poses else cameras


def huber(residual: Float[Tensor, "row 3"], delta: float) -> Float[Tensor, ""]:
    """The mean of residuals' Huber loss, divided by delta, so that the linear part has slope 1."""
    return nn.functional.huber_loss(residual, torch.zeros_like(residual), delta=delta) / delta
