"""DVGO: density and features in voxel grids, a shallow network for colour (Sun et al. 2022, arXiv 2111.11215)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .. import kernels
from ..camera import Camera
from ..camera.rays import Look
from ..components.fields.layers import MLP
from ..components.fields.spaces import NDC, Space, space_of
from ..components.fields.teacher import cells_of, logit, teacher_of
from ..components.fields.voxels import VoxelGrid, corners, tight_box
from ..components.sampling.importance import importance
from ..components.sampling.occupancy_sampler import GridSchedule, OccupancyNumbers, OccupancySampler
from ..components.sampling.samplers import ProposalNumbers, sampler_for
from ..components.training.photometric import backdrop, residuals
from ..components.training.regularizers import opacity_entropy
from ..components.training.row_optimizers import LazyAdam
from ..components.training.schedules import falling
from ..datasets.scene import Batch, Frame, Scene
from ..exchange.packing import Stored, most_important
from ..files.ranges import LearningRate, NonNegative, PositiveShare, Share, Width, between, changed
from ..geometry import evenly
from ..kernels.spherical_harmonics import K00
from ..method import BaseConfig, Field, FieldMethod, seeded
from ..method.depth import DepthNumbers, depth_terms
from ..method.field import Colours, Densities, Directions, Points
from ..volume import composite

Voxels = Annotated[int, between(64, 1 << 30)]


TV_DENSITY_WEIGHT = 1e-3  # weight of density's total variation, in the open
TV_FEATURE_WEIGHT = 1e-4  # weight of features' total variation, in the open
COARSE_ALPHA = 1e-6  # initial alpha of the coarse stage, eq. 9; higher begins denser
FINE_ALPHA = 1e-2  # initial alpha of the fine stage, eq. 9; higher begins denser
OPEN_ALPHA = 1e-4  # initial alpha of both stages in the open; higher begins as haze
BOX_ALPHA = 1e-3  # alpha of a voxel above which the tight box holds it; higher gives a smaller box
WEIGHT_THRESHOLD = 1e-4  # weight of a sample below which it gets no colour in the fine stage; higher: faster
FINAL_LEARNING_RATE = 0.1  # share of these rates at the end of the budget, section 6.1
TV_INTERVAL = 8  # steps between these two terms, whose weight is multiplied by it; more are faster

FEATURE_CHANNELS = 12  # channels of a corner, 6.1; the first 3 are a colour
HIDDEN_LAYERS = 2  # hidden layers of the colour network, section 6.1


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, with where it or its published code gives them; `DVGO.preset` says what a CPU does."""

    occupancy: OccupancyNumbers = OccupancyNumbers(samples_per_step=1 << 20)  # 8192 rays, section 6.1
    proposals: ProposalNumbers = ProposalNumbers()
    measured: DepthNumbers = DepthNumbers()
    coarse_voxels: Voxels = 1_024_000  # voxels of the coarse stage, the release's; more cost memory and time
    voxels: Voxels = 160**3  # voxels of the fine stage at its end, section 6.1; more give detail, cost memory
    hidden_width: Width = 128  # channels of the colour network, section 6.1; wider costs time
    sh_bands: Annotated[int, between(1, 4)] = 4  # spherical-harmonics bands of the direction; 1: no view dependence
    coarse_share: Share = 0.2  # share of the budget of the coarse stage: 5 of the paper's 25 thousand steps
    doublings: Annotated[int, between(0, 12)] = 4  # doublings of the voxels in the fine stage, section 5.2; 0: none
    growing_share: Share = 0.2  # share of the fine stage with these doublings: 4 of 20 thousand steps
    step_size: PositiveShare = 0.5  # distance of samples in voxels, section 6.1; larger is faster, less exact
    open_samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 20  # the same where there is no bound
    density_learning_rate: LearningRate = 0.1  # rate of the density grid at first, section 6.1
    feature_learning_rate: LearningRate = 0.1  # rate of the feature grid at first, section 6.1
    network_learning_rate: LearningRate = 1e-3  # rate of the colour network at first, section 6.1
    coarse_point_weight: NonNegative = 0.1  # weight of each sample's own colour in the coarse stage, eq. 12; 0: off
    point_weight: NonNegative = 0.01  # the same in the fine stage; 0: off
    coarse_entropy_weight: NonNegative = 0.01  # weight of the entropy of opacity in the coarse stage, eq. 13; 0: off
    entropy_weight: NonNegative = 0.001  # the same in the fine stage; higher gives harder edges


