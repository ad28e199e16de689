"""RayMethod: a Method that renders one ray at a time."""

from __future__ import annotations

import copy
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..budget import BY_RAY, Efforts
from ..camera import Camera
from ..camera.rays import Rays, Rendering
from ..datasets.scene import Batch, Photograph, Scene
from ..system.work import at_work
from ..volume import composite
from .capabilities import ColourPairs, HasLooks, needs
from .depth import depth_layers, depth_terms
from .method import Method

POSE_RAYS = 512  # of a photograph, from which the error of a pose is measured


class RayMethod(Method):
    """A Method that renders rays independently: write `looks` or `render_rays`, inherit the rest."""

    any_lens: ClassVar[bool] = True
    efforts: ClassVar[Efforts] = BY_RAY
    rays_per_chunk: int = 16_384

    def steps_per_pass(self, data: Any) -> float:
        """Number of steps with as many rays as the training photographs have trusted pixels."""
        if not isinstance(data, Scene):
            return super().steps_per_pass(data)
        return data.pixels("train") / self.rays_in_a_step(data)

    def rays_in_a_step(self, data: Scene) -> float:
        """Approximate number of rays of a step, measured on a copy's first step."""
        fresh = copy.deepcopy(self)
        fresh.progress = 0.0
        return len(fresh.batch(data, torch.Generator().manual_seed(0)))

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        layers = depth_layers(self.config, data)
        return data.sample_rays(self.config.rays_per_step, generator, layers=layers).to(self.device)

    @property
    def pass_weights(self) -> dict[str, float]:
        """Loss weights of the passes, by the names of their looks; 1 for others. A pass of weight 0 is not trained. By
        default the Config's `coarse_loss_weight`, if it has one."""
        return {"coarse": getattr(self.config, "coarse_loss_weight", 1.0)}

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Squared error of each pass's picture (Mildenhall 2020, eq. 6), for `looks` with jitter in training."""
        background = self.background
        target = batch.before(background)
        terms, taught = dict[str, Tensor](), dict[str, Tensor]()
        for look in needs(self, HasLooks).looks(batch.rays, self.random(step)):
            if weight := self.pass_weights.get(look.name, 1.0):
                seen = composite(look.samples, look.density, look.rgb, background)
                error = (seen.rgb - target).square().mean()
                self.figures["mse"] = float(error.detach())  # of the last pass in the end
                terms[look.name] = weight * error
                taught = depth_terms(self.config, batch.extra, seen.depth, seen.opacity)  # of the last pass
        return terms | taught

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        """Rendering of each ray over a background colour: the last look, composited."""
        look = needs(self, HasLooks).looks(rays)[-1]
        return composite(look.samples, look.density, look.rgb, background)

    def colour_pairs(self, photograph: Photograph) -> ColourPairs:
        """Rendered colours as a function of a photograph's pose at random trusted pixels; see `RefinesPoses`."""

        def pairs(poses: Any, generator: torch.Generator) -> tuple[Float[Tensor, "ray 3"], Float[Tensor, "ray 3"]]:
            batch = photograph.sample_rays(POSE_RAYS, generator).to(self.device)
            return self.render_rays(poses(batch.rays), self.background).rgb, batch.before(self.background)

        return pairs

    @at_work()
    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        width, height = camera.size[0].tolist()
        rays = camera.rays(camera.pixels()).to(self.device)
        background = self.background
        chunks = [slice(i, i + self.rays_per_chunk) for i in range(0, len(rays), self.rays_per_chunk)]
        parts = [self.render_rays(rays[chunk], background) for chunk in chunks]
        return Rendering.cat(parts).reshape(height, width)
