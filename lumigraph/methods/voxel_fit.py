"""Voxel fitting: soft occupancy and colour of voxels, fitted to photographs by gradients; a first mesh for mesh-fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import binary_fill_holes, gaussian_filter
from torch import Tensor, nn

from ..components.fields.level_set import level_set
from ..components.fields.spaces import space_of
from ..components.fields.voxels import VoxelGrid
from ..components.sampling.occupancy_sampler import GridSchedule, OccupancyNumbers, OccupancySampler
from ..components.training.photometric import backdrop
from ..components.training.row_optimizers import LazyAdam
from ..components.training.schedules import falling
from ..datasets.mesh import Mesh
from ..datasets.scene import Batch, Frame, Scene
from ..errors import LumigraphError
from ..files.ranges import LearningRate, between, changed
from ..method import BaseConfig, Field, FieldMethod
from ..method.field import Colours, Densities, Directions, Points
from ..volume import composite

Voxels = Annotated[int, between(8, 1 << 28)]
GROWING_SHARE = 0.5  # share of the budget in which they happen
INITIAL_OPACITY = 0.01  # share of light that a voxel stops at first; higher is harder to clear
MASK_WEIGHT = 0.1  # of the silhouettes' squared error
ENTROPY_WEIGHT = 1e-3  # of rays' entropy of opacity; larger makes voxels full or empty
VARIATION_WEIGHT = 1e-5  # of total variation; larger is smoother


@dataclass(frozen=True)
class Config(BaseConfig):
    """Numbers of a small grid: no paper's. Voxels and opacity at first are those of Sun 2022."""

    occupancy: OccupancyNumbers = OccupancyNumbers(
        samples_per_step=1 << 18, transmittance_threshold=1e-3, occupancy_threshold=0.05
    )
    first_voxels: Voxels = 64**3  # voxels at first; fewer are faster, and find the shape sooner
    voxels: Voxels = 160**3  # voxels in the end; more show more detail, and cost memory and time
    doublings: Annotated[int, between(0, 20)] = 4  # times that voxels grow in number, at even shares of the budget
    step_size: Annotated[float, between(0.05, 4)] = 0.5  # of samples, in voxels; larger is faster, and coarser
    learning_rate: LearningRate = 0.3  # of the grid; larger is faster, and noisier
    final_learning_rate: LearningRate = 0.03  # at the end of the budget


SOURCES = {  # of the numbers of `paper`; the others are ours
    "sunset1995/DirectVoxGO, configs/default.py (341e1fc)": "voxels initial_opacity step_size",
}


MAX_SMOOTHED = 1 << 12  # voxels of a step whose variation counts
MESH_BLUR = 0.6  # voxels of deviation by which occupancy is smoothed for a mesh
CLEAR = 3.0  # logits beyond which a voxel is as good as full, or empty


class SoftVoxels(Field):
    """A grid of logits: opacity and view-independent colour of each voxel.

        alpha = sigmoid(v_0)      density = -log(1 - alpha) / edge = softplus(v_0) / edge      rgb = sigmoid(v_1..3)

    edge: of a voxel at the final resolution, so that the same logits mean the same density at every resolution
    """

    cheap_density: ClassVar[bool] = True

    def __init__(self, config: Config, frame: Frame):
        super().__init__()
        self.config = config
        self.grid = VoxelGrid([list(corner) for corner in frame.bounds], config.first_voxels, 4)
        self.shift = math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))
        volume = math.prod(high - low for low, high in zip(*frame.bounds, strict=True))
        self.edge = (volume / config.voxels) ** (1 / 3)

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Float[Tensor, "point 3"]]:
        values = self.grid(points)
        return nn.functional.softplus(values[:, 0] + self.shift) / self.edge, values[:, 1:]

    def colour(self, features: Float[Tensor, "point 3"], directions: Directions, code: Tensor | None = None) -> Colours:
        return features.sigmoid()

    @property
    def step_length(self) -> float:
        return self.config.step_size * self.grid.edge


