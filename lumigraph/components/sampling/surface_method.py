"""SurfaceMethod: a RayMethod that renders the zero level of a function of points, shaded by its normals."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from ...budget import Effort, Efforts
from ...camera.rays import Rays, Rendering
from ...datasets.shapes import Shapes
from ...method import RayMethod
from ...method.controls import Control
from .sphere_trace import March, sphere_trace

SHADINGS = ("grey", "normals")  # a grey surface lit from the camera; normals as colours
AMBIENT, DIFFUSE = 0.25, 0.65  # of the grey surface


class SurfaceMethod(RayMethod):
    """Surface method trained on Shapes. Write `distance`, negative inside; pictures have colour, depth, opacity and
    normals.

    march:    steps along rays towards the surface
    shadings: choices of the control of that name, the default first
    """

    learns_from: ClassVar[type] = Shapes
    efforts: ClassVar[Efforts] = {"draft": Effort(20, 500), "good": Effort(200, 4000), "best": Effort(1000, 30_000)}
    march: ClassVar[March] = March()
    shadings: ClassVar[tuple[str, ...]] = SHADINGS

    @abstractmethod
    def distance(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """A function of points in scene units that is zero at the surface and negative inside."""

    def met(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 3"]]:
        """Distance of each ray's intersection with the surface inside the box of interest, infinity for none, and the
        unit normal there, zero for none."""
        box = torch.tensor(self.frame.bounds, device=self.device)
        return self.with_normals(rays, sphere_trace(self.distance, rays, box, self.march, self.frame.near).t)

    def with_normals(
        self, rays: Rays, t: Float[Tensor, " ray"]
    ) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 3"]]:
        """Distances with the normals there."""
        normals, there = torch.zeros_like(rays.directions), t.isfinite().nonzero()[:, 0]
        if len(there):
            normals[there] = self.normals(rays[there].at(t[there]))
        return t, normals

    def normals(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Unit gradients of the function."""
        with torch.enable_grad():
            points = points.detach().requires_grad_()
            (gradient,) = torch.autograd.grad(self.distance(points).sum(), points)
        return normalize(gradient, dim=-1)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        t, normals = self.met(rays)
        hit = t.isfinite()
        rgb = torch.where(hit[:, None], self.shaded(normals, rays.directions), background)
        return Rendering(rgb, t, hit.float(), {"normals": normals})

    def shaded(
        self, normals: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        """Colour of the surface seen along unit directions."""
        if self.control("shading") == "normals":
            return 0.5 + 0.5 * normals
        facing = (normals * directions).sum(-1, keepdim=True).abs()
        return (AMBIENT + DIFFUSE * facing).expand(-1, 3)

    @property
    def controls(self) -> tuple[Control, ...]:
        about = "Colours of the surface: grey in light from the camera, or its normals."
        return (*super().controls, Control("shading", self.shadings[0], choices=self.shadings, about=about))