SOURCES = {  # of the numbers of `paper`; the others are ours
    "sunset1995/DirectVoxGO, configs/default.py (341e1fc)": (
        "coarse_voxels voxels feature_channels hidden_width hidden_layers coarse_alpha fine_alpha doublings "
        "growing_share box_alpha step_size weight_threshold density_learning_rate feature_learning_rate "
        "network_learning_rate coarse_point_weight point_weight coarse_entropy_weight entropy_weight"
    ),
    "Sun 2022, section 6.1": "coarse_share",
}
EMPTY = -5.0  # of density, where compression has taken a corner out: a softplus of less than 0.0001
TEACHER_EMPTY = -3.0  # of density, where another method that is taken over holds nothing; it can still learn
FREE_FROM = 0.5  # share of the coarse stage before anything counts as free: at first all density is alike
SAMPLES_PER_RAY = 32  # of a typical ray, once free space is known
FLAT = (1.5, 1.5, 0.5)  # a forward-facing capture has few depths and many pixels
MAX_SMOOTHED = 1 << 14  # voxels at which total variation is taken, of those that a step's samples are in
MAX_VIEWS, VIEW_CELLS = 24, 32  # photographs, and cells along an axis, that tell how many photographs see a voxel


def shift_of(alpha: float) -> float:
    """b with softplus(b) = -log(1 - alpha): where a grid holds zero, a voxel stops a share alpha of light (eq. 9)."""
    return math.log(1 / (1 - alpha) - 1)


def inverse_softplus(y: Float[Tensor, " corner"]) -> Float[Tensor, " corner"]:
    """x with softplus(x) = y; -50 where y is nothing."""
    return y + torch.log(-torch.expm1(-y)).clamp_min(-50)


class VoxelField(Field):
    """Density and features in voxel grids; a shallow network makes colours of features and direction (section 3).

    stage: 0 in the coarse stage, k in the fine one after k - 1 doublings of the number of voxels
    edge:  of a voxel of this stage's last grid, in coordinates
    """

    cheap_density: ClassVar[bool] = True
    stage: Tensor
    edge: Tensor

    def __init__(self, config: Config, frame: Frame, space: Space):
        super().__init__()
        c = config
        self.config, self.space = c, space
        box = [[-1.0] * 3, [1.0] * 3] if space.is_open else [list(corner) for corner in frame.bounds]
        finer = FLAT if isinstance(space, NDC) else (1.0, 1.0, 1.0)
        self.density_grid = VoxelGrid(box, c.coarse_voxels, 1, finer)
        self.feature_grid = VoxelGrid(box, c.coarse_voxels, FEATURE_CHANNELS, finer)
        self.colour_network = MLP(FEATURE_CHANNELS + c.sh_bands**2, *[c.hidden_width] * HIDDEN_LAYERS, 3)
        self.register_buffer("stage", torch.tensor(0))
        sides = [high - low for low, high in zip(*box, strict=True)]
        self.register_buffer("edge", torch.tensor((math.prod(sides) / c.coarse_voxels) ** (1 / 3)))

    @property
    def grids(self) -> tuple[VoxelGrid, VoxelGrid]:
        return self.density_grid, self.feature_grid

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Points]:
        """Density: interpolate, then activate (section 4.1, "post-activation"). Features: the points' coordinates."""
        coordinates = self.space.warp(points)
        thickness = nn.functional.softplus(self.density_grid(coordinates)[:, 0] + self.shift(int(self.stage)))
        density = thickness * float(1 / self.edge)  # contracted voxels are larger
        return density * self.space.stretch(points) if self.space.is_open else density, coordinates

    def colour(self, features: Float[Tensor, "point 3"], directions: Directions, code: Tensor | None = None) -> Colours:
        found = self.feature_grid(features)
        harmonics = kernels.spherical_harmonics(directions, self.config.sh_bands)
        if self.stage == 0:  # which knows one colour for all directions (section 4.2)
            harmonics = harmonics * (torch.arange(harmonics.shape[1], device=harmonics.device) == 0)
        seen = self.colour_network(torch.cat([found.t(), harmonics.t()]).t())
        return torch.sigmoid(found[:, :3] + seen)

    def shift(self, stage: int) -> float:
        """The b of softplus(grid + b), eq. 9."""
        return shift_of(OPEN_ALPHA if self.space.is_open else FINE_ALPHA if stage > 0 else COARSE_ALPHA)

    @property
    def step_length(self) -> float:
        return self.config.step_size * self.density_grid.edge

    @property
    def min_weight(self) -> float:
        return WEIGHT_THRESHOLD if self.stage > 0 else 0.0  # in the coarse stage all is thin at first

    def storage(self) -> dict[str, Stored]:
        """Features by a codebook, density as whole numbers, the network as halves."""
        networks = [f"colour_network.{name}" for name, _ in self.colour_network.named_parameters()]
        grids = {"density_grid.values": Stored("scaled", fill=EMPTY), "feature_grid.values": Stored("coded")}
        return grids | dict.fromkeys(networks, Stored("half"))


