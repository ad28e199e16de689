"""EG3D: a generator of objects on three planes, learnt from photographs by an adversary (Chan et al. 2022, arXiv
2112.07945)."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...budget import Effort, Efforts
from ...camera import Camera
from ...camera.lens import Pinhole
from ...camera.rays import Rays, Rendering, Samples
from ...components.fields.appearance import fitted
from ...components.fields.kept_photographs import Kept, chance, photographed, square
from ...components.fields.spaces import Box
from ...components.sampling.sampling import inverse_transform, midpoints, stratified
from ...components.training.adversarial import (
    Discriminator,
    Mapping,
    discriminator_loss,
    follow,
    generator_loss,
    lazy_adam,
    r1_penalty,
    widths_of,
)
from ...datasets.collection import Collection
from ...datasets.scene import Frame, Scene
from ...errors import LumigraphError
from ...files.ranges import Layers, LearningRate, NonNegative, Positive, RaySamples, Width, between
from ...method import BaseConfig, Descend, Method, frozen, seeded
from ...method.controls import Control, Value
from ...method.field import Colours, Densities, Directions, Points
from ...system.work import at_work
from ...volume import composite, weights_of
from .fields import FilmField, Made, MadeField, PlaneField
from .networks import Pictures, Style, Styles, SuperResolution, blurred, resized

Tally = Annotated[int, between(0, 100_000_000)]
Side = Annotated[int, between(8, 1024)]
Label = Float[Tensor, "picture 25"]
DISCRIMINATOR_RATE = 0.002  # Adam's learning rate of the discriminator
DENSITY_WEIGHT = 0.25  # weight of differences in density between neighbouring points
DENSITY_DISTANCE = 0.004  # deviation of such points from each other, in units of the planes
DENSITY_INTERVAL = 4  # steps from one such term to the next
SWAP_PROBABILITY = 0.5  # of conditioning the generator on another pose than that of the picture, section 4.4
CODE_LEARNING_RATE = 0.1  # Adam's learning rate of that fit, in deviations of the styles
CODE_PRIOR = 1e-3  # weight of a style's squared distance from the average, in deviations
TUNE_LEARNING_RATE = 3e-4  # Adam's learning rate of tuning; higher changes the generator more
MAPPING_LAYERS = 2  # layers of the mapping network
GROWTH_START = 25 / 27.5  # share of the budget from which the rendering grows, over a share of 0.04
R1_INTERVAL = 16  # steps from one R1 to the next


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers for FFHQ at 512 pixels, as its published code has them (NVlabs/eg3d, train.py)."""

    picture_size: Side = 512  # pixels across of pictures, a power of two; larger ones cost time
    rendering_size: Side = 64  # pixels across of the volume rendering, section 4.2; larger is sharper and slower
    final_rendering_size: Side = 128  # pixels across of the volume rendering in the end, section 5
    super_resolution: Literal[2, 4] = 4  # factor from the features to the picture, section 4.3
    super_widths: tuple[Width, Width] = (256, 128)  # channels of the super-resolution's two blocks
    field: Literal["planes", "film"] = "planes"  # planes, or pi-GAN's sines without super-resolution
    plane_size: Side = 256  # nodes across a plane, a power of two; more hold finer detail
    plane_channels: Annotated[int, between(1, 256)] = 32  # channels of a plane
    features: Annotated[int, between(4, 256)] = 32  # features of a pixel of the volume rendering, colours included
    decoder_width: Width = 64  # hidden channels of the decoder, section 4.1
    film_width: Width = 256  # channels of pi-GAN's layers
    film_layers: Layers = 8  # layers of pi-GAN
    coarse_samples: RaySamples = 48  # samples of a ray; more are finer, and cost time
    fine_samples: RaySamples = 48  # further samples where the first are dense
    density_scale: Positive = 1.0  # density per scene unit where its activation is one; higher makes walls sooner
    density_shift: Annotated[float, between(-20, 20)] = -1.0  # added ahead of the softplus; lower begins emptier
    code: Width = 512  # numbers of a random code
    style: Width = 512  # numbers of a style
    channel_base: Annotated[int, between(8, 1 << 20)] = 32_768  # channels at a size, times the size; more cost time
    channel_most: Width = 512  # channels at most
    pictures_per_step: Annotated[int, between(1, 1024)] = 32  # photographs, and made pictures, of a step
    learning_rate: LearningRate = 0.0025  # Adam's learning rate of the generator
    r1_weight: NonNegative = 1.0  # gamma of R1: 0.3 for cars, 1 for faces, 5 for cats; small batches need more
    swap_pictures: Tally = 1_000_000  # pictures over which that probability falls from one
    blur_deviation: NonNegative = 10.0  # pixels by which the discriminator's pictures are blurred at first
    blur_pictures: Tally = 200_000  # pictures over which that blur vanishes
    average_pictures: Tally = 10_000  # pictures in which the averaged weights forget half; fewer follow sooner
    # Finding the code of photographs (Roich 2021, pivotal tuning).
    code_steps: Tally = 500  # steps that fit a style to photographs; more take longer
    tune_steps: Tally = 500  # steps that tune the generator to the photographs; 0: style alone

    def check(self) -> None:
        """Raises LumigraphError for sizes that do not fit together."""
        for name in ("picture_size", "plane_size"):
            if (size := getattr(self, name)) & (size - 1):
                raise LumigraphError(f"{name} {size} is no power of two; give 64 or 128, for example")
        if max(self.rendering_size, self.final_rendering_size) > self.picture_size:
            raise LumigraphError(
                f"A volume rendering of {max(self.rendering_size, self.final_rendering_size)} pixels is larger than "
                f"the picture's {self.picture_size}; give a smaller rendering_size"
            )


