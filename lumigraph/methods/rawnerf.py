"""RawNeRF: light as sensors measured it, learnt from mosaics full of noise (Mildenhall et al. 2022, arXiv 2111.13679).

The field is Instant-NGP's, so that a CPU learns it in minutes; the paper's is mip-NeRF's network.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, fields
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from .. import kernels
from ..camera import Camera
from ..components.fields.activations import truncated_exp
from ..components.fields.development import CONTROLS, decoded, exposed, toned
from ..components.fields.hash_field import HashField, HashNumbers, side_by_side
from ..components.sampling.spaces import Space
from ..components.sampling.thin_lens import through_lens
from ..components.training.fog import evened
from ..controls import Control
from ..errors import LumigraphWarning
from ..method import RayMethod
from ..ranges import Layers, LearningRate, NonNegative, Positive, Seed, Share, Steps, Width, between
from ..rays import Look, Rays, Rendering
from ..scene import Batch, Frame, Scene
from ..volume import composite
from .instant_ngp import Config as NgpConfig
from .instant_ngp import InstantNGP


@dataclass(frozen=True)
class Config(HashNumbers):
    """The paper's numbers of the loss, and Instant-NGP's of the field, which are explained there."""

    epsilon: Positive = 1e-3  # added to what the error is relative to, eq. 4; 1 is white in the longest exposure
    variance_weight: NonNegative = 1e-3  # of the variance of weights along a ray, supplement
    exposure_scales: bool = True  # learn a factor per colour of each exposure, section 4.2
    hidden_width: Width = 64
    density_layers: Layers = 1
    colour_layers: Layers = 2
    geometry_features: Annotated[int, between(1, 256)] = 16
    sh_bands: Annotated[int, between(1, 4)] = 4
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 18
    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 1024
    cone_angle: Share = 1 / 256
    transmittance_threshold: Share = 1e-4
    occupancy_resolution: Annotated[int, between(4, 512)] = 128
    occupancy_threshold: NonNegative = 0.05
    occupancy_interval: Steps = 16
    occupancy_decay: Share = 0.95
    learning_rate: LearningRate = 1e-2
    final_learning_rate: LearningRate = 1e-3
    hash_weight_decay: NonNegative = 0.0
    refine_cameras: bool = False  # learn a correction of each photograph's pose
    seed: Seed = 0

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        self.field.check()

    @property
    def field(self) -> NgpConfig:
        """The numbers of the field, as Instant-NGP has them."""
        return NgpConfig(**{name: getattr(self, name) for name in OF_THE_FIELD}, exposure_correction="no")

    @classmethod
    def around(cls, field: NgpConfig, **own: Any) -> Config:
        """The numbers of a field, with those of the loss."""
        return cls(**{name: getattr(field, name) for name in OF_THE_FIELD}, **own)


OF_THE_FIELD = {x.name for x in fields(NgpConfig)} & {x.name for x in fields(Config)}
LENS_PLACES = 24  # through which a picture with a shallow focus is seen
OPENED = 0.06  # diameter of the lens, as a share of the distance, where a focus is told and no aperture
WIDEST, FARTHEST = 0.5, 8.0  # aperture in scene units; focus in reaches
GROSS = 1.0  # relative error from which on the loss is linear
WHITE = 0.97  # quantile of the light that is shown as white, where nobody said how bright to develop it
GLANCE = 1 << 14  # pixels that tell how much light there is


class LightField(HashField):
    """Instant-NGP's field with linear radiance instead of encoded colour: an exponential keeps it above zero and
    spans the range of light (section 4.1).

    level: log of the light that the scene has on average, where the network begins
    """

    level: Tensor

    def __init__(self, config: NgpConfig, space: Space, reach: float):
        super().__init__(config, space, reach)
        self.register_buffer("level", torch.tensor(-1.0))

    def colour(
        self,
        geometry: Float[Tensor, "sample geometry"],
        directions: Float[Tensor, "sample 3"],
        *codes: Float[Tensor, "sample code"],
    ) -> Float[Tensor, "sample 3"]:
        """Light in the camera's colours, 1 for what fills the sensor in the longest exposure."""
        harmonics = kernels.spherical_harmonics(directions, self.bands)
        return truncated_exp(self.colour_network(side_by_side(geometry, harmonics, *codes)) + self.level)


