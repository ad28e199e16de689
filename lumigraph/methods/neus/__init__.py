"""NeuS: a signed distance as a radiance field whose weights are unbiased (Wang et al. 2021, arXiv 2106.10689)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, normalize

from ...camera.rays import Rays, Rendering
from ...components.fields.coordinate_field import CoordinateField, NetworkNumbers
from ...components.fields.hash_field import CPU_TABLE, TINY_TABLE, HashField, HashNumbers
from ...components.fields.spaces import Box, contraction_of
from ...components.sampling.hierarchical_sampler import RayNumbers
from ...components.sampling.occupancy import MaskNumbers, visual_hull
from ...components.training.photometric import backdrop
from ...components.training.schedules import BandSchedule
from ...datasets.scene import Batch, Frame, Scene
from ...errors import LumigraphError
from ...files.ranges import LearningRate, NonNegative, RaySamples, Share, Width, between, changed
from ...method import BaseConfig, FieldMethod, seeded
from ...method.depth import DepthNumbers, depth_terms
from ...volume import composite
from .fields import COLOUR_DEPTH, DistanceNumbers, HashDistance, NetworkDistance, NeuSField
from .sampler import NETWORK_CHUNK, TABLE_CHUNK, SectionSampler

HULL_CELLS = 64  # per axis, of the visual hull that the first sphere is found from
MIN_POINTS = 16  # sparse points in the box, from which the first sphere is found
FIRST_RADIUS = 0.5  # radius of the first sphere, of that around all that is known to matter, section E.1
ROOM_RADIUS = 0.9  # the same of a hollow sphere, seen from inside
CLEAR_RADIUS = 0.5  # largest radius of it, of the distance from its middle to the nearest camera
TAPS = 5  # evaluations of the hash table for each section: in its middle, and around it for the gradient
MIN_OPACITY = 1e-3  # opacities of the mask term stay so far from 0 and 1, where its slope has no end
EIKONAL_WEIGHT = 0.1  # lambda, weight of the eikonal term, eq. 17; higher keeps f closer to a distance
MASK_WEIGHT = 0.1  # beta, weight of the mask term, eq. 18, where photographs have alpha


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, from section E and the release (confs/wmask.conf, womask.conf)."""

    network: DistanceNumbers = DistanceNumbers()
    table: HashNumbers = HashNumbers()
    rays: RayNumbers = RayNumbers(coarse_samples=64, fine_samples=64, rays_per_step=512)
    mask: MaskNumbers = MaskNumbers()
    measured: DepthNumbers = DepthNumbers()
    field: Literal["network", "hash"] = "network"  # distance field: the paper's network, or a faster hash table
    hidden_width: Width = 256  # channels of a hidden layer; wider holds more detail, and costs time
    upsampling_rounds: Annotated[int, between(1, 16)] = 4  # rounds that share the fine samples; more are finer, slower
    samples_per_step: Annotated[int, between(0, 1 << 24)] = 0  # sections of a step, which sets its rays; 0: fixed rays
    outside_samples: RaySamples = 32  # samples of a ray behind the box of an open capture; more are sharper, slower
    weight_threshold: Share = 0.0  # weight of a section below which it is left out; higher is faster, less exact
    curvature_weight: NonNegative = 0.0  # weight of the Laplacian's magnitude, with --field hash; higher smooths
    cosine_annealing: Share = 1 / 6  # share of the budget in which slopes are annealed, where nothing has alpha
    coarse_to_fine: Share = 0.0  # share of the budget in which levels of the hash table are added; 0: at once
    learning_rate: LearningRate = 5e-4  # Adam's learning rate after the warm-up; higher: faster, may diverge
    final_learning_rate: LearningRate = 2.5e-5  # learning rate at the end of the budget, reached along a cosine
    sharpness_rate: Share = 1.0  # share of the learning rate that the inverse deviation s learns at
    warmup: Share = 1 / 60  # share of the budget in which the learning rate grows

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.rays.fine_samples < self.upsampling_rounds:
            raise LumigraphError(
                f"--fine-samples {self.rays.fine_samples} in --upsampling-rounds {self.upsampling_rounds} leave a "
                "round without any; give fewer rounds"
            )


