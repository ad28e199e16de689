"""pixelNeRF: a radiance field from one or few photographs, learnt across scenes (Yu et al. 2021, arXiv 2012.02190)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from ...budget import Effort, Efforts
from ...camera import Camera
from ...camera.rays import Look, Rays, Samples
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.kept_photographs import KeptPhotographs, chance, padded, photographed, rays_through
from ...components.fields.layers import in_chunks
from ...components.fields.spaces import space_of
from ...components.sampling.sampling import inverse_transform, midpoints, stratified
from ...components.training.schedules import exponential_decay
from ...datasets.collection import Collection
from ...datasets.scene import Batch, Frame, Photograph, Scene
from ...errors import LumigraphError
from ...files.ranges import (
    BatchSize,
    Layers,
    LearningRate,
    NonNegative,
    Positive,
    RaySamples,
    Share,
    Width,
    between,
)
from ...method import BaseConfig, RayMethod
from ...method.controls import Control, Value
from ...method.field import Colours, Densities, Directions, Points
from ...readers.views import spread_out
from ...volume import composite, weights_of
from .networks import STRIDE, PictureEncoder, ResidualNetwork, look_up

Views = Annotated[int, between(1, 64)]
POSITION_FREQUENCIES = 6  # octaves of positions, appendix B.1; the lowest turns by 1.5 radians a unit
DEPTH_DEVIATION = 0.01  # standard deviation of these, as a share of the ray's length in the scene

BLOCKS = 5  # residual blocks of the network, appendix B.1
VIEW_BLOCKS = 3  # blocks of these before the mean over views, appendix B.1
TARGETS = 4  # photographs of a member that a step's rays come from
BFLOAT16 = True  # multiply in bfloat16 where the processor is fast at it


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers (appendix B), with where its published code gives them; below them what saves time."""

    hidden_width: Width = 512  # channels of the network's layers, appendix B.1; wider costs memory and time
    encoder_widths: tuple[Width, Width, Width, Width] = (64, 64, 128, 256)  # channels of ResNet-34's stem and 3 stages
    encoder_blocks: tuple[Layers, Layers, Layers] = (3, 4, 6)  # blocks of the encoder's three stages; more cost time
    encoder_pool: bool = True  # halve the resolution after the encoder's stem; off: finer features, slower
    encoder_weights: str = ""  # file of torchvision's resnet34 weights to begin with; without, begin at random
    centred: bool = True  # positions relative to an object's centre, as published; off: to each camera
    coarse_samples: RaySamples = 64  # coarse samples of a ray, appendix B.2; more find thinner things, slower
    fine_samples: RaySamples = 16  # fine samples of a ray, by the coarse weights, appendix B.2; more are sharper
    depth_samples: Annotated[int, between(0, 4096)] = 16  # samples around the coarse depth, appendix B.2; 0: none
    networks: Annotated[int, between(1, 2)] = 2  # networks: one for each pass, or 1 for both, which is faster
    coarse_loss_weight: NonNegative = 1.0  # weight of the coarse pass's colours; 0: it only guides the fine one
    density: Literal["relu", "softplus"] = "relu"  # activation of density; softplus has a gradient below zero too
    density_scale: Positive = 1.0  # density per scene unit of an output of 1; higher starts more opaque
    source_views: Views = 3  # given photographs in a step at most, a random number, section 5.1
    members_per_step: Annotated[int, between(1, 1024)] = 4  # scenes in a step; more reduce noise, and cost time
    rays_per_member: BatchSize = 128  # rays of each scene in a step; more reduce noise, and cost time
    boxed: Share = 0.75  # share of the budget in which rays go through boxes around opaque pixels, appendix B.2
    learning_rate: LearningRate = 1e-4  # Adam's learning rate at first; higher learns faster, and may diverge
    final_learning_rate: LearningRate = 1e-4  # learning rate at the end of the budget, reached exponentially
    warmup: Share = 0.0  # share of the budget in which the learning rate rises; 0: none
    empty_threshold: Share = 0.0  # coarse opacity below which a ray has no fine pass; higher is faster

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.networks == 2 and not self.coarse_loss_weight:
            raise LumigraphError(
                "The first of two networks learns from --coarse-loss-weight alone, so it cannot be 0 with --networks 2"
            )


