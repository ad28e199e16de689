"""DVGO: density and features in voxel grids, a shallow network for colour (Sun et al. 2022, arXiv 2111.11215)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .. import kernels
from ..camera import Camera
from ..choice import evenly
from ..components.clouds.dense_points import compile_sweep
from ..components.fields.mlp import MLP
from ..components.fields.taken_over import cells_of, logit, taken_over
from ..components.fields.voxels import VoxelGrid, corners, tight_box
from ..components.sampling.carving import visual_hull
from ..components.sampling.importance import importance
from ..components.sampling.marching import FIRST_RAYS, rays_for, weighty
from ..components.sampling.occupancy import OccupancyGrid
from ..components.sampling.spaces import NDC, space_of
from ..components.sampling.unbounded import RAYS, OpenNumbers, Unbounded, rays_of, unbounded
from ..components.training.lazy_adam import LazyAdam
from ..components.training.photometric import backdrop, residuals
from ..components.training.schedules import falling
from ..components.training.smoothness import variation
from ..kernels.spherical_harmonics import K00
from ..method import RayMethod
from ..packing import Stored, most_important
from ..ranges import Layers, LearningRate, NonNegative, PositiveShare, Seed, Share, Steps, Width, between
from ..rays import Look, Rays, Rendering
from ..scene import Batch, Frame, Scene
from ..volume import composite

Voxels = Annotated[int, between(64, 1 << 30)]


@dataclass(frozen=True)
class Config(OpenNumbers):
    """The paper's numbers, with where it or its published code gives them; `DVGO.preset` says what a CPU does."""

    coarse_voxels: Voxels = 100**3  # of the coarse stage, section 6.1
    voxels: Voxels = 160**3  # of the fine stage in the end, section 6.1
    feature_channels: Annotated[int, between(3, 64)] = 12  # section 6.1; the first three are colour by themselves
    hidden_width: Width = 128  # section 6.1
    hidden_layers: Layers = 2  # section 6.1
    sh_bands: Annotated[int, between(1, 4)] = 4  # of spherical harmonics of the direction
    coarse_alpha: PositiveShare = 1e-6  # alpha_init of the coarse stage, section 4.1
    fine_alpha: PositiveShare = 1e-2  # alpha_init of the fine stage
    open_alpha: PositiveShare = 1e-4  # of both stages where there is no bound, the code's: long rays would see fog
    coarse_share: Share = 0.2  # of the budget: 5 of 25 thousand steps
    doublings: Annotated[int, between(0, 12)] = 4  # of the number of voxels in the fine stage, section 5.2
    growing_share: Share = 0.2  # of the fine stage, in which that happens: 4 of 20 thousand steps
    box_alpha: PositiveShare = 1e-3  # of a voxel, above which it is inside the tight box
    step_size: PositiveShare = 0.5  # of a voxel's edge, section 6.1
    transmittance_threshold: Share = 1e-4  # at which a ray is spent
    weight_threshold: Share = 1e-4  # of a sample, below which it is asked for no colour in the fine stage
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 20  # 8192 rays, section 6.1
    open_samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 20  # the same where there is no bound
    occupancy_resolution: Annotated[int, between(4, 512)] = 128  # cells per axis of the mask of known free space
    occupancy_threshold: NonNegative = 0.05  # optical thickness across a cell below which it is free
    occupancy_interval: Steps = 16  # steps between looks at the mask
    occupancy_decay: Share = 0.95  # of the densities it remembers
    density_learning_rate: LearningRate = 0.1  # section 6.1
    feature_learning_rate: LearningRate = 0.1  # section 6.1
    network_learning_rate: LearningRate = 1e-3  # section 6.1
    final_learning_rate: PositiveShare = 0.1  # share of them at the end of the budget, section 6.1
    point_weight: NonNegative = 0.01  # of each sample's own colour in the loss, eq. 12
    entropy_weight: NonNegative = 0.001  # of opacities that are neither 0 nor 1, eq. 13
    tv_density_weight: NonNegative = 1e-3  # of total variation where there is no bound, as the code has it there
    tv_feature_weight: NonNegative = 1e-4  # the same, of features
    tv_interval: Steps = 8  # steps between looks at it, each as much stronger
    seed: Seed = 0


