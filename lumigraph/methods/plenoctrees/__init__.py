"""PlenOctrees: density and harmonics, baked into an octree and tuned there (Yu et al. 2021, arXiv 2103.14024)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rays, Rendering
from ...components.fields.hash_field import CPU_LEVELS, TINY_LEVELS, TableNumbers
from ...components.fields.spaces import Box
from ...components.fields.teacher import density_of, logit, teacher_of
from ...components.sampling.occupancy_sampler import NGP_SCHEDULE, OccupancyNumbers, OccupancySampler, StepNumbers
from ...components.training.photometric import backdrop, residuals
from ...components.training.row_optimizers import LazyRMSprop
from ...components.training.schedules import falling, hold_and_decay
from ...datasets.scene import Batch, Frame, Scene
from ...errors import LumigraphError
from ...exchange.baked import Octree
from ...exchange.packing import most_important
from ...files.ranges import (
    BatchSize,
    LearningRate,
    NonNegative,
    Share,
    Width,
    between,
    changed,
)
from ...method import BaseConfig, Field, FieldMethod, Sampler, seeded
from ...method.capabilities import HasField, HasLooks, can
from ...volume import composite, weights_of
from .baking import Baking, averaged_harmonics, bake, fill, met
from .harmonic_field import HarmonicHash, HarmonicNetwork, HarmonicTeacher
from .leaves import LeafSampler, Leaves, ask_for_octree

DEPTH = 8  # hidden layers of the network, as in NeRF
POSITION_FREQUENCIES = 10  # octaves of positions of the network
HIDDEN_LAYERS = 2  # hidden layers after the hash table
SPARSITY_LENGTH = 0.05  # lambda of eq. 4: scene units over which that density absorbs light
WEIGHT_THRESHOLD = 1e-3  # least weight of a leaf on some ray, section 4.1


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, with where it or its release gives them; `PlenOctrees.preset` has those of a plain CPU."""

    table: TableNumbers = TableNumbers()
    occupancy: OccupancyNumbers = OccupancyNumbers(transmittance_threshold=0.01)  # of all stages; section 4.2
    field: Literal["hash", "network"] = "network"  # first field: the paper's network, or a faster hash table
    hidden_width: Width = 256  # channels of a hidden layer, of either field; wider costs memory and time
    sh_bands: Annotated[int, between(1, 4)] = 4  # spherical-harmonics bands, section 5.1: 4 have 16 coefficients
    sparsity_weight: NonNegative = 1e-3  # weight of density at random points, eq. 4; higher empties more; the release's
    sparsity_points: Annotated[int, between(1, 1 << 20)] = 10_000  # K, random points of eq. 4; more cost time
    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 1024  # samples across the cube's diagonal, first stage
    learning_rate: LearningRate = 5e-4  # the field's learning rate at first, section 5.1; higher may diverge
    final_learning_rate: LearningRate = 5e-6  # learning rate of the field at the end of the first stage, the release's
    decay_start: Annotated[float, between(0, 0.99)] = 0.0  # share of the first stage before that rate falls
    teacher_share: Share = 0.9  # share of the budget after which the field is baked; the leaves have the rest
    octree_depth: Annotated[int, between(1, 10)] = 9  # levels of the octree, section 4.1, to a pixel's size at most
    leaf_points: Annotated[int, between(1, 4096)] = 256  # points of a leaf that are averaged, section 4.1
    rays_per_step: BatchSize = 4096  # rays in a step of the last stage; more reduce noise, and cost time


SOURCES = {  # of the numbers of `paper`; the others are ours
    "sxyu/plenoctree, nerf_sh/config/blender.yaml (f0b8263)": "sh_bands",
    "sxyu/plenoctree, nerf_sh/nerf/utils.py (f0b8263)": (
        "field depth position_frequencies hidden_width sparsity_weight sparsity_length sparsity_points learning_rate "
        "final_learning_rate"
    ),
    "sxyu/plenoctree, octree/extraction.py (f0b8263)": "octree_depth weight_threshold",
    "sxyu/plenoctree, octree/config/syn_sh16.json (f0b8263)": "leaf_points",
    "Yu 2021, section 4.2": "transmittance_threshold",
}


