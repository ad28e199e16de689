"""Crop: what a method shows inside a box of the scene, and nothing of what is outside.

A cloud of Gaussians is filtered by its centres. A RayMethod's rays begin where they enter the box, so what stands in
front of it vanishes; what lies behind it is told by the expected depth, pixel by pixel, which is all that other methods
offer. Where a see-through surface inside the box stands before a solid one outside, that pixel goes by their mean.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .. import splatting
from ..camera import Camera
from ..gaussians import Gaussians
from ..method import Method, RayMethod
from ..rays import Rays, Rendering
from ..scene import Vector

TOLERANCE = 0.01  # of the box's sides: an expected depth may lie so far outside


@dataclass(frozen=True)
class Box:
    """Corners in the scene's frame; lower is nowhere above upper."""

    lower: Vector
    upper: Vector

    def holds(self, points: Float[Tensor, "*point 3"], tolerance: float = 0.0) -> Bool[Tensor, "*point"]:
        lower, upper = torch.tensor(self.lower).to(points), torch.tensor(self.upper).to(points)
        margin = tolerance * (upper - lower)
        return ((points >= lower - margin) & (points <= upper + margin)).all(-1)

    def entered(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Bool[Tensor, " ray"]]:
        """Distance at which each ray is first inside, 0 for one that begins inside, and whether it ever is."""
        enter, leave = rays.through_box(rays.origins.new_tensor((self.lower, self.upper)))
        enter = enter.clamp_min(0)
        return enter, enter < leave

    def cropped(self, cloud: Gaussians) -> Gaussians:
        return cloud[self.holds(cloud.means)]


def render_inside(method: Method, camera: Camera, box: Box, is_cloud: bool) -> Rendering:
    """What a camera sees inside a box. is_cloud: whether the method has Gaussians."""
    frame = method.frame
    if is_cloud:
        cloud = box.cropped(method.gaussians())
        return splatting.render(cloud, camera.to(method.device), frame.background, frame.near)
    rays = camera.rays(camera.pixels())
    if isinstance(method, RayMethod):
        rendering = from_entry(method, rays, box)
    else:
        rendering = method.render(camera).cpu()
    width, height = camera.size[0].tolist()
    depth = rendering.depth.reshape(-1)
    inside = box.holds(rays.at(depth.nan_to_num(0, 0)), TOLERANCE) & depth.isfinite()
    keep = inside.view(height, width)
    rendering = rendering.reshape(height, width)
    return replace(
        rendering,
        rgb=torch.where(keep[..., None], rendering.rgb, torch.tensor(frame.background)),
        depth=torch.where(keep, rendering.depth, torch.inf),
        opacity=torch.where(keep, rendering.opacity, 0.0),
    )


@torch.no_grad()
def from_entry(method: RayMethod, rays: Rays, box: Box) -> Rendering:
    """What rays see from where they enter a box on; depth is still told from where they began."""
    enter, hits = box.entered(rays)
    begin = (enter - method.frame.near).clamp_min(0)[hits]  # methods pass over the first stretch of every ray
    moved = replace(rays[hits], origins=rays[hits].at(begin))
    background = torch.tensor(method.frame.background)
    rgb, depth, opacity = background.repeat(len(rays), 1), torch.full((len(rays),), torch.inf), torch.zeros(len(rays))
    if len(moved):
        chunks = [slice(i, i + method.rays_per_chunk) for i in range(0, len(moved), method.rays_per_chunk)]
        behind = background.to(method.device)[None]
        seen = Rendering.cat([method.render_rays(moved[c].to(method.device), behind).cpu() for c in chunks])
        rgb[hits], depth[hits], opacity[hits] = seen.rgb, seen.depth + begin, seen.opacity
    return Rendering(rgb, depth, opacity)
