"""Mip-NeRF: pixels see cones, and what is smaller than a cone's width fades (Barron et al. 2021, arXiv 2103.13415)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool1d, pad, softplus

from ..components.coordinate_network import CoordinateNetwork
from ..components.dense import in_chunks
from ..components.empty_space import EmptySpace
from ..components.encodings import FrequencyEncoding, IntegratedEncoding
from ..components.frustums import frustum_moments
from ..components.sampling import inverse_transform, stratified
from ..components.schedules import falling, set_learning_rate
from ..components.spaces import space_of
from ..components.two_looks import squared_errors
from ..method import RayMethod
from ..rays import Look, Rays, Rendering, Samples
from ..scene import Batch, Frame, Scene
from ..volume import composite, weights_of


@dataclass(frozen=True)
class Config:
    """The paper's numbers, with where it gives them; below them what saves time and keeps the mathematics."""

    depth: int = 8  # hidden layers before density, as NeRF's
    width: int = 256  # channels of a layer, as NeRF's
    rejoin: int = 5  # the layer whose activation the input joins again, as NeRF's
    position_bands: int = 16  # L for frustums, section 4: with cones, more do no harm
    direction_bands: int = 4  # L for directions, as NeRF's
    coarse_samples: int = 128  # frustums of a ray, section 3.2
    fine_samples: int = 128  # of a ray, drawn where the first found something, section 3.2
    blur: float = 0.01  # alpha, weight that every frustum has at least, eq. 17
    coarse_loss: float = 0.1  # lambda, section 3.2; 0: the first look only guides the second
    rays_per_step: int = 4096  # section 4
    learning_rate: float = 5e-4  # section 4
    last_learning_rate: float = 5e-6  # at the end of the budget, section 4
    warm_up: float = 0.0025  # share of the budget in which the learning rate grows, section 4
    occupancy: int = 0  # cells per axis of a grid that knows where to look; 0 looks everywhere
    cell_thickness: float = 0.01  # optical thickness across a cell below which it is empty
    bfloat16: bool = True  # multiply in bfloat16 where the machine is fast at it
    seed: int = 0


PADDING = 0.001  # colours may reach so far beyond 0 and 1, so that both are within reach of the sigmoid


