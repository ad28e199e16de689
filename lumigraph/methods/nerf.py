"""NeRF: a scene held in the weights of a coordinate network (Mildenhall et al. 2020, arXiv 2003.08934)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..components.coordinate_network import CoordinateNetwork
from ..components.dense import in_chunks
from ..components.empty_space import EmptySpace
from ..components.encodings import FrequencyEncoding
from ..components.sampling import inverse_transform, midpoints, stratified
from ..components.schedules import falling, set_learning_rate
from ..components.spaces import space_of
from ..components.two_looks import squared_errors
from ..errors import LumigraphError
from ..method import RayMethod
from ..rays import Look, Rays, Rendering, Samples
from ..scene import Batch, Frame, Scene
from ..volume import composite, weights_of


@dataclass(frozen=True)
class Config:
    """The paper's numbers, with where it gives them; below them what saves time and keeps the mathematics."""

    depth: int = 8  # hidden layers before density, appendix A
    width: int = 256  # channels of a layer, appendix A
    rejoin: int = 5  # the layer whose activation the input joins again, figure 7
    position_bands: int = 10  # L for points, section 5.1
    direction_bands: int = 4  # L for directions, section 5.1
    coarse_samples: int = 64  # of a ray, appendix A
    fine_samples: int = 128  # of a ray, drawn where the first found something, appendix A
    rays_per_step: int = 4096  # section 5.3
    learning_rate: float = 5e-4  # section 5.3
    last_learning_rate: float = 5e-5  # at the end of the budget, section 5.3
    density_noise: float = 1.0  # deviation of what is added to captures' raw density in training, appendix A
    networks: int = 2  # one for each look; 1 looks twice with the same
    coarse_loss: float = 1.0  # weight of the first look's colours, eq. 6; 0 with one network: it only guides
    occupancy: int = 0  # cells per axis of a grid that knows where to look; 0 looks everywhere
    cell_thickness: float = 0.01  # optical thickness across a cell below which it is empty
    stop: float = 0.0  # transmittance at which a ray is spent
    warm_up: float = 0.0  # share of the budget in which the learning rate grows
    bfloat16: bool = True  # multiply in bfloat16 where the machine is fast at it
    seed: int = 0


class NeRF(RayMethod):
    """Look once evenly, then again where the first look found something (section 5.2)."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        if config.networks not in (1, 2) or (config.networks == 2 and not config.coarse_loss):
            raise LumigraphError(
                f"nerf has 1 or 2 networks, and the first of 2 learns from --coarse-loss alone; --networks "
                f"{config.networks} with --coarse-loss {config.coarse_loss:g} cannot be"
            )
        super().__init__(frame, config)
        self.space = space_of(frame)
        self.encode_position = FrequencyEncoding(3, config.position_bands, keep_input=False)
        self.encode_direction = FrequencyEncoding(3, config.direction_bands, keep_input=False)
        inputs = self.encode_position.width, self.encode_direction.width
        common = {"depth": config.depth, "width": config.width, "rejoin": config.rejoin, "exact": not config.bfloat16}
        self.fine = CoordinateNetwork(*inputs, **common)
        self.coarse = CoordinateNetwork(*inputs, **common) if config.networks == 2 else None
        self.empty = EmptySpace(config.occupancy, config.cell_thickness) if config.occupancy else None
        self._optimizers: list[torch.optim.Optimizer] = []
        self._figures: dict[str, float] = {}

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU a smaller network that looks twice, and only where something is."""
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
            warm_up=0.02,
            networks=1,
            coarse_loss=0.0,
            occupancy=128,
            stop=1e-3,
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
        """The squared error of both looks (eq. 6)."""
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
        with torch.set_grad_enabled(torch.is_grad_enabled() and colours):
            shares = stratified(count, c.coarse_samples, generator, device)
            coarse = self._look("coarse", self.coarse or self.fine, rays, shares, generator, colours=colours)
            weights = weights_of(coarse.samples, coarse.density).view(count, -1).detach()
        again = inverse_transform(
            midpoints(shares), weights[:, 1:-1], stratified(count, c.fine_samples, generator, device)
        )
        shares, order = torch.cat([shares, again], -1).sort(-1)
        lit = None
        if c.stop:  # the coarse look knows which of its places no light comes back from
            lit = weights.cumsum(-1) - weights <= 1 - c.stop
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
        """Ask a network at places along rays; its answer holds as far as the next place (eq. 3)."""
        near, far = self.space.interval(rays)
        t = self.space.distance(shares, rays, near, far)
        samples, ray = Samples.rows(t, far), torch.arange(t.numel(), device=t.device) // t.shape[1]
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        coordinates = self.space.warp(points.flatten(0, 1))
        directions = self.encode_direction(rays.directions)
        noise = self.config.density_noise if generator and self.frame.reach > 1 else 0.0

        def answer(x: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
            position = self.encode_position(x)
            raw, rgb = network(position, directions[ray]) if colours else (network.density(position), x)
            if noise:
                raw = raw + noise * torch.randn(len(raw), generator=generator).to(raw.device)
            return raw.relu(), rgb.sigmoid()

        asked = lit
        if self.empty:
            there = self.empty.may_hold(coordinates)
            asked = there if lit is None else lit & there
        density, rgb = in_chunks(answer, coordinates, ray, where=asked)
        self._figures |= {"rays": len(rays), "samples": len(samples) if asked is None else int(asked.sum())}
        return Look(name, samples, density * self.space.along(rays, samples), rgb)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self._density_at(self.space.warp(points)) * self.space.stretch(points)

    def _density_at(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per unit of the coordinates."""
        return in_chunks(lambda x: (self.fine.density(self.encode_position(x)).relu(),), coordinates)[0]

    def optimizers(self) -> list[torch.optim.Optimizer]:
        self._optimizers = [torch.optim.Adam(self.parameters(), self.config.learning_rate, eps=1e-7)]
        return self._optimizers

    def before_step(self, step: int, progress: float) -> None:
        """The learning rate falls exponentially (section 5.3)."""
        c = self.config
        set_learning_rate(self._optimizers, falling(c.learning_rate, c.last_learning_rate, progress, c.warm_up))
        if self.empty:
            self.empty.look(step, progress, self._density_at, self.random(~step))

    def statistics(self) -> dict[str, float]:
        return self._figures