class DVGO(FieldMethod):
    """A coarse stage finds the occupied box, a fine one within it learns appearance."""

    Config = Config
    network: VoxelField

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        with seeded(c.seed):
            self.network = VoxelField(c, frame, space)
        schedule = GridSchedule(begins=FREE_FROM * c.coarse_share, early_steps=0)
        numbers = c.occupancy, c.proposals, schedule
        open_samples = c.open_samples_per_step
        self.sampler = sampler_for(frame, space, *numbers, open_samples=open_samples, samples_per_ray=SAMPLES_PER_RAY)
        self._adam: LazyAdam | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        return changed(Config(), samples_per_step=1 << 17, transmittance_threshold=1e-3, occupancy_threshold=0.1,
            coarse_voxels=64**3, voxels=128**3, hidden_width=32, step_size=0.8, coarse_share=0.1, doublings=3,
            growing_share=0.4, open_samples_per_step=1 << 16, density_learning_rate=0.6, feature_learning_rate=0.2,
            network_learning_rate=5e-3, coarse_point_weight=0.0, point_weight=0.0, coarse_entropy_weight=0.0,
            entropy_weight=0.0)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Grids of a few thousand voxels that reach the fine stage and double twice within some twenty quick steps."""
        return changed(Config(), samples_per_step=4096, occupancy_resolution=16, coarse_voxels=16**3, voxels=24**3,
            hidden_width=16, sh_bands=2, open_samples_per_step=4096,
            density_learning_rate=0.5, feature_learning_rate=0.2, network_learning_rate=1e-2, doublings=2,
            growing_share=0.5)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """The finest grids; while they learn also their gradient and two moments."""
        numbers = config.voxels * (1 + FEATURE_CHANNELS)
        return super().further_bytes(frame, config, learning) + 4 * numbers * (4 if learning else 1)

    # Training

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Eqs. 11 to 13: squared error of rays, of each sample by its weight, entropy of opacity."""
        generator, c, fine = self.random(step), self.config, self.network.stage > 0
        (samples,), terms = self.learn(batch.rays, generator)
        look = samples.look(self.network)
        background = backdrop(batch, self.background, generator, self.sampler.is_open)
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background)
        terms |= {"colour": residual.square().mean()}
        terms |= depth_terms(c, batch.extra, rendering.depth, rendering.opacity)
        if weight := c.point_weight if fine else c.coarse_point_weight:
            terms["points"] = weight * point_error(look, batch.before(self.background))
        if weight := c.entropy_weight if fine else c.coarse_entropy_weight:
            terms["entropy"] = weight * opacity_entropy(rendering.opacity)
        if self.sampler.is_open and step % TV_INTERVAL == 0 and len(look.samples):
            assert isinstance(samples.features, Tensor)
            weights = {"tv_density": TV_DENSITY_WEIGHT, "tv_feature": TV_FEATURE_WEIGHT}
            for grid, (name, weight) in zip(self.network.grids, weights.items(), strict=True):
                if weight:
                    terms[name] = TV_INTERVAL * weight * grid.variation(samples.features, MAX_SMOOTHED, generator)
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        density, features = ([grid.values] for grid in self.network.grids)
        grids = [{"params": density, "name": "density"}, {"params": features, "name": "features"}]
        self._adam = LazyAdam(grids, betas=(0.9, 0.99))
        network = [{"params": [*self.network.colour_network.parameters()], "name": "network"}]
        return [self._adam, torch.optim.Adam(network, betas=(0.9, 0.99)), *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c = self.config
        share = falling(1.0, FINAL_LEARNING_RATE, progress) * min(1.0, (step + 1) / 20)
        rates = {"density": c.density_learning_rate, "features": c.feature_learning_rate}
        return {name: share * rate for name, rate in {**rates, "network": c.network_learning_rate}.items()}

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        """Initialise with the silhouettes' hull and the number of photographs that see each voxel."""
        super().begin(data, seconds)
        if self._adam is not None:
            rates = self._view_share(data)
            for group in self._adam.param_groups:
                group["rates"] = rates

    def before_step(self, step: int, progress: float) -> None:
        if (stage := self._stage_at(progress)) > int(self.network.stage):
            self._advance(stage)
            if isinstance(self.sampler, OccupancySampler):
                self.sampler.stale = True
        super().before_step(step, progress)

    def _stage_at(self, progress: float) -> int:
        """0 in the coarse stage; in the fine stage one more than the doublings there have been."""
        c = self.config
        if progress < c.coarse_share:
            return 0
        fine = (progress - c.coarse_share) / max(1 - c.coarse_share, 1e-9)
        return 1 + min(c.doublings, int(fine / max(c.growing_share, 1e-9) * c.doublings))

    def _advance(self, stage: int) -> None:
        """On to a stage: from the coarse one into the tight box, from a fine one to more voxels (section 5.2)."""
        c, network = self.config, self.network
        voxels = max(64, c.voxels >> (c.doublings - stage + 1))
        if network.stage > 0:
            for grid in network.grids:
                grid.rebuild(grid.box, voxels, self._adam)
        else:
            self._enter_fine(voxels)
        network.stage.fill_(stage)

    @torch.no_grad()
    def _enter_fine(self, voxels: int) -> None:
        """Shrink to the bounding box of dense cells, in bounded scenes. Coarse densities are kept; densities below the
        fine stage's initial free space are raised to it."""
        c, network, grid = self.config, self.network, self.network.density_grid
        thickness = nn.functional.softplus(grid.values[:, 0] + network.shift(0))
        dense = 1 - torch.exp(-thickness) > BOX_ALPHA
        inside = dense.view(grid.shape)
        box = grid.box.clone() if self.sampler.is_open else tight_box(grid.box, inside)
        volume = float((box[1] - box[0]).prod())
        edge = (volume / c.voxels) ** (1 / 3)
        thickness = thickness * (edge / float(network.edge))
        raw = inverse_softplus(thickness) - network.shift(1)
        grid.replace(raw.clamp_min(0)[:, None], self._adam)
        network.edge.fill_(edge)
        for each in network.grids:
            each.rebuild(box, voxels, self._adam)
        if self._adam is not None:
            for group in self._adam.param_groups:
                group["rates"] = None

    @torch.no_grad()
    def _view_share(self, scene: Scene) -> Float[Tensor, " corner"]:
        """Number of photographs that see each corner, as a share of the largest: learning rates of the coarse stage, so
        that space seen by one camera alone does not become dense first (section 4.1)."""
        n = VIEW_CELLS
        counts = torch.zeros(n**3, device=self.device)
        box = self.network.density_grid.box
        shares = (torch.arange(2 * n, device=self.device) + 0.5) / (2 * n)
        for index in evenly(scene.splits["train"].tolist(), MAX_VIEWS):
            camera = scene.cameras[index]
            camera = camera.resized(n / int(camera.size.max()))
            rays = camera.rays(camera.pixels()).to(self.device)
            near, far = self.network.space.interval(rays)
            t = self.network.space.distance(shares.expand(len(rays), -1), rays, near, far)
            points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
            cells = ((self.network.space.warp(points.view(-1, 3)) - box[0]) / (box[1] - box[0]) * n).floor().long()
            x, y, z = cells[((cells >= 0) & (cells < n)).all(-1)].unbind(-1)
            seen = torch.zeros_like(counts)
            seen[(x * n + y) * n + z] = 1
            counts += seen
        lattice = (counts / counts.max().clamp_min(1)).view(n, n, n, 1)
        return kernels.dense_grid(corners(box, self.network.density_grid.shape), lattice, box)[:, 0].contiguous()

    # From another method

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Density and colour of the teacher at occupied corners of the fine grid; its first three features are colour,
        and the network adds nothing at first."""
        known, c, chance, network = teacher_of(teacher, cameras), self.config, self.random(3), self.network
        space, n = network.space, c.occupancy
        occupied = known.occupied(space, n.occupancy_resolution, n.occupancy_threshold, chance)
        network.stage.fill_(1 + c.doublings)
        box = network.density_grid.box.cpu()
        if isinstance(self.sampler, OccupancySampler):
            grid = self.sampler.grid
            grid.rule_out(occupied[None])
            box = torch.stack([grid.box.cpu().max(box)[0], grid.box.cpu().min(box)[1]])
        edge = float(((box[1] - box[0]).prod() / c.voxels) ** (1 / 3))
        network.edge.fill_(edge)
        for each in network.grids:
            each.rebuild(box.to(self.device), c.voxels, self._adam)
        places = corners(box, network.density_grid.shape)
        there = occupied[tuple(cells_of(places, len(occupied)).t())]
        points = space.unwarp(places[there])
        stretch = space.stretch(points) if space.is_open else points.new_ones(len(points))
        thickness = known.density_around(points, edge / stretch, chance) / stretch * edge
        raw, features = torch.full((len(places), 1), TEACHER_EMPTY), torch.zeros(len(places), FEATURE_CHANNELS)
        shift = network.shift(int(network.stage))
        raw[there] = (inverse_softplus(thickness)[:, None] - shift).clamp_min(TEACHER_EMPTY)
        features[there, :3] = known.harmonics(points, 1, logit)[:, 0] * K00
        network.density_grid.replace(raw.to(self.device), self._adam)
        network.feature_grid.replace(features.to(self.device), self._adam)
        network.colour_network.weights[-1].zero_()
        if self.sampler.is_open:
            self.sampler.begin_from(known, chance)
        self.sampler.settle(self.density, self.random(~0))

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """Share of each corner in one picture; see `components.sampling.importance`."""

        def lookup(points: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 1"]:
            return self.network.density_grid(self.network.space.warp(points))

        (shares,) = importance(self, camera, lookup, [self.network.density_grid.values])
        return {"network.feature_grid.values": shares[:, 0]}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Leave nothing at the least important corners."""
        gone = ~most_important(importance["network.feature_grid.values"], 1 - share)
        self.network.density_grid.values[gone] = EMPTY
        self.network.feature_grid.values[gone] = 0.0
        return importance


def point_error(look: Look, target: Float[Tensor, "ray 3"]) -> Float[Tensor, ""]:
    """sum_i w_i |c_i - C|^2 over each ray, its mean; weights are taken as they are (eq. 12)."""
    seen = composite(look.samples, look.density.detach(), look.rgb, square=look.rgb.square().sum(-1, keepdim=True))
    squares = seen.extra["square"][:, 0] - 2 * (seen.rgb * target).sum(-1)
    return (squares + seen.opacity * target.square().sum(-1)).mean()