GONE = -5.0  # of density, where compression has taken a corner out: a softplus of less than 0.0001
THIN = -3.0  # of density, where another method that is taken over holds nothing; it can still learn
PROBES, LOOKS = 0.02, 4  # share of cells looked at again at random; cells at most for each sample of a step
WARM = 0.5  # share of the coarse stage before anything counts as free: at first all density is alike
SAMPLES_OF_A_RAY = 32  # that a ray needs, about, once free space is known
FLAT = (1.5, 1.5, 0.5)  # a forward-facing capture has few depths and many pixels
SMOOTHED = 1 << 14  # voxels at which total variation is taken, of those that a step's samples are in
VIEWS, LATTICE = 24, 32  # photographs, and cells along an axis, that tell how many photographs see a voxel


def shift_of(alpha: float) -> float:
    """b with softplus(b) = -log(1 - alpha): where a grid holds zero, a voxel stops a share alpha of light (eq. 9)."""
    return math.log(1 / (1 - alpha) - 1)


def inverse_softplus(y: Float[Tensor, " corner"]) -> Float[Tensor, " corner"]:
    """x with softplus(x) = y; -50 where y is nothing."""
    return y + torch.log(-torch.expm1(-y)).clamp_min(-50)


class DVGO(RayMethod):
    """A coarse stage finds where things are, a fine one within their tight box shows what they look like."""

    Config = Config
    rays_per_step: Tensor
    stage: Tensor
    edge: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame)
        box = [list(corner) for corner in frame.bounds] if frame.reach <= 1 else [[-1.0] * 3, [1.0] * 3]
        finer = FLAT if isinstance(self.space, NDC) else (1.0, 1.0, 1.0)
        self.density_grid = VoxelGrid(box, config.coarse_voxels, 1, finer)
        self.feature_grid = VoxelGrid(box, config.coarse_voxels, config.feature_channels, finer)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            hidden = [config.hidden_width] * config.hidden_layers
            self.colour_network = MLP(config.feature_channels + config.sh_bands**2, *hidden, 3)
        self.occupancy = OccupancyGrid(1.0, config.occupancy_resolution)
        self.unbounded = unbounded(frame, self.space, config)
        if self.unbounded:
            self.rays_per_chunk = RAYS
        first = rays_of(self._samples, config) if self.unbounded else FIRST_RAYS
        self.register_buffer("rays_per_step", torch.tensor(first))
        self.register_buffer("stage", torch.tensor(0))  # 0: coarse; k: fine, after k - 1 doublings
        sides = [high - low for low, high in zip(*box, strict=True)]
        self.register_buffer("edge", torch.tensor((math.prod(sides) / config.coarse_voxels) ** (1 / 3)))
        self._adam: LazyAdam | None = None

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU, what learns most in a minute."""
        if device.type == "cuda":
            return Config()
        return Config(
            coarse_voxels=64**3,
            voxels=128**3,
            hidden_width=32,
            coarse_share=0.1,
            doublings=3,
            growing_share=0.4,
            step_size=0.8,
            transmittance_threshold=1e-3,
            samples_per_step=1 << 17,
            open_samples_per_step=1 << 16,
            occupancy_threshold=0.1,
            density_learning_rate=0.6,
            feature_learning_rate=0.2,
            network_learning_rate=5e-3,
            point_weight=0.0,
            entropy_weight=0.0,
        )

    @classmethod
    def smallest(cls) -> Any:
        """Grids of a few thousand voxels that reach the fine stage and double twice within some twenty quick steps."""
        return Config(
            coarse_voxels=16**3,
            voxels=24**3,
            feature_channels=4,
            hidden_width=16,
            hidden_layers=1,
            sh_bands=2,
            coarse_share=0.2,
            doublings=2,
            growing_share=0.5,
            samples_per_step=4096,
            open_samples_per_step=4096,
            occupancy_resolution=16,
            density_learning_rate=0.5,
            feature_learning_rate=0.2,
            network_learning_rate=1e-2,
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        numbers = config.voxels * (1 + config.feature_channels)
        grids = Unbounded.bytes_of(frame, learning)
        return grids + 4 * numbers * (4 if learning else 1)  # the values, their gradient, two moments

    # What is learnt

    def density(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """Density per scene unit: interpolate, then activate (section 4.1, "post-activation")."""
        return self._activated(self.density_grid(self.space.warp(points))[:, 0], points)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        coordinates = self.space.warp(points)
        density = self._activated(self.density_grid(coordinates)[:, 0], points)
        features = self.feature_grid(coordinates)
        harmonics = kernels.spherical_harmonics(directions, self.config.sh_bands)
        if self.stage == 0:  # which knows one colour for all directions (section 4.2)
            harmonics = harmonics * (torch.arange(harmonics.shape[1], device=harmonics.device) == 0)
        seen = self.colour_network(torch.cat([features.t(), harmonics.t()]).t())
        return density, torch.sigmoid(features[:, :3] + seen)

    def storage(self) -> dict[str, Stored]:
        """Features by a codebook, density as whole numbers, the network as halves; of the mask, marks alone are needed
        for pictures."""
        networks = [f"colour_network.{name}" for name, _ in self.colour_network.named_parameters()]
        return {
            "density_grid.values": Stored("scaled", fill=GONE),
            "feature_grid.values": Stored("coded"),
            **dict.fromkeys(networks, Stored("half")),
            "occupancy.density": Stored("nothing"),
            "occupancy.possible": Stored("nothing", fill=1.0),
            **(self.unbounded.storage() if self.unbounded else {}),
        }

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """How much each corner adds to one picture; see `components.sampling.importance`."""

        def lookup(points: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 1"]:
            return self.density_grid(self.space.warp(points))

        (shares,) = importance(self, camera, lookup, [self.density_grid.values])
        return {"feature_grid.values": shares[:, 0]}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Leave nothing at the least important corners."""
        gone = ~most_important(importance["feature_grid.values"], 1 - share)
        self.density_grid.values[gone] = GONE
        self.feature_grid.values[gone] = 0.0
        return importance

    @property
    def shift(self) -> float:
        """The b of softplus(grid + b), eq. 9."""
        return self._shift_in(int(self.stage))

    def _shift_in(self, stage: int) -> float:
        c = self.config
        return shift_of(c.open_alpha if self.frame.reach > 1 else c.fine_alpha if stage > 0 else c.coarse_alpha)

    def _activated(self, raw: Float[Tensor, " sample"], points: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """softplus(raw + b) for each voxel's edge of the last grid of this stage: contracted voxels are larger."""
        thickness = nn.functional.softplus(raw + self.shift)
        density = thickness * float(1 / self.edge)
        return density * self.space.stretch(points) if self.frame.reach > 1 else density

    # Along rays

    def looks(self, rays: Rays) -> list[Look]:
        return [self.unbounded.look(self.field, rays)[0] if self.unbounded else self._march(rays)]

    def _march(self, rays: Rays, jitter: Float[Tensor, " ray"] | None = None) -> Look:
        """Samples in what is not known to be free, a share of a voxel from one to the next."""
        c = self.config
        step = c.step_size * self.density_grid.edge
        found = self.occupancy.sample(rays, self.frame.near, step, jitter=jitter)
        least = c.weight_threshold if self.stage > 0 else 0.0  # in the coarse stage all is thin at first
        samples = weighty(rays, found, self.density, c.transmittance_threshold, least)
        points, directions = samples.along(rays)
        density, rgb = self.field(points, directions)
        self.figures |= {"rays": len(rays), "samples": len(found), "visible_samples": len(samples)}
        return Look("samples", samples, density, rgb)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Eqs. 11 to 13: squared error of rays, of each sample by its weight, entropy of opacity."""
        generator = self.random(step)
        jitter = torch.rand(len(batch), 2 if self.unbounded else 1, generator=generator).to(self.device)
        background = backdrop(batch, self.background, generator, self.frame.reach > 1)
        further = dict[str, Tensor]()
        if self.unbounded:
            look, proposed = self.unbounded.look(self.field, batch.rays, jitter)
            further = self.unbounded.terms(self.density, proposed, look.density, generator)
            self.figures |= {"rays": len(batch), "samples": len(look.samples)}
        else:
            look = self._march(batch.rays, jitter[:, 0])
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background)
        terms, c = {"colour": residual.square().mean(), **further}, self.config
        if weight := c.point_weight:
            terms["points"] = weight * self._points(look, batch.before(self.background))
        if weight := c.entropy_weight:
            a = rendering.opacity.clamp(1e-6, 1 - 1e-6)
            terms["entropy"] = weight * -(a * a.log() + (1 - a) * (1 - a).log()).mean()
        if self.frame.reach > 1 and step % c.tv_interval == 0 and len(look.samples):
            coordinates = self.space.warp(look.samples.along(batch.rays)[0])
            grids = ("density", self.density_grid), ("feature", self.feature_grid)
            for (name, grid), weight in zip(grids, (c.tv_density_weight, c.tv_feature_weight), strict=True):
                if weight:
                    terms[f"tv_{name}"] = c.tv_interval * weight * variation(grid, coordinates, SMOOTHED, generator)
        return terms

    def _points(self, look: Look, target: Float[Tensor, "ray 3"]) -> Float[Tensor, ""]:
        """sum_i w_i |c_i - C|^2 over each ray, its mean; weights are taken as they are (eq. 12)."""
        seen = composite(look.samples, look.density.detach(), look.rgb, square=look.rgb.square().sum(-1, keepdim=True))
        squares = seen.extra["square"][:, 0] - 2 * (seen.rgb * target).sum(-1)
        return (squares + seen.opacity * target.square().sum(-1)).mean() / 3

    # Learning

    def rays_in_a_step(self, data: Scene) -> float:
        return self._samples / (self.config.samples_per_ray if self.unbounded else SAMPLES_OF_A_RAY)

    @property
    def _samples(self) -> int:
        """That a step asks about."""
        return self.config.open_samples_per_step if self.frame.reach > 1 else self.config.samples_per_step

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        return data.sample_rays(int(self.rays_per_step), generator).to(self.device)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        (look,) = self.looks(rays)
        return composite(look.samples, look.density, look.rgb, background)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        grids = [
            {"params": [self.density_grid.values], "name": "density"},
            {"params": [self.feature_grid.values], "name": "features"},
        ]
        self._adam = LazyAdam(grids, betas=(0.9, 0.99))
        network = [{"params": [*self.colour_network.parameters()], "name": "network"}]
        optimizers = [self._adam, torch.optim.Adam(network, betas=(0.9, 0.99))]
        return [*optimizers, self.unbounded.optimizer()] if self.unbounded else optimizers

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c = self.config
        share = falling(1.0, c.final_learning_rate, progress) * min(1.0, (step + 1) / 20)
        rates = {"density": c.density_learning_rate, "features": c.feature_learning_rate}
        found = {name: share * rate for name, rate in {**rates, "network": c.network_learning_rate}.items()}
        return found | {"proposal": Unbounded.rate(progress)}

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        """What no learning is needed for: the silhouettes' hull, and how many photographs see each voxel."""
        if scene.images.has_alpha and self.frame.reach <= 1:
            self.occupancy.rule_out(visual_hull(scene, self.config.occupancy_resolution)[None])
        if self.unbounded:
            self.unbounded.begin(scene, seconds, self.random(1))
        if self._adam is not None:
            rates = self._views(scene)
            for group in self._adam.param_groups:
                group["rates"] = rates

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Density and colour of the teacher at the fine grid's corners, where it holds something; its first three
        features are colour, and the network adds nothing at first."""
        known, c, chance = taken_over(teacher, cameras), self.config, self.random(3)
        occupied = known.occupied(self.space, c.occupancy_resolution, c.occupancy_threshold, chance)
        self.stage.fill_(1 + c.doublings)
        box = self.density_grid.box.cpu()
        if self.frame.reach <= 1:
            self.occupancy.rule_out(occupied[None])
            box = torch.stack([self.occupancy.box.cpu().max(box)[0], self.occupancy.box.cpu().min(box)[1]])
        edge = float(((box[1] - box[0]).prod() / c.voxels) ** (1 / 3))
        self.edge.fill_(edge)
        for grid in (self.density_grid, self.feature_grid):
            grid.rebuild(box.to(self.device), c.voxels, self._adam)
        places = corners(box, self.density_grid.shape)
        there = occupied[tuple(cells_of(places, len(occupied)).t())]
        points = self.space.unwarp(places[there])
        stretch = self.space.stretch(points) if self.frame.reach > 1 else points.new_ones(len(points))
        thickness = known.density_around(points, edge / stretch, chance) / stretch * edge
        raw, features = torch.full((len(places), 1), THIN), torch.zeros(len(places), c.feature_channels)
        raw[there] = (inverse_softplus(thickness)[:, None] - self.shift).clamp_min(THIN)
        features[there, :3] = known.harmonics(points, 1, logit)[:, 0] * K00
        self.density_grid.replace(raw.to(self.device), self._adam)
        self.feature_grid.replace(features.to(self.device), self._adam)
        self.colour_network.weights[-1].zero_()
        if self.unbounded:
            self.unbounded.begin_at(known.surface.points, known.surface.origins)
        else:
            self._look(0, 1.0)

    def rehearse_begin(self) -> None:
        if self.unbounded:
            compile_sweep()

    @torch.no_grad()
    def _views(self, scene: Scene) -> Float[Tensor, " corner"]:
        """How many photographs see each corner, as a share of the most: by it the coarse stage learns, so that what one
        camera alone has before its lens does not grow dense first (section 4.1)."""
        n = LATTICE
        counts = torch.zeros(n**3, device=self.device)
        box = self.density_grid.box
        shares = (torch.arange(2 * n, device=self.device) + 0.5) / (2 * n)
        for index in evenly(scene.splits["train"].tolist(), VIEWS):
            camera = scene.cameras[index]
            camera = camera.resized(n / int(camera.size.max()))
            rays = camera.rays(camera.pixels()).to(self.device)
            near, far = self.space.interval(rays)
            t = self.space.distance(shares.expand(len(rays), -1), rays, near, far)
            points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
            cells = ((self.space.warp(points.view(-1, 3)) - box[0]) / (box[1] - box[0]) * n).floor().long()
            x, y, z = cells[((cells >= 0) & (cells < n)).all(-1)].unbind(-1)
            seen = torch.zeros_like(counts)
            seen[(x * n + y) * n + z] = 1
            counts += seen
        lattice = (counts / counts.max().clamp_min(1)).view(n, n, n, 1)
        return kernels.dense_grid(corners(box, self.density_grid.shape), lattice, box)[:, 0].contiguous()

    def before_step(self, step: int, progress: float) -> None:
        c = self.config
        if self.unbounded:
            self.unbounded.before_step(progress)
        settled = not self.unbounded and progress >= WARM * c.coarse_share
        if self._stage_at(progress) > int(self.stage):
            self._advance(self._stage_at(progress))
            if settled:
                self._look(step, 1.0)
        elif settled and step % c.occupancy_interval == 0:
            self._look(step, PROBES)

    def after_step(self, step: int) -> None:
        if self.unbounded:
            return
        rays = rays_for(self._samples, int(self.rays_per_step), self.figures["samples"])
        self.rays_per_step.fill_(rays)

    def _stage_at(self, progress: float) -> int:
        """0 in the coarse stage; in the fine stage one more than the doublings there have been."""
        c = self.config
        if progress < c.coarse_share:
            return 0
        fine = (progress - c.coarse_share) / max(1 - c.coarse_share, 1e-9)
        return 1 + min(c.doublings, int(fine / max(c.growing_share, 1e-9) * c.doublings))

    def _advance(self, stage: int) -> None:
        """On to a stage: from the coarse one into the tight box, from a fine one to more voxels (section 5.2)."""
        c = self.config
        voxels = max(64, c.voxels >> (c.doublings - stage + 1))
        grids = self.density_grid, self.feature_grid
        if self.stage > 0:
            for grid in grids:
                grid.rebuild(grid.box, voxels, self._adam)
        else:
            self._enter_fine(voxels)
        self.stage.fill_(stage)

    @torch.no_grad()
    def _enter_fine(self, voxels: int) -> None:
        """Shrink to the box around all that is dense, where there is a bound. What was found stays as dense as it was;
        what is thinner than free space at the beginning of the fine stage begins as that does."""
        c, grid = self.config, self.density_grid
        thickness = nn.functional.softplus(grid.values[:, 0] + self.shift)
        dense = 1 - torch.exp(-thickness) > c.box_alpha
        inside = dense.view(grid.shape)
        box = tight_box(grid.box, inside) if self.frame.reach <= 1 else grid.box.clone()
        volume = float((box[1] - box[0]).prod())
        edge = (volume / c.voxels) ** (1 / 3)
        thickness = thickness * (edge / float(self.edge))
        raw = inverse_softplus(thickness) - self._shift_in(1)
        grid.replace(raw.clamp_min(0)[:, None], self._adam)
        self.edge.fill_(edge)
        for each in (grid, self.feature_grid):
            each.rebuild(box, voxels, self._adam)
        if self._adam is not None:
            for group in self._adam.param_groups:
                group["rates"] = None

    def _look(self, step: int, share: float) -> None:
        """Look at the mask of known free space again: at all cells, or at the occupied ones and a few more."""
        c = self.config
        budget = self._samples * LOOKS if share < 1 else None
        generator = self.random(~step)
        self.occupancy.update(self.density, c.occupancy_threshold, generator, c.occupancy_decay, share, budget)
