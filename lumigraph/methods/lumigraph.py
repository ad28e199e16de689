"""The lumigraph: photographs blended ray by ray over a rough surface (Gortler et al. 1996; Buehler et al. 2001)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from .. import kernels
from ..camera import Camera
from ..camera.lens import OpenCV, Pinhole
from ..camera.rays import Rendering
from ..components.image_based.depth import Geometry, shape
from ..components.image_based.kept_views import focal_length
from ..components.image_based.method import ImageBasedMethod
from ..components.image_based.surface import surface_seen
from ..datasets.scene import Frame, Scene
from ..files.ranges import Count, Pixels
from ..method import BaseConfig
from ..method.controls import Control
from ..system.work import at_work

LENS_SAMPLES = 24  # places on a lens of some aperture
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
FOCUS_RANGE = 8.0  # times the distance of the optimum plane, to which the control reaches
DEFAULT_APERTURE = 0.04  # of that distance: the lens's radius where only the focus is set
RESOLUTION_WEIGHT = 0.05  # penalty of photographs coarser than the new picture, beside the angle in radians
HIDDEN_WEIGHT = 10.0  # penalty of photographs that see another surface there, times the angle
DEPTH_TOLERANCE = 0.015  # of distance, within which they see the same
BORDER = 0.08  # of a photograph's side, over which its weight falls to its edge


@dataclass(frozen=True)
class Config(BaseConfig):
    """Numbers of Buehler 2001, which gives the form of the weights (sec. 4 and 5) and leaves their factors open."""

    geometry: Geometry = "stereo"  # source of depth: multi-view stereo, a layer `depth`, a mesh, or one plane
    mesh_file: str = ""  # of --geometry mesh: a mesh in the frame of the photographs
    depth_size: Pixels = 400  # longer side of the depth maps; larger: finer edges, slower
    blended_views: Count = 4  # k: photographs blended at each pixel; more: smoother, more ghosts
    candidate_views: Count = 16  # photographs near a camera among which each pixel chooses
    surface_views: Count = 6  # photographs whose depth maps make the surface before a camera


SOURCES = {  # of the numbers of `paper`; the others are ours
    "Gortler 1996, section 3.4": "blended_views",
}


class Lumigraph(ImageBasedMethod):
    """Photographs, a depth map of each, and weights by angle, resolution and field of view."""

    Config = Config
    plane: Tensor  # 1 / z of the optimum plane; 0 before photographs are known

    def __init__(self, frame: Frame, config: Any = None):
        super().__init__(frame, config or Config())
        self.register_buffer("plane", torch.tensor(0.0))

    @classmethod
    def cpu_preset(cls) -> Any:
        """Depth maps of 200 pixels and half as many candidates, for ten pictures a second."""
        return Config(depth_size=200, candidate_views=8, surface_views=4)

    @classmethod
    def smallest(cls) -> Any:
        """Measured depth of a few pixels."""
        return Config(geometry="measured", depth_size=24, candidate_views=4, surface_views=3)

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        c = self.config
        self.keep(data, c.geometry, seconds, c.mesh_file)
        self.plane.fill_(float(1 / self.views.tables.middle))

    # Rendering

    @property
    def controls(self) -> tuple[Control, ...]:
        """Focus and aperture (Isaksen 2000)."""
        if not self.views:
            return super().controls
        away = 1 / float(self.plane)
        focus = "Distance that is sharp, along the axis; 0: all, or with an aperture what is in the middle."
        aperture = "Radius of the lens; larger blurs more of what is out of focus."
        return (
            *super().controls,
            Control("focus", 0.0, range=(0.0, FOCUS_RANGE * away), unit="scene units", about=focus),
            Control("aperture", 0.0, range=(0.0, away), unit="scene units", about=aperture),
        )

    @at_work()
    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        if not self.views:
            return self._nothing(camera)
        focus, aperture = (float(self.control(name)) for name in ("focus", "aperture"))
        if not (focus or aperture) or not isinstance(camera.lens, Pinhole | OpenCV):
            return self._sharp(camera, focus)
        first = self._sharp(camera, focus)
        height, width = shape(camera)
        focus = focus or float((first.depth * camera.cosines())[height // 2, width // 2].clamp_max(1e3))
        aperture = aperture or (0.0 if self.config.geometry == "plane" else DEFAULT_APERTURE / float(self.plane))
        if not aperture:
            return first
        total = torch.zeros_like(first.rgb)
        for k in range(LENS_SAMPLES):
            radius, angle = aperture * math.sqrt((k + 0.5) / LENS_SAMPLES), k * GOLDEN_ANGLE
            aside = camera.sheared(radius * math.cos(angle), radius * math.sin(angle), focus)
            total += self._sharp(aside, focus).rgb
        return replace(first, rgb=total / LENS_SAMPLES)

    def _sharp(self, camera: Camera, focus: float) -> Rendering:
        """Through a pinhole. focus: distance of the plane, where a plane is the geometry; 0 for the optimum."""
        c, tables = self.config, self.views.tables
        height, width = shape(camera)
        chosen = tables.nearest(camera, c.candidate_views)
        solid = torch.ones(height, width, dtype=torch.bool, device=self.device)
        if c.geometry == "plane":
            depth = (focus or 1 / float(self.plane)) / camera.cosines().clamp_min(1e-2)
        else:
            depth, solid = surface_seen(self.views, chosen[: c.surface_views], camera, not self.frame.has_alpha)
        rays = camera.rays(camera.pixels())
        points = rays.at(torch.where(solid, depth, 1.0).flatten())[solid.flatten()]
        named = (tables.pictures, tables.depths, tables.sizes, tables.poses, tables.lenses)
        pictures, depths, sizes, poses, lenses = (x[chosen] for x in named)
        hidden = 0.0 if c.geometry == "plane" else HIDDEN_WEIGHT
        weights = RESOLUTION_WEIGHT, hidden, DEPTH_TOLERANCE, BORDER
        eyes = rays.origins[solid.flatten()].contiguous()
        found, share = kernels.blend_views(
            points, eyes, focal_length(camera), pictures, depths, sizes, poses, lenses, c.blended_views, *weights
        )
        alpha = found[:, 3] if found.shape[1] > 3 else torch.ones_like(share)
        rgb, opacity = self.background.repeat(height * width, 1), torch.zeros(height * width, device=self.device)
        rgb[solid.flatten()] = torch.where(share[:, None] > 0, found[:, :3], self.background)
        opacity[solid.flatten()] = torch.where(share > 0, alpha, 0)
        depth = torch.where(opacity > 0, depth.flatten(), torch.inf)
        return Rendering(rgb, depth, opacity).reshape(height, width)

    def _nothing(self, camera: Camera) -> Rendering:
        """The background, for a method without photographs."""
        height, width = shape(camera)
        empty = torch.zeros(height, width, device=self.device)
        return Rendering(self.background.expand(height, width, 3).clone(), empty + torch.inf, empty)
