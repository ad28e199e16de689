"""GANcraft: block worlds as landscapes, a field at blocks that learns from a label-to-picture network (Hao et al. 2021,
arXiv 2104.07659)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ... import kernels
from ...budget import Effort, Efforts
from ...camera import Camera
from ...camera.rays import Rays, Rendering, Samples
from ...components.fields.kept_photographs import Kept
from ...components.training.adversarial import discriminator_loss, generator_loss
from ...components.training.row_optimizers import exchange
from ...datasets.scene import Frame
from ...datasets.world import LABELS, BlockWorld
from ...files.ranges import Count, LearningRate, NonNegative, Octaves, Positive, Share, Width, between
from ...method import BaseConfig, Method, frozen, seeded
from ...method.controls import Control, blend
from ...readers.single_image import photograph
from ...system.progress import track
from ...system.work import at_work
from .landscapes import STYLES, landscape
from .networks import BORDER, BlockField, NeuralRenderer, SkyNetwork, StyleEncoder, StyleNetwork, divergence, drawn
from .spade import Adversary, LabelPainter, channels, halves, perceptual

MIN_OPACITY = 1e-3  # from which on a ray has a depth
STYLE_SUFFIXES = (".png", ".jpg", ".jpeg")  # of pictures whose style is shown
KEPT_STYLE = 0.98  # share of a style's mean code that one more picture leaves
CORNER_DEVIATION = 0.1  # of features at corners at first: labels count more
RAYS_PER_CHUNK = 16_384  # of renderings
PER_LAND = 8  # landscapes that show the same land
SKY = LABELS.index("sky")
SKY_BANDS = 5  # octaves of the encoding of directions in the sky
GAN_WEIGHT = 0.5  # of the adversary that sees landscapes as real
PSEUDO_GAN_WEIGHT = 0.5  # of the adversary that sees pseudo truth as real
L2_WEIGHT = 10.0  # of the squared difference from pseudo truth, of colours in [-1, 1]
PERCEPTUAL_WEIGHT = 10.0  # of the difference of features


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, as its published code has them (NVlabs/imaginaire, landscape.yaml and lhq.yaml)."""

    # Field
    features: Width = 64  # numbers at each corner of a block
    encoded: Width = 24  # of these, numbers that are encoded as waves
    bands: Octaves = 4  # octaves of that encoding
    hidden_width: Width = 256  # of the field, the sky and the neural renderer; wider costs time
    output_features: Width = 64  # numbers of a pixel from which the neural renderer makes its colour
    style: Width = 256  # numbers of the style after its network
    style_layers: Count = 5  # layers of the style network
    code: Width = 128  # numbers of a style code
    samples_per_block: Annotated[int, between(1, 64)] = 8  # 24 in 3 blocks
    sample_depth: Positive = 3.0  # blocks along a ray that are sampled, from the first surface on
    density_scale: Positive = 0.25  # factor of distances in blocks
    # Pictures
    crop: Annotated[int, between(16, 1024)] = 256  # pixels of the square part that a step learns from
    label_window: Annotated[int, between(0, 64)] = 11  # pixels within which the most frequent label of blocks counts
    encoder_size: Annotated[int, between(8, 1024)] = 256  # pixels to which pictures are resized for the style encoder
    encoder_width: Width = 64  # channels of its first layer
    # Pseudo truth
    painter_code: Width = 256  # numbers of the painter's style code
    painter_width: Width = 128  # channels of the painter's finest layer; coarser ones have up to 16 times as many
    painter_levels: Annotated[int, between(1, 8)] = 6  # resolutions of the painter beside the finest
    painter_share: Share = 0.5  # share of the budget in which the painter learns, first of all
    field_interval: Count = 4  # steps of the painter to one of the field in that share
    landscapes: Count = 4096  # pictures that the painter learns from; more vary more, and take time ahead of training
    landscapes_per_step: Annotated[int, between(1, 64)] = 4  # of the painter; more reduce noise, and cost time
    # Losses
    adversary_width: Width = 128  # channels of the adversaries' first layer
    opacity_weight: NonNegative = 0.0  # of the light that passes through blocks; higher: blocks are opaque earlier
    kl_weight: NonNegative = 0.05  # of the style codes' divergence from the normal distribution
    learning_rate: LearningRate = 1e-4  # Adam's learning rate of the field's networks
    corner_learning_rate: LearningRate = 1e-3  # of the features at corners
    adversary_learning_rate: LearningRate = 4e-4  # of the adversary
    momentum: Annotated[float, between(0, 0.999)] = 0.0  # beta_1 of Adam
    painter_learning_rate: LearningRate = 1e-4  # of the painter of pseudo truth
    painter_adversary_learning_rate: LearningRate = 4e-4  # of the painter's adversary


