"""NGLOD: signed distance in a sparse octree of codes, with levels of detail (Takikawa 2021, arXiv 2101.10994)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ... import kernels
from ...camera.rays import Rays
from ...components.sampling.surface_method import SurfaceMethod
from ...components.training.row_optimizers import LazyAdam
from ...components.training.schedules import exponential_decay
from ...components.training.shape_points import PointNumbers, PointPools
from ...datasets.scene import Frame
from ...datasets.shapes import PointBatch, Shapes
from ...errors import LumigraphError
from ...files.ranges import LearningRate, NonNegative, Width, between, changed
from ...kernels.octree_cells import MAX_LEVELS, Crossed
from ...method import BaseConfig, seeded
from ...method.controls import Control
from .loops import trace
from .octree import CodeOctree

MAX_STEPS = 64  # steps of sphere tracing at most


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers; where it leaves them open, those of the published code (sdf-net/lib/options.py)."""

    points: PointNumbers = PointNumbers(near_share=0.8, near_spread=0.01, fine_spread=0.0)
    levels: Annotated[int, between(1, 8)] = 5  # levels of detail; more are finer, and four times as large each
    base_level: Annotated[int, between(1, 6)] = 2  # log2 of cells per axis of the coarsest level
    features: Annotated[int, between(1, 256)] = 32  # numbers of a corner's code, section 4
    hidden_width: Width = 128  # channels of the hidden layer of each level's decoder, section 4; wider costs time
    points_per_step: Annotated[int, between(1, 1 << 22)] = 512  # points in a step; more reduce noise, and cost time
    learning_rate: LearningRate = 1e-3  # Adam's learning rate at first
    final_learning_rate: LearningRate = 1e-3  # learning rate at the end of the budget, reached exponentially
    hit_distance: NonNegative = 3e-4  # scene units from the surface at which a ray meets it; smaller costs steps

    def check(self) -> None:
        """Raises LumigraphError for an octree deeper than rays can cross."""
        if self.base_level + self.levels - 1 > MAX_LEVELS:
            raise LumigraphError(
                f"--base-level {self.base_level} with --levels {self.levels} is deeper than {MAX_LEVELS} levels; "
                "give a smaller one"
            )


SOURCES = {  # of the numbers of `paper`; the others are ours
    "nv-tlabs/nglod, sdf-net/lib/options.py (05e15f3)": (
        "features hidden_width base_level pool_points near_share fine_spread points_per_step learning_rate"
    ),
    "nv-tlabs/nglod, sdf-net/README.md (05e15f3)": "levels",
}