class MipNeRF(RayMethod):
    """One network, asked twice about stretches of cones: evenly at first, then where something was found."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.space = space_of(frame)
        self.encode_frustum = IntegratedEncoding(3, config.position_bands)
        self.encode_direction = FrequencyEncoding(3, config.direction_bands, base=1.0)
        inputs = self.encode_frustum.width, self.encode_direction.width
        shape = config.depth, config.width, config.rejoin
        self.network = CoordinateNetwork(*inputs, *shape, exact=not config.bfloat16)
        self.empty = EmptySpace(config.occupancy, config.cell_thickness) if config.occupancy else None
        self._optimizers: list[torch.optim.Optimizer] = []
        self._figures: dict[str, float] = {}

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU a smaller network, asked only where something is."""
        if device.type == "cuda":
            return Config()
        return Config(
            depth=6,
            width=128,
            rejoin=3,
            coarse_samples=32,
            fine_samples=16,
            rays_per_step=1024,
            learning_rate=4e-3,
            last_learning_rate=2e-4,
            coarse_loss=0.0,
            warm_up=0.02,
            occupancy=128,
        )

    def begin(self, scene: Scene) -> None:
        if self.empty:
            self.empty.begin(scene)

    def batch(self, scene: Scene, generator: torch.Generator) -> Batch:
        return scene.sample_rays(self.config.rays_per_step, generator).to(self.device)

    def looks(self, rays: Rays) -> list[Look]:
        return self._looks(rays, None, colours=True)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        _, fine = self._looks(rays, None, colours=False)
        return composite(fine.samples, fine.density, fine.rgb, background)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The squared error of both looks (section 3.2)."""
        background = self.background
        looks = self._looks(batch.rays, self.random(step), colours=self.config.coarse_loss > 0)
        terms = squared_errors(looks, batch.before(background), background, self.config.coarse_loss)
        self._figures["mse"] = float(terms["fine"].detach())
        return terms

    def _looks(self, rays: Rays, generator: torch.Generator | None, colours: bool) -> list[Look]:
        """The coarse look and the fine one.

        generator: of samples' places in training; None takes the middles of their bins
        colours:   of the coarse look; without them it only guides the fine one, and nothing is learnt from it
        """
        c, count, device = self.config, len(rays), self.device
        between = stratified(count, c.coarse_samples - 1, generator, device)
        between = (0.5 + (c.coarse_samples - 1) * between) / c.coarse_samples
        edges = pad(pad(between, (1, 0)), (0, 1), value=1.0)
        with torch.set_grad_enabled(torch.is_grad_enabled() and colours):
            coarse = self._look("coarse", rays, edges, colours)
            weights = weights_of(coarse.samples, coarse.density).view(count, -1).detach()
        again = stratified(count, c.fine_samples + 1, generator, device)
        return [coarse, self._look("fine", rays, inverse_transform(edges, blurred(weights) + c.blur, again))]

    def _look(self, name: str, rays: Rays, edges: Float[Tensor, "ray edge"], colours: bool = True) -> Look:
        """Ask the network about the frustums between edges, which are shares of the way along each ray."""
        near, far = self.space.interval(rays)
        t = self.space.distance(edges, rays, near, far)
        samples = Samples.rows(t[:, :-1], t[:, -1])
        ray = samples.ray_index
        distance, along, across = frustum_moments(samples.t_start, samples.t_end, rays.radius[ray])
        directions = rays.directions[ray]
        points = rays.origins[ray] + distance[:, None] * directions
        means, variances = self.space.warp_gaussians(points, directions, along, across)
        seen = self.encode_direction(rays.directions)

        def answer(mean: Tensor, variance: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
            encoded = self.encode_frustum(mean, variance)
            raw, rgb = self.network(encoded, seen[ray]) if colours else (self.network.density(encoded), mean)
            return softplus(raw - 1), rgb.sigmoid() * (1 + 2 * PADDING) - PADDING

        asked = self.empty.may_hold(means, variances.amax(-1).sqrt()) if self.empty else None
        density, rgb = in_chunks(answer, means, variances, ray, where=asked)
        self._figures |= {"rays": len(rays), "samples": len(samples) if asked is None else int(asked.sum())}
        return Look(name, samples, density * self.space.along(rays, samples), rgb)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self._density_at(self.space.warp(points)) * self.space.stretch(points)

    def _density_at(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per unit of the coordinates, over as much space as a cell of a grid of 128 takes: what is smaller no
        photograph has shown."""
        variances = torch.full_like(coordinates, (2 / 128) ** 2 / 12)

        def answer(mean: Tensor, variance: Tensor) -> tuple[Tensor]:
            return (softplus(self.network.density(self.encode_frustum(mean, variance)) - 1),)

        return in_chunks(answer, coordinates, variances)[0]

    def optimizers(self) -> list[torch.optim.Optimizer]:
        self._optimizers = [torch.optim.Adam(self.network.parameters(), self.config.learning_rate)]
        return self._optimizers

    def before_step(self, step: int, progress: float) -> None:
        c = self.config
        set_learning_rate(self._optimizers, falling(c.learning_rate, c.last_learning_rate, progress, c.warm_up))
        if self.empty:
            self.empty.look(step, progress, self._density_at, self.random(~step))

    def statistics(self) -> dict[str, float]:
        return self._figures


def blurred(weights: Float[Tensor, "ray bin"]) -> Float[Tensor, "ray bin"]:
    """A little wider than they are, so that the second look surrounds what the first one found (eq. 17)."""
    larger = max_pool1d(pad(weights, (1, 1)), 2, 1)  # of each two neighbours
    return 0.5 * (larger[:, 1:] + larger[:, :-1])