SOURCES = {  # of the numbers of `paper`; the others are ours
    "NVlabs/imaginaire, configs/projects/gancraft/landscape.yaml (7e37171)": (
        "features encoded bands output_features sky_bands style style_layers code samples_per_block sample_depth "
        "density_scale crop label_window encoder_size encoder_width adversary_width gan_weight pseudo_gan_weight "
        "l2_weight perceptual_weight kl_weight momentum learning_rate corner_learning_rate adversary_learning_rate"
    ),
    "NVlabs/imaginaire, configs/projects/spade/landscapes/lhq.yaml (7e37171)": "painter_code painter_width",
    "NVlabs/imaginaire, imaginaire/generators/gancraft_base.py (6ef7ff0)": "hidden_width",
    "NVlabs/imaginaire, configs/projects/gancraft/landscape.yaml (7e37171), which has no such term": "opacity_weight",
}


@dataclass(frozen=True)
class WorldLesson:
    """A part of a camera's picture of the world, and landscapes.

    rays:       of the part and of `BORDER` pixels around it
    labels:     of the part's pixels, as `LABELS` counts them
    landscapes: colours in [-1, 1]; ground: their labels; styles: their numbers in `STYLES`
    """

    unit: ClassVar[str] = "rays"

    rays: Rays
    labels: Int[Tensor, "1 height width"]
    landscapes: Float[Tensor, "picture 3 height width"]
    ground: Int[Tensor, "picture height width"]
    styles: list[int] = field(default_factory=list)

    def __len__(self) -> int:
        return self.labels.numel()


