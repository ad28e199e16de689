"""PlenOctrees: density and harmonics, baked into an octree and tuned there (Yu et al. 2021, arXiv 2103.14024)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering
from ..components.fields.harmonic_field import HarmonicHash, HarmonicNetwork, colour
from ..components.fields.hash_field import TABLE_ON_A_CPU, TINY_TABLE, HashNumbers, check_levels
from ..components.fields.leaves import Leaves, ask_for_octree
from ..components.fields.octree_baking import (
    Baking,
    averaged_harmonics,
    bake,
    density_of,
    fill,
    met,
)
from ..components.fields.taken_over import logit, taken_over
from ..components.sampling.carving import visual_hull
from ..components.sampling.coarse_to_fine import SAMPLES_OF_A_RAY, first_grid, keep_looking, lattice, stage
from ..components.sampling.marching import FIRST_RAYS, rays_for, reached
from ..components.sampling.occupancy import OccupancyGrid
from ..components.training.lazy_adam import LazyAdam
from ..components.training.lazy_rmsprop import LazyRMSprop
from ..components.training.photometric import backdrop, residuals
from ..components.training.schedules import falling, held
from ..datasets.scene import Batch, Frame, Scene
from ..errors import LumigraphError
from ..exchange.baked import Octree
from ..exchange.packing import Stored, most_important
from ..files.ranges import (
    BatchSize,
    Depth,
    Layers,
    LearningRate,
    NonNegative,
    Octaves,
    Positive,
    PositiveShare,
    Seed,
    Share,
    Steps,
    Width,
    between,
)
from ..method import RayMethod
from ..method.capabilities import HasField, HasLooks, can
from ..volume import composite, weights_of

DensityRate = Annotated[float, between(1e-6, 1e4)]


@dataclass(frozen=True)
class Config(HashNumbers):
    """The paper's numbers, with where it or its release gives them; `PlenOctrees.preset` has those of a plain CPU."""

    field: Literal["hash", "network"] = "network"  # first field: the paper's network, or a faster hash table
    depth: Depth = 8  # hidden layers of the network, as in NeRF; more hold more detail, and cost time
    skip_layer: Layers = 5  # layer of the network whose activation the input is concatenated to again
    position_frequencies: Octaves = 10  # octaves of positions of the network; more give finer detail, and noise
    hidden_width: Width = 256  # channels of a hidden layer, of either field; wider costs memory and time
    hidden_layers: Layers = 2  # hidden layers after the hash table; more cost time
    sh_bands: Annotated[int, between(1, 4)] = 4  # spherical-harmonics bands, section 5.1: 4 have 16 coefficients
    sparsity_weight: NonNegative = 1e-3  # weight of density at random points, eq. 4; higher empties more; the release's
    sparsity_length: Positive = 0.05  # lambda of eq. 4: scene units over which that density absorbs light
    sparsity_points: Annotated[int, between(1, 1 << 20)] = 10_000  # K, random points of eq. 4; more cost time
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 18  # samples in a step of the first stage
    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 1024  # samples across the cube's diagonal, first stage
    occupancy_resolution: Annotated[int, between(4, 512)] = 128  # cells per axis of the occupancy grid, first stage
    occupancy_threshold: NonNegative = 0.05  # optical thickness of a cell below which it is empty; higher skips more
    occupancy_interval: Steps = 16  # steps between updates of the occupancy grid; more are faster, less current
    occupancy_decay: Share = 0.95  # share of a cell's density kept at each update; higher forgets more slowly
    learning_rate: LearningRate = 5e-4  # the field's learning rate at first, section 5.1; higher may diverge
    final_learning_rate: LearningRate = 5e-5  # learning rate of the field at the end of the first stage
    decay_start: Annotated[float, between(0, 0.99)] = 0.0  # share of the first stage before that rate falls
    teacher_share: Share = 0.9  # share of the budget after which the field is baked; the leaves have the rest
    octree_depth: Annotated[int, between(1, 10)] = 9  # levels of the octree, section 4.1; 9 has 512 cells per axis
    leaf_points: Annotated[int, between(1, 4096)] = 256  # points of a leaf that are averaged, section 4.1
    weight_threshold: PositiveShare = 1e-3  # least weight of a leaf on some ray, section 4.1; higher drops more leaves
    rays_per_step: BatchSize = 4096  # rays in a step of the last stage; more reduce noise, and cost time
    density_learning_rate: DensityRate = 10.0  # rate of the leaves' density at first, per scene unit
    final_density_learning_rate: DensityRate = 1.0  # rate of the leaves' density at the end
    harmonics_learning_rate: LearningRate = 0.02  # rate of the leaves' harmonics at first
    final_harmonics_learning_rate: LearningRate = 0.002  # rate of the leaves' harmonics at the end
    transmittance_threshold: Share = 0.01  # transmittance at which a ray terminates, section 4.2; higher is faster
    seed: Seed = 0  # seed of all random numbers; another seed gives another run

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        check_levels(self)


