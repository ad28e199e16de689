"""FieldMethod: a RayMethod made of a field, a sampler and a loss."""

from __future__ import annotations

from abc import ABC
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera.rays import Look, Rays, Rendering
from ..datasets.scene import Batch, Scene
from ..volume import composite
from .depth import depth_layers, depth_terms
from .field import Colours, Densities, Directions, Field, Points
from .ray_method import RayMethod
from .sampler import Density, Pass, Sampler


class FieldMethod(RayMethod, ABC):
    """A method of radiance fields: assign a Field as `network` and a Sampler as `sampler`, write `optimizers`, and
    `loss` where it is more than the squared error of each pass."""

    network: Field
    sampler: Sampler

    # Along rays

    @property
    def shown_code(self) -> Float[Tensor, "1 code"] | None:
        """Code of pictures, by the settings; None without one."""
        return None

    def code(self, rays: Rays) -> Float[Tensor, "#ray code"] | None:
        """Code of the field, for each ray or one row for all; None without one."""
        return self.shown_code

    def passes(self, rays: Rays, generator: torch.Generator | None = None) -> list[Pass]:
        """Passes of the field along rays, with their codes. generator: of jitter in training"""
        return self.sampler.sample(rays, self.network, self.code(rays), generator)

    def looks(self, rays: Rays) -> list[Look]:
        """Density and colour along rays, one entry for each pass, the composited one last."""
        return [self._look(each, rays) for each in self.passes(rays)]

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        look = self._look(self.passes(rays)[-1], rays)
        return composite(look.samples, look.density, look.rgb, self.behind(rays, self.code(rays), background))

    def _look(self, seen: Pass, rays: Rays) -> Look:
        look = seen.look(self.network, self.code(rays))
        return replace(look, rgb=self.recoloured(look.rgb))

    def behind(
        self, rays: Rays, code: Float[Tensor, "#ray code"] | None, background: Float[Tensor, "#ray 3"]
    ) -> Float[Tensor, "#ray 3"]:
        """Background colours of rays: the scene's, or a sky."""
        for part in self.parts:
            background = part.behind(rays, code, background)
        return background

    def recoloured(self, rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Colours of the field under the settings."""
        for part in self.parts:
            rgb = part.recoloured(self, rgb)
        return rgb

    @property
    def rays_per_chunk(self) -> int:  # type: ignore[override]
        """Number of rays in a rendering chunk."""
        return self.sampler.rays_per_chunk

    # At points

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        code = self.shown_code
        density, rgb = self.network(points, directions, None if code is None else code.expand(len(points), -1))
        return density, self.recoloured(rgb)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self.network.density(points)

    # Training

    def density_in_training(self, generator: torch.Generator) -> Density:
        """Density for the sampler's grid and its loss terms, over all codes that rays may have."""
        return self.density

    def random_times(self, points: Points, generator: torch.Generator) -> Float[Tensor, " point"]:
        """A random moment of the capture for each point."""
        first, last = self.frame.times or (0.0, 0.0)
        return first + (last - first) * torch.rand(len(points), generator=generator).to(self.device)

    def rays_in_a_step(self, data: Scene) -> float:
        return self.sampler.expected_rays

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        layers = depth_layers(self.config, data)
        return data.sample_rays(self.sampler.batch_size, generator, layers=layers).to(self.device)

    def learn(self, rays: Rays, generator: torch.Generator) -> tuple[list[Pass], dict[str, Tensor]]:
        """Passes along rays of photographs with jitter, and the sampler's loss terms by name."""
        return self.learn_along(self.refine_rays(rays), generator)

    def refine_rays(self, rays: Rays) -> Rays:
        """Rays of photographs with their learnt poses."""
        for part in self.parts:
            rays = part.refine_rays(rays)
        return rays

    def learn_along(self, rays: Rays, generator: torch.Generator) -> tuple[list[Pass], dict[str, Tensor]]:
        """Passes along rays with jitter, and the sampler's loss terms by name."""
        passes = self.passes(rays, generator)
        last = passes[-1]
        self.figures |= {"rays": len(rays), "samples": last.evaluated, "visible_samples": len(last.samples)}
        return passes, self.sampler.terms(self.density_in_training(generator), last, generator)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The squared error of each pass's picture (Mildenhall 2020, eq. 6), and the sampler's terms."""
        passes, terms = self.learn(batch.rays, self.random(step))
        target, code = batch.before(self.background), self.code(batch.rays)
        taught = dict[str, Tensor]()
        for each in passes:
            if weight := self.pass_weights.get(each.name, 1.0):
                look = each.look(self.network, code)
                seen = composite(look.samples, look.density, look.rgb, self.background)
                error = (seen.rgb - target).square().mean()
                self.figures["mse"] = float(error.detach())  # of the last pass in the end
                terms[each.name] = weight * error
                taught = depth_terms(self.config, batch.extra, seen.depth, seen.opacity)  # of the last pass
        return terms | taught