SKIP_LAYER = 5  # layer of the network whose activation the input is concatenated to again
DENSITY_LEARNING_RATE, FINAL_DENSITY_LEARNING_RATE = 10.0, 1.0  # of the leaves, per scene unit
HARMONICS_LEARNING_RATE, FINAL_HARMONICS_LEARNING_RATE = 0.02, 0.002  # of the leaves
ROWS_PER_CELL = 16  # leaves of most scenes, for each cell of one face of the cube


class PlenOctrees(FieldMethod):
    """Three stages: NeRF-SH learns, its field is baked into an octree, the leaves learn on. From the second on there is
    nothing but the octree: `teacher` and `teacher_sampler` are None.

    begun: share of the budget at which the leaves began to learn
    """

    Config = Config
    taught_steps = 800
    teacher: HarmonicTeacher | None
    teacher_sampler: OccupancySampler | None
    begun: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        if frame.is_open:
            raise LumigraphError(
                "An octree here holds an object, and this capture has no bounds; "
                "`lumigraph train plenoxels` or instant-ngp learn it"
            )
        with seeded(c.seed):
            if c.field == "hash":
                self.teacher = HarmonicHash(c.table, HIDDEN_LAYERS, c.hidden_width, c.sh_bands)
            else:
                layers = DEPTH, c.hidden_width, SKIP_LAYER
                self.teacher = HarmonicNetwork(POSITION_FREQUENCIES, *layers, c.sh_bands)
        space, steps = Box(frame.bounds, frame.near), StepNumbers(c.steps_per_diagonal)
        self.teacher_sampler = OccupancySampler(frame, space, c.occupancy, NGP_SCHEDULE, steps)
        self.leaves = Leaves(c.sh_bands**2)
        self.leaf_sampler = LeafSampler(frame.near, c.occupancy.transmittance_threshold, c.rays_per_step)
        learnt, baked = self.teacher_sampler.expected_rays, self.leaf_sampler.expected_rays
        self.expected_rays = c.teacher_share * learnt + (1 - c.teacher_share) * baked
        self.register_buffer("begun", torch.tensor(0.0, dtype=torch.float64))
        self._optimizers = list[torch.optim.Optimizer]()

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table, three bands, and a shallower octree."""
        return changed(Config(CPU_LEVELS), samples_per_step=1 << 15, occupancy_threshold=0.15, field="hash",
            hidden_width=32, sh_bands=3, steps_per_diagonal=384, learning_rate=2e-2, final_learning_rate=1e-3,
            decay_start=0.3, sparsity_points=1024, teacher_share=0.5, octree_depth=8, leaf_points=8)  # fmt: skip

    @classmethod
    def taught_preset(cls, device: torch.device) -> Any:
        """The paper's depth for photographs of a sufficient resolution: coarser leaves lose detail permanently."""
        return replace(cls.preset(device), octree_depth=cls.Config.octree_depth)

    @classmethod
    def smallest(cls) -> Any:
        """Tiny tables that are baked half way through some twenty quick steps."""
        return changed(Config(TINY_LEVELS), samples_per_step=2048, occupancy_resolution=16, field="hash",
            hidden_width=16, sh_bands=2, steps_per_diagonal=128, learning_rate=2e-2,
            final_learning_rate=1e-2, sparsity_points=64, teacher_share=0.5, octree_depth=4, leaf_points=2,
            rays_per_step=128)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        rows = min(ROWS_PER_CELL << 2 * config.octree_depth, 1 << 3 * config.octree_depth)
        return super().further_bytes(frame, config, learning) + Leaves.bytes_of(rows, config.sh_bands**2, learning)

    # The field and its sampler

    @property
    def baked(self) -> bool:
        return self.teacher is None

    @property
    def network(self) -> Field:  # type: ignore[override]
        return self.teacher or self.leaves

    @property
    def sampler(self) -> Sampler:  # type: ignore[override]
        return self.teacher_sampler or self.leaf_sampler

    def octree(self, depth: int | None = None) -> Octree:
        """The scene as an octree with a largest depth; deeper cells are averaged. Raises LumigraphError before baking,
        and if it exceeds memory, with the depth that fits."""
        leaves = self._leaves()
        ask_for_octree(leaves, depth)
        return (leaves if depth is None or depth >= leaves.tree.depth else leaves.coarser(depth)).octree()

    def _leaves(self) -> Leaves:
        if not self.baked:
            share = self.config.teacher_share
            raise LumigraphError(
                f"There is no octree yet: it is baked after {share:.0%} of the budget; resume the run with a longer one"
            )
        return self.leaves

    @torch.no_grad()
    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """Share of each leaf in one picture. Raises LumigraphError while there is no octree."""
        leaves, rays = self._leaves(), camera.rays(camera.pixels()).to(self.device)
        total = torch.zeros(len(leaves), device=self.device)
        for i in range(0, len(rays), self.rays_per_chunk):
            found = leaves.crossed(rays[i : i + self.rays_per_chunk], *self._ends)
            total.index_add_(0, found.rows, weights_of(found.samples, leaves.densities[found.rows, 0].relu()))
        return {"leaves.harmonics": total}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Prune the least important leaves."""
        weights = importance["leaves.harmonics"]
        kept = most_important(weights, 1 - share)
        self.leaves.keep(kept)
        return {"leaves.harmonics": weights[kept]}

    # Rendering

    @property
    def _ends(self) -> tuple[float, float]:
        """Distance at which rays begin, and transmittance at which they terminate."""
        return self.leaf_sampler.near, self.leaf_sampler.stop

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        return self.leaves.seen(rays, *self._ends, background) if self.baked else super().render_rays(rays, background)

    # Learning

    def compile_begin(self) -> None:
        """One step of eight leaves, whose kernels later stages need."""
        leaves, device = Leaves(self.leaves.basis).to(self.device), self.device
        fill(leaves, torch.arange(8, 16, device=device))
        leaves.densities.data += 1
        (optimizer,) = self._of_leaves(leaves)
        origin, direction = torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0.0, 0.0]])
        rays = Rays(origin, direction, torch.ones(1)).to(device)
        rows = leaves.touched(rays, 0.0, 1e-3)
        leaves.seen(rays, 0.0, 1e-3, self.background, leaves.part(rows)).rgb.sum().backward()
        optimizer.step()

    def rays_in_a_step(self, data: Scene) -> float:
        return self.expected_rays

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        """Rays of a step. Bakes the field after its share of the budget, for here cameras are known."""
        if not self.baked and self.progress >= self.config.teacher_share:
            self._bake(data.cameras[data.splits["train"]])
            self.begun.fill_(self.progress)
        return super().batch(data, generator)

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Bake a teacher's density and colour in the cameras' view; from then on leaves are trained."""
        known, chance, numbers = teacher_of(teacher, cameras), self.random(-1), self._baking(cameras)
        mask = met(teacher, cameras, numbers, chance) if can(teacher, HasLooks) else None
        density = density_of(teacher) if can(teacher, HasField) else known.density
        bake(self.leaves, density, mask, cameras, numbers, chance)
        centres, _ = self.leaves.centres
        harmonics = known.harmonics(centres.cpu(), self.config.sh_bands, logit)
        self.leaves.harmonics.data.copy_(harmonics.flatten(1))
        self._leave_field()

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Load as any module does; without a field where a baked octree was saved."""
        if not any(name.startswith("teacher.") for name in state_dict):
            self._leave_field()
        return super().load_state_dict(state_dict, strict, assign)

    def _bake(self, cameras: Camera) -> None:
        """Bake the field into leaves, and drop it."""
        assert self.teacher is not None
        chance, numbers = self.random(-1), self._baking(cameras)
        mask = met(self, cameras, numbers, chance)
        bake(self.leaves, self.density, mask, cameras, numbers, chance)
        averaged_harmonics(self.leaves, self.teacher.geometry, numbers.points, chance)  # type: ignore[arg-type]  # one tensor
        self._leave_field()

    def _baking(self, cameras: Camera) -> Baking:
        """Parameters of baking. The octree is no deeper than a cell for each pixel along the largest picture."""
        c, depth = self.config, math.ceil(math.log2(int(cameras.size.max())))
        return Baking(min(c.octree_depth, max(depth, 1)), c.leaf_points, WEIGHT_THRESHOLD, self.frame.near)

    def _leave_field(self) -> None:
        """Drop the teacher and its sampler."""
        self.teacher = self.teacher_sampler = None
        self.figures = {}
        self._optimizers[:] = self._of_leaves(self.leaves)  # in the list that the trainer holds

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator = self.random(step)
        background = backdrop(batch, self.background, generator)
        terms: dict[str, Tensor] = {}
        if self.baked:
            rows = self.leaves.touched(batch.rays, *self._ends)
            rendering = self.leaves.seen(batch.rays, *self._ends, background, self.leaves.part(rows))
            self.figures |= {"rays": len(batch), "leaves": len(self.leaves), "touched": len(rows)}
        else:
            (samples,), terms = self.learn(batch.rays, generator)
            look = samples.look(self.network)
            rendering = composite(look.samples, look.density, look.rgb, background)
            if self.config.sparsity_weight:
                terms["sparsity"] = self.config.sparsity_weight * self._sparsity(generator)
        residual, self.figures["mse"] = residuals(rendering, batch, background)
        return {"colour": residual.square().mean(), **terms}

    def _sparsity(self, generator: torch.Generator) -> Tensor:
        """(1 / K) sum_k |1 - exp(-lambda sigma_k)| at K random points (eq. 4)."""
        points = 2 * torch.rand(self.config.sparsity_points, 3, generator=generator) - 1
        density = self.density(points.to(self.device))
        return (1 - torch.exp(-SPARSITY_LENGTH * density)).abs().mean()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        teacher, c = self.teacher, self.config
        self._optimizers = teacher.optimizers_at(c.learning_rate) if teacher else self._of_leaves(self.leaves)
        return self._optimizers

    def _of_leaves(self, leaves: Leaves) -> list[torch.optim.Optimizer]:
        density = {"params": [leaves.densities], "name": "density"}
        harmonics = {"params": [leaves.harmonics], "name": "harmonics"}
        table = LazyRMSprop([density, harmonics])
        for group in table.param_groups:
            group["lr"] = self._rates(0.0)[group["name"]]
        return [table]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        """The field's rate is constant, then decays; the leaves' rate decays from the start of their training."""
        c = self.config
        over = min(progress / max(c.teacher_share, 1e-9), 1.0)
        begun = float(self.begun)
        rates = self._rates((progress - begun) / max(1 - begun, 1e-9) if self.baked else 0.0)
        return {"": hold_and_decay(c.learning_rate, c.final_learning_rate, step, over, c.decay_start), **rates}

    def _rates(self, progress: float) -> dict[str, float]:
        return {
            "density": falling(DENSITY_LEARNING_RATE, FINAL_DENSITY_LEARNING_RATE, progress),
            "harmonics": falling(HARMONICS_LEARNING_RATE, FINAL_HARMONICS_LEARNING_RATE, progress),
        }

    def before_step(self, step: int, progress: float) -> None:
        share = self.config.teacher_share
        if not self.baked and progress < share:
            super().before_step(step, progress / share)