RAYS = 1 << 18  # rendered at once, once there are leaves alone
ROWS = 16  # leaves that are left of most scenes, for each cell of one face of the cube


class PlenOctrees(RayMethod):
    """Three stages: NeRF-SH learns, its field is baked into an octree, the leaves learn on. From the second on there is
    nothing but the octree: `teacher` and `occupancy` are None.

    begun: share of the budget at which the leaves began to learn
    """

    Config = Config
    teacher: HarmonicHash | HarmonicNetwork | None
    occupancy: OccupancyGrid | None
    teacher_rays: Tensor
    begun: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        if frame.reach > 1:
            raise LumigraphError(
                "An octree here holds an object, and this capture has no bounds; "
                "`lumigraph train plenoxels` or instant-ngp learn it"
            )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.teacher = HarmonicHash(config) if config.field == "hash" else HarmonicNetwork(config)
        self.occupancy = first_grid(config, 1.0)
        self.lattice = lattice(config, 1.0)
        self.leaves = Leaves(config.sh_bands**2)
        self.register_buffer("teacher_rays", torch.tensor(FIRST_RAYS))
        self.register_buffer("begun", torch.tensor(0.0, dtype=torch.float64))
        self._progress, self._optimizers = 0.0, list[torch.optim.Optimizer]()

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU a hash table, three bands, and what learns most in a minute."""
        if device.type == "cuda":
            return Config()
        return Config(
            field="hash",
            hidden_width=32,
            **TABLE_ON_A_CPU,
            sh_bands=3,
            sparsity_points=1024,
            samples_per_step=1 << 15,
            steps_per_diagonal=384,
            occupancy_threshold=0.15,
            learning_rate=2e-2,
            final_learning_rate=1e-3,
            decay_start=0.3,
            teacher_share=0.5,
            octree_depth=8,
            leaf_points=8,
        )

    @classmethod
    def smallest(cls) -> Any:
        """Tiny tables that are baked half way through some twenty quick steps."""
        return Config(
            field="hash",
            hidden_width=16,
            **TINY_TABLE,
            hidden_layers=1,
            sh_bands=2,
            sparsity_points=64,
            samples_per_step=2048,
            steps_per_diagonal=128,
            occupancy_resolution=16,
            learning_rate=2e-2,
            final_learning_rate=1e-2,
            teacher_share=0.5,
            octree_depth=4,
            leaf_points=2,
            rays_per_step=128,
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        rows = min(ROWS << 2 * config.octree_depth, 1 << 3 * config.octree_depth)
        grid = OccupancyGrid.bytes_of(1.0, config.occupancy_resolution)
        return grid + Leaves.bytes_of(rows, config.sh_bands**2, learning)

    # What is there

    @property
    def baked(self) -> bool:
        return self.teacher is None

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self.teacher.density(points) if self.teacher else self.leaves.density_at(points)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        if not self.teacher:
            return self.leaves.at(points, directions)
        density, harmonics = self.teacher(points)
        return density, colour(harmonics, directions)

    def octree(self, depth: int | None = None) -> Octree:
        """The scene as an octree, of so many levels at most; what lies deeper is averaged. Raises LumigraphError while
        it is not baked, and where it does not fit into memory, with the depth that does."""
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

    def storage(self) -> dict[str, Stored]:
        """Harmonics by a codebook, density in 16 bits."""
        return {"leaves.density": Stored("scaled", bits=16), "leaves.harmonics": Stored("coded")}

    @torch.no_grad()
    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """How much each leaf adds to one picture. Raises LumigraphError while there is no octree."""
        leaves, rays = self._leaves(), camera.rays(camera.pixels()).to(self.device)
        total = torch.zeros(len(leaves), device=self.device)
        for i in range(0, len(rays), RAYS):
            found = leaves.crossed(rays[i : i + RAYS], self.frame.near, self.config.transmittance_threshold)
            total.index_add_(0, found.rows, weights_of(found.samples, leaves.density[found.rows, 0].relu()))
        return {"leaves.harmonics": total}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Leave the least important leaves out."""
        weights = importance["leaves.harmonics"]
        kept = most_important(weights, 1 - share)
        self.leaves.keep(kept)
        return {"leaves.harmonics": weights[kept]}

    # Being seen

    def looks(self, rays: Rays) -> list[Look]:
        return [self._crossed(rays) if self.baked else self._march(rays)]

    def _march(self, rays: Rays, jitter: Float[Tensor, " ray"] | None = None) -> Look:
        """The field at samples in occupied cells that light reaches."""
        assert self.occupancy is not None
        found = self.occupancy.sample(rays, self.frame.near, *self.lattice, jitter=jitter)
        samples, asked = reached(rays, found, self.density, self.config.transmittance_threshold)
        density, rgb = self.field(*samples.along(rays))
        self.figures |= {"rays": len(rays), "samples": asked, "visible_samples": len(samples)}
        return Look("samples", samples, density, rgb)

    def _crossed(self, rays: Rays) -> Look:
        """The leaves along rays, each a sample as long as the ray is in it."""
        found = self.leaves.crossed(rays, self.frame.near, self.config.transmittance_threshold)
        directions = rays.directions[found.samples.ray_index]
        harmonics = self.leaves.harmonics[found.rows].view(-1, self.leaves.basis, 3)
        return Look("leaves", found.samples, self.leaves.density[found.rows, 0].relu(), colour(harmonics, directions))

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        if self.baked:
            return self.leaves.seen(rays, self.frame.near, self.config.transmittance_threshold, background)
        look = self._march(rays)
        return composite(look.samples, look.density, look.rgb, background)

    # Learning

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        if self.occupancy is not None and scene.images.has_alpha:
            self.occupancy.rule_out(visual_hull(scene, self.config.occupancy_resolution)[None])

    def rehearse_begin(self) -> None:
        """One step of eight leaves, on the copy that is there to compile what later stages need."""
        learnt, teacher, occupancy = self.leaves, self.teacher, self.occupancy
        self.leaves = Leaves(learnt.basis).to(self.device)
        fill(self.leaves, torch.arange(8, 16, device=self.device))
        self.leaves.density.data += 1
        self.teacher = self.occupancy = None
        (optimizer,) = self._of_leaves()
        from_outside = torch.tensor([[-3.0, 0.1, 0.2]], device=self.device)
        rays = Rays(
            from_outside, torch.tensor([[1.0, 0.0, 0.0]], device=self.device), torch.ones(1, device=self.device)
        )
        rows = self.leaves.touched(rays, 0.0, 1e-3)
        self.leaves.seen(rays, 0.0, 1e-3, self.background, self.leaves.part(rows)).rgb.sum().backward()
        optimizer.step()
        self.leaves, self.teacher, self.occupancy = learnt, teacher, occupancy

    def rays_in_a_step(self, data: Scene) -> float:
        c = self.config
        first = c.samples_per_step / SAMPLES_OF_A_RAY
        return c.teacher_share * first + (1 - c.teacher_share) * c.rays_per_step

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        """Rays of a step. Here the field is baked when its share of the budget is over, for here cameras are known."""
        if not self.baked and self._progress >= self.config.teacher_share:
            self._bake(data.cameras[data.splits["train"]])
            self.begun.fill_(self._progress)
        rays = self.config.rays_per_step if self.baked else int(self.teacher_rays)
        return data.sample_rays(rays, generator).to(self.device)

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Bake a teacher's density and colour as far as cameras see them; what is learnt from then on are leaves."""
        known, chance, numbers = taken_over(teacher, cameras), self.random(-1), self._baking
        mask = met(teacher, cameras, numbers, chance) if can(teacher, HasLooks) else None
        density = density_of(teacher) if can(teacher, HasField) else known.density
        bake(self.leaves, density, mask, cameras, numbers, chance)
        centres, _ = self.leaves.centres
        harmonics = known.harmonics(centres.cpu(), self.config.sh_bands, logit)
        self.leaves.harmonics.data.copy_(harmonics.flatten(1))
        self._leave_field()

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """As of any module; where what was saved is baked, there is no field any more."""
        if not any(name.startswith("teacher.") for name in state_dict):
            self._leave_field()
        return super().load_state_dict(state_dict, strict, assign)

    def _bake(self, cameras: Camera) -> None:
        """What was learnt becomes leaves, and is dropped."""
        assert self.teacher is not None
        chance, numbers = self.random(-1), self._baking
        mask = met(self, cameras, numbers, chance)
        bake(self.leaves, self.density, mask, cameras, numbers, chance)
        averaged_harmonics(self.leaves, self.teacher, numbers.points, chance)
        self._leave_field()

    @property
    def _baking(self) -> Baking:
        c = self.config
        return Baking(c.octree_depth, c.leaf_points, c.weight_threshold, self.frame.near)

    def _leave_field(self) -> None:
        """From here on there are leaves alone, which need little memory along rays."""
        self.teacher = self.occupancy = None
        self.figures, self.rays_per_chunk = {}, RAYS
        self._optimizers[:] = self._of_leaves()  # in the list that the trainer holds

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        generator, stop = self.random(step), self.config.transmittance_threshold
        background = backdrop(batch, self.background, generator)
        terms = {}
        if self.baked:
            rows = self.leaves.touched(batch.rays, self.frame.near, stop)
            rendering = self.leaves.seen(batch.rays, self.frame.near, stop, background, self.leaves.part(rows))
            self.figures |= {"rays": len(batch), "leaves": len(self.leaves), "touched": len(rows)}
        else:
            look = self._march(batch.rays, torch.rand(len(batch), generator=generator).to(self.device))
            rendering = composite(look.samples, look.density, look.rgb, background)
            if self.config.sparsity_weight:
                terms["sparsity"] = self.config.sparsity_weight * self._sparsity(generator)
        residual, self.figures["mse"] = residuals(rendering, batch, background)
        return {"colour": residual.square().mean(), **terms}

    def _sparsity(self, generator: torch.Generator) -> Tensor:
        """(1 / K) sum_k |1 - exp(-lambda sigma_k)| at K random points (eq. 4)."""
        assert self.teacher is not None
        points = 2 * torch.rand(self.config.sparsity_points, 3, generator=generator) - 1
        density = self.teacher.density(points.to(self.device))
        return (1 - torch.exp(-self.config.sparsity_length * density)).abs().mean()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        self._optimizers = self._of_leaves() if self.baked else self._of_teacher()
        return self._optimizers

    def _of_teacher(self) -> list[torch.optim.Optimizer]:
        assert self.teacher is not None
        common = {"lr": self.config.learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        if isinstance(self.teacher, HarmonicNetwork):
            return [torch.optim.Adam(self.teacher.parameters(), lr=self.config.learning_rate, eps=1e-7)]
        networks = [*self.teacher.network.parameters()]
        return [LazyAdam([self.teacher.table], **common), torch.optim.Adam(networks, foreach=True, **common)]

    def _of_leaves(self) -> list[torch.optim.Optimizer]:
        density = {"params": [self.leaves.density], "name": "density"}
        harmonics = {"params": [self.leaves.harmonics], "name": "harmonics"}
        table = LazyRMSprop([density, harmonics])
        for group in table.param_groups:
            group["lr"] = self._rates(0.0)[group["name"]]
        return [table]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        """The field's is held, then falls; the leaves' fall from where they begin."""
        c = self.config
        over = min(progress / max(c.teacher_share, 1e-9), 1.0)
        begun = float(self.begun)
        rates = self._rates((progress - begun) / max(1 - begun, 1e-9) if self.baked else 0.0)
        return {"": held(c.learning_rate, c.final_learning_rate, step, over, c.decay_start), **rates}

    def _rates(self, progress: float) -> dict[str, float]:
        c = self.config
        return {
            "density": falling(c.density_learning_rate, c.final_density_learning_rate, progress),
            "harmonics": falling(c.harmonics_learning_rate, c.final_harmonics_learning_rate, progress),
        }

    def before_step(self, step: int, progress: float) -> None:
        self._progress, c = progress, self.config
        if self.occupancy is not None and progress < c.teacher_share:
            over = progress / c.teacher_share
            self.lattice = lattice(c, 1.0, stage(over).steps)
            keep_looking(self.occupancy, self.density, c, step, over, self.random(~step))

    def after_step(self, step: int) -> None:
        """Set the next step's number of rays so that they give about `samples_per_step` samples."""
        if not self.baked:
            rays = rays_for(self.config.samples_per_step, int(self.teacher_rays), self.figures["samples"])
            self.teacher_rays.fill_(rays)