class GANcraft(Method):
    """Renders a block world as a landscape in a style: features of a field at blocks and of a sky, composited along
    rays, become colours in a small convolutional network."""

    Config, learns_from = Config, BlockWorld
    efforts: ClassVar[Efforts] = {"draft": Effort(4, 300), "good": Effort(20, 1500), "best": Effort(400, 40_000)}
    styles: Tensor
    blocks_from_scene: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        with seeded(c.seed):
            self.encoder = StyleEncoder(c.encoder_size, c.encoder_width, c.code)
            self.style = StyleNetwork(c.code, c.style, c.style_layers)
            shape = c.hidden_width, c.style, c.output_features
            self.field_network = BlockField(c.features, c.encoded, c.bands, len(LABELS), *shape)
            self.sky = SkyNetwork(SKY_BANDS, 5, *shape)
            self.behind = nn.Parameter(torch.zeros(c.output_features))
            self.renderer = NeuralRenderer(c.output_features, c.hidden_width, c.style)
            widths = [min(c.painter_width << k, 16 * c.painter_width) for k in range(c.painter_levels, -1, -1)]
            sizes = c.encoder_size, c.encoder_width
            self.painter = LabelPainter(len(LABELS), c.painter_code, widths, c.painter_width, *sizes)
            self.adversary, self.painter_adversary = (Adversary(len(LABELS), c.adversary_width) for _ in range(2))
        self.labels = Kept(torch.zeros(1, 1, 1, 1, dtype=torch.uint8))
        self.register_buffer("blocks_from_scene", torch.eye(4, dtype=torch.float64))
        self.register_buffer("styles", torch.zeros(len(STYLES), c.code))
        self._optimizers: list[torch.optim.Optimizer] = []
        self._world: BlockGrid | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        """Networks of an eighth of the width, fewer samples, parts of 64 pixels; higher learning rates."""
        return Config(features=16, encoded=8, bands=3, hidden_width=32, output_features=12, style=32, style_layers=2,
            code=8, samples_per_block=3, sample_depth=1.5, density_scale=1.0, crop=64, label_window=5, encoder_size=32,
            encoder_width=12, painter_code=8, painter_width=12, painter_levels=3, landscapes=160, landscapes_per_step=2,
            adversary_width=12, kl_weight=3e-4, opacity_weight=0.5, momentum=0.5, learning_rate=3e-3,
            corner_learning_rate=1e-2, adversary_learning_rate=1e-3, painter_learning_rate=5e-4,
            painter_adversary_learning_rate=5e-4)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """All networks of eight channels, parts of 16 pixels."""
        return Config(features=4, encoded=2, bands=1, hidden_width=8, output_features=4, style=8, style_layers=1,
            code=2, samples_per_block=2, sample_depth=1.0, density_scale=1.0, crop=16, label_window=3, encoder_size=8,
            encoder_width=4, painter_code=2, painter_width=4, painter_levels=1, landscapes=4, landscapes_per_step=1,
            painter_share=1.0, field_interval=1, opacity_weight=0.5, adversary_width=4, learning_rate=1e-2,
            corner_learning_rate=2e-2, painter_learning_rate=1e-2)  # fmt: skip

    # The world

    def begin(self, data: BlockWorld, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        self.labels.rows = torch.from_numpy(data.blocks.labels)[None].to(self.device)
        self.blocks_from_scene.copy_(data.blocks_from_scene)
        corners = len(self.world.corners)
        values = CORNER_DEVIATION * torch.randn(corners, self.config.features, generator=self.random(1))
        exchange(self.field_network, "values", values, self._optimizers[0] if self._optimizers else None)

    @property
    def world(self) -> BlockGrid:
        """The blocks as grids for kernels."""
        if self._world is None or self._world.labels is not self.labels.rows:
            self._world = BlockGrid.of(self.labels.rows)
        return self._world

    def in_blocks_frame(self, rays: Rays) -> Rays:
        """Rays with origins and distances in blocks."""
        matrix = self.blocks_from_scene.to(self.device)
        rotation = (matrix[:3, :3] / self.block_scale).float()
        origins = (rays.origins.double() @ matrix[:3, :3].T + matrix[:3, 3]).float()
        return Rays(origins, rays.directions @ rotation.T, rays.radius)

    @property
    def block_scale(self) -> float:
        """Blocks to a scene unit."""
        return float(torch.linalg.det(self.blocks_from_scene[:3, :3]) ** (1 / 3))

    # Pictures

    def features_of(
        self, rays: Rays, style: Float[Tensor, "1 style"], generator: torch.Generator | None = None
    ) -> tuple[Float[Tensor, "ray feature"], Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Feature of each ray (eq. 1), its depth in scene units, and its opacity before the sky.

            f = sum_i T_i (1 - exp(-sigma_i delta_i)) c_i + T sky(d),   T_i = exp(-sum_{j<i} sigma_j delta_j)

        Samples lie in blocks, of which each ray sees the first `sample_depth` blocks of its way through them. Behind
        these a learnt feature takes the place of the sky, which otherwise shines through (keep_sky_out).
        generator: of the samples' random places, in training
        """
        c, world, inner = self.config, self.world, self.in_blocks_frame(rays)
        jitter = None if generator is None else torch.rand(len(rays), generator=generator).to(self.device)
        samples = world.sampled(inner, 1 / c.samples_per_block, c.sample_depth, jitter)
        positions, _ = samples.along(inner)
        density, colour = self.field_network(positions / world.size, world.nodes, world.label_at(positions), style)
        tau = c.density_scale * density * samples.length
        total, opacity, _ = kernels.composite(tau, torch.cat([colour, samples.t[:, None]], -1), samples.ray_starts)
        sky, meets = self.sky(inner.directions, style), samples.ray_starts.diff() > 0
        behind = torch.where(meets[:, None], self.behind.clamp(-1, 1), sky)
        features = total[:, :-1] + (1 - opacity)[:, None] * behind
        depth = torch.where(opacity > MIN_OPACITY, total[:, -1] / opacity.clamp_min(MIN_OPACITY), torch.inf)
        return features, depth / self.block_scale, opacity

    def picture(
        self, rays: Rays, size: tuple[int, int], code: Float[Tensor, "1 code"], generator: torch.Generator | None = None
    ) -> tuple[Float[Tensor, "1 3 height width"], Float[Tensor, "height width"], Float[Tensor, "height width"]]:
        """Colours in [-1, 1], depth and opacity. rays: of the picture and of `BORDER` pixels around it; size: (width,
        height) without these"""
        width, height = (n + 2 * BORDER for n in size)
        style = self.style(code)
        chunks = [rays[i : i + RAYS_PER_CHUNK] for i in range(0, len(rays), RAYS_PER_CHUNK)]
        parts = [self.features_of(chunk, style, generator) for chunk in chunks]
        features, depth, opacity = (torch.cat(column) for column in zip(*parts, strict=True))
        colours = self.renderer(features.T.reshape(1, -1, height, width), style)
        inner = slice(BORDER, -BORDER)
        depth, opacity = (x.view(height, width)[inner, inner] for x in (depth, opacity))
        return colours[..., inner, inner], depth, opacity

    @at_work()
    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        width, height = camera.size[0].tolist()
        rays = camera.to(self.device).rays(bordered(0, 0, width, height).to(self.device))
        rgb, depth, opacity = self.picture(rays, (width, height), self.shown_code)
        return Rendering(0.5 + 0.5 * rgb[0].movedim(0, -1), depth, opacity)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit; 0 in the air."""
        matrix = self.blocks_from_scene.to(self.device)
        places = (points.double() @ matrix[:3, :3].T + matrix[:3, 3]).float()
        label = self.world.label_at(places)
        found, _ = self.field_network(places / self.world.size, self.world.nodes, label, self.style(self.shown_code))
        return torch.where(label > SKY, self.config.density_scale * found * self.block_scale, 0)

    # Style

    @property
    def controls(self) -> tuple[Control, ...]:
        about = "Style of the landscape: a name, a picture, or A:B:0.5 between two names."
        names = tuple(STYLES)
        style = Control("style", names[0], choices=names, blends=True, files=STYLE_SUFFIXES, about=about)
        return (*super().controls, style)

    @property
    def shown_code(self) -> Float[Tensor, "1 code"]:
        """Code of the style of pictures, by the control."""
        chosen = str(self.control("style"))
        if chosen.lower().endswith(STYLE_SUFFIXES):
            return style_of_file(self.encoder, chosen, self.device)
        first, second, share = blend(chosen)
        a, b = (self.styles[list(STYLES).index(name)] for name in (first, second))
        return torch.lerp(a, b, share)[None]

    # Learning

    def batch(self, data: BlockWorld, generator: torch.Generator) -> WorldLesson:
        c = self.config
        there = data.splits["train"]
        shot = data.photograph(int(there[chance(len(there), generator)]), layers=("labels",))
        width, height = (min(c.crop, int(n)) for n in shot.camera.size[0])
        x, y = (
            chance(int(n) - own + 1, generator) for n, own in zip(shot.camera.size[0], (width, height), strict=True)
        )
        labels = data.label_numbers[shot.extra["labels"]][y : y + height, x : x + width]
        rays = shot.camera.rays(bordered(x, y, width, height))
        gallery = landscapes_of(c.landscapes, 2 * c.crop, c.seed)
        chosen = [chance(c.landscapes, generator) for _ in range(c.landscapes_per_step)]
        parts = [part_of(gallery, k, (width, height), generator) for k in chosen]
        rgb, ground = (torch.stack(column) for column in zip(*parts, strict=True))
        styles = [k % len(STYLES) for k in chosen]
        device = self.device
        return WorldLesson(rays.to(device), labels[None].to(device), rgb.to(device), ground.to(device), styles)

    def step(self, batch: WorldLesson, step: int, descend: Any) -> dict[str, Tensor]:
        generator, painting = self.random(step), self.progress <= self.config.painter_share
        terms = self._step_of_painter(batch, generator, descend) if painting else {}
        if painting and step % self.config.field_interval:
            return terms
        return terms | self._step_of_field(batch, generator, descend)

    def _step_of_painter(self, batch: WorldLesson, generator: torch.Generator, descend: Any) -> dict[str, Tensor]:
        """One step of the label-to-picture network on landscapes (Park 2019, section 3 and appendix A)."""
        c, real, labels = self.config, batch.landscapes, channels(batch.ground, len(LABELS))
        mean, log_variance = self.painter.encoder(real)
        fake = self.painter(labels, drawn(mean, log_variance, generator))
        adversary, count = self.painter_adversary, len(real)
        adversary.iterate()
        for_real, for_fake = adversary(torch.cat([real, fake.detach()]), labels.repeat(2, 1, 1, 1)).split(count)
        descend({"painter_adversary": discriminator_loss(for_real, for_fake)}, [self._optimizers[3]])
        with frozen(adversary):
            of_fake, of_real = halves(adversary.features(torch.cat([fake, real])), count)
            terms = {
                "painter_gan": generator_loss(adversary.logits(of_fake, labels)),
                "painter_l2": L2_WEIGHT * (fake - real).square().mean(),
                "painter_perceptual": PERCEPTUAL_WEIGHT * perceptual(of_fake, of_real),
                "painter_kl": c.kl_weight * divergence(mean, log_variance),
            }
            descend(terms, [self._optimizers[2]])
        return terms

    def _step_of_field(self, batch: WorldLesson, generator: torch.Generator, descend: Any) -> dict[str, Tensor]:
        """One step of the field: pseudo truth for the camera in the style of a landscape; adversarial, perceptual and
        reconstruction terms (section 3.3)."""
        c, smooth = self.config, self.config.label_window
        labels = channels(batch.labels, len(LABELS), smooth)
        real, real_labels = batch.landscapes[:1], channels(batch.ground[:1], len(LABELS), smooth)
        with torch.no_grad():
            mean, log_variance = self.painter.encoder(real)
            pseudo = self.painter(labels, drawn(mean, log_variance, generator))
        mean, log_variance = self.encoder(pseudo)
        self.styles[batch.styles[0]].lerp_(mean[0].detach(), 1 - KEPT_STYLE)
        height, width = batch.labels.shape[1:]
        fake, _, opacity = self.picture(batch.rays, (width, height), drawn(mean, log_variance, generator), generator)
        self.adversary.iterate()
        shown = torch.cat([real, pseudo, fake.detach()])
        for_real, for_pseudo, for_fake = self.adversary(shown, torch.cat([real_labels, labels, labels]))
        against = GAN_WEIGHT * discriminator_loss(for_real, for_fake)
        against = against + PSEUDO_GAN_WEIGHT * discriminator_loss(for_pseudo, for_fake)
        descend({"adversary": against}, [self._optimizers[1]])
        error = (fake - pseudo).square().mean()
        with frozen(self.adversary, self.painter_adversary):
            like = perceptual(*halves(self.painter_adversary.features(torch.cat([fake, pseudo])), 1))
            terms = {
                "gan": (GAN_WEIGHT + PSEUDO_GAN_WEIGHT) * generator_loss(self.adversary(fake, labels)),
                "l2": L2_WEIGHT * error,
                "perceptual": PERCEPTUAL_WEIGHT * like,
                "kl": c.kl_weight * divergence(mean, log_variance),
                "opacity": c.opacity_weight * ((1 - opacity) * (batch.labels[0] != SKY)).square().mean(),
            }
            descend(terms, [self._optimizers[0]])
        self.figures = {"pseudo_mse": float(error.detach()) / 4}
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c = self.config
        corners = {"params": [self.field_network.values], "lr": c.corner_learning_rate}
        own = (self.encoder, self.style, self.field_network, self.sky, self.renderer)
        networks = [self.behind, *(p for m in own for p in m.parameters() if p is not self.field_network.values)]
        adam = partial(torch.optim.Adam, eps=1e-7)
        own_betas, other_betas = (c.momentum, 0.999), (0.0, 0.999)
        self._optimizers = [
            adam([{"params": networks, "lr": c.learning_rate}, corners], betas=own_betas),
            adam(self.adversary.parameters(), c.adversary_learning_rate, betas=other_betas),
            adam(self.painter.parameters(), c.painter_learning_rate, betas=own_betas),
            adam(self.painter_adversary.parameters(), c.painter_adversary_learning_rate, betas=other_betas),
        ]
        return self._optimizers


@dataclass(frozen=True)
class BlockGrid:
    """Blocks as grids for kernels.

    labels:   (1, x, y, z)
    size:     blocks along each axis, as numbers for division
    occupied: a cube of cells that holds all blocks, as `kernels.march` has it
    corners:  numbers of the corners of blocks in the grid of all corners
    """

    labels: Tensor
    size: Float[Tensor, " 3"]
    occupied: Bool[Tensor, "1 n n n"]
    density: Float[Tensor, "1 n n n"]
    corners: Int[Tensor, " corner"]
    nodes: kernels.Nodes

    @staticmethod
    def of(labels: Tensor) -> BlockGrid:
        solid = labels[0] > SKY
        shape, device = tuple(solid.shape), labels.device
        occupied = torch.zeros((1, *[max(shape)] * 3), dtype=torch.bool, device=device)
        occupied[0, : shape[0], : shape[1], : shape[2]] = solid
        near = torch.zeros([n + 1 for n in shape], dtype=torch.bool, device=device)
        for x, y, z in np.ndindex(2, 2, 2):
            near[x : x + shape[0], y : y + shape[1], z : z + shape[2]] |= solid
        corners = near.flatten().nonzero()[:, 0]
        x, y, z = near.shape
        nodes = kernels.Nodes.of(corners, (x, y, z))
        return BlockGrid(labels, torch.tensor(shape, device=device).float(), occupied, occupied.float(), corners, nodes)

    def sampled(self, rays: Rays, step: float, depth: float, jitter: Float[Tensor, " ray"] | None) -> Samples:
        """Samples of rays within blocks, a step apart; each ray ends after a length of `depth` blocks inside them.

        rays, step, depth: in blocks; jitter: random offset of each ray's samples, as a share of a step
        """
        half = self.occupied.shape[1] / 2  # the kernel's cube goes from -1 to 1
        enter, leave = rays.through_box(torch.stack([torch.zeros_like(self.size), self.size]))
        begin = enter.clamp_min(0) + step * (0.5 if jitter is None else jitter) - step
        begin = begin.clamp_min(0)
        found = kernels.march(
            rays.origins / half - 1, rays.directions, begin / half, leave / half,
            self.occupied, self.density, step / half, stop=math.exp(-depth / half))  # fmt: skip
        return Samples(found.t_start * half, found.t_end * half, found.ray_starts)

    def label_at(self, places: Float[Tensor, "point 3"]) -> Int[Tensor, " point"]:
        """Label of the block around each place; that of the sky outside."""
        index = places.floor().long()
        size = self.size.long()
        inside = ((index >= 0) & (index < size)).all(-1)
        x, y, z = torch.minimum(index.clamp_min(0), size - 1).unbind(-1)
        return torch.where(inside, self.labels[0, x, y, z].long(), SKY)


def bordered(x: int, y: int, width: int, height: int) -> Float[Tensor, "pixel 2"]:
    """Centres of the pixels of a part of a picture and of `BORDER` pixels around it, row by row."""
    across, down = (torch.arange(a - BORDER, a + n + BORDER) + 0.5 for a, n in ((x, width), (y, height)))
    return torch.cartesian_prod(down, across).flip(-1)


def chance(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (1,), generator=generator))


@lru_cache(maxsize=2)
def landscapes_of(count: int, size: int, seed: int) -> list[tuple[Tensor, Tensor]]:
    """Landscapes to learn from, the styles by turns: colours as bytes (3, height, width), labels (height, width)."""
    names, found = list(STYLES), []
    for k in track(range(count), "Painting landscapes", count):
        rgb, labels = landscape((seed << 20) + k, names[k % len(names)], size, (seed << 20) + k // PER_LAND)
        found.append(((torch.from_numpy(rgb) * 255).round().byte().movedim(-1, 0), torch.from_numpy(labels)))
    return found


def part_of(
    gallery: list[tuple[Tensor, Tensor]], number: int, size: tuple[int, int], generator: torch.Generator
) -> tuple[Float[Tensor, "3 height width"], Int[Tensor, "height width"]]:
    """A random part of a landscape, (width, height) pixels, mirrored or not: colours in [-1, 1] and labels."""
    rgb, labels = gallery[number]
    x, y = (chance(n - own + 1, generator) for n, own in zip(labels.shape[::-1], size, strict=True))
    part = slice(y, y + size[1]), slice(x, x + size[0])
    rgb, labels = rgb[:, *part], labels[part]
    if chance(2, generator):
        rgb, labels = rgb.flip(-1), labels.flip(-1)
    return rgb.float() / 127.5 - 1, labels


@torch.no_grad()
def style_of_file(encoder: StyleEncoder, path: str, device: torch.device) -> Float[Tensor, "1 code"]:
    """Code of the style of a picture in a file. Raises LumigraphError for a file that is no picture."""
    rgb = photograph(Path(path).expanduser()).rgb.to(device)
    return encoder(2 * rgb.movedim(-1, 0)[None] - 1)[0]
