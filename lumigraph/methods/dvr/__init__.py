"""DVR: occupancy and texture from photographs and masks, by implicit differentiation (Niemeyer et al. 2020, arXiv
1912.07372)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize, softplus

from ...budget import BY_RAY, Efforts
from ...camera.rays import Rays, Rendering, Samples
from ...components.fields.hash_field import CPU_LEVELS, TINY_LEVELS, TableNumbers
from ...components.fields.layers import in_chunks
from ...components.sampling.occupancy import OccupancyGrid, visual_hull
from ...components.sampling.sphere_trace import regula_falsi, with_gradient
from ...components.sampling.surface_method import SHADINGS, SurfaceMethod
from ...components.training.schedules import BandSchedule, exponential_decay
from ...datasets.scene import Batch, Frame, Scene
from ...errors import LumigraphError
from ...files.ranges import BatchSize, Cells, LearningRate, NonNegative, Positive, Share, Width, between
from ...method import BaseConfig, seeded
from .fields import LOGIT_SCALE, OccupancyField, TableField

MarchSteps = Annotated[int, between(4, 4096)]

NORMAL_WEIGHT, HASH_NORMAL_WEIGHT = 0.1, 0.05  # weight of L_normal, which smooths the surface, by field


@dataclass(frozen=True)
class Config(BaseConfig):
    """The numbers of the paper's multi-view reconstruction, as its published code has them (configs/)."""

    table: TableNumbers = TableNumbers()
    field: Literal["network", "hash"] = "network"  # occupancy and texture: the paper's network, or a faster hash table
    hidden_width: Width = 512  # channels of a hidden layer; wider holds more detail, and costs time
    march_steps: MarchSteps = 128  # steps along the diagonal of [-1, 1]^3 in the end; more find thinner things, slower
    first_march_steps: MarchSteps = 16  # steps at first, which double until they are march_steps
    march_settling: Share = 0.5  # share of the budget after which there are march_steps
    hull_cells: Cells = 0  # cells per axis of the visual hull, outside of which rays do not look; 0: they look anywhere
    rays_per_step: BatchSize = 2048  # rays of a step; more reduce noise, and cost time
    depth_weight: NonNegative = 0.0  # weight of L_depth, for photographs with depth; 0: depth is not read
    neighbour_distance: Positive = 2e-3  # side of the cube around a point from which L_normal draws its neighbour
    difference_step: Positive = 2e-3  # scene units between two values whose difference is a normal's component
    coarse_to_fine: Share = 0.0  # share of the budget in which levels of the hash table are added; 0: at once
    learning_rate: LearningRate = 1e-4  # Adam's learning rate at first; higher learns faster, and may diverge
    final_learning_rate: LearningRate = 2.5e-5  # learning rate at the end of the budget, reached exponentially

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.first_march_steps > self.march_steps:
            raise LumigraphError(
                f"--first-march-steps {self.first_march_steps} are more than the --march-steps {self.march_steps} in "
                "the end; give fewer"
            )


RELEASE = "autonomousvision/differentiable_volumetric_rendering"
SOURCES = {  # of the numbers of `paper`; the others are ours
    f"{RELEASE}, configs/default.yaml (5a19010)": (
        "colour_weight freespace_weight occupancy_weight depth_weight learning_rate"
    ),
    f"{RELEASE}, configs/multi_view_reconstruction/skull/ours_rgb.yaml (5a19010)": (
        "rays_per_step normal_weight final_learning_rate"
    ),
    f"{RELEASE}, im2mesh/dvr/models/decoder.py (5a19010)": ("field hidden_width blocks"),
    f"{RELEASE}, im2mesh/dvr/models/depth_function.py (5a19010)": (
        "threshold march_steps first_march_steps secant_steps"
    ),
    f"{RELEASE}, im2mesh/dvr/models/__init__.py (5a19010)": ("neighbour_distance difference_step"),
    f"{RELEASE}, im2mesh/dvr (5a19010), which has no such step": "hull_cells",
}


BLOCKS = 5  # residual blocks of the network
THRESHOLD = 0.5  # tau, occupancy at the surface
SECANT_STEPS = 8  # evaluations that narrow a crossing down, section 3.2
COLOUR_WEIGHT = 1.0  # weight of L_rgb, eq. 3
FREESPACE_WEIGHT = 1.0  # weight of L_freespace, for rays beside the object
OCCUPANCY_WEIGHT = 1.0  # weight of L_occupancy, for rays of the object that miss the surface
DIAGONAL = 2 * math.sqrt(3)  # of [-1, 1]^3
HULL_CELLS = 32  # per axis, of the hull that the first sphere is found from
SPHERE_RADIUS = 0.6  # of the first sphere, of that around the hull


