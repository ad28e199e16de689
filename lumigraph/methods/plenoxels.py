"""Plenoxels: a sparse grid of density and harmonics, without any network (Fridovich-Keil and Yu 2022, arXiv 2112.05131)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..components.fields.sparse_voxels import Part, SparseVoxels
from ..components.sampling.carving import visual_hull
from ..components.sampling.occupancy import OccupancyGrid
from ..components.sampling.spaces import NDC, space_of
from ..components.training.lazy_rmsprop import LazyRMSprop
from ..components.training.schedules import falling
from ..errors import LumigraphError
from ..kernels import total_variation
from ..method import RayMethod
from ..ranges import BatchSize, NonNegative, Positive, PositiveShare, Seed, Share, Steps, between
from ..rays import Look, Rays, Rendering, Samples
from ..scene import Batch, Frame, Scene
from ..volume import composite, weights_of

Resolution = Annotated[int, between(4, 1024)]


@dataclass(frozen=True)
class Config:
    """The paper's numbers for bounded scenes (section 3, appendix A, and the authors' release); `Plenoxels.preset` says
    what a plain CPU does otherwise."""

    base_resolution: Resolution = 256  # voxels per axis at first
    max_resolution: Resolution = 512  # in the end; doubled in between
    refine_at: Share = 0.35  # share of the budget at which the grid is as fine as it gets
    step_size: Annotated[float, between(0.05, 4)] = 0.5  # of samples along a ray, in voxels
    initial_density: Positive = 0.1  # per unit of coordinates
    transmittance_threshold: Share = 1e-4  # at which a ray is spent
    weight_threshold: Share = 0.005  # of a sample in a picture, below which its voxel is pruned
    occupancy_resolution: Annotated[int, between(4, 512)] = 256  # of the grid that rays march through
    occupancy_threshold: NonNegative = 1e-3  # optical thickness across a cell below which it is skipped
    occupancy_interval: Steps = 64  # steps between updates of the occupancy grid
    rays_per_step: BatchSize = 5000
    density_learning_rate: Annotated[float, between(0, 1e4)] = 30.0
    final_density_learning_rate: Annotated[float, between(0, 1e4)] = 0.05
    density_delay: Share = 0.06  # share of the budget in which the density's learning rate rises
    harmonics_learning_rate: Annotated[float, between(0, 10)] = 1e-2
    final_harmonics_learning_rate: Annotated[float, between(0, 10)] = 5e-6
    tv_density: NonNegative = 1e-5
    tv_harmonics: NonNegative = 1e-3
    tv_share: PositiveShare = 0.01  # of the nodes, drawn for each step
    tv_until: Share = 1.0  # share of the budget after which total variation is left alone
    sparsity: NonNegative = 1e-11  # weight of the Cauchy loss of densities
    beta: NonNegative = 0.0  # weight of the loss that opacities are 0 or 1
    seed: Seed = 0

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.base_resolution > self.max_resolution:
            raise LumigraphError(
                f"A grid cannot begin finer than it ends: --base-resolution {self.base_resolution:,} is above "
                f"--max-resolution {self.max_resolution:,}"
            )


class Plenoxels(RayMethod):
    """Rays are sampled in occupied cells; a first pass looks up density alone, and what light reaches is looked up once
    more, with colour."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame)
        self.voxels = SparseVoxels(self.cells_of(config.base_resolution), config.initial_density)
        self.occupancy = OccupancyGrid(frame.reach, config.occupancy_resolution)
        self._optimizer: LazyRMSprop | None = None

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        if device.type == "cuda":
            return Config()
        return Config(
            base_resolution=128,
            max_resolution=256,
            occupancy_resolution=128,
            rays_per_step=4096,
            density_learning_rate=30.0,
            final_density_learning_rate=1.0,
            harmonics_learning_rate=0.1,
            final_harmonics_learning_rate=0.01,
        )

    def cells_of(self, resolution: int) -> tuple[int, int, int]:
        return (resolution, resolution, resolution)

    # What is seen

    def render_rays(
        self, rays: Rays, background: Float[Tensor, "#ray 3"], jitter: Float[Tensor, " ray"] | None = None
    ) -> Rendering:
        (look,) = self.looks(rays, jitter)
        return composite(look.samples, look.density, look.rgb, background)

    def looks(self, rays: Rays, jitter: Float[Tensor, " ray"] | None = None) -> list[Look]:
        samples, places = self._seen(rays, jitter)
        density, rgb = self._field(self.voxels, places, rays.directions[samples.ray_index])
        return [Look("samples", samples, density, rgb)]

    @torch.no_grad()
    def _seen(self, rays: Rays, jitter):
        step = self.config.step_size * 2 / int(self.voxels.cells[0])
        found = self.occupancy.sample(rays, self.frame.near, step, 0.0, jitter=jitter)
        places, _ = found.along(rays)
        tau = self.density(places) * found.length
        weights = __import__("lumigraph").kernels.composite(tau, tau[:, None], found.ray_starts, self.config.transmittance_threshold)[2]
        keep = weights > 0
        self.figures |= {"samples": len(found), "visible_samples": int(keep.sum()), "rays": len(rays)}
        if self.training:
            self.voxels.note(places[keep], weights[keep])
        return found.keep(keep), places[keep]

    def _field(self, table, places, directions):
        density, rgb = table.at(places, directions)
        return density.relu(), COLOUR(rgb)

    def density(self, points):
        return self.voxels.density_at(points).relu()

    def field(self, points, directions):
        return self._field(self.voxels, points, directions)

    # Learning

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        if scene.images.has_alpha and self.frame.reach == 1:
            hull = visual_hull(scene, self.config.occupancy_resolution)
            self.occupancy.rule_out(hull[None])
            self.voxels.rebuild(hull, tuple(self.voxels.cells.tolist()), self._optimizer)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator = self.random(step)
        rays, config = batch.rays, self.config
        jitter = torch.rand(len(batch), generator=generator)
        background = self.background
        if batch.alpha is not None:
            background = torch.rand(len(batch), 3, generator=generator)
        samples, places = self._seen(rays, jitter)
        rows = self.voxels.touched(places)
        part = self.voxels.part(rows)
        density, rgb = self._field(part, places, rays.directions[samples.ray_index])
        seen = composite(samples, density, rgb, background)
        residual = seen.rgb - batch.before(background)
        self.figures["mse"] = float(residual.detach().square().mean())
        if batch.alpha is not None:
            lacking = (batch.alpha - seen.opacity)[:, None]
            residual = torch.cat([residual, residual + lacking * (1 - 2 * background)])
        terms = {"colour": residual.square().mean()}
        chosen = self.voxels.numbers[rows[torch.rand(len(rows), generator=generator) < config.tv_share]].long()
        if config.tv_density: terms["tv_density"] = config.tv_density * total_variation(chosen, part.nodes, part.density)
        if config.tv_harmonics: terms["tv_harmonics"] = config.tv_harmonics * total_variation(chosen, part.nodes, part.harmonics)
        self.figures["rows"], self.figures["touched"] = len(self.voxels), len(rows)
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        groups = [
            {"params": [self.voxels.density], "name": "density"},
            {"params": [self.voxels.harmonics], "name": "harmonics"},
        ]
        self._optimizer = LazyRMSprop(groups)
        return [self._optimizer]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c = self.config
        delay = 0.01 + 0.99 * math.sin(0.5 * math.pi * min(1.0, progress / max(c.density_delay, 1e-9)))
        return {
            "density": delay * falling(c.density_learning_rate, c.final_density_learning_rate, progress),
            "harmonics": falling(c.harmonics_learning_rate, c.final_harmonics_learning_rate, progress),
        }

    def before_step(self, step: int, progress: float) -> None:
        c = self.config
        if progress >= c.refine_at and int(self.voxels.cells[0]) < c.max_resolution:
            kept = self.voxels.important(c.weight_threshold)
            self.voxels.rebuild(kept, self.cells_of(c.max_resolution), self._optimizer)
            self.occupancy.density.zero_()
            self.occupancy.update(self.density, c.occupancy_threshold, self.random(~step))
        elif step and step % c.occupancy_interval == 0:
            self.occupancy.update(self.density, c.occupancy_threshold, self.random(~step), 0.9)


COLOUR = torch.sigmoid