SOURCES = {  # of the numbers of `paper`; the others are ours
    "NVlabs/eg3d, eg3d/train.py (7cf1fd1)": (
        "coarse_samples fine_samples code style mapping_layers channel_base channel_most learning_rate "
        "discriminator_rate density_weight density_distance density_interval swap_probability swap_pictures "
        "blur_deviation blur_pictures average_pictures"
    ),
    "NVlabs/eg3d, eg3d/training/triplane.py (7cf1fd1)": "field plane_size plane_channels features decoder_width",
    "NVlabs/eg3d, eg3d/training/superresolution.py (7cf1fd1)": "super_resolution super_widths",
    "NVlabs/eg3d, eg3d/training/volumetric_rendering/ray_marcher.py (7cf1fd1)": "density_scale density_shift",
    "NVlabs/eg3d, eg3d/training/training_loop.py (7cf1fd1)": "r1_interval",
    "NVlabs/eg3d, docs/training_guide.md (7cf1fd1)": "rendering_size final_rendering_size pictures_per_step r1_weight",
    "Chan 2022, sections 4 and 5": "picture_size growth_start",
    "Chan 2021, supplement, of the generator with --field film": "film_width film_layers",
}


@dataclass(frozen=True)
class AdversarialLesson:
    """Photographs with their cameras, and as many cameras of generated pictures."""

    unit: ClassVar[str] = "pictures"

    real: Pictures
    cameras: Camera
    views: Camera

    def __len__(self) -> int:
        return len(self.real)


GROWTH = 1 / 27.5  # share of the budget over which the rendering grows
AVERAGE_RAMP = 0.05  # share of the pictures so far, in which the averaged weights forget half at the beginning
STYLE_KEEP = 0.998  # share of the average style that a step keeps; fewer steps than 500 have their plain mean
DENSITY_POINTS = 1000  # of each field
STYLE_CANDIDATES = 64  # random styles at most that a fit may begin with
STYLE_SAMPLES = 512  # random codes from which the deviation of styles is measured
MAX_SEED = 9999
LABEL = 25  # numbers of a camera: pose 4x4, intrinsics 3x3
RAYS_AT_ONCE = 16_384


class ObjectGenerator(nn.Module):
    """Mapping network, field and super-resolution: the whole generator.

    average: moving average of styles
    """

    average: Tensor

    def __init__(self, config: Config):
        super().__init__()
        c = config
        self.mapping = Mapping(c.code, LABEL, c.style, MAPPING_LAYERS)
        self.upscaling: SuperResolution | None = None
        if c.field == "planes":
            widths = widths_of(c.plane_size, c.channel_base, c.channel_most)
            self.field: MadeField = PlaneField(c.plane_channels, widths, c.style, c.decoder_width, c.features)
            self.upscaling = SuperResolution(c.features, c.super_widths, c.style, c.super_resolution)
        else:
            self.field = FilmField(c.film_width, c.film_layers, c.style, 3)
        self.register_buffer("average", torch.zeros(c.style))

    def repeated(self, styles: Style) -> Styles:
        """The same style for each layer."""
        return styles[:, None].expand(-1, self.field.styles, -1)


