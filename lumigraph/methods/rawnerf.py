"""RawNeRF: light as sensors measured it, learnt from mosaics full of noise (Mildenhall et al. 2022, arXiv 2111.13679).

The field is Instant-NGP's, so that a CPU learns it in minutes; the paper's is mip-NeRF's network.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering
from ..components.fields.hash_field import HashField, HashNumbers
from ..components.fields.layers import truncated_exp
from ..components.fields.spaces import space_of
from ..components.sampling.occupancy_sampler import OccupancyNumbers, StepNumbers
from ..components.sampling.samplers import CPU_HASH, TINY_HASH, ProposalNumbers, sampler_for, sampling_bytes
from ..components.training.development import CONTROLS, decoded, exposed, toned
from ..components.training.pose_refinement import PoseNumbers, poses_for
from ..components.training.regularizers import normalized_distance
from ..components.training.schedules import hold_and_decay
from ..datasets.scene import Batch, Frame, Scene
from ..errors import LumigraphWarning
from ..files.ranges import LearningRate, NonNegative, Positive, Width
from ..method import BaseConfig, FieldMethod, seeded
from ..method.controls import Control
from ..method.field import Colours, Densities, Directions, Points
from ..volume import composite

VARIANCE_WEIGHT = 1e-3  # weight of the variance of weights, supplement
EXPOSURE_SCALES = True  # an option of older runs: a factor per colour of each exposure is learnt, section 4.2
FINAL_LEARNING_RATE = 1e-3  # learning rate at the end of the budget, reached exponentially


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers of the loss, and those of a hash table in place of its network."""

    table: HashNumbers = HashNumbers()
    occupancy: OccupancyNumbers = OccupancyNumbers()
    steps: StepNumbers = StepNumbers()
    proposals: ProposalNumbers = ProposalNumbers()
    poses: PoseNumbers = PoseNumbers()
    epsilon: Positive = 1e-3  # epsilon of eq. 4; 1 is white in the longest exposure; higher: less weight in the dark
    huber_delta: NonNegative = 0.0  # relative error at which the loss turns from squared to linear; 0: always squared
    hidden_width: Width = 64  # neurons of a hidden layer; wider costs time
    learning_rate: LearningRate = 1e-2  # Adam's learning rate at first; higher learns faster, and may diverge
    hash_weight_decay: NonNegative = 0.0  # decoupled weight decay of an object's table, towards a density of 1


SOURCES = {  # of the numbers of `paper`; the others are ours
    "google-research/multinerf, internal/train_utils.py (5b4d4f6)": "epsilon huber_delta exposure_scales",
}
LENS_PLACES = 24  # through which a picture with a shallow focus is seen
DEFAULT_APERTURE = 0.06  # diameter of the lens, as a share of the distance, where a focus is told and no aperture
MAX_APERTURE, MAX_FOCUS = 0.5, 8.0  # aperture in scene units; focus in reaches
DECAY_START = 0.3  # share of the budget before the learning rate falls
WHITE_QUANTILE = 0.97  # quantile of the light that is shown as white, where nobody said how bright to develop it
GLANCE_PIXELS = 1 << 14  # pixels that tell how much light there is