class NGLOD(SurfaceMethod):
    """Learns one shape. The control `level` is the level of detail, whole or between two."""

    Config = Config
    learning_rate = exponential_decay
    rays_per_chunk = 1 << 18  # a whole picture: few samples are kept of each ray

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        with seeded(c.seed):
            self.octree = CodeOctree(1 << c.base_level, c.levels, c.features, c.hidden_width)
        self.levels = c.levels
        self.pools = PointPools("nglod", c.points, c.seed)

    @classmethod
    def cpu_preset(cls) -> Any:
        """Smaller codes and decoders, and more points in a step."""
        return changed(Config(), pool_points=300_000, near_spread=0.04, fine_spread=0.006, features=16, hidden_width=64,
            points_per_step=1 << 13, learning_rate=1e-2, final_learning_rate=5e-4, hit_distance=1e-3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        return changed(
            Config(), pool_points=4096, near_spread=0.02, levels=2, features=4, hidden_width=16, learning_rate=1e-2,
        )  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Dense indices of cells and corners, and activations that a step keeps for its gradients."""
        c = config
        indices = sum(8 << 3 * (c.base_level + level) for level in range(c.levels))
        return indices + 4 * c.points_per_step * c.levels * (c.features + c.hidden_width) * learning

    # Learning

    def begin(self, data: Shapes, seconds: float = math.inf) -> None:
        if len(data) != 1:
            raise LumigraphError(
                f"nglod learns one shape, and {data.source} holds {len(data)}; name the file of one of them"
            )
        self.pools.draw(data, 0, 1, self.random(1))  # refuses a shape without an inside
        self.octree.fill(data.members[0], self.random(2))

    def batch(self, data: Shapes, generator: torch.Generator) -> PointBatch:  # type: ignore[override]
        return self.pools.draw(data, 0, self.config.points_per_step, generator).to(self.device)

    def loss(self, batch: PointBatch, step: int) -> dict[str, Tensor]:  # type: ignore[override]
        """Squared errors of all levels, each of the points in its cells (eq. 5)."""
        signed, terms = batch.signed, {}
        for number, (held, predicted) in enumerate(self.octree.predictions(batch.points), 1):
            terms[f"level {number}"] = (predicted - signed[held]).square().sum() / len(batch)
        self.figures = {"distance error": float((predicted - signed[held]).detach().abs().mean())}
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        common: dict[str, Any] = {"lr": self.config.learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        decoders = [x for level in self.octree for x in level.decoder.parameters()]
        return [LazyAdam([level.features for level in self.octree], **common), torch.optim.Adam(decoders, **common)]

    # Levels of detail

    @property
    def controls(self) -> tuple[Control, ...]:
        most = float(self.config.levels)
        about = "Level of detail; between two whole numbers, a blend of both."
        level = [Control("level", most, range=(1.0, most), about=about)] if most > 1 else []
        return (*level, *super().controls)

    @property
    def level(self) -> tuple[int, float]:
        """The rendered level, counted from 0, and the share of the next one in it."""
        shown = float(self.control("level")) - 1 if self.config.levels > 1 else 0.0
        whole = min(int(shown), self.config.levels - 1)
        return whole, shown - whole

    def level_bytes(self, level: int) -> int:
        """Bytes of a level of detail, counted from 1."""
        return self.octree.bytes_at(level - 1)

    def distance(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Signed distance at the rendered level: (1 - alpha) d_L + alpha d_L+1 (section 3.2). Outside the cube, that of
        its nearest point plus the distance to it."""
        within = points.clamp(-1, 1)
        number, share = self.level
        found = self.octree.distance(within, number)
        if share > 0:
            found = torch.lerp(found, self.octree.distance(within, number + 1), share)
        return found + (points - within).norm(dim=-1)

    # Along rays

    def met(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 3"]]:
        """Sphere tracing within the cells that rays cross (section 3.3), skipping the space between them."""
        if self.device.type == "cpu" and not self.level[1]:
            return self._traced_by_loops(rays)
        with torch.no_grad():
            return self.with_normals(rays, self._traced(rays))

    def _traced_by_loops(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 3"]]:
        number = self.level[0]
        level, t, normals = self.octree.levels[number], torch.empty(len(rays)), torch.empty(len(rays), 3)
        _, nodes, tree = level.cells.made
        with torch.no_grad():
            tables = nodes.index.flatten(), self.octree.hidden(number), level.decoder.weights[1][0]
        given = [x.contiguous().numpy() for x in (0.5 * rays.origins + 0.5, rays.directions, tree.cells, tree.rows)]
        near, hit = np.float32(0.5 * self.frame.near), np.float32(0.5 * self.config.hit_distance)
        found = [x.numpy() for x in (t, normals)]
        trace(*given, tree.depth, near, *(x.detach().numpy() for x in tables), hit, MAX_STEPS, *found)
        return 2 * t, normals

    def _traced(self, rays: Rays) -> Float[Tensor, " ray"]:
        """Distances to the surface along rays, by tensors."""
        c, tree = self.config, self.octree.levels[self.level[0]].cells.made[2]
        origins, nothing = (0.5 * rays.origins + 0.5).contiguous(), torch.zeros(tree.count, device=self.device)
        found = kernels.octree_cells(origins, rays.directions.contiguous(), tree, nothing, 0.5 * self.frame.near)
        spans = Spans(found)
        t = torch.full((len(rays),), torch.inf, device=self.device)
        row = (found.ray_starts.diff() > 0).nonzero()[:, 0]
        place = 2 * found.t_start[found.ray_starts[row]]
        before, ahead = place, torch.zeros_like(place)  # 0: no value in front of it
        for _ in range(MAX_STEPS):
            if not len(row):
                break
            value = self.distance(rays[row].at(place))
            met = value < c.hit_distance
            share = torch.where(ahead > 0, ahead / (ahead - value).clamp_min(1e-9), 1.0)
            t[row[met]] = torch.where(value < 0, before + share * (place - before), place)[met]
            before, ahead = place, value
            place, inside, jumped = spans.enter(row, place + value.clamp_min(c.hit_distance))
            ahead = torch.where(jumped, 0.0, ahead)
            stays = ~met & inside
            row, place, before, ahead = row[stays], place[stays], before[stays], ahead[stays]
        return t


class Spans:
    """Intervals of rays in cells, with lookup at any distance."""

    def __init__(self, found: Crossed):
        self.start, self.end, self.ray_starts = 2 * found.t_start, 2 * found.t_end, found.ray_starts
        ray = found.samples.ray_index
        self.apart = 2 * float(self.end.max()) + 1 if len(self.end) else 1.0  # from one ray's keys to the next one's
        self.keys = self.end.double() + self.apart * ray.double()

    def enter(self, row: Int[Tensor, " ray"], t: Float[Tensor, " ray"]) -> tuple[Float[Tensor, " ray"], Tensor, Tensor]:
        """The first point at or behind t in an interval of each ray, whether there is one, and whether it is farther
        than t."""
        number = torch.searchsorted(self.keys, t.double().clamp(max=self.apart) + self.apart * row.double())
        inside = number < self.ray_starts[row + 1]
        start = self.start[number.clamp(max=len(self.start) - 1)]
        return torch.where(inside, t.maximum(start), t), inside, inside & (start > t)