class RawNeRF(RayMethod):
    """Each pixel of a mosaic is compared in the one colour that it measured, noise and all, so that noise averages out
    over all photographs; the picture is developed afterwards."""

    Config = Config
    exposure: Tensor
    group: Tensor
    free: Tensor
    gains: Tensor
    srgb_from_camera: Tensor
    brightness: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.marcher = InstantNGP(frame, config.field)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.marcher.network = LightField(config.field, self.marcher.space, frame.reach)
        photographs = frame.image_count
        self.log_scale = nn.Parameter(torch.zeros(photographs, 3), requires_grad=config.exposure_scales)
        self.register_buffer("exposure", torch.ones(photographs))  # of each photograph, of the longest
        self.register_buffer("group", torch.arange(photographs))  # photographs of one exposure share a number
        self.register_buffer("free", torch.ones(photographs))  # 0 for those whose scale is 1, by which others go
        self.register_buffer("gains", torch.ones(3))
        self.register_buffer("srgb_from_camera", torch.eye(3))
        self.register_buffer("brightness", torch.tensor(1.0))

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """What Instant-NGP takes on this device."""
        return Config.around(InstantNGP.preset(device))

    @classmethod
    def smallest(cls) -> Any:
        """Instant-NGP's, with an error that is less relative: in a few steps its gross beginnings fall, and no more."""
        return Config.around(InstantNGP.smallest(), epsilon=1.0)

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        return InstantNGP.further_bytes(frame, config.field, learning)

    def rehearse_begin(self) -> None:
        self.marcher.rehearse_begin()

    # What there is to learn from

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        """Take what the photographs say of exposure and colour, and how much light there is in all."""
        self.marcher.begin(scene, seconds)
        train = scene.splits["train"]
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
        glance = scene.sample_rays(GLANCE, self.random(0), layers=layers_of(scene)).to(self.device)
        light, measured = self.measured(glance)
        taken = self.exposure[glance.rays.image_index]
        network = self.marcher.network
        assert isinstance(network, LightField)
        network.level.copy_((light[measured].mean() / taken.mean()).clamp_min(1e-6).log())
        self.brightness.copy_(self.brightness_of(scene, light[measured[:, 1] & (taken == 1), 1]))

    def brightness_of(self, scene: Scene, green: Float[Tensor, " pixel"]) -> Float[Tensor, ""]:
        """What linear light is multiplied by when it is developed: as the photographs were, else so that little of it
        is beyond white.

        green: light of some pixels in the longest exposure
        """
        exposure = self.exposure.cpu()[scene.splits["train"]]
        if "brightness" in scene.about:
            return (scene.about["brightness"][scene.splits["train"]] * exposure).nanmedian()
        if "mosaic" in scene.layers:
            return 1 / (green.quantile(WHITE) * self.gains[1]).clamp_min(1e-6)
        return exposure.median()

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        return data.sample_rays(int(self.marcher.rays_per_step), generator, layers=layers_of(data)).to(self.device)

    def rays_in_a_step(self, data: Scene) -> float:
        return self.marcher.rays_in_a_step(data)

    def measured(self, batch: Batch) -> tuple[Float[Tensor, "ray 3"], Bool[Tensor, "ray 3"]]:
        """The light of a batch's pixels as it was exposed, and which of its colours were measured."""
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
        """Linear light along rays in the camera's colours, before nothing."""
        (look,) = self.marcher.looks(rays)
        return composite(look.samples, look.density, look.rgb)

    def light_and_spread(self, look: Look) -> Rendering:
        """The light of a look, and how far from one another the weights lie that make each ray's colour: the extra
        `moments` is the mean and the mean square of their places."""
        s = evened(look.samples.t)
        return composite(look.samples, look.density, look.rgb, moments=torch.stack([s, s * s], -1))

    def scale(self, rays: Rays) -> Float[Tensor, "ray 3"]:
        """What light is multiplied by in each ray's photograph: its exposure, times alpha, which is learnt for each
        exposure and colour (section 4.2)."""
        assert rays.image_index is not None
        alpha = (self.log_scale[self.group] * self.free[:, None]).exp()
        return (self.exposure[:, None] * alpha)[rays.image_index]

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The squared error relative to what is shown (eq. 4): that of a tone curve with slope 1 / (y + epsilon)."""
        measured, known = self.measured(batch)
        rays = self.marcher.poses(batch.rays) if self.marcher.poses else batch.rays
        look, terms = self.marcher.look_to_learn(rays, self.random(step))
        seen = self.light_and_spread(look)
        shown = seen.rgb * self.scale(batch.rays) + (1 - seen.opacity)[:, None] * decoded(self.background)
        shown = torch.where(measured >= 1, shown.clamp(max=1), shown)  # a full sensor says: at least so much
        error = (shown - measured) / (shown.detach() + self.config.epsilon)
        self.figures |= self.marcher.figures
        first, second = seen.extra["moments"].unbind(-1)
        variance = (second - first.square() / seen.opacity.clamp_min(1e-3)).mean()
        # Gross errors count linearly: noise is far below, and what is dark by mistake does not outweigh all else.
        relative = 2 * nn.functional.huber_loss(error[known], torch.zeros_like(error[known]), delta=GROSS)
        return {"relative": relative, "variance": self.config.variance_weight * variance, **terms}

    def optimizers(self) -> list[torch.optim.Optimizer]:
        optimizers = self.marcher.optimizers()
        if self.config.exposure_scales:
            group: dict[str, Any] = {"params": [self.log_scale], "scale": 0.05}
            optimizers.append(torch.optim.Adam([group], lr=self.config.learning_rate, betas=(0.9, 0.99), eps=1e-15))
        return optimizers

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        return self.marcher.learning_rate(step, progress)

    def before_step(self, step: int, progress: float) -> None:
        self.marcher.before_step(step, progress)

    def after_step(self, step: int) -> None:
        self.marcher.after_step(step)

    # Being seen

    @property
    def controls(self) -> tuple[Control, ...]:
        return (
            *CONTROLS,
            Control(
                "aperture",
                0.0,
                (0.0, WIDEST),
                unit="scene units",
                about="Diameter of the lens: the wider, the more blurred is what lies before and behind the focus.",
            ),
            Control(
                "focus",
                0.0,
                (0.0, FARTHEST * self.frame.reach),
                unit="scene units",
                about="Distance that is sharp; 0: that of the picture's middle. Told alone, it opens the lens.",
            ),
        )

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        aperture, focus = float(self.control("aperture")), float(self.control("focus"))
        if not aperture and not focus:
            return super().render(camera)
        focus = focus or self.distance_ahead(camera)
        width, height = camera.size[0].tolist()
        sharp = self.chunked(camera.rays(camera.pixels()).to(self.device))
        light, opacity = torch.zeros_like(sharp.rgb), torch.zeros_like(sharp.opacity)
        for rays in through_lens(camera, aperture or OPENED * focus, focus, LENS_PLACES):
            seen = self.chunked(rays.to(self.device))
            light, opacity = light + seen.rgb / LENS_PLACES, opacity + seen.opacity / LENS_PLACES
        blurred = Rendering(light, sharp.depth, opacity)
        return self.developed(blurred, self.background).reshape(height, width)

    def chunked(self, rays: Rays) -> Rendering:
        """The light along any number of rays."""
        parts = [slice(i, i + self.rays_per_chunk) for i in range(0, len(rays), self.rays_per_chunk)]
        return Rendering.cat([self.light(rays[part]) for part in parts])

    def distance_ahead(self, camera: Camera) -> float:
        """How far away along the optical axis that is what the middle of a camera's picture shows."""
        depth = float(self.light(camera.rays(camera.size[:1] / 2).to(self.device)).depth[0])
        return depth if math.isfinite(depth) else self.frame.reach

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        return self.developed(self.light(rays), background)

    def developed(self, seen: Rendering, background: Float[Tensor, "#ray 3"]) -> Rendering:
        """Light as the picture that the controls ask for; `radiance` holds what of it was not encoded, linear sRGB."""
        light = self.linear(seen.rgb) + (1 - seen.opacity)[:, None] * decoded(background)
        rgb = toned(light, str(self.control("tone")))
        return Rendering(rgb, seen.depth, seen.opacity, {"radiance": light})

    def linear(self, light: Float[Tensor, "ray 3"]) -> Float[Tensor, "ray 3"]:
        """The camera's colours as linear sRGB, exposed and balanced as the controls say."""
        balanced = (self.brightness * self.gains * light) @ self.srgb_from_camera.T
        return exposed(balanced, float(self.control("exposure")), float(self.control("white_balance")))

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        density, light = self.marcher.field(points, directions)
        return density, toned(self.linear(light), str(self.control("tone")))

    def density(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """Density per scene unit."""
        return self.marcher.density(points)

    def refined(self, cameras: Camera) -> Camera:
        return self.marcher.refined(cameras)


def layers_of(scene: Scene) -> tuple[str, ...]:
    """What of a scene tells light best: mosaics, linear photographs, else pictures alone."""
    if "mosaic" in scene.layers:
        return "mosaic", "filter"
    return ("raw",) if "raw" in scene.layers else ()