class EG3D(Method):
    """Learns from a Collection to generate objects that look like its photographs; `given` a Scene, it inverts the
    generator for the scene's photographs."""

    Config, learns_from, accepts = Config, Collection, (Scene,)
    efforts: ClassVar[Efforts] = {"draft": Effort(50, 2000), "good": Effort(500, 20_000), "best": Effort(5000, 200_000)}
    label: Tensor
    size: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        with seeded(c.seed):
            self.generator = ObjectGenerator(c)
            channels = 6 if self.generator.upscaling else 3
            widths = widths_of(c.picture_size, c.channel_base, c.channel_most)
            self.discriminator = Discriminator(channels, widths, LABEL)
        self.averaged = copy.deepcopy(self.generator).requires_grad_(False)
        self.found = Kept(torch.empty(0, c.style))  # the style of what was drawn, or found in photographs
        self.register_buffer("label", torch.zeros(LABEL))  # of the pose that renderings are conditioned on
        self.register_buffer("size", torch.tensor(c.rendering_size))  # of the volume rendering, as it has grown
        self._adversaries: list[torch.optim.Optimizer] = []
        self._shown: tuple[Made, Style] | None = None  # until a step changes it

    @classmethod
    def cpu_preset(cls) -> Any:
        """The same design for pictures of 64 pixels."""
        return Config(picture_size=64, rendering_size=32, final_rendering_size=32, super_resolution=2, super_widths=(32,
            16), plane_size=64, plane_channels=16, features=8, decoder_width=32, film_width=64, film_layers=4,
            coarse_samples=8, fine_samples=6, density_scale=10.0, density_shift=-3.0, code=64, style=128,
            channel_base=1024, channel_most=128, pictures_per_step=4, r1_weight=2.0, swap_pictures=10_000,
            blur_deviation=1.0, blur_pictures=2000, average_pictures=1000, code_steps=150, tune_steps=150)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        return Config(
            picture_size=16, rendering_size=8, final_rendering_size=8, super_resolution=2, super_widths=(4, 4),
            plane_size=8, plane_channels=4, features=4, decoder_width=8, film_width=8, film_layers=2,
            coarse_samples=8, fine_samples=4, density_scale=10.0, code=8, style=8, channel_base=64, channel_most=8,
            pictures_per_step=4, blur_pictures=40, swap_pictures=40, average_pictures=16, code_steps=4, tune_steps=4,
        )  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Activations that a step keeps for its gradients."""
        c = config
        width = 4 * c.plane_channels + c.decoder_width if c.field == "planes" else 3 * c.film_width * c.film_layers
        samples = max(c.rendering_size, c.final_rendering_size) ** 2 * (c.coarse_samples + c.fine_samples)
        return 4 * c.pictures_per_step * samples * (width + 3 * c.features) * learning

    # Learning

    def begin(self, data: Collection, seconds: float = math.inf) -> None:
        camera = data.preview()
        if camera is None:
            raise LumigraphError(f"eg3d learns from photographs, and {data.source} has none; name a folder of scenes")
        self.label.copy_(labels(camera)[0])

    def steps_per_pass(self, data: Collection) -> float:
        return len(data.splits["train"]) / self.config.pictures_per_step

    def batch(self, data: Collection, generator: torch.Generator) -> AdversarialLesson:
        """Random photographs, and the cameras of others of the same objects."""
        c = self.config

        def one_of(scene: Scene) -> tuple[Float[Tensor, "3 _ _"], Camera]:
            there = scene.splits["train"]
            return square(scene.photograph(int(there[chance(len(there), generator)])), scene.frame, c.picture_size)

        members = [data.sample_member(generator)[1] for _ in range(c.pictures_per_step)]
        scenes = [bounded(photographed(member, "eg3d")) for member in members]
        real, others = [one_of(scene) for scene in scenes], [one_of(scene) for scene in scenes]
        cameras = (Camera.cat([camera for _, camera in both]) for both in (real, others))
        pictures = torch.stack([picture for picture, _ in real])
        return AdversarialLesson(pictures.to(self.device), *(camera.to(self.device) for camera in cameras))

    def step(self, batch: AdversarialLesson, step: int, descend: Descend) -> dict[str, Tensor]:
        """A step of the discriminator, then one of the generator (section 4.3). Neither loss measures progress, so they
        are figures and no terms."""
        c, random = self.config, self.random(step)
        generators, discriminators = self._adversaries
        blur = c.blur_deviation * max(0.0, 1 - step * c.pictures_per_step / max(c.blur_pictures, 1))
        made, drawn = self._drawn(batch.views, step, random)
        fake = self._discriminated(*drawn, blur)
        real = self._discriminated(batch.real, resized(batch.real, (int(self.size),) * 2), blur)
        views, cameras = labels(batch.views), labels(batch.cameras)

        penalised = step % R1_INTERVAL == 0 and c.r1_weight > 0
        shown = real.detach().requires_grad_(penalised)
        seen, supposed = self.discriminator(shown, cameras), self.discriminator(fake.detach(), views)
        terms = {"discriminator": discriminator_loss(seen, supposed)}
        if penalised:
            terms["r1"] = R1_INTERVAL * c.r1_weight * r1_penalty(seen, [shown])
        descend(terms, [discriminators])
        self.figures = {name: float(value.detach()) for name, value in terms.items()}

        with frozen(self.discriminator):
            terms = {"generator": generator_loss(self.discriminator(fake, views))}
        if step % DENSITY_INTERVAL == 0:
            terms["density"] = DENSITY_INTERVAL * DENSITY_WEIGHT * self._roughness(made, random)
        descend(terms, [generators])
        self.figures |= {name: float(value.detach()) for name, value in terms.items()}
        self.figures |= {"logit_real": float(seen.detach().mean()), "logit_fake": float(supposed.detach().mean())}
        self.figures["pictures"] = (step + 1) * c.pictures_per_step
        return {}

    def _drawn(self, views: Camera, step: int, random: torch.Generator) -> tuple[Made, tuple[Pictures, Pictures]]:
        """Fields of random codes, and their pictures. The generator is conditioned on the picture's pose, or on the
        next picture's (section 4.4)."""
        c, generator = self.config, self.generator
        codes = torch.randn(len(views), c.code, generator=random).to(self.device)
        share = min(1.0, step * c.pictures_per_step / max(c.swap_pictures, 1))
        swapped = torch.rand(len(views), 1, generator=random) < 1 + share * (SWAP_PROBABILITY - 1)
        own = labels(views)
        style = generator.mapping(codes, torch.where(swapped.to(self.device), own.roll(1, 0), own))
        with torch.no_grad():
            generator.average.lerp_(style.mean(0), max(1 - STYLE_KEEP, 1 / (step + 1)))
        made = generator.field.made(generator.repeated(style), random)
        return made, self._pictures(generator, made, style, views, random)

    def _discriminated(self, pictures: Pictures, raw: Pictures, blur: float) -> Pictures:
        """Input of the discriminator in [-1, 1]: the picture, beside the volume rendering at its size (dual
        discrimination, section 4.3)."""
        parts = [pictures]
        if self.generator.upscaling:
            parts.append(resized(raw, (self.config.picture_size,) * 2))
        return blurred(2 * torch.cat(parts, 1) - 1, blur)

    def _roughness(self, made: Made, random: torch.Generator) -> Tensor:
        """Mean difference of density, ahead of its activation, between random points and others close by."""
        points = 2 * torch.rand(DENSITY_POINTS, 3, generator=random).to(self.device) - 1
        others = points + DENSITY_DISTANCE * torch.randn(points.shape, generator=random).to(self.device)
        both = [self.generator.field.found(one, torch.cat([points, others]))[0].chunk(2) for one in made]
        return torch.stack([(a - b).abs().mean() for a, b in both]).mean()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c = self.config
        self._adversaries = [
            lazy_adam(self.generator.parameters(), c.learning_rate, DENSITY_INTERVAL),
            lazy_adam(self.discriminator.parameters(), DISCRIMINATOR_RATE, R1_INTERVAL),
        ]
        return self._adversaries

    def before_step(self, step: int, progress: float) -> None:
        c, self._shown = self.config, None
        grown = min(1.0, max(0.0, progress - GROWTH_START) / GROWTH)
        self.size.fill_(round(c.rendering_size + grown * (c.final_rendering_size - c.rendering_size)))

    def after_step(self, step: int) -> None:
        """Update the averaged generator: an exponential average with a half-life in pictures, shorter at the
        beginning."""
        c = self.config
        half = min(c.average_pictures, AVERAGE_RAMP * (step + 1) * c.pictures_per_step)
        follow(self.averaged, self.generator, 0.5 ** (c.pictures_per_step / max(half, EPSILON)))

    # Volume rendering

    def _pictures(
        self,
        generator: ObjectGenerator,
        made: Made,
        style: Style,
        cameras: Camera,
        random: torch.Generator | None = None,
    ) -> tuple[Pictures, Pictures]:
        """Pictures of fields, each through a camera of its own, and their volume renderings.

        cameras: of one size
        """
        small = cameras.resized(int(self.size) / self.config.picture_size)
        (columns, rows), (width, height) = small.size[0].tolist(), cameras.size[0].tolist()
        pixels = small[0].pixels()
        index = torch.arange(len(cameras), device=self.device).repeat_interleave(len(pixels))
        rays = small.rays(pixels.repeat(len(cameras), 1), index)
        seen = self._seen(generator.field, made, rays, random)
        features = torch.cat([seen.rgb, seen.extra["features"]], -1)
        features = features.view(len(cameras), rows, columns, -1).permute(0, 3, 1, 2)
        return self._upscaled(generator, features, style, (height, width)), features[:, :3]

    def _upscaled(
        self, generator: ObjectGenerator, features: Pictures, style: Style, size: tuple[int, int]
    ) -> Pictures:
        """Pictures of a size (height, width) from the features of their volume renderings (section 4.3)."""
        if generator.upscaling:
            factor = self.config.super_resolution
            within = (-(-size[0] // factor), -(-size[1] // factor))
            features = generator.upscaling(resized(features, within), style)
        return resized(features, size)

    def _seen(self, field: MadeField, made: Made, rays: Rays, random: torch.Generator | None = None) -> Rendering:
        """Rendering of equally many rays through each field, with coarse and fine samples merged (section 4.2).
        Features beyond colours are in the rendering's extras."""
        c, count = self.config, len(rays)
        near, far = Box(self.frame.bounds, self.frame.near).interval(rays)

        def ask(shares: Float[Tensor, "ray sample"]) -> tuple[Tensor, Tensor]:
            t = torch.lerp(near[:, None], far[:, None], shares)
            points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
            parts = points.view(len(made), -1, 3)
            answers = [field.found(one, some) for one, some in zip(made, parts, strict=True)]
            density, features = (torch.cat(column) for column in zip(*answers, strict=True))
            return self._activated(density).view(shares.shape), features.view(*shares.shape, -1)

        def samples(shares: Float[Tensor, "ray sample"]) -> Samples:
            return Samples.rows(torch.lerp(near[:, None], far[:, None], shares), far)

        shares = stratified(count, c.coarse_samples, random, self.device)
        density, features = ask(shares)
        with torch.no_grad():
            weights = weights_of(samples(shares), density.flatten()).view(count, -1)
            places = stratified(count, c.fine_samples, random, self.device)
            again = inverse_transform(midpoints(shares), weights[:, 1:-1], places)
        further = ask(again)
        shares, order = torch.cat([shares, again], -1).sort(-1)
        density = torch.cat([density, further[0]], 1).gather(1, order)
        features = torch.cat([features, further[1]], 1)
        features = features.gather(1, order[..., None].expand(-1, -1, features.shape[-1])).flatten(0, 1)
        rgb, rest = features[:, :3], features[:, 3:]
        return composite(samples(shares), density.flatten(), rgb, self.background, features=rest)

    def _activated(self, density: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
        """Density per scene unit."""
        return self.config.density_scale * nn.functional.softplus(density + self.config.density_shift)

    # Objects

    @at_work()
    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        made, style = self.shown
        width, height = camera.size[0].tolist()
        small = camera.resized(int(self.size) / self.config.picture_size)
        rays = small.rays(small.pixels()).to(self.device)
        parts = [
            self._seen(self.averaged.field, made, rays[i : i + RAYS_AT_ONCE]) for i in range(0, len(rays), RAYS_AT_ONCE)
        ]
        columns, rows = small.size[0].tolist()
        seen = Rendering.cat(parts).reshape(rows, columns)
        features = torch.cat([seen.rgb, seen.extra["features"]], -1).permute(2, 0, 1)[None]
        if self.control("picture") == VOLUME:
            rgb = resized(features[:, :3], (height, width))
        else:
            rgb = self._upscaled(self.averaged, features, style, (height, width))
        depth, opacity = enlarged(seen.depth, seen.opacity, (height, width))
        return Rendering(rgb[0].permute(1, 2, 0).contiguous(), depth, opacity)

    @property
    def shown(self) -> tuple[Made, Style]:
        """Field and style of the renderings."""
        if self._shown is None:
            with torch.no_grad():
                style = self._style()[None]
                self._shown = self.averaged.field.made(self.averaged.repeated(style)), style
        return self._shown

    def _style(self) -> Float[Tensor, " style"]:
        """Style of the inversion, or of the control's seed, interpolated between two seeds. Truncated towards the
        average (Karras 2019, appendix B)."""
        if len(self.found.rows):
            style = self.found.rows[0]
        else:
            seed = float(self.control("seed"))
            first = min(int(seed), MAX_SEED - 1)
            one, next_one = self._styles_of([first, first + 1])
            style = torch.lerp(one, next_one, seed - first)
        return torch.lerp(self.averaged.average, style, float(self.control("truncation")))

    def _styles_of(self, seeds: Sequence[int]) -> Style:
        """Styles of seeds, conditioned on the pose of renderings."""
        codes = [torch.randn(self.config.code, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        with torch.no_grad():
            return self.averaged.mapping(torch.stack(codes).to(self.device), self.label.expand(len(seeds), -1))

    @property
    def controls(self) -> tuple[Control, ...]:
        seed = "Which object is drawn; between two whole numbers, one between theirs."
        truncation = "How far the object is from the average one: 1 as it was drawn, 0 the average."
        picture = "The picture after super-resolution, or the volume rendering, which agrees from view to view."
        return (
            *(() if len(self.found.rows) else (Control("seed", 0.0, (0.0, float(MAX_SEED)), about=seed),)),
            Control("truncation", 1.0, (0.0, 1.0), about=truncation),
            *((Control("picture", FINAL, choices=(FINAL, VOLUME), about=picture),) if self.generator.upscaling else ()),
        )

    def draw_object(self, seed: int) -> Method:
        """A generated object, from a random code."""
        told: Any = self.given()
        told._show(self._styles_of([seed]))
        return told

    @at_work()
    @torch.no_grad()
    def pictures(self, cameras: Camera, random: torch.Generator) -> Float[Tensor, "camera height width 3"]:
        """Pictures of random objects, one for each camera, conditioned on its pose, as for the published figures. All
        cameras have one size."""
        found, count = [], self.config.pictures_per_step
        for i in range(0, len(cameras), count):
            some = cameras[slice(i, i + count)].to(self.device)
            codes = torch.randn(len(some), self.config.code, generator=random).to(self.device)
            style = self.averaged.mapping(codes, labels(some))
            made = self.averaged.field.made(self.averaged.repeated(style))
            found.append(self._pictures(self.averaged, made, style, some)[0].permute(0, 2, 3, 1).cpu())
        return torch.cat(found)

    @property
    def viewpoint(self) -> Camera:
        """The camera whose pose renderings are conditioned on, of a picture of the Config's size."""
        pose, intrinsics = (x.cpu().view(1, n, n) for x, n in zip(self.label.split([16, 9]), (4, 3), strict=True))
        side = self.config.picture_size
        focal = torch.stack([intrinsics[:, 0, 0], intrinsics[:, 1, 1]], -1)
        lens = Pinhole(side * focal, side * intrinsics[:, :2, 2])
        return Camera(pose[:, :3], lens, torch.tensor([[side, side]]))

    @property
    def evidence_views(self) -> int | None:
        return 1

    def evidence_bytes(self, scene: Scene) -> int:
        """Activations of the photographs in a step."""
        c = replace(self.config, pictures_per_step=len(scene.splits["train"]))
        return self.further_bytes(self.frame, c, True)

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Invert the generator for a scene's photographs: a style, and a generator fine-tuned to it."""
        self._shown = None
        for scene in evidence[-1:]:
            self.frame = replace(bounded(scene).frame, has_alpha=self.frame.has_alpha)
            self._find(scene)

    def _show(self, style: Style) -> None:
        self.found, self._shown = Kept(style), None
        self.settings.pop("seed", None)

    def _find(self, scene: Scene) -> None:
        """Fit the style of a scene's photographs, then fine-tune the generator around it (Roich 2021, section 3)."""
        c = self.config
        photographs = [scene.photograph(i) for i in scene.splits["train"].tolist()]
        both = [square(photograph, scene.frame, c.picture_size) for photograph in photographs]
        target = torch.stack([picture for picture, _ in both]).to(self.device)
        cameras = Camera.cat([camera for _, camera in both]).to(self.device)
        generator = copy.deepcopy(self.averaged)
        random = self.random(2)

        def error(style: Float[Tensor, " style"]) -> Tensor:
            """Squared error of pictures and of volume renderings."""
            made = generator.field.made(generator.repeated(style[None])).expand(len(target), -1, -1)
            picture, raw = self._pictures(generator, made, style[None].expand(len(target), -1), cameras, random)
            small = resized(target, (raw.shape[-2], raw.shape[-1]))
            return (picture - target).square().mean() + (raw - small).square().mean()

        codes = torch.randn(STYLE_SAMPLES, c.code, generator=random).to(self.device)
        with torch.no_grad():
            styles = generator.mapping(codes, self.label.expand(len(codes), -1))
            average, deviation = styles.mean(0), styles.std(0)
            candidates = [average, *styles[:STYLE_CANDIDATES]]
            best = candidates[int(torch.stack([error(style) for style in candidates]).argmin())]

        def likely(where: Float[Tensor, " style"]) -> Tensor:
            return error(average + deviation * where) + CODE_PRIOR * where.square().mean()

        where = fitted((best - average) / deviation.clamp_min(EPSILON), likely, c.code_steps, CODE_LEARNING_RATE)
        style = average + deviation * where
        with torch.enable_grad():
            learning = [p.requires_grad_() for p in generator.parameters()]
            adam = torch.optim.Adam(learning, TUNE_LEARNING_RATE)
            for _ in range(c.tune_steps):
                adam.zero_grad()
                error(style).backward()
                adam.step()
        self.averaged = generator.requires_grad_(False)
        self._show(style[None])

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, nothing beyond the bounds, and sRGB-encoded colour, ahead of super-resolution."""
        density, features = self.averaged.field.found(self.shown[0][0], points)
        return self._activated(density) * self._inside(points), features[:, :3].clamp(0, 1)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit, nothing beyond the bounds."""
        density, _ = self.averaged.field.found(self.shown[0][0], points)
        return self._activated(density) * self._inside(points)

    def _inside(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        low, high = torch.tensor(self.frame.bounds, device=self.device)
        return ((points > low) & (points < high)).all(-1).float()


FINAL, VOLUME = "final", "volume"
EPSILON = 1e-8


def labels(cameras: Camera) -> Label:
    """Poses as 4x4 matrices and intrinsics in picture widths as 3x3, row by row (section 4.4). Raises LumigraphError
    for cameras without a focal length."""
    lens: Any = cameras.lens
    if not hasattr(lens, "focal") or not hasattr(lens, "centre"):
        raise LumigraphError(f"eg3d knows flat pictures, and a lens is {type(lens).__name__.lower()}; undistort them")
    size = cameras.size.to(cameras.pose)
    count, last = len(cameras), cameras.pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    pose = torch.cat([cameras.pose, last.expand(count, 1, 4)], 1).flatten(1)
    intrinsics = torch.eye(3).to(pose).repeat(count, 1, 1)
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = (lens.focal / size).unbind(-1)
    intrinsics[:, :2, 2] = lens.centre / size
    return torch.cat([pose, intrinsics.flatten(1)], -1)


def bounded(scene: Scene) -> Scene:
    """A scene that lies within its box. Raises LumigraphError for others."""
    if scene.frame.is_open:
        raise LumigraphError(
            f"eg3d knows objects, and {scene.source} is a place without bounds; name photographs of an object"
        )
    return scene


def enlarged(
    depth: Float[Tensor, "_ _"], opacity: Float[Tensor, "_ _"], size: tuple[int, int]
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Depth and opacity at another size: depth of the nearest pixel, because means across edges lie on no surface."""
    nearest = nn.functional.interpolate(depth[None, None], size=size, mode="nearest-exact")[0, 0]
    return nearest, resized(opacity[None, None], size)[0, 0]
