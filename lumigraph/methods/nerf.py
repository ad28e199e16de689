"""NeRF: a scene held in the weights of a coordinate network (Mildenhall et al. 2020, arXiv 2003.08934)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import softplus

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering, Samples
from ..components.fields.coordinate_network import CoordinateNetwork, bytes_kept
from ..components.fields.dense import in_chunks
from ..components.fields.encodings import FrequencyEncoding
from ..components.fields.taken_over import taken_over
from ..components.sampling.occupancy_mask import OccupancyMask
from ..components.sampling.sampling import inverse_transform, midpoints, stratified
from ..components.sampling.spaces import space_of
from ..components.training.distillation import distil
from ..components.training.pose_refinement import PoseRefinement
from ..components.training.schedules import falling
from ..datasets.scene import Batch, Frame, Scene
from ..errors import LumigraphError
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
    between,
)
from ..method import RayMethod
from ..volume import composite, weights_of


@dataclass(frozen=True)
class Config:
    """The paper's numbers, with where it gives them; below them what saves time and keeps the mathematics."""

    depth: Depth = 8  # hidden layers before density, appendix A
    hidden_width: Width = 256  # channels of a layer, appendix A
    skip_layer: Layers = 5  # the layer whose activation the input joins again, figure 7
    position_frequencies: Octaves = 10  # L for points, section 5.1
    direction_frequencies: Octaves = 4  # L for directions, section 5.1
    coarse_samples: RaySamples = 64  # of a ray, appendix A
    fine_samples: RaySamples = 128  # of a ray, drawn where the first found something, appendix A
    rays_per_step: BatchSize = 4096  # section 5.3
    learning_rate: LearningRate = 5e-4  # section 5.3
    final_learning_rate: LearningRate = 5e-5  # at the end of the budget, section 5.3
    density_noise: NonNegative = 1.0  # deviation of what is added to captures' raw density in training, appendix A
    networks: Annotated[int, between(1, 2)] = 2  # one for each look; 1 looks twice with the same
    coarse_loss_weight: NonNegative = 1.0  # of the first look's colours, eq. 6; 0 with one network: it only guides
    occupancy_resolution: Cells = 0  # cells per axis of a grid that tells where to sample; 0 samples everywhere
    occupancy_threshold: NonNegative = 0.01  # optical thickness across a cell below which it is empty
    transmittance_threshold: Share = 0.0  # at which a ray is spent
    warmup: Share = 0.0  # share of the budget in which the learning rate grows
    refine_cameras: bool = False  # learn where each photograph was taken from, coarse to fine (Lin 2021, BARF)
    pose_learning_rate: LearningRate = 5e-4  # radians by which a step moves a picture, with refine_cameras
    match_photographs: bool = True  # with refine_cameras, begin where features that photographs share say
    bfloat16: bool = True  # multiply in bfloat16 where the machine is fast at it
    seed: Seed = 0

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.networks == 2 and not self.coarse_loss_weight:
            raise LumigraphError(
                "The first of two networks learns from --coarse-loss-weight alone, so --networks 2 with "
                "--coarse-loss-weight 0 cannot be; give --networks 1, or a weight above 0"
            )


TAUGHT = 8  # points for each ray of a step, from which distillation learns


