"""Mip-NeRF: pixels see cones, and what is smaller than a cone's width fades (Barron et al. 2021, arXiv 2103.13415)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad, softplus

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering
from ..components.fields.coordinate_network import CoordinateNetwork, bytes_kept
from ..components.fields.dense import in_chunks
from ..components.fields.encodings import FrequencyEncoding, IntegratedEncoding
from ..components.fields.taken_over import taken_over
from ..components.sampling.frustums import blurred, frustums_between
from ..components.sampling.occupancy_mask import OccupancyMask
from ..components.sampling.sampling import inverse_transform, stratified
from ..components.sampling.spaces import space_of
from ..components.training.coarse_to_fine import band_weights
from ..components.training.distillation import distil
from ..components.training.pose_refinement import PoseRefinement
from ..components.training.schedules import falling
from ..datasets.scene import Batch, Frame, Scene
from ..files.ranges import (
    BatchSize,
    Cells,
    Depth,
    Layers,
    LearningRate,
    NonNegative,
    Octaves,
    RaySamples,
    Seed,
    Share,
    Width,
)
from ..method import RayMethod
from ..volume import composite, weights_of


@dataclass(frozen=True)
class Config:
    """The paper's numbers, with where it gives them; below them what saves time and keeps the mathematics."""

    depth: Depth = 8  # hidden layers before density, as NeRF's
    hidden_width: Width = 256  # channels of a layer, as NeRF's
    skip_layer: Layers = 5  # the layer whose activation the input joins again, as NeRF's
    position_frequencies: Octaves = 16  # L for frustums, section 4: with cones, more do no harm
    direction_frequencies: Octaves = 4  # L for directions, as NeRF's
    coarse_samples: RaySamples = 128  # frustums of a ray, section 3.2
    fine_samples: RaySamples = 128  # of a ray, drawn where the first found something, section 3.2
    coarse_to_fine: Share = 0.0  # share of the budget in which octaves join the coarsest (Yang 2023, eq. 2); 0: at once
    resample_padding: NonNegative = 0.01  # alpha, weight that every frustum has at least, eq. 17
    coarse_loss_weight: NonNegative = 0.1  # lambda, section 3.2; 0: the first look only guides the second
    rays_per_step: BatchSize = 4096  # section 4
    learning_rate: LearningRate = 5e-4  # section 4
    final_learning_rate: LearningRate = 5e-6  # at the end of the budget, section 4
    warmup: Share = 0.0025  # share of the budget in which the learning rate grows, section 4
    occupancy_resolution: Cells = 0  # cells per axis of a grid that tells where to sample; 0 samples everywhere
    occupancy_threshold: NonNegative = 0.01  # optical thickness across a cell below which it is empty
    refine_cameras: bool = False  # learn where each photograph was taken from, coarse to fine (Lin 2021, BARF)
    pose_learning_rate: LearningRate = 5e-4  # radians by which a step moves a picture, with refine_cameras
    match_photographs: bool = True  # with refine_cameras, begin where features that photographs share say
    bfloat16: bool = True  # multiply in bfloat16 where the machine is fast at it
    seed: Seed = 0


TAUGHT = 8  # points for each ray of a step, from which distillation learns
PADDING = 0.001  # colours may reach so far beyond 0 and 1, so that both are within reach of the sigmoid


