"""Cropping: what a camera sees inside a box or a sphere of the scene.

A RayMethod's rays begin where they enter the crop, so what stands in front of it vanishes. What lies behind it is
removed pixel by pixel, by its expected depth; for all other methods, so is what lies before it. Where something
see-through inside stands before something solid outside, their mean depth decides. (Of a cloud, Gaussians are picked;
see `Shared.cloud`.)
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from ..camera import Camera
from ..camera.crop import Crop
from ..camera.rays import Rays, Rendering
from ..method import Method, RayMethod

TOLERANCE = 0.01  # of the crop's size: an expected depth may lie so far outside


def render_inside(method: Method, camera: Camera, crop: Crop) -> Rendering:
    """Rendering of the inside of a crop, for a method without Gaussians."""
    frame = method.frame
    rays = camera.rays(camera.pixels())
    if isinstance(method, RayMethod):
        rendering = from_entry(method, rays, crop)
    else:
        rendering = method.render(camera).cpu()
    width, height = camera.size[0].tolist()
    depth = rendering.depth.reshape(-1)
    inside = crop.holds(rays.at(depth.nan_to_num(0, 0)), TOLERANCE) & depth.isfinite()
    keep = inside.view(height, width)
    rendering = rendering.reshape(height, width)
    return replace(
        rendering,
        rgb=torch.where(keep[..., None], rendering.rgb, torch.tensor(frame.background)),
        depth=torch.where(keep, rendering.depth, torch.inf),
        opacity=torch.where(keep, rendering.opacity, 0.0),
        extra={name: kept(values, keep) for name, values in rendering.extra.items()},
    )


def kept(values: Shaped[Tensor, "*all"], where: Bool[Tensor, "*pixels"]) -> Shaped[Tensor, "*all"]:
    """An extra's values at the pixels of a mask, zeros elsewhere."""
    where = where.reshape(*where.shape, *(1,) * (values.ndim - where.ndim))
    return torch.where(where, values, torch.zeros_like(values))


@torch.no_grad()
def from_entry(method: RayMethod, rays: Rays, crop: Crop) -> Rendering:
    """Rendering along rays from their entry into a crop; depth is measured from their origins."""
    enter, hits = crop.entered(rays)
    asked = hits.clone()
    asked[0] = True  # so that a picture beside the crop has the method's extras too
    begin = torch.where(hits, enter - method.frame.near, 0).clamp_min(0)[asked]  # no method looks nearer than near
    moved = replace(rays[asked], origins=rays[asked].at(begin))
    background = torch.tensor(method.frame.background)
    behind = background.to(method.device)[None]
    chunks = [slice(i, i + method.rays_per_chunk) for i in range(0, len(moved), method.rays_per_chunk)]
    seen = Rendering.cat([method.render_rays(moved[c].to(method.device), behind).cpu() for c in chunks])

    def spread(values: Tensor) -> Tensor:
        return kept(values.new_zeros(len(rays), *values.shape[1:]).index_put((asked,), values), hits)

    return Rendering(
        torch.where(hits[:, None], spread(seen.rgb), background),
        torch.where(hits, spread(seen.depth + begin), torch.inf),
        spread(seen.opacity),
        {name: spread(values) for name, values in seen.extra.items()},
    )