class NeRF(RayMethod):
    """Coarse samples evenly along each ray, fine ones where the coarse ones found something (section 5.2)."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame)
        self.encode_position = FrequencyEncoding(3, config.position_frequencies, keep_input=False)
        self.encode_direction = FrequencyEncoding(3, config.direction_frequencies, keep_input=False)
        inputs = self.encode_position.width, self.encode_direction.width
        shape, exact = (config.depth, config.hidden_width, config.skip_layer), not config.bfloat16
        self.fine = CoordinateNetwork(*inputs, *shape, exact=exact)
        self.coarse = CoordinateNetwork(*inputs, *shape, exact=exact) if config.networks == 2 else None
        self.empty = OccupancyMask(config.occupancy_resolution, config.occupancy_threshold)
        refining, rate = config.refine_cameras, config.pose_learning_rate
        self.poses = PoseRefinement(frame.image_count, rate) if refining else None

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU a smaller network that looks twice, and only where something is."""
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
            warmup=0.02,
            networks=1,
            coarse_loss_weight=0.0,
            occupancy_resolution=128,
            transmittance_threshold=1e-3,
        )

    @classmethod
    def smallest(cls) -> Any:
        """The paper's two networks, tiny, and a grid of what is empty: every part, within some twenty quick steps."""
        return Config(
            depth=3,
            hidden_width=32,
            skip_layer=2,
            position_frequencies=5,
            coarse_samples=16,
            fine_samples=12,
            rays_per_step=192,
            learning_rate=5e-3,
            final_learning_rate=5e-4,
            occupancy_resolution=16,
            transmittance_threshold=1e-3,
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
        """Both networks alike, taught at points by the teacher."""
        known, c, chance = taken_over(teacher, cameras), self.config, self.random(3)
        if c.occupancy_resolution:
            occupied = known.occupied(self.space, c.occupancy_resolution, c.occupancy_threshold, chance)
            self.empty.grid.rule_out(occupied[None])
        optimizer = torch.optim.Adam(self.fine.parameters(), c.learning_rate, eps=1e-7)
        field = partial(self._field, activation=softplus)  # for what is below 0 must learn as well
        distil(field, known, self.space, [optimizer], TAUGHT * c.rays_per_step, chance, self.device)
        if self.coarse:
            self.coarse.load_state_dict(self.fine.state_dict())

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
        with torch.set_grad_enabled(torch.is_grad_enabled() and colours):
            shares = stratified(count, c.coarse_samples, generator, device)
            coarse = self._look("coarse", self.coarse or self.fine, rays, shares, generator, colours=colours)
            weights = weights_of(coarse.samples, coarse.density).view(count, -1).detach()
        again = inverse_transform(
            midpoints(shares), weights[:, 1:-1], stratified(count, c.fine_samples, generator, device)
        )
        shares, order = torch.cat([shares, again], -1).sort(-1)
        lit = None
        if c.transmittance_threshold:  # the coarse look knows which of its places no light comes back from
            lit = weights.cumsum(-1) - weights <= 1 - c.transmittance_threshold
            lit = torch.cat([lit, torch.ones_like(again, dtype=torch.bool)], -1).gather(-1, order).flatten()
        return [coarse, self._look("fine", self.fine, rays, shares, generator, lit)]

    def _look(
        self,
        name: str,
        network: CoordinateNetwork,
        rays: Rays,
        shares: Float[Tensor, "ray sample"],
        generator: torch.Generator | None,
        lit: Bool[Tensor, " all_samples"] | None = None,
        colours: bool = True,
    ) -> Look:
        """A network's outputs at places along rays; each holds as far as the next place (eq. 3)."""
        with torch.no_grad():  # where samples lie tells nothing of a pose
            near, far = self.space.interval(rays)
            t = self.space.distance(shares, rays, near, far)
        samples, ray = Samples.rows(t, far), torch.arange(t.numel(), device=t.device) // t.shape[1]
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        coordinates = self.space.warp(points.flatten(0, 1))
        directions = self.encode_direction(rays.directions)
        noise = self.config.density_noise if generator and self.frame.reach > 1 else 0.0

        def answer(x: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
            position = self._encoded(x)
            raw, rgb = network(position, directions[ray]) if colours else (network.density(position), x)
            if noise:
                raw = raw + noise * torch.randn(len(raw), generator=generator).to(raw.device)
            return raw.relu(), rgb.sigmoid()

        there = self.empty.may_hold(coordinates)
        asked = there if lit is None else lit if there is None else lit & there
        density, rgb = in_chunks(answer, coordinates, ray, where=asked)
        self.figures |= {"rays": len(rays), "samples": len(samples) if asked is None else int(asked.sum())}
        return Look(name, samples, density * self.space.along(rays, samples), rgb)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        return self._field(points, directions, torch.relu)

    def _field(
        self,
        points: Float[Tensor, "point 3"],
        directions: Float[Tensor, "point 3"],
        activation: Callable[[Tensor], Tensor],
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        def answer(x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
            raw, rgb = self.fine(self._encoded(x), self.encode_direction(direction))
            return activation(raw), rgb.sigmoid()

        density, rgb = in_chunks(answer, self.space.warp(points), directions)
        return density * self.space.stretch(points), rgb

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self._density_at(self.space.warp(points)) * self.space.stretch(points)

    def _density_at(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per unit of the coordinates."""
        return in_chunks(lambda x: (self.fine.density(self._encoded(x)).relu(),), coordinates)[0]

    def _encoded(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, "point width"]:
        """Coordinates as waves; while poses are refined, of as many octaves as have joined."""
        weights = self.poses.weights(self.config.position_frequencies) if self.poses else None
        return self.encode_position(coordinates, weights)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        networks = [p for name, p in self.named_parameters() if not name.startswith("poses.")]
        of_networks = torch.optim.Adam(networks, self.config.learning_rate, eps=1e-7)
        return [of_networks, self.poses.optimizer()] if self.poses else [of_networks]

    def learning_rate(self, step: int, progress: float) -> float | dict[str, float]:
        """Exponential decay (section 5.3)."""
        c = self.config
        rate = falling(c.learning_rate, c.final_learning_rate, progress, c.warmup)
        return {"": rate, "poses": self.poses.rate(progress)} if self.poses else rate

    def before_step(self, step: int, progress: float) -> None:
        if self.poses:
            self.poses.progress.fill_(progress)
        self.empty.look(step, progress, self._density_at, self.random(~step))

    def refined(self, cameras: Camera) -> Camera:
        return self.poses.refined(cameras) if self.poses else cameras