class VoxelFit(FieldMethod):
    """Voxels in the box of interest: trained, upsampled and meshed."""

    Config = Config
    network: SoftVoxels
    sampler: OccupancySampler
    doubled: Tensor  # times so far

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.network = SoftVoxels(c, frame)
        self.sampler = OccupancySampler(frame, space_of(frame), c.occupancy, GridSchedule(begins=0.02, early_steps=0))
        self.register_buffer("doubled", torch.tensor(0))
        self._adam: LazyAdam | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        return changed(Config(), samples_per_step=1 << 17, occupancy_threshold=0.1, first_voxels=48**3, voxels=112**3,
            doublings=3, step_size=0.8)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Some thousand voxels that double once."""
        return changed(Config(), samples_per_step=4096, occupancy_resolution=16, first_voxels=12**3, voxels=20**3,
            doublings=1, learning_rate=0.5, final_learning_rate=0.2, transmittance_threshold=0.0001)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """The finest grid; while it learns also its gradient and two moments."""
        return super().further_bytes(frame, config, learning) + 16 * config.voxels * (4 if learning else 1)

    # Learning

    def check_data(self, data: Scene) -> None:
        if data.frame.is_open:
            raise LumigraphError(
                "voxel-fit fills the box of interest alone, and this capture goes on to the horizon; train dvgo, or "
                "cut out the photographs' object and give them an alpha channel"
            )

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Squared errors of colours and silhouettes, entropy of opacity, total variation."""
        generator = self.random(step)
        (samples,), terms = self.learn(batch.rays, generator)
        look = samples.look(self.network)
        background = backdrop(batch, self.background, generator)
        seen = composite(look.samples, look.density, look.rgb, background)
        error = (seen.rgb - batch.before(background)).square().mean()
        self.figures["mse"] = float(error.detach())
        terms |= {"colour": error}
        if batch.alpha is not None:
            terms["mask"] = MASK_WEIGHT * (seen.opacity - batch.alpha).square().mean()
        a = seen.opacity.clamp(1e-6, 1 - 1e-6)
        terms["entropy"] = ENTROPY_WEIGHT * -(a * a.log() + (1 - a) * (1 - a).log()).mean()
        if len(look.samples):
            points, _ = look.samples.along(batch.rays)
            terms["variation"] = VARIATION_WEIGHT * self.network.grid.variation(points, MAX_SMOOTHED, generator)
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        self._adam = LazyAdam([{"params": [self.network.grid.values], "name": "grid"}], betas=(0.9, 0.99))
        return [self._adam, *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        return {"grid": falling(self.config.learning_rate, self.config.final_learning_rate, progress)}

    def before_step(self, step: int, progress: float) -> None:
        """Double the number of voxels at even shares of the budget."""
        c, grid = self.config, self.network.grid
        due = min(c.doublings, int(progress / GROWING_SHARE * (c.doublings + 1)))
        if due > int(self.doubled):
            grid.rebuild(
                grid.box, round(c.first_voxels * (c.voxels / c.first_voxels) ** (due / c.doublings)), self._adam
            )
            self.doubled.fill_(due)
            self.sampler.stale = True
        super().before_step(step, progress)

    # As a mesh

    @torch.no_grad()
    def mesh(self) -> Mesh:
        """The surface between voxels with alpha above and below one half, with colours. Raises LumigraphError if
        there is none."""
        grid = self.network.grid
        values = (grid.values[:, 0] + self.network.shift).view(grid.shape).cpu().numpy().clip(-CLEAR, CLEAR)
        values[binary_fill_holes(values > 0) & (values <= 0)] = CLEAR  # what no camera sees is solid
        values = gaussian_filter(values, MESH_BLUR)
        if not (values > 0).any():
            raise LumigraphError("No voxel stops half of the light, so there is no surface; train for longer")
        low, high = grid.box.cpu().double().numpy()
        made = level_set(values, low, (high - low) / (np.array(grid.shape) - 1))
        points = torch.from_numpy(made.vertices).float().to(self.device)
        rgb = (grid(points)[:, 1:].sigmoid() * 255).round().to(torch.uint8)
        return replace(made, colours=rgb.cpu().numpy())
