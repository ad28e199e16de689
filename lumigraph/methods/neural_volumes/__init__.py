"""Neural Volumes: photographs of a moment to a code, a code to a warped volume (Lombardi et al. 2019, 1906.07751)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from ...camera.rays import Rays, Rendering
from ...color.blending import over
from ...components.sampling.sampling import stratified
from ...components.training.schedules import held_decay
from ...datasets.scene import Batch, Frame, Scene
from ...errors import LumigraphError
from ...files.ranges import BatchSize, LearningRate, RaySamples, Width, between
from ...method import BaseConfig, RayMethod, seeded
from ...method.controls import Control, moment
from ...method.field import Colours, Densities, Directions, Points
from .cameras import Backgrounds, Rig
from .networks import Decoded, Encoder, VolumeDecoder, divergence, opacity_prior, opacity_roughness

Side = Annotated[int, between(8, 1024)]


SHARED_RATE = 25.0  # learning rate of what all moments share, as a multiple of the others'
ENCODER_CAMERAS = 3  # cameras whose pictures are encoded, section 4.1
DIVERGENCE_WEIGHT = 1e-3  # of the code's divergence from the unit Gaussian
OPACITY_WEIGHT = 0.01  # of rays that are neither opaque nor clear, section 5.4
SMOOTH_WEIGHT = 0.01  # of the total variation of log opacity, section 5.4


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers; `NeuralVolumes.preset` has those of a plain CPU."""

    encoder_size: Side = 512  # pixels a side of those pictures, a power of two; larger ones cost memory and time
    encoder_width: Width = 64  # channels of the encoder's first layers; later ones have up to 4 times as many
    code: Annotated[int, between(1, 4096)] = 256  # numbers of a moment's code, section 4.1
    volume_resolution: Side = 128  # voxels along each side of the template, a power of two, section 4.2
    volume_width: Width = 1024  # channels of its first layer; each doubling of its side halves them, every other time
    shared_resolution: Annotated[int, between(0, 1024)] = 0  # voxels along a side of what all moments share; 0: nothing
    affines: Annotated[int, between(0, 256)] = 16  # affine maps that warp it, section 5.2; 0: no warp
    warp_resolution: Side = 32  # cells along each side of the warp, section 5.2
    warp_width: Width = 128  # channels of the layers that make affine maps
    view_dependence: bool = False  # colours depend on the camera's direction, section 4.2; each camera is decoded
    background_size: Side = 256  # pixels a side of each camera's background, where photographs are opaque
    samples: RaySamples = 128  # samples of a ray; more are sharper, slower
    moments_per_step: Annotated[int, between(1, 256)] = 16  # moments in a step; each is decoded
    rays_per_step: BatchSize = 1 << 18  # rays of a step, of all its moments; the release has 128 x 128 of each
    learning_rate: LearningRate = 1e-4  # Adam's learning rate at first; higher: faster, may diverge
    final_learning_rate: LearningRate = 1e-4  # learning rate at the end of the budget, reached exponentially
    decay_start: Annotated[float, between(0, 0.99)] = 0.0  # share of the budget before the learning rate falls

    def check(self) -> None:
        """Raises LumigraphError for sides that halving does not lead to."""
        for name in ("encoder_size", "volume_resolution"):
            side = getattr(self, name)
            if side & (side - 1):
                raise LumigraphError(f"--{name.replace('_', '-')} {side} is no power of two; give 64 or 128")

    def further_bytes(self, frame: Frame, learning: bool) -> int:
        """Lower bound of the bytes of a decoded volume's activations."""
        decoded = self.volume_resolution**3 * (4 + self.volume_width // 64)
        return 4 * (decoded + 4 * self.shared_resolution**3) * (2 if learning else 1)


SOURCES = {  # of the numbers of `paper`; the others are ours
    "facebookresearch/neuralvolumes, models/encoders/mvconv1.py (8c5fad4)": "encoder_size encoder_width code",
    "facebookresearch/neuralvolumes, models/decoders/voxel1.py (8c5fad4)": (
        "volume_resolution volume_width affines warp_resolution warp_width view_dependence"
    ),
    "Giogia/Neural-Scene-Rendering, experiments/dryice1/experiment1/config.py (666649f), a copy of the release's": (
        "encoder_cameras samples moments_per_step rays_per_step divergence_weight opacity_weight smooth_weight "
        "learning_rate"
    ),
}


class NeuralVolumes(RayMethod):
    """An autoencoder of moments: from pictures of a few cameras to a volume that all cameras see."""

    Config, learning_rate = Config, held_decay

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        with seeded(c.seed):
            self.encoder = Encoder(ENCODER_CAMERAS, c.encoder_size, c.encoder_width, c.code)
            warp = c.affines, c.warp_resolution, c.warp_width
            sides = c.shared_resolution, c.view_dependence
            self.decoder = VolumeDecoder(c.code, c.volume_resolution, c.volume_width, *warp, *sides)
        self.rig = Rig(ENCODER_CAMERAS, c.encoder_size)
        self.backgrounds = Backgrounds(frame, c.background_size, learns_background=not frame.has_alpha)
        self.decoded: tuple[Any, Any] = (None, None)  # of the last picture

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        return config.further_bytes(frame, learning)

    @classmethod
    def cpu_preset(cls) -> Any:
        """Smaller pictures and networks, one moment in a step, a higher learning rate, and a finer volume that all
        moments share."""
        return Config(
            encoder_size=64, encoder_width=16, code=64, volume_resolution=32, volume_width=256, affines=8,
            shared_resolution=64, warp_resolution=16, warp_width=64, background_size=32, samples=64,
            moments_per_step=1, rays_per_step=2048, learning_rate=2e-3, final_learning_rate=2e-4, decay_start=0.3,
        )  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Tiny pictures and volumes of 16 voxels a side, within some twenty quick steps."""
        return Config(encoder_size=8, encoder_width=4, code=8, volume_resolution=16, volume_width=32, affines=2,
            warp_resolution=8, warp_width=8, background_size=8, samples=24, moments_per_step=1, shared_resolution=16,
            rays_per_step=256, learning_rate=1e-2, final_learning_rate=1e-3)  # fmt: skip

    # Codes and volumes

    def encoded(self, moment: int) -> tuple[Tensor, Tensor]:
        """Mean and log deviation of a moment's code."""
        return self.encoder(self.rig.inputs(moment))

    def code_at(self, time: float) -> Float[Tensor, "1 code"]:
        """Mean code of a moment; between two moments theirs, interpolated."""
        times = self.rig.times
        after = int(torch.searchsorted(times, torch.tensor([time], device=times.device)).clamp(0, len(times) - 1))
        before = max(after - 1, 0)
        gap = float(times[after] - times[before])
        share = min(max((time - float(times[before])) / gap, 0.0), 1.0) if gap else 1.0
        if share == 1:
            return self.encoded(after)[0]
        return torch.lerp(self.encoded(before)[0], self.encoded(after)[0], share)

    def volume_at(self, time: float, toward: Float[Tensor, " 3"]) -> Decoded:
        """Decoded volume of a time for renderings; the last one is cached."""
        key = time, toward.tolist() if self.config.view_dependence else None, self.encoder.mean.weight._version
        if self.decoded[0] != key:
            code = self.code_at(time)
            self.decoded = key, self.decoder.with_rough(Decoded(code, *self.decoder(code, toward)))
        return self.decoded[1]

    @property
    def controls(self) -> tuple[Control, ...]:
        return (*super().controls, *((moment(self.frame.times),) if self.frame.times else ()))

    # Along rays

    def march(
        self, rays: Rays, volume: Decoded, generator: torch.Generator | None = None
    ) -> tuple[Float[Tensor, "ray 3"], Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Colour, opacity and mean distance of rays through a volume (eq. 3): opacity accumulates along a ray, up to 1.

        alpha(t) = min(integral of V_alpha, 1)      C = integral of V_rgb d alpha
        """
        near, far = rays.through_box(self.box)
        near = near.clamp_min(self.frame.near)
        far = torch.maximum(far, near)
        shares = stratified(len(rays), self.config.samples, generator, self.device)
        t = torch.lerp(near[:, None], far[:, None], shares)
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        alpha, rgb = self.decoder.look_up(volume, self.coordinates(points.flatten(0, 1)))
        step = ((far - near) / self.config.samples)[:, None]
        total = (alpha.view(t.shape) * self.per_unit * step).cumsum(1).clamp(max=1)
        weights = torch.diff(total, dim=1, prepend=torch.zeros_like(total[:, :1]))
        light = (weights[..., None] * rgb.view(*t.shape, 3)).sum(1) * self.backgrounds.gain(rays)
        opacity = total[:, -1]
        depth = torch.where(opacity > 1e-3, (weights * t).sum(1) / opacity.clamp_min(1e-3), torch.inf)
        return light, opacity, depth

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        return torch.tensor(self.frame.bounds, device=self.device)

    @property
    def per_unit(self) -> float:
        """Units of the volume's coordinates to a scene unit."""
        low, high = self.frame.bounds
        return 2 / max(b - a for a, b in zip(low, high, strict=True))

    def coordinates(self, points: Points) -> Points:
        """Places in the volume, which is a cube around the box of interest."""
        return (points - self.box.mean(0)) * self.per_unit

    def toward(self, origins: Points) -> Float[Tensor, " 3"]:
        """Direction from the volume to a camera."""
        return normalize(origins[0] - self.box.mean(0), dim=-1)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        times, parts = self.moments(rays), torch.zeros(len(rays), 5, device=self.device)
        for time in times.unique().tolist():
            own = times == time
            light, opacity, depth = self.march(rays[own], self.volume_at(time, self.toward(rays.origins[own])))
            parts[own] = torch.cat([light, opacity[:, None], depth[:, None]], 1)
        light, opacity, depth = parts.split([3, 1, 1], 1)
        rgb = over(light, opacity[:, 0], self.backgrounds.colours(rays, background))
        return Rendering(rgb, depth[:, 0], opacity[:, 0])

    # At points

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Opacity per scene unit and colour, at the moment of the settings."""
        first, _ = self.frame.times or (0.0, 0.0)
        volume = self.volume_at(float(self.settings.get("time", first)), -directions.mean(0))
        alpha, rgb = self.decoder.look_up(volume, self.coordinates(points))
        return self.per_unit * alpha, rgb

    def density(self, points: Points) -> Densities:
        return self.field(points, torch.zeros_like(points))[0]

    # Learning

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        """Rays of a few moments."""
        train, time = data.splits["train"], data.cameras.time
        if time is not None:
            moments = time[train].unique()
            drawn = moments[torch.randperm(len(moments), generator=generator)[: self.config.moments_per_step]]
            data = replace(data, splits={"train": train[torch.isin(time[train], drawn)]})
        return data.sample_rays(self.config.rays_per_step, generator).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The squared error of standardised colours, the code's divergence, and priors on opacity (section 5.4)."""
        generator, c = self.random(step), self.config
        target, times = batch.before(self.background), self.moments(batch.rays)
        moments = times.unique().tolist()
        terms = dict.fromkeys(("image", "divergence", "opacity", "smooth"), torch.zeros((), device=self.device))
        for time in moments:
            index = int(torch.searchsorted(self.rig.times, torch.tensor([time], device=self.device)))
            mean, deviation = self.encoded(min(index, len(self.rig.times) - 1))
            noise = torch.randn(mean.shape, generator=generator).to(mean)
            code, own = mean + deviation.exp() * noise, times == time
            rays = batch.rays[own]
            groups = self.by_camera(rays) if c.view_dependence else [torch.arange(len(rays), device=self.device)]
            for group in groups:
                some, volume = rays[group], self.decoder(code, self.toward(rays.origins[group]))
                light, opacity, _ = self.march(some, Decoded(code, *volume), generator)
                seen = over(light, opacity, self.backgrounds.colours(some, self.background))
                error = (seen - target[own][group]).square().mean() * (len(group) / len(target))
                terms["image"] = terms["image"] + error
                share = 1 / (len(moments) * len(groups))
                terms["opacity"] = terms["opacity"] + share * OPACITY_WEIGHT * opacity_prior(opacity)
                terms["smooth"] = terms["smooth"] + share * SMOOTH_WEIGHT * opacity_roughness(volume[0])
            terms["divergence"] = terms["divergence"] + DIVERGENCE_WEIGHT / len(moments) * divergence(mean, deviation)
        self.figures["mse"] = float(terms["image"].detach())
        return terms | {"image": terms["image"] / self.rig.deviation**2}

    @staticmethod
    def by_camera(rays: Rays) -> list[Tensor]:
        """Rows of rays with the same origin."""
        _, origin = rays.origins.unique(dim=0, return_inverse=True)
        return [(origin == i).nonzero()[:, 0] for i in range(int(origin.max()) + 1)]

    def optimizers(self) -> list[torch.optim.Optimizer]:
        shared = self.decoder.shared
        groups: list[dict[str, Any]] = [{"params": [p for p in self.parameters() if p is not shared]}]
        if shared is not None:
            groups.append({"params": [shared], "scale": SHARED_RATE})
        return [torch.optim.Adam(groups, self.config.learning_rate, fused=True), *super().optimizers()]