class DVR(SurfaceMethod):
    """Learns occupancy and colour of points from photographs with masks; a ray's surface is its first crossing of the
    occupancy threshold."""

    Config, learns_from = Config, Scene
    learning_rate = exponential_decay
    efforts: ClassVar[Efforts] = BY_RAY
    rays_per_chunk = 4096
    shadings = ("texture", *SHADINGS)

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        hashed = c.field == "hash"
        self.bands = BandSchedule(c.coarse_to_fine) if c.coarse_to_fine and hashed else None
        with seeded(c.seed):
            joining = self.bands.weights if self.bands else None
            self.network = (
                TableField(c.table, c.hidden_width, joining) if hashed else OccupancyField(c.hidden_width, BLOCKS)
            )
        self.cells = OccupancyGrid(1.0, max(c.hull_cells, 1))
        self._march_steps = c.march_steps

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table whose levels join one by one; rays look within the visual hull alone."""
        return Config(CPU_LEVELS, field="hash", hidden_width=32, hull_cells=64, march_steps=192, first_march_steps=96,
            march_settling=0.3, coarse_to_fine=0.5, neighbour_distance=1e-2, difference_step=1e-2, learning_rate=1e-2,
            final_learning_rate=1e-3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        return Config(TINY_LEVELS, field="hash", hidden_width=16, hull_cells=16, march_steps=32, rays_per_step=256,
            coarse_to_fine=0.5, neighbour_distance=0.05, difference_step=0.05, learning_rate=2e-2,
            final_learning_rate=5e-3)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Activations of a step: at the surface, and at the differences of two normals there."""
        layers = 2 if config.field == "hash" else 2 * BLOCKS
        return 4 * config.rays_per_step * (3 + 12) * config.hidden_width * layers * learning

    # Learning

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        """Find the visual hull and the first sphere. Raises as `batch` does."""
        confirm(data)
        if self.config.hull_cells:
            self.cells.rule_out(visual_hull(data, self.config.hull_cells)[None])
        hull = (visual_hull(data, HULL_CELLS).nonzero() + 0.5) * (2 / HULL_CELLS) - 1
        if len(hull):
            centre = hull.median(0).values
            self.network.begin_as(centre, SPHERE_RADIUS * float((hull - centre).norm(dim=-1).quantile(0.98)))
        super().begin(data, seconds)

    def before_step(self, step: int, progress: float) -> None:
        super().before_step(step, progress)
        c = self.config
        doublings = math.log2(c.march_steps / c.first_march_steps)
        share = min(progress / c.march_settling, 1.0) if c.march_settling else 1.0
        self._march_steps = round(c.march_steps / 2 ** math.ceil((1 - share) * doublings))

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        """Raises LumigraphError for photographs without masks, and for scenes without bounds."""
        confirm(data)
        layers = ("depth",) if self.config.depth_weight else ()
        return data.sample_rays(self.config.rays_per_step, generator, layers=layers).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """L_rgb, L_depth, L_normal, L_freespace and L_occupancy (section 3.3), sums over rays by the rays of a step."""
        assert batch.alpha is not None
        c, rays, generator = self.config, batch.rays, self.random(step)
        t, samples = self._met(rays)
        hit, inside, count = t.isfinite(), batch.alpha > 0.5, len(batch)
        met = hit.nonzero()[:, 0]
        points = rays[met].at(t[met])
        rgb, right = self.colour(points), inside[met]
        off = (rgb - batch.rgb[met])[right].abs().sum(-1)
        terms = {"colour": COLOUR_WEIGHT * off.sum() / count}
        if c.depth_weight:
            error = (t[met] - batch.extra["depth"][met])[right].abs()
            terms["depth"] = c.depth_weight * error[error.isfinite()].sum() / count
        here = points.detach()
        shift = torch.rand(here.shape, generator=generator).to(here) - 0.5
        normals = (normalize(self._differences(x), dim=-1) for x in (here, here + c.neighbour_distance * shift))
        weight = HASH_NORMAL_WEIGHT if c.field == "hash" else NORMAL_WEIGHT
        terms["normal"] = weight * sum_of_lengths(*normals) / count
        terms |= self._mask_terms(rays, t.detach(), inside, samples, generator)
        shown = self.background.repeat(count, 1).index_copy(0, met, rgb.detach())
        self.figures = {"mse": float((shown - batch.before(self.background)).square().mean()), "met": len(met) / count}
        return terms

    def _mask_terms(
        self,
        rays: Rays,
        t: Float[Tensor, " ray"],
        inside: Bool[Tensor, " ray"],
        samples: Samples,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """L_freespace and L_occupancy: cross-entropy where rays beside the object meet a surface, or at a random place
        of the box, and at a random place of rays that should meet one and do not."""
        hit = t.isfinite()
        enter, leave = rays.through_box(torch.tensor(self.frame.bounds, device=self.device))
        share = torch.rand(len(rays), generator=generator).to(t)
        anywhere = torch.lerp(enter.clamp_min(self.frame.near), leave, share)
        beside = (~inside & (hit | (enter < leave))).nonzero()[:, 0]
        counts = samples.ray_starts.diff()
        missed = (inside & ~hit & (counts > 0)).nonzero()[:, 0]
        held = samples.t[(samples.ray_starts[:-1] + (share * counts).long())[missed]]
        free = self.logits(rays[beside].at(torch.where(hit, t, anywhere)[beside]))
        full = self.logits(rays[missed].at(held))
        return {
            "freespace": FREESPACE_WEIGHT * softplus(free).sum() / len(rays),
            "occupancy": OCCUPANCY_WEIGHT * softplus(-full).sum() / len(rays),
        }

    def _differences(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Central differences, which are differentiable where the hash table's gradient is not."""
        half = 0.5 * self.config.difference_step * torch.eye(3, device=self.device)
        taps = (points + torch.cat([half, -half])[:, None]).flatten(0, 1)
        ahead, behind = self.distance(taps).view(2, 3, len(points))
        return (ahead - behind).t()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return self.network.optimizers_at(self.config.learning_rate)

    # Surface

    def logits(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Logit of occupancy."""
        return in_chunks(lambda x: (self.network(x)[:, 0],), points)[0]

    def colour(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """t(p), sRGB-encoded."""
        return in_chunks(lambda x: (self.network(x)[:, 1:].sigmoid(),), points)[0]

    def distance(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Logit of the threshold less that of points, by LOGIT_SCALE: it has the sign and the zero level of a distance,
        and not its length."""
        level = math.log(THRESHOLD / (1 - THRESHOLD))
        return (level - self.logits(points)) / LOGIT_SCALE

    def met(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 3"]]:
        with torch.no_grad():
            t, _ = self._met(rays)
        return self.with_normals(rays, t)

    def _met(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Samples]:
        """Distance of each ray's first intersection with the surface, infinity without one, and the evaluated samples.
        Equal steps in the hull bracket the crossing, the secant method refines it (section 3.2).

        Differentiable in the field where gradients are enabled (eq. 10).
        """
        step = DIAGONAL / self._march_steps
        with torch.no_grad():
            samples = self.cells.sample(rays, self.frame.near, step)
            value = self.distance(samples.along(rays)[0])
            first = first_of_each(value < 0, samples)
            row = (first < len(samples)).nonzero()[:, 0]
            met, b, at_b = rays[row], samples.t[first[row]], value[first[row]]
            a = (b - step).clamp_min(self.frame.near)
            at_a = self.distance(met.at(a))
            entered = at_a >= 0  # not where a ray begins inside
            crossing = regula_falsi(self.distance, met, a, b, at_a, at_b, SECANT_STEPS)
            found = torch.where(entered, crossing, b)
        if torch.is_grad_enabled() and bool(entered.any()):
            found = found.index_put((entered,), with_gradient(self.distance, met[entered], found[entered]))
        return torch.full_like(rays.radius, torch.inf).index_copy(0, row, found), samples

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        found = super().render_rays(rays, background)
        if self.control("shading") != self.shadings[0]:
            return found
        row = found.depth.isfinite().nonzero()[:, 0]
        rgb = self.colour(rays[row].at(found.depth[row]))
        return replace(found, rgb=background.expand_as(found.rgb).index_copy(0, row, rgb))


def first_of_each(chosen: Bool[Tensor, " sample"], samples: Samples) -> Tensor:
    """Number of the first chosen sample of each ray; that of all samples where none is."""
    numbers = chosen.nonzero()[:, 0]
    none = torch.full((len(samples.ray_starts) - 1,), len(samples), device=numbers.device)
    return none.scatter_reduce(0, samples.ray_index[numbers], numbers, "amin")


def sum_of_lengths(a: Float[Tensor, "point 3"], b: Float[Tensor, "point 3"]) -> Float[Tensor, ""]:
    """Sum of |a - b|, with a gradient also where they agree."""
    return ((a - b).square().sum(-1) + 1e-12).sqrt().sum()


def confirm(data: Scene) -> None:
    """Raises LumigraphError for photographs without masks, and for scenes without bounds."""
    if not data.images.has_alpha or data.frame.is_open:
        lacking = "have no masks" if not data.images.has_alpha else "show a place without bounds"
        raise LumigraphError(
            f"dvr learns one object from photographs with masks, and those of {data.source} {lacking}; give PNG files "
            "with alpha or a folder object_masks, or train neus"
        )