SOURCES = {  # of the numbers of `paper`; the others are ours
    "sxyu/pixel-nerf, conf/default.conf (91a044b)": (
        "position_frequencies coarse_samples fine_samples depth_samples depth_deviation networks coarse_loss_weight"
    ),
    "sxyu/pixel-nerf, conf/default_mv.conf (91a044b)": "hidden_width blocks view_blocks",
    "sxyu/pixel-nerf, src/util/args.py (91a044b)": "learning_rate",
    "sxyu/pixel-nerf, train/train.py (91a044b)": "members_per_step rays_per_member",
}


@dataclass(frozen=True)
class Sources:
    """Encoded photographs of one scene.

    cameras: of the photographs
    maps:    for each network, each cell's addition to its blocks; see `ResidualNetwork.prepared`
    frame:   the scene's
    """

    cameras: Camera
    maps: tuple[Float[Tensor, "view row column joins"], ...]
    frame: Frame


@dataclass(frozen=True)
class SourceLesson:
    """Source photographs of several scenes, in order, and rays through others."""

    unit: ClassVar[str] = "rays"

    sources: list[list[Photograph]]
    batches: list[Batch]
    frames: list[Frame]

    def __len__(self) -> int:
        return sum(map(len, self.batches))


class PixelNeRF(RayMethod):
    """A radiance field of a point's features in each photograph, and its position in that camera's frame.

    Learns from a Collection; `given` a Scene, it is a field of that scene, conditioned on its training photographs.
    """

    Config, learns_from, accepts = Config, Collection, (Scene,)
    learning_rate = exponential_decay
    efforts: ClassVar[Efforts] = {"draft": Effort(10, 1000), "good": Effort(200, 20_000), "best": Effort(2000, 200_000)}

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.encode = FrequencyEncoding(3, POSITION_FREQUENCIES, base=1.5)
        self.encoder = PictureEncoder(c.encoder_widths, c.encoder_blocks, c.encoder_pool, bool(c.encoder_weights))
        shape = (self.encode.width + 3, self.encoder.width, c.hidden_width, BLOCKS, VIEW_BLOCKS, not BFLOAT16)
        self.networks = torch.nn.ModuleList(ResidualNetwork(*shape) for _ in range(c.networks))
        self.kept = KeptPhotographs(self.encoder.width)
        self._sources: Sources | None = None  # found in what is kept, until a step changes the encoder
        self._boxed = True

    @classmethod
    def cpu_preset(cls) -> Any:
        """A smaller encoder and network of the same design."""
        return Config(hidden_width=64, encoder_widths=(32, 32, 64, 128), encoder_blocks=(2, 2, 2), encoder_pool=False,
            coarse_samples=20, fine_samples=12, depth_samples=0, networks=1, empty_threshold=1e-2, density="softplus",
            density_scale=10.0, members_per_step=3, boxed=0.5, coarse_loss_weight=0.1, learning_rate=1e-3,
            warmup=0.02)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        return Config(encoder_widths=(8, 8, 8, 8), encoder_blocks=(1, 1, 1), encoder_pool=False, hidden_width=16,
            density="softplus", density_scale=5.0, source_views=2,
            coarse_samples=12, fine_samples=4, depth_samples=4, members_per_step=1, rays_per_member=96,
            learning_rate=1e-2, final_learning_rate=3e-3)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Activations that a step keeps for its gradients."""
        c = config
        samples = c.members_per_step * c.rays_per_member * (c.coarse_samples + c.fine_samples + c.depth_samples)
        return 4 * samples * c.hidden_width * 3 * (c.source_views * VIEW_BLOCKS + BLOCKS) if learning else 0

    # Learning

    def begin(self, data: Collection, seconds: float = math.inf) -> None:
        if self.config.encoder_weights:
            self.encoder.load(Path(self.config.encoder_weights).expanduser())
        _, first = next(data.members())
        self.kept = self._keeping(photographed(first, "pixelnerf"), self.config.source_views)

    def steps_per_pass(self, data: Collection) -> float:
        return len(data.splits["train"]) / self.config.members_per_step

    def batch(self, data: Collection, generator: torch.Generator) -> SourceLesson:  # type: ignore[override]
        """Random members; of each as many random source photographs, and rays through some others."""
        c = self.config
        views = 1 + chance(c.source_views, generator)
        lesson = SourceLesson([], [], [])
        for _ in range(c.members_per_step):
            scene = photographed(data.sample_member(generator)[1], "pixelnerf")
            there = scene.splits["train"]
            order = there[torch.randperm(len(there), generator=generator)].tolist()
            lesson.sources.append([scene.photograph(i).to(self.device) for i in order[:views]])
            seen = order[views:] or order
            targets = [scene.photograph(i) for i in seen[:TARGETS]]
            rays = rays_through(targets, c.rays_per_member, self._boxed, generator)
            lesson.batches.append(rays.to(self.device))
            lesson.frames.append(scene.frame)
        return lesson

    def loss(self, batch: SourceLesson, step: int) -> dict[str, Tensor]:  # type: ignore[override]
        """The squared error of the coarse and fine renderings, over all members (section 4.2)."""
        terms: dict[str, Tensor] = {}
        generator, share = self.random(step), 1 / len(batch.batches)
        for sources, rays, frame in zip(self._seen(batch), batch.batches, batch.frames, strict=True):
            background = torch.tensor([frame.background], device=self.device)
            for look in self._looks(rays.rays, sources, generator):
                if not (weight := self.pass_weights.get(look.name, 1.0)):
                    continue
                seen = composite(look.samples, look.density, look.rgb, background)
                error = share * (seen.rgb - rays.before(background)).square().mean()
                terms[look.name] = terms.get(look.name, 0.0) + weight * error
        self.figures |= {"mse": float(terms["fine"].detach()), "views": len(batch.sources[0])}
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.parameters(), self.config.learning_rate)]

    def before_step(self, step: int, progress: float) -> None:
        self._sources, self._boxed = None, progress < self.config.boxed

    # One scene

    @property
    def controls(self) -> tuple[Control, ...]:
        count = len(self.kept.cameras()) if self.kept else 0
        about = "How many of the photographs that it was given are looked at."
        return (Control("views", float(count), (1.0, float(count)), about=about),) if count > 1 else ()

    @property
    def evidence_views(self) -> int | None:
        return int(float(self.control("views"))) if self.controls else 1

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Condition the field on a scene's training photographs, or on fewer of them."""
        self._sources = None
        for scene in evidence[-1:]:
            self.frame = scene.frame
            self.settings.pop("views", None)
            self.kept = self._keeping(scene, len(scene.splits["train"])).to(self.device)
            with torch.no_grad():
                self.kept.found.rows = self._features(self.kept.pictures()).flatten(0, 2)

    def evidence_bytes(self, scene: Scene) -> int:
        """Bytes of the photographs and their features."""
        sizes = scene.cameras.size[scene.splits["train"]]
        cells = len(sizes) * int(torch.ceil(sizes.amax(0) / STRIDE).prod())
        numbers = self.encoder.width * 4 + len(self.networks) * VIEW_BLOCKS * self.config.hidden_width
        return 4 * cells * numbers

    def _keeping(self, scene: Scene, most: int) -> KeptPhotographs:
        """At most `most` training photographs of a scene, in an order with evenly spread prefixes."""
        there = scene.splits["train"]
        chosen = there[spread_out(scene.cameras[there])[:most]].tolist()
        return KeptPhotographs.of([scene.photograph(i) for i in chosen], scene.frame.background, self.encoder.width)

    @property
    def sources(self) -> Sources:
        """Source photographs as features. Raises LumigraphError without any."""
        if self._sources is None:
            if not self.kept:
                raise LumigraphError("pixelnerf shows what it was given photographs of, and it was given none")
            cameras = self.kept.cameras()
            with torch.no_grad():
                if len(rows := self.kept.found.rows):
                    height, width = (-(-int(n) // STRIDE) for n in cameras.size.amax(0).flip(0))
                    features = rows.view(len(cameras), height, width, -1)
                else:
                    features = self._features(self.kept.pictures())
                count = int(float(self.settings.get("views", len(cameras))))
                self._sources = self._prepared(features[:count], cameras[slice(count)].to(self.device), self.frame)
        return self._sources

    def _seen(self, lesson: SourceLesson) -> list[Sources]:
        """Features of the photographs of each scene, encoded all at once."""
        both = zip(lesson.sources, lesson.frames, strict=True)
        pictures = [photograph.before(frame.background) for photographs, frame in both for photograph in photographs]
        cameras = [Camera.cat([photograph.camera for photograph in photographs]) for photographs in lesson.sources]
        features = self._features(pictures).split([len(x) for x in cameras])
        return [self._prepared(*of_one) for of_one in zip(features, cameras, lesson.frames, strict=True)]

    def _features(self, pictures: list[Float[Tensor, "_ _ 3"]]) -> Float[Tensor, "view row column feature"]:
        return self.encoder(padded(pictures).to(self.device))

    def _prepared(self, features: Float[Tensor, "view row column feature"], cameras: Camera, frame: Frame) -> Sources:
        maps = tuple(network.prepared(features) for network in self.networks)  # type: ignore[operator]
        return Sources(cameras, maps, frame)

    # Along rays

    def looks(self, rays: Rays, generator: torch.Generator | None = None) -> list[Look]:
        return self._looks(rays, self.sources, generator)

    def _looks(self, rays: Rays, sources: Sources, generator: torch.Generator | None) -> list[Look]:
        """The coarse look and the fine one (section 4.1, appendix B.2)."""
        c, count, device, space = self.config, len(rays), self.device, space_of(sources.frame)
        near, far = space.interval(rays)

        def ask(network: int, shares: Tensor, where: Tensor | None = None) -> tuple[Tensor, Tensor]:
            t = space.distance(shares, rays, near, far)
            points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
            directions = rays.directions[:, None].expand_as(points)
            asked = None if where is None else where[:, None].expand_as(shares).flatten()
            density, rgb = self._ask(network, points.flatten(0, 1), directions.flatten(0, 1), sources, asked)
            return density.view(shares.shape), rgb.view(*shares.shape, 3)

        def look(name: str, shares: Tensor, density: Tensor, rgb: Tensor) -> Look:
            samples = Samples.rows(space.distance(shares, rays, near, far), far)
            return Look(name, samples, density.flatten(), rgb.flatten(0, 1))

        shares = stratified(count, c.coarse_samples, generator, device)
        coarse = look("coarse", shares, *(first := ask(0, shares)))
        weights = weights_of(coarse.samples, coarse.density).view(count, -1).detach()
        again = self._again(shares, weights, generator)
        where = weights.sum(-1) > c.empty_threshold if generator is None and c.empty_threshold else None
        self.figures |= {"rays": count, "samples": shares.numel() + again.numel()}
        if c.networks == 1:  # the same network has answered for the coarse places
            further = ask(0, again, where)
            density, rgb = (torch.cat(pair, 1) for pair in zip(first, further, strict=True))
            shares, order = torch.cat([shares, again], -1).sort(-1)
            density, rgb = density.gather(1, order), rgb.gather(1, order[..., None].expand(-1, -1, 3))
        else:
            shares = torch.cat([shares, again], -1).sort(-1).values
            density, rgb = ask(1, shares, where)
        return [coarse, look("fine", shares, density, rgb)]

    def _again(
        self, shares: Float[Tensor, "ray sample"], weights: Float[Tensor, "ray sample"], generator: Any
    ) -> Float[Tensor, "ray again"]:
        """Distances of the fine samples: by the coarse weights, and around the coarse depth."""
        c, count, device = self.config, len(shares), self.device
        evenly = stratified(count, c.fine_samples, generator, device)
        places = [inverse_transform(midpoints(shares), weights[:, 1:-1], evenly)]
        if c.depth_samples:
            total = weights.sum(-1, keepdim=True)
            depth = torch.where(total > 0, (weights * shares).sum(-1, keepdim=True) / total.clamp_min(1e-9), 0.5)
            spread = 2 * stratified(count, c.depth_samples, generator, device) - 1
            places.append((depth + DEPTH_DEVIATION * 2**0.5 * torch.erfinv(spread.clamp(-0.999, 0.999))).clamp(0, 1))
        return torch.cat(places, -1)

    def _ask(
        self, network: int, points: Points, directions: Directions, sources: Sources, where: Tensor | None = None
    ) -> tuple[Densities, Colours]:
        """Density per scene unit and colour of points seen along directions (section 4.2, eq. 4 to 6)."""
        cameras, c = sources.cameras, self.config
        turned = cameras.pose[:, :, :3].mT  # the world's axes in each camera's
        middle = c.centred and not sources.frame.is_open
        origins = torch.zeros_like(cameras.position) if middle else cameras.position

        def answer(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
            places = (points - origins[:, None]) @ turned.mT  # R^T (p - o), of each view
            seen = [self.encode(places.flatten(0, 1)).unflatten(0, places.shape[:2]), directions @ turned.mT]
            pixels = torch.stack([cameras[i].project(points)[0] for i in range(len(cameras))])
            joins = look_up(sources.maps[network], pixels, cameras.size.to(pixels))
            raw = self.networks[network](torch.cat(seen, -1), joins)
            density = softplus(raw[:, 3]) if c.density == "softplus" else raw[:, 3].relu()
            return c.density_scale * density, raw[:, :3].sigmoid()

        density, rgb = in_chunks(answer, points, directions, where=where)
        return density, rgb

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions. Both depend on the direction."""
        return self._ask(len(self.networks) - 1, points, directions, self.sources)