class LightField(HashField):
    """A hash table with linear radiance in the camera's colours instead of encoded colour, 1 for a full sensor in the
    longest exposure: an exponential keeps it above zero and spans the range of light (section 4.1).

    level: log of the light that the scene has on average, where the network begins
    """

    level: Tensor

    def __init__(self, *arguments: Any, **named: Any):
        super().__init__(*arguments, **named)
        self.register_buffer("level", torch.tensor(-1.0))

    def activated(self, raw: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        return truncated_exp(raw + self.level)


class RawNeRF(FieldMethod):
    """Each pixel of a mosaic is compared in the one colour that it measured, noise and all, so that noise averages out
    over all photographs; the picture is developed afterwards."""

    Config, further_bytes = Config, staticmethod(sampling_bytes)
    looks = None  # type: ignore[assignment]  # samples hold light, and a picture is developed from its sum
    network: LightField
    exposure: Tensor
    group: Tensor
    free: Tensor
    gains: Tensor
    srgb_from_camera: Tensor
    brightness: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        self.poses = poses_for(frame, c.poses)
        joining = self.poses.weights if self.poses else None
        with seeded(c.seed):
            self.network = LightField(c.table, c.hidden_width, space, frame.reach, joining=joining)
        self.sampler = sampler_for(frame, space, c.occupancy, c.proposals, steps=c.steps)
        photographs = frame.image_count
        self.log_scale = nn.Parameter(torch.zeros(photographs, 3))
        self.register_buffer("exposure", torch.ones(photographs))  # of each photograph, of the longest
        self.register_buffer("group", torch.arange(photographs))  # photographs of one exposure share a number
        self.register_buffer("free", torch.ones(photographs))  # 0 for those whose scale is 1, by which others go
        self.register_buffer("gains", torch.ones(3))
        self.register_buffer("srgb_from_camera", torch.eye(3))
        self.register_buffer("brightness", torch.tensor(1.0))

    @classmethod
    def cpu_preset(cls) -> Any:
        return Config(**CPU_HASH, hidden_width=32, learning_rate=2e-2, hash_weight_decay=0.3, huber_delta=1.0)

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table with an error that is less relative: in a few steps its gross beginnings fall, and no more."""
        poses = PoseNumbers(refine_cameras=True)
        return Config(**TINY_HASH, poses=poses, hidden_width=16, learning_rate=2e-2, epsilon=1.0, huber_delta=1.0)

    # What there is to learn from

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        """Set exposure and colour from the photographs, and the mean light."""
        super().begin(data, seconds)
        scene, train = data, data.splits["train"]
        if "mosaic" not in scene.layers and "raw" not in scene.layers:
            warnings.warn(
                f"{scene.source} holds no raw light, so rawnerf learns what its pictures tell of it; give it raw files "
                "by way of lumigraph capture",
                LumigraphWarning,
                stacklevel=2,
            )
        said = scene.about.get("exposure")
        if said is not None and bool(said[train].isfinite().all()):
            exposure = (said / said[train].max()).nan_to_num(1.0)
            _, group = exposure.unique(return_inverse=True)
            longest = group[train][exposure[train].argmax()]
        else:  # each photograph is as bright as it turns out to be
            exposure, group, longest = torch.ones(len(scene)), torch.arange(len(scene)), train[0]
        self.exposure.copy_(exposure)
        self.group.copy_(group)
        self.free.copy_((group != longest).float())
        if "white_balance" in scene.about:
            self.gains.copy_(scene.about["white_balance"][train].nanmedian(0).values)
            self.srgb_from_camera.copy_(scene.about["srgb_from_camera"][train].nanmedian(0).values)
        glance = scene.sample_rays(GLANCE_PIXELS, self.random(0), layers=layers_of(scene)).to(self.device)
        light, measured = self.measured(glance)
        taken = self.exposure[glance.rays.image_index]
        self.network.level.copy_((light[measured].mean() / taken.mean()).clamp_min(1e-6).log())
        self.brightness.copy_(self.brightness_of(scene, light[measured[:, 1] & (taken == 1), 1]))

    def brightness_of(self, scene: Scene, green: Float[Tensor, " pixel"]) -> Float[Tensor, ""]:
        """Factor on linear light in development: that of the photographs, else one that clips few pixels.

        green: light of some pixels in the longest exposure
        """
        exposure = self.exposure.cpu()[scene.splits["train"]]
        if "brightness" in scene.about:
            return (scene.about["brightness"][scene.splits["train"]] * exposure).nanmedian()
        if "mosaic" in scene.layers:
            return 1 / (green.quantile(WHITE_QUANTILE) * self.gains[1]).clamp_min(1e-6)
        return exposure.median()

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        return data.sample_rays(self.sampler.batch_size, generator, layers=layers_of(data)).to(self.device)

    def measured(self, batch: Batch) -> tuple[Float[Tensor, "ray 3"], Bool[Tensor, "ray 3"]]:
        """Exposed light of a batch's pixels, and a mask of measured colours."""
        if "mosaic" in batch.extra:
            light = batch.extra["mosaic"][:, None].expand(-1, 3)
            behind = batch.extra["filter"][:, None] == torch.arange(3, device=light.device)
            return light, behind & light.isfinite()
        if "raw" in batch.extra:
            light = batch.extra["raw"][:, :3]
            return light, light.isfinite()
        light = decoded(batch.before(self.background))
        return light, torch.ones_like(light, dtype=torch.bool)

    # Learning

    def light(self, rays: Rays) -> Rendering:
        """Linear light along rays in the camera's colours, before black."""
        (samples,) = self.sampler.sample(rays, self.network)
        look = samples.look(self.network)
        return composite(look.samples, look.density, look.rgb)

    def light_and_spread(self, look: Look) -> Rendering:
        """Light of a look; the extra `moments` is the mean and the mean square of its samples' normalized distances."""
        s = normalized_distance(look.samples.t)
        return composite(look.samples, look.density, look.rgb, moments=torch.stack([s, s * s], -1))

    def scale(self, rays: Rays) -> Float[Tensor, "ray 3"]:
        """Factor on light in each photograph: its exposure times alpha of that exposure and colour (section 4.2)."""
        assert rays.image_index is not None
        alpha = (self.log_scale[self.group] * self.free[:, None]).exp()
        return (self.exposure[:, None] * alpha)[rays.image_index]

    def light_behind(self, batch: Batch) -> Float[Tensor, "#ray 3"]:
        """Light of the background in a batch's photographs, in the camera's colours: what development shows as the
        background, exposed as each photograph is. Behind alpha it is put in afterwards and has no exposure."""
        shown = decoded(self.background)
        if batch.alpha is not None and not batch.extra.keys() & {"mosaic", "raw"}:
            return shown
        light = torch.linalg.solve(self.srgb_from_camera, shown.T).T / (self.brightness * self.gains)
        return light * self.scale(batch.rays)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The squared error relative to the rendering (eq. 4): that of a tone curve with slope 1 / (y + epsilon)."""
        measured, known = self.measured(batch)
        (samples,), terms = self.learn(batch.rays, self.random(step))
        seen = self.light_and_spread(samples.look(self.network))
        shown = seen.rgb * self.scale(batch.rays) + (1 - seen.opacity)[:, None] * self.light_behind(batch)
        shown = torch.where(measured >= 1, shown.clamp(max=1), shown)  # a full sensor says: at least so much
        error = (shown - measured) / (shown.detach() + self.config.epsilon)
        first, second = seen.extra["moments"].unbind(-1)
        variance = (second - first.square() / seen.opacity.clamp_min(1e-3)).mean()
        return {"relative": self.penalized(error[known]), "variance": VARIANCE_WEIGHT * variance, **terms}

    def penalized(self, error: Float[Tensor, " value"]) -> Float[Tensor, ""]:
        """The mean square of relative errors; beyond a delta the tangent of the square, so that wrongly dark pixels do
        not dominate. Noise is far below."""
        if not (delta := self.config.huber_delta):
            return error.square().mean()
        return 2 * nn.functional.huber_loss(error, torch.zeros_like(error), delta=delta)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c = self.config
        optimizers = self.network.optimizers_at(c.learning_rate, c.hash_weight_decay)
        group: dict[str, Any] = {"params": [self.log_scale], "scale": 0.05}
        optimizers.append(torch.optim.Adam([group], lr=c.learning_rate, betas=(0.9, 0.99), eps=1e-15))
        return [*optimizers, *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> float:
        c = self.config
        return hold_and_decay(c.learning_rate, FINAL_LEARNING_RATE, step, progress, DECAY_START)

    # Being seen

    @property
    def controls(self) -> tuple[Control, ...]:
        wide = "Diameter of the lens: the wider, the more blurred is what lies before and behind the focus."
        sharp = "Distance that is sharp; 0: that of the picture's middle. Told alone, it opens the lens."
        aperture = Control("aperture", 0.0, (0.0, MAX_APERTURE), unit="scene units", about=wide)
        ends = 0.0, MAX_FOCUS * self.frame.reach
        return *CONTROLS, aperture, Control("focus", 0.0, ends, unit="scene units", about=sharp)

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        aperture, focus = float(self.control("aperture")), float(self.control("focus"))
        if not aperture and not focus:
            return super().render(camera)
        focus = focus or self.distance_ahead(camera)
        width, height = camera.size[0].tolist()
        sharp = self.chunked(camera.rays(camera.pixels()).to(self.device))
        light, opacity = torch.zeros_like(sharp.rgb), torch.zeros_like(sharp.opacity)
        for rays in through_lens(camera, aperture or DEFAULT_APERTURE * focus, focus, LENS_PLACES):
            seen = self.chunked(rays.to(self.device))
            light, opacity = light + seen.rgb / LENS_PLACES, opacity + seen.opacity / LENS_PLACES
        blurred = Rendering(light, sharp.depth, opacity)
        return self.developed(blurred, self.background).reshape(height, width)

    def chunked(self, rays: Rays) -> Rendering:
        """Light along any number of rays, in chunks."""
        parts = [slice(i, i + self.rays_per_chunk) for i in range(0, len(rays), self.rays_per_chunk)]
        return Rendering.cat([self.light(rays[part]) for part in parts])

    def distance_ahead(self, camera: Camera) -> float:
        """Depth along the optical axis of the surface at the centre of a camera's picture."""
        depth = float(self.light(camera.rays(camera.size[:1] / 2).to(self.device)).depth[0])
        return depth if math.isfinite(depth) else self.frame.reach

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        return self.developed(self.light(rays), background)

    def developed(self, seen: Rendering, background: Float[Tensor, "#ray 3"]) -> Rendering:
        """Light developed by the controls; `radiance` holds the unencoded part, linear sRGB."""
        light = self.linear(seen.rgb) + (1 - seen.opacity)[:, None] * decoded(background)
        rgb = toned(light, str(self.control("tone")))
        return Rendering(rgb, seen.depth, seen.opacity, {"radiance": light})

    def linear(self, light: Float[Tensor, "ray 3"]) -> Float[Tensor, "ray 3"]:
        """The camera's colours as linear sRGB, exposed and balanced as the controls say."""
        balanced = (self.brightness * self.gains * light) @ self.srgb_from_camera.T
        return exposed(balanced, float(self.control("exposure")), float(self.control("white_balance")))

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        density, light = self.network(points, directions)
        return density, toned(self.linear(light), str(self.control("tone")))


def layers_of(scene: Scene) -> tuple[str, ...]:
    """Names of the layers with a scene's light: mosaics, else linear photographs, else none."""
    if "mosaic" in scene.layers:
        return "mosaic", "filter"
    return ("raw",) if "raw" in scene.layers else ()


GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
MIN_COSINE = 0.2  # cosine with the axis below which a ray is taken to be no flatter


def through_lens(camera: Camera, aperture: float, focus: float, count: int) -> Iterator[Rays]:
    """Rays of all pixels of a camera (a batch of one) through so many places of its lens, one place after the other.

    aperture: diameter of the lens, scene units
    focus:    distance along the optical axis at which all of a pixel's rays meet, scene units
    Places lie on a spiral that fills the disc evenly (Vogel 1979), turned for each pixel by a fixed amount of its own,
    so that few of them make grain rather than rings, and the same grain each time.
    """
    pixels = camera.pixels()
    rays = camera.rays(pixels)
    right, down, forward = camera.pose[0, :, :3].unbind(-1)
    meeting = rays.at(focus / (rays.directions @ forward).clamp_min(MIN_COSINE))
    turn = 2 * math.pi * grain(pixels)
    for k in range(count):
        radius, angle = 0.5 * aperture * math.sqrt((k + 0.5) / count), GOLDEN_ANGLE * k + turn
        place = radius * (angle.cos()[:, None] * right + angle.sin()[:, None] * down)
        origins = rays.origins + place
        yield replace(rays, origins=origins, directions=torch.nn.functional.normalize(meeting - origins, dim=-1))


def grain(pixels: Float[Tensor, "pixel 2"]) -> Float[Tensor, " pixel"]:
    """A number in [0, 1) for each pixel, unlike its neighbours' (interleaved gradient noise, Jimenez 2014)."""
    weights = torch.tensor([0.06711056, 0.00583715], dtype=torch.float64)
    return ((52.9829189 * ((pixels.double().cpu() @ weights) % 1)) % 1).to(pixels)