class MipNeRF(RayMethod):
    """One network, evaluated twice on stretches of cones: evenly at first, then where something was found."""

    Config = Config
    joined: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame)
        self.encode_frustum = IntegratedEncoding(3, config.position_frequencies)
        self.encode_direction = FrequencyEncoding(3, config.direction_frequencies, base=1.0)
        inputs = self.encode_frustum.width, self.encode_direction.width
        shape = config.depth, config.hidden_width, config.skip_layer
        self.network = CoordinateNetwork(*inputs, *shape, exact=not config.bfloat16)
        self.empty = OccupancyMask(config.occupancy_resolution, config.occupancy_threshold)
        self.sampled = 1.0  # share of each ray, around its middle, that is sampled in training
        if config.coarse_to_fine:  # how far octaves have joined; kept, for a run that stopped early looks as it learnt
            self.register_buffer("joined", torch.zeros(()))
        refining, rate = config.refine_cameras, config.pose_learning_rate
        self.poses = PoseRefinement(frame.image_count, rate) if refining else None

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU a smaller network, asked only where something is."""
        if device.type == "cuda":
            return Config()
        return Config(
            depth=6,
            hidden_width=128,
            skip_layer=3,
            coarse_samples=32,
            fine_samples=16,
            rays_per_step=1024,
            learning_rate=4e-3,
            final_learning_rate=2e-4,
            coarse_loss_weight=0.0,
            warmup=0.02,
            occupancy_resolution=128,
        )

    @classmethod
    def smallest(cls) -> Any:
        """The paper's network, tiny, and a grid of what is empty: every part, within some twenty quick steps."""
        return Config(
            depth=3,
            hidden_width=32,
            skip_layer=2,
            position_frequencies=6,
            coarse_samples=16,
            fine_samples=12,
            rays_per_step=192,
            learning_rate=5e-3,
            final_learning_rate=5e-4,
            occupancy_resolution=16,
            warmup=0.1,
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        return bytes_kept(config) if learning else 0

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        if self.poses:
            self.poses.find(scene, self.config.match_photographs)
        else:  # silhouettes seen from wrong poses would carve what is there
            self.empty.begin(scene)

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """The network, taught at points by the teacher."""
        known, c, chance = taken_over(teacher, cameras), self.config, self.random(3)
        if c.coarse_to_fine:
            self.joined.fill_(1.0)  # what is taken over has its details
        if c.occupancy_resolution:
            occupied = known.occupied(self.space, c.occupancy_resolution, c.occupancy_threshold, chance)
            self.empty.grid.rule_out(occupied[None])
        optimizer = torch.optim.Adam(self.network.parameters(), c.learning_rate)
        distil(self.field, known, self.space, [optimizer], TAUGHT * c.rays_per_step, chance, self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        return super().loss(replace(batch, rays=self.poses(batch.rays)) if self.poses else batch, step)

    @property
    def pass_weights(self) -> dict[str, float]:
        return {"coarse": self.config.coarse_loss_weight}

    def looks(self, rays: Rays, generator: torch.Generator | None = None) -> list[Look]:
        return self._looks(rays, generator, colours=generator is None or self.config.coarse_loss_weight > 0)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        _, fine = self._looks(rays, None, colours=False)
        return composite(fine.samples, fine.density, fine.rgb, background)

    def _looks(self, rays: Rays, generator: torch.Generator | None, colours: bool) -> list[Look]:
        """The coarse look and the fine one.

        generator: of samples' places in training; None takes the middles of their bins
        colours:   of the coarse look; without them it only guides the fine one, and nothing is learnt from it
        """
        c, count, device = self.config, len(rays), self.device
        between = stratified(count, c.coarse_samples - 1, generator, device)
        between = (0.5 + (c.coarse_samples - 1) * between) / c.coarse_samples
        edges = pad(pad(between, (1, 0)), (0, 1), value=1.0)
        if generator:
            edges = 0.5 + self.sampled * (edges - 0.5)
        with torch.set_grad_enabled(torch.is_grad_enabled() and colours):
            coarse = self._look("coarse", rays, edges, colours)
            weights = weights_of(coarse.samples, coarse.density).view(count, -1).detach()
        again = stratified(count, c.fine_samples + 1, generator, device)
        edges = inverse_transform(edges, blurred(weights) + c.resample_padding, again)
        return [coarse, self._look("fine", rays, edges)]

    def _look(self, name: str, rays: Rays, edges: Float[Tensor, "ray edge"], colours: bool = True) -> Look:
        """The network's outputs for the frustums between edges, which are shares of the way along each ray."""
        samples, means, variances = frustums_between(edges, rays, self.space)
        ray = samples.ray_index
        seen = self.encode_direction(rays.directions)

        def answer(mean: Tensor, variance: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
            encoded = self._frustums(mean, variance)
            raw, rgb = self.network(encoded, seen[ray]) if colours else (self.network.density(encoded), mean)
            return softplus(raw - 1), padded(rgb)

        asked = self.empty.may_hold(means, variances.amax(-1).sqrt())
        density, rgb = in_chunks(answer, means, variances, ray, where=asked)
        self.figures |= {"rays": len(rays), "samples": len(samples) if asked is None else int(asked.sum())}
        return Look(name, samples, density * self.space.along(rays, samples), rgb)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""

        def answer(mean: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
            raw, rgb = self.network(self._encoded(mean), self.encode_direction(direction))
            return softplus(raw - 1), padded(rgb)

        density, rgb = in_chunks(answer, self.space.warp(points), directions)
        return density * self.space.stretch(points), rgb

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self._density_at(self.space.warp(points)) * self.space.stretch(points)

    def _density_at(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per unit of the coordinates."""
        return in_chunks(lambda x: (softplus(self.network.density(self._encoded(x)) - 1),), coordinates)[0]

    def _encoded(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, "point width"]:
        """Points, encoded over as much space as a cell of a grid of 128 takes: photographs show nothing smaller."""
        return self._frustums(coordinates, torch.full_like(coordinates, (2 / 128) ** 2 / 12))

    def _frustums(
        self, means: Float[Tensor, "point 3"], variances: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point width"]:
        """Frustums as waves, of as many octaves as have joined."""
        octaves, weights = self.config.position_frequencies, None
        if self.poses:
            weights = self.poses.weights(octaves)
        elif self.config.coarse_to_fine and self.joined < 1:
            weights = band_weights(octaves, float(self.joined), 0.0, 1.0).to(self.device)
        return self.encode_frustum(means, variances, weights)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        of_network = torch.optim.Adam(self.network.parameters(), self.config.learning_rate)
        return [of_network, self.poses.optimizer()] if self.poses else [of_network]

    def learning_rate(self, step: int, progress: float) -> float | dict[str, float]:
        """Exponential decay after a warm-up (section 4)."""
        c = self.config
        rate = falling(c.learning_rate, c.final_learning_rate, progress, c.warmup)
        return {"": rate, "poses": self.poses.rate(progress)} if self.poses else rate

    def before_step(self, step: int, progress: float) -> None:
        if self.poses:
            self.poses.progress.fill_(progress)
        if share := self.config.coarse_to_fine:
            self.joined.fill_(max(float(self.joined), min(progress / share, 1.0)))
        self.empty.look(step, progress, self._density_at, self.random(~step))

    def refined(self, cameras: Camera) -> Camera:
        return self.poses.refined(cameras) if self.poses else cameras


def padded(raw: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 3"]:
    """Colours of a network's raw output, PADDING beyond [0, 1] at most."""
    return raw.sigmoid() * (1 + 2 * PADDING) - PADDING