SOURCES = {  # of the numbers of `paper`; the others are ours
    "Totoro97/NeuS, confs/wmask.conf (6e0a230)": (
        "depth skip_layer colour_depth position_frequencies direction_frequencies hidden_width coarse_samples "
        "fine_samples rays_per_step upsampling_rounds eikonal_weight mask_weight learning_rate final_learning_rate "
        "warmup"
    ),
    "Totoro97/NeuS, confs/womask.conf (6e0a230)": "outside_samples cosine_annealing",
    "Totoro97/NeuS, models/fields.py (6e0a230)": "field sharpness_rate",
    "Totoro97/NeuS, models/renderer.py (6e0a230), which has no such step": (
        "weight_threshold curvature_weight coarse_to_fine occupancy_resolution"
    ),
}


class NeuS(FieldMethod):
    """A signed distance in the box of interest, seen through unbiased weights; around it density, in the open."""

    Config = Config
    network: NeuSField
    sampler: SectionSampler

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        box = Box(frame.bounds, frame.near)
        around = contraction_of(frame) if frame.is_open else None
        hashed = c.field == "hash"
        self.bands = BandSchedule(c.coarse_to_fine) if c.coarse_to_fine and hashed else None
        slopes = c.cosine_annealing if not frame.has_alpha else 0.0
        self.slopes = BandSchedule(slopes) if slopes else None
        with seeded(c.seed):
            if hashed:
                shape: Any = HashDistance(c.table, c.hidden_width, self.bands.weights if self.bands else None)
                outside: Any = HashField(c.table, c.hidden_width, around, frame.reach) if around else None
            else:
                shape = NetworkDistance(c.network, c.hidden_width)
                outside = CoordinateField(NetworkNumbers(), c.hidden_width, around) if around else None
            margin = 2 * math.sqrt(3) / max(c.mask.occupancy_resolution, 1)
            self.network = NeuSField(shape, frame.bounds, outside, margin, self.slopes)
        self.sampler = SectionSampler(
            box,
            c.rays,
            c.mask,
            c.upsampling_rounds,
            c.samples_per_step,
            c.weight_threshold,
            (around, c.outside_samples) if around else None,
            TABLE_CHUNK if hashed else NETWORK_CHUNK,
        )

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table whose levels join one by one, a grid of what is empty, sections that matter alone."""
        return changed(Config(table=CPU_TABLE), coarse_samples=48, fine_samples=16, rays_per_step=768,
            occupancy_resolution=64, field="hash", hidden_width=32, upsampling_rounds=2, outside_samples=24,
            weight_threshold=1e-3, samples_per_step=12_288, cosine_annealing=0.2, coarse_to_fine=0.5,
            learning_rate=2e-2, final_learning_rate=1e-3, sharpness_rate=0.15, warmup=0.02)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table whose levels join, with a grid of what is empty, within some twenty quick steps."""
        return changed(Config(table=TINY_TABLE), coarse_samples=16, fine_samples=8, rays_per_step=192,
            occupancy_resolution=16, field="hash", hidden_width=16, upsampling_rounds=2, samples_per_step=2048,
            outside_samples=8, weight_threshold=1e-3, coarse_to_fine=0.5, curvature_weight=1e-4, warmup=0.1,
            learning_rate=2e-2, final_learning_rate=1e-3, sharpness_rate=0.1)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Activations of a step: of the networks with those of their gradients, or of the table with its taps."""
        if not learning:
            return 0
        if config.field == "hash":
            return config.table.activation_bytes(TAPS * config.samples_per_step, config.hidden_width)
        n = config.network
        return 8 * config.rays.samples_per_step * config.hidden_width * (n.depth + COLOUR_DEPTH)

    def distance(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Signed distance to the nearest surface in scene units, negative inside."""
        return self.network.distance(points)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        """Rendering of each ray, with unit normals of intersections in its extras, 0 without one."""
        (seen,) = self.sampler.sample(rays, self.network)
        look, (gradient, *_) = self._look(seen, rays), seen.features
        behind = self.behind(rays, None, background)
        found = composite(look.samples, look.density, look.rgb, behind, normals=normalize(gradient, dim=-1))
        return found.with_extra(normals=normalize(found.extra["normals"], dim=-1))

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        """Initialise the sphere and the mask of empty space."""
        self.network.shape.begin_as(*first_sphere(data))
        super().begin(data, seconds)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """L1 of colours, the eikonal term, the mask term (eqs. 15 to 18)."""
        c, generator = self.config, self.random(step)
        (seen,), terms = self.learn(batch.rays, generator)
        background = backdrop(batch, self.background, generator, self.sampler.is_open)
        look, (gradient, inside, *laplacian) = seen.look(self.network), seen.features
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual = rendering.rgb - batch.before(background)
        self.figures |= {"mse": float(residual.detach().square().mean()), "s": float(self.network.sharpness.detach())}
        shown = 1.0 if batch.alpha is None else batch.alpha.mean().clamp_min(1e-2)
        terms["colour"] = residual.abs().mean() / shown
        terms |= depth_terms(c, batch.extra, rendering.depth, rendering.opacity)
        points = self._anywhere(len(batch), generator)
        anywhere, filled = self.network.shape.surface(points), self.sampler.empty.may_hold(points)
        if filled is not None:  # nothing else is learnt where the mask says that nothing is
            terms["empty"] = ((-anywhere.distance).clamp_min(0) * ~filled).mean()
        terms["eikonal"] = EIKONAL_WEIGHT * eikonal(torch.cat([gradient[inside], anywhere.gradient]))
        if c.curvature_weight and laplacian:
            bent = laplacian[0][inside].abs()
            terms["curvature"] = c.curvature_weight * bent.sum() / max(len(bent), 1)
        if batch.alpha is not None:
            terms["mask"] = MASK_WEIGHT * mask_error(rendering.opacity, batch.alpha)
        return terms

    def _anywhere(self, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
        """Random points of the box, for the eikonal term in skipped sections."""
        low, high = self.network.box
        return torch.lerp(low, high, torch.rand(count, 3, generator=generator).to(low))

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, network = self.config, self.network
        sharpness = {"params": [network.deviation], "scale": c.sharpness_rate}
        if isinstance(network.shape, HashDistance):
            around = network.outside
            outside = around.optimizers_at(c.learning_rate) if isinstance(around, HashField) else []
            return [*network.shape.table.optimizers_at(c.learning_rate, scale=1.0, groups=[sharpness]), *outside]
        others = [x for x in network.parameters() if x is not network.deviation]
        return [torch.optim.Adam([{"params": others}, sharpness], c.learning_rate)]

    def learning_rate(self, step: int, progress: float) -> float:
        """Linear warm-up, then cosine decay (the release's schedule)."""
        c, first = self.config, self.config.warmup
        if progress < first:
            return c.learning_rate * progress / first
        wave = 0.5 + 0.5 * math.cos(math.pi * (progress - first) / (1 - first))
        return c.final_learning_rate + (c.learning_rate - c.final_learning_rate) * wave


def eikonal(gradient: Float[Tensor, "point 3"]) -> Float[Tensor, ""]:
    """Mean squared deviation of the gradient's length from 1 (eq. 17)."""
    return (gradient.norm(dim=-1) - 1).square().mean()


def mask_error(opacity: Float[Tensor, " ray"], alpha: Float[Tensor, " ray"]) -> Float[Tensor, ""]:
    """Binary cross-entropy of rays' opacities and the photographs' alpha (eq. 18)."""
    return binary_cross_entropy(opacity.clamp(MIN_OPACITY, 1 - MIN_OPACITY), alpha)


def first_sphere(data: Scene) -> tuple[Float[Tensor, " 3"], float, bool]:
    """Centre and radius of the initial sphere, and whether it is hollow.

    Half the radius of the ball around the visual hull of photographs with alpha, or the sparse points in the box of
    interest, or that box. It fits between the closest planes around that, and no camera is near it, for one inside
    would render only black. If most cameras are in the box, that is a room, and the sphere is hollow.
    """
    low, high = torch.tensor(data.frame.bounds)
    stands = data.cameras[data.splits["train"]].position.cpu()
    known = torch.cat([torch.diag(high), torch.diag(low)])  # middles of the box's faces, where it is about the origin
    if data.images.has_alpha and not data.frame.is_open:
        cells = visual_hull(data, HULL_CELLS).nonzero()
        known = (cells + 0.5) * (2 / HULL_CELLS) - 1 if len(cells) else known
    elif data.points is not None:
        inside = data.points[((data.points > low) & (data.points < high)).all(-1)].cpu()
        known = inside if len(inside) >= MIN_POINTS else known
    centre = known.median(0).values
    away = (known - centre).abs()
    if float(((stands > low) & (stands < high)).all(-1).float().mean()) > 0.5:
        return centre, ROOM_RADIUS * float(away.amax(-1).quantile(0.9)), True
    radius = FIRST_RADIUS * float(away.norm(dim=-1).quantile(0.98))
    clear = CLEAR_RADIUS * float((stands - centre).norm(dim=-1).min())
    return centre, min(radius, clear, float(away.quantile(0.98, dim=0).min())), False
