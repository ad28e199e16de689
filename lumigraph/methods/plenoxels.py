"""Plenoxels: a sparse grid of density and harmonics, no network (Fridovich-Keil and Yu 2022, arXiv 2112.05131)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..camera import Camera
from ..components.clouds.dense_points import compile_sweep
from ..components.fields.sparse_voxels import Cells, Part, SparseVoxels
from ..components.fields.taken_over import logit, taken_over
from ..components.sampling.carving import visual_hull
from ..components.sampling.importance import importance
from ..components.sampling.occupancy import OccupancyGrid
from ..components.sampling.spaces import NDC, space_of
from ..components.sampling.unbounded import RAYS, OpenNumbers, Unbounded, rays_of, unbounded
from ..components.training.corrections import Setting
from ..components.training.exposed import Exposed
from ..components.training.lazy_rmsprop import LazyRMSprop
from ..components.training.photometric import backdrop, residuals
from ..components.training.schedules import falling
from ..components.training.sparsity import cauchy
from ..errors import LumigraphError
from ..kernels import total_variation
from ..kernels.harmonic_grid import BANDS
from ..method import RayMethod
from ..packing import Stored, most_important
from ..ranges import BatchSize, LearningRate, NonNegative, Positive, PositiveShare, Seed, Share, Steps, between
from ..rays import Look, Rays, Rendering, Samples
from ..scene import Batch, Frame, Scene
from ..volume import composite, weights_of

Resolution = Annotated[int, between(4, 1024)]
DensityRate = Annotated[float, between(1e-6, 1e4)]


@dataclass(frozen=True)
class Config(OpenNumbers):
    """The paper's numbers for synthetic scenes (section 3, and the authors' release); `Plenoxels.preset` says what a
    plain CPU does otherwise."""

    base_resolution: Resolution = 256  # voxels per axis at first, section 3.3
    max_resolution: Resolution = 512  # and in the end, doubled in between
    open_base_resolution: Resolution = 128  # the same where there is no bound, the release's
    open_max_resolution: Resolution = 640
    refine_until: Share = 0.3  # share of the budget at which the grid is as fine as it gets
    step_size: Annotated[float, between(0.05, 4)] = 0.5  # of samples along a ray, in voxels
    initial_density: Positive = 0.1  # per unit of coordinates
    transmittance_threshold: Share = 1e-4  # at which a ray is spent
    weight_threshold: Share = 5e-3  # of a sample in a picture, below which its voxel is pruned, section 3.3
    occupancy_resolution: Annotated[int, between(4, 512)] = 256  # cells per axis of the grid that rays march through
    occupancy_threshold: NonNegative = 1e-2  # optical thickness across a cell below which it is skipped
    occupancy_interval: Steps = 64  # steps between updates of the occupancy grid
    rays_per_step: BatchSize = 5000  # section 4; at most
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 20  # that these may meet where there is no bound
    density_learning_rate: DensityRate = 30.0  # per unit of coordinates, of 256 voxels per axis; in proportion to them
    final_density_learning_rate: DensityRate = 0.05
    density_delay: Share = 0.12  # share of the budget in which the density's learning rate comes up to that
    harmonics_learning_rate: LearningRate = 1e-2
    final_harmonics_learning_rate: LearningRate = 5e-6
    tv_density: NonNegative = 1e-5  # weight of the density's total variation, eq. 3
    tv_harmonics: NonNegative = 1e-3
    open_tv_density: NonNegative = 5e-4  # the same where there is no bound, the release's
    open_tv_harmonics: NonNegative = 5e-3
    tv_share: PositiveShare = 0.01  # of the nodes that a step touches: those that total variation looks at
    tv_interval: Steps = 1  # steps from one look at it to the next
    sparsity: NonNegative = 1e-11  # weight of the densities' Cauchy loss, eq. 4
    beta: NonNegative = 0.0  # weight of the loss of opacities between 0 and 1, eq. 5; for captures without alpha
    exposure_correction: Setting = "auto"  # learn a gain per photograph; auto: where they are found to differ
    seed: Seed = 0

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


DELAYED = 0.01  # what the density's learning rate begins with, as a share
REMEMBERED = 0.9  # of a cell's density and a voxel's weight, from one look of the occupancy grid to the next
NOTED = 4  # steps between those whose samples' weights are remembered for pruning
LEAST = 1e-2  # density of a node at least, where another method is taken over: what is not above 0 learns nothing
EDGE = 1e-3  # opacities are kept so far from 0 and 1 in the beta loss


class Plenoxels(Exposed, RayMethod):  # type: ignore[override]  # what is accepted
    """Rays are sampled in occupied cells; a first pass looks up density alone, and what light reaches is looked up once
    more, with colour. Values belong to the nodes of a grid over the coordinates of a `Space`: an object as it is, a
    forward-facing capture in normalised device coordinates, anything else contracted into a ball."""

    Config = Config
    rays_per_step: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame)
        first, _ = config.resolutions(frame.reach > 1)
        self.voxels = SparseVoxels(cells_of(frame, first), config.initial_density)
        self.occupancy = OccupancyGrid(1.0, config.occupancy_resolution)
        self.expose(frame, config.exposure_correction)
        self.unbounded, rays = unbounded(frame, self.space, config), config.rays_per_step
        if self.unbounded:
            self.rays_per_chunk, rays = RAYS, min(rays, rays_of(config.samples_per_step, config))
        self.register_buffer("rays_per_step", torch.tensor(rays))
        self._touched: tuple[Tensor, Part]
        self._table: LazyRMSprop | None = None

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU, what learns most in a minute."""
        if device.type == "cuda":
            return Config()
        return Config(
            base_resolution=128,
            max_resolution=192,
            open_base_resolution=64,
            open_max_resolution=192,
            occupancy_resolution=128,
            rays_per_step=4096,
            samples_per_step=1 << 16,
            refine_until=0.4,
            step_size=1.0,
            transmittance_threshold=1e-3,
            occupancy_threshold=0.02,
            occupancy_interval=16,
            density_learning_rate=40.0,
            final_density_learning_rate=4.0,
            density_delay=0.2,
            harmonics_learning_rate=0.15,
            final_harmonics_learning_rate=0.02,
            tv_share=0.1,
            tv_interval=8,
            sparsity=0.0,
        )

    @classmethod
    def smallest(cls) -> Any:
        """A grid of three sizes with every loss, within some twenty quick steps."""
        return Config(
            base_resolution=8,
            max_resolution=32,
            open_base_resolution=8,
            open_max_resolution=32,
            refine_until=0.5,
            step_size=1.0,
            occupancy_resolution=16,
            occupancy_interval=4,
            rays_per_step=128,
            density_delay=0.1,
            density_learning_rate=60.0,
            final_density_learning_rate=10.0,
            harmonics_learning_rate=0.2,
            final_harmonics_learning_rate=0.05,
            tv_share=0.5,
            tv_interval=2,
            sparsity=1e-5,
            beta=1e-4,
            exposure_correction="yes",
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        _, last = config.resolutions(frame.reach > 1)
        grown = SparseVoxels.bytes_of(cells_of(frame, last), learning)
        return grown + OccupancyGrid.bytes_of(1.0, config.occupancy_resolution) + Unbounded.bytes_of(frame, learning)

    def rays_in_a_step(self, data: Scene) -> float:
        return int(self.rays_per_step)

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        return data.sample_rays(int(self.rays_per_step), generator).to(self.device)

    # Being seen

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        (look,) = self.looks(rays)
        return composite(look.samples, look.density, look.rgb, background)

    def looks(self, rays: Rays) -> list[Look]:
        if self.unbounded:
            return [self.unbounded.look(self.field, rays)]
        samples, _ = self._reached(rays)
        return [Look("samples", samples, *self.field(*samples.along(rays)))]

    def _reached(
        self, rays: Rays, jitter: Float[Tensor, " ray"] | None = None
    ) -> tuple[Samples, Float[Tensor, " sample"]]:
        """The samples of rays that light reaches and that are not clear, and how much each weighs in a picture."""
        step = self.config.step_size * 2 / int(self.voxels.cells.amax())
        found = self.occupancy.sample(rays, self.frame.near, step, jitter=jitter)
        with torch.no_grad():  # a lookup of density is so quick that all are asked about at once
            density = self.density(found.along(rays)[0])
            weights = weights_of(found, density, self.config.transmittance_threshold)
        seen = weights > 0
        samples = found.keep(seen)
        self.figures |= {"rays": len(rays), "samples": len(found), "visible_samples": len(samples)}
        return samples, weights[seen]

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        density, rgb = self._field(points, directions, self.voxels)
        return density, self.exposed(rgb)

    def _field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"], voxels: SparseVoxels | Part
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        density, rgb = voxels.at(self.space.warp(points), directions)
        return density.relu() * self.space.stretch(points), rgb.sigmoid()

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self._density(self.space.warp(points)) * self.space.stretch(points)

    def _density(self, places: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per unit of coordinates."""
        return self.voxels.density_at(places).relu()

    def storage(self) -> dict[str, Stored]:
        """Harmonics by a codebook, density as whole numbers; of the grid, marks alone are needed for pictures."""
        return {
            "voxels.density": Stored("scaled"),
            "voxels.harmonics": Stored("coded"),
            "voxels.weights": Stored("nothing"),
            "occupancy.density": Stored("nothing"),
            "occupancy.possible": Stored("nothing", fill=1.0),
            **(self.unbounded.storage() if self.unbounded else {}),
        }

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """How much each voxel adds to one picture; see `components.sampling.importance`."""

        def lookup(points: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 1"]:
            return self.voxels.density_at(self.space.warp(points))[:, None]

        (shares,) = importance(self, camera, lookup, [self.voxels.density])
        return {"voxels.harmonics": shares[:, 0]}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Leave the least important voxels out."""
        weights = importance["voxels.harmonics"]
        kept = most_important(weights, 1 - share)
        self.voxels.keep(kept)
        return {"voxels.harmonics": weights[kept]}

    # Learning

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        self.tell_exposed(scene)
        if scene.images.has_alpha and self.frame.reach == 1:
            hull = visual_hull(scene, self.config.occupancy_resolution)
            self.occupancy.rule_out(hull[None])
            self.voxels.rebuild(hull, self.cells, self._table)
        if self.unbounded:
            self.unbounded.begin(scene, seconds, self.random(1))

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Density and harmonics of the teacher at the finest grid's nodes, where it holds something."""
        known, c, chance = taken_over(teacher, cameras), self.config, self.random(3)
        occupied = known.occupied(self.space, c.occupancy_resolution, c.occupancy_threshold, chance)
        cells = cells_of(self.frame, c.resolutions(self.frame.reach > 1)[1])
        self.voxels.rebuild(occupied.to(self.device), cells, self._table)
        points = self.space.unwarp(self.voxels.places.cpu())
        stretch = self.space.stretch(points)
        density = known.density_around(points, 2 / max(cells) / stretch, chance) / stretch
        self.voxels.density.copy_(density.clamp_min(LEAST)[:, None])
        dense = self.voxels.dense(c.occupancy_threshold * max(cells) / 2)
        self.voxels.rebuild(dense, cells, self._table)
        points = self.space.unwarp(self.voxels.places.cpu())
        self.voxels.harmonics.copy_(known.harmonics(points, BANDS, logit).flatten(1))
        if self.unbounded:
            self.unbounded.begin_at(known.surface.points, known.surface.origins)
        else:
            self.occupancy.update(self.density, c.occupancy_threshold, chance)

    def rehearse_begin(self) -> None:
        if self.unbounded:
            compile_sweep()

    @property
    def cells(self) -> Cells:
        x, y, z = self.voxels.cells.tolist()
        return x, y, z

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        config, generator = self.config, self.random(step)
        jitter = torch.rand(len(batch), 2 if self.unbounded else 1, generator=generator).to(self.device)
        further = dict[str, Tensor]()
        if self.unbounded:
            look, proposed = self.unbounded.learn(self._learnt, batch.rays, jitter)
            rows, part = self._touched
            further = self.unbounded.terms(self.density, proposed, look.density, generator)
            self.figures |= {"rays": len(batch), "samples": len(look.samples)}
        else:
            samples, weights = self._reached(batch.rays, jitter[:, 0])
            points, directions = samples.along(batch.rays)
            if step % NOTED == 0:
                self.voxels.note(self.space.warp(points), weights)
            look = Look("samples", samples, *self._learnt(points, directions))
            rows, part = self._touched
        background = backdrop(batch, self.background, generator, self.frame.reach > 1)
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background, self.gains)
        self.figures |= {"voxels": len(self.voxels), "touched": len(rows)}
        terms = {"colour": residual.square().mean(), **further}
        if config.sparsity:
            terms["sparsity"] = config.sparsity * cauchy(look.density, len(batch))
        if step % config.tv_interval == 0:
            drawn = torch.rand(len(rows), generator=generator).to(rows.device) < config.tv_share
            chosen = self.voxels.numbers[rows[drawn]].long()
            open_ = config.open_tv_density, config.open_tv_harmonics
            variations = open_ if self.frame.reach > 1 else (config.tv_density, config.tv_harmonics)
            for name, weight in zip(("density", "harmonics"), variations, strict=True):
                if weight:
                    terms[f"tv_{name}"] = weight * total_variation(chosen, part.nodes, getattr(part, name))
        if config.beta and batch.alpha is None:
            terms["beta"] = config.beta * undecided(rendering.opacity)
        return terms

    def _learnt(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """`field` of the rows that points touch alone, which are remembered: gradients of the others are not made."""
        rows = self.voxels.touched(self.space.warp(points))
        self._touched = rows, self.voxels.part(rows)
        return self._field(points, directions, self._touched[1])

    def optimizers(self) -> list[torch.optim.Optimizer]:
        density = {"params": [self.voxels.density], "name": "density"}
        harmonics = {"params": [self.voxels.harmonics], "name": "harmonics"}
        self._table = LazyRMSprop([density, harmonics])
        optimizers: list[torch.optim.Optimizer] = [self._table]
        if self.exposure:
            gains = {"params": [*self.exposure.parameters()], "name": "harmonics", "scale": 0.05}
            optimizers.append(torch.optim.Adam([gains]))
        return [*optimizers, self.unbounded.optimizer()] if self.unbounded else optimizers

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        """Exponential decay; the density's rate comes up slowly at first (the release's delayed rates). It is in
        proportion to the resolution, for it is density times a voxel's size that stops light."""
        c, share = self.config, self._resolution(progress) / 256
        up = math.sin(0.5 * math.pi * min(1.0, progress / c.density_delay)) if c.density_delay else 1.0
        density = c.density_learning_rate, c.final_density_learning_rate
        return {
            "density": share * (DELAYED + (1 - DELAYED) * up) * falling(*density, progress),
            "harmonics": falling(c.harmonics_learning_rate, c.final_harmonics_learning_rate, progress),
            "proposal": Unbounded.rate(progress),
        }

    def before_step(self, step: int, progress: float) -> None:
        c = self.config
        wanted = cells_of(self.frame, self._resolution(progress))
        finer = wanted > self.cells
        if finer:
            self.voxels.rebuild(self._kept(), wanted, self._table)
            self.occupancy.density.zero_()
        if step % c.occupancy_interval == 0:
            self.voxels.weights *= REMEMBERED
        if self.unbounded:
            self.unbounded.before_step(progress)
        elif finer or (step and step % c.occupancy_interval == 0):
            self.occupancy.update(self.density, c.occupancy_threshold, self.random(~step), REMEMBERED)

    def _kept(self) -> Bool[Tensor, "x y z"]:
        """Cells that are not pruned. Where there is no bound, a step's few long rays leave most nodes without a known
        weight; there a voxel goes that would stop less light than the threshold, as in the release."""
        least = self.config.weight_threshold
        if self.frame.reach <= 1:
            return self.voxels.important(least)
        return self.voxels.dense(least * int(self.voxels.cells.amax()) / 2)

    def _resolution(self, progress: float) -> int:
        """Voxels per axis at a share of the budget: doubled at equal intervals up to `refine_until`."""
        c = self.config
        first, last = c.resolutions(self.frame.reach > 1)
        doublings = math.ceil(math.log2(last / first))
        done = doublings if progress >= c.refine_until else int(doublings * progress / c.refine_until)
        return min(first << done, last)


def cells_of(frame: Frame, resolution: int) -> Cells:
    """Voxels along each axis. A forward-facing capture has few depths and many pixels."""
    if isinstance(space_of(frame), NDC):
        return resolution + resolution // 2, resolution + resolution // 2, resolution // 2
    return resolution, resolution, resolution


def undecided(opacity: Float[Tensor, " ray"]) -> Tensor:
    """Mean of log(T) + log(1 - T), which is least where light passes wholly or not at all (eq. 5)."""
    light = (1 - opacity).clamp(EDGE, 1 - EDGE)
    return (light.log() + (1 - light).log()).mean()
