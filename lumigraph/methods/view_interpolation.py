"""View interpolation: photographs warped forward by depth or flow (Chen and Williams 1993; Niklaus and Liu 2020)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from ..camera import Camera
from ..camera.rays import Rendering
from ..components.image_based.depth import shape
from ..components.image_based.kept_views import NOTHING, continued, focal_length
from ..components.image_based.method import ImageBasedMethod
from ..components.image_based.surface import consensus
from ..components.image_based.warping import behind, pushed, soft_splat
from ..datasets.scene import Frame, Scene
from ..depth_maps.optical_flow import optical_flow, round_trip_error, sampled
from ..files.ranges import Pixels, between
from ..geometry import to_matrix, to_quaternion
from ..method import BaseConfig
from ..system.work import at_work

MIN_COVER = 0.2  # sum of splatting weights from which on a pixel is covered
FLOW_DISAGREEMENT = 1.5  # pixels between a flow and the one back, at which a pixel's weight has fallen to 1 / e
OCCLUSION = 80.0  # alpha: sharpness of the choice of the nearer of two surfaces, per relative depth
AGREEMENT = 0.04  # of distance, within which photographs show one surface
NEARNESS = 2.0  # power of the inverse distance of a photograph in its weight


@dataclass(frozen=True)
class Config(BaseConfig):
    """Numbers of softmax splatting, whose weight of occlusion is ours; the papers give none for depth."""

    by: Literal["depth", "flow"] = "depth"  # what photographs are warped by
    geometry: Literal["stereo", "measured"] = "stereo"  # source of depth: multi-view stereo, or a layer `depth`
    depth_size: Pixels = 400  # longer side of the depth maps; larger: finer edges, slower
    warped_views: Annotated[int, between(1, 16)] = 2  # photographs warped into a picture; more: fewer holes, slower


SOURCES = {  # of the numbers of `paper`; the others are ours
    "Chen and Williams 1993, between two photographs": "warped_views",
}


class ViewInterpolation(ImageBasedMethod):
    """Photographs with depth, or flow between neighbours; a picture blends the nearest ones."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        super().__init__(frame, config or Config())
        self._flows: dict[tuple[int, int], Tensor] = {}

    @classmethod
    def cpu_preset(cls) -> Any:
        """Depth maps of 200 pixels."""
        return Config(depth_size=200)

    @classmethod
    def smallest(cls) -> Any:
        """Measured depth of a few pixels."""
        return Config(geometry="measured", depth_size=24)

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        c = self.config
        geometry: Any = "plane" if c.by == "flow" else c.geometry
        self.keep(data, geometry, seconds)

    # Rendering

    @at_work()
    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        if not self.views:
            height, width = shape(camera)
            empty = torch.zeros(height, width, device=self.device)
            return Rendering(self.background.expand(height, width, 3).clone(), empty + torch.inf, empty)
        return self._by_flow(camera) if self.config.by == "flow" else self._by_depth(camera)

    def _by_depth(self, camera: Camera) -> Rendering:
        """Photographs warped by their depth, then blended if they show the same, nearest surface."""
        c, tables = self.config, self.views.tables
        chosen = tables.nearest(camera, c.warped_views)
        layers = [self._splatted(i, camera) for i in chosen]
        apart = (tables.cameras.position[chosen] - camera.position).norm(dim=-1) / tables.middle
        near = ((1e-3 + apart.min()) / (1e-3 + apart)) ** NEARNESS
        rgb, depth, cover = (torch.stack(x) for x in zip(*layers, strict=True))
        weight = near[:, None, None] * cover.clamp_max(1) * (cover > MIN_COVER)
        agreed = consensus(depth, weight)
        weight = weight * ((depth - agreed).abs() < AGREEMENT * agreed)
        total = weight.sum(0)
        seen = total > 0
        found = (weight[..., None] * rgb).sum(0) / total.clamp_min(1e-12)[..., None]
        away = (weight * depth).sum(0) / total.clamp_min(1e-12)
        return self._closed(found, away, seen)

    def _splatted(self, i: int, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
        """One photograph's colours (and alpha), distances and cover in a new camera."""
        tables, own = self.views.tables, self.views.tables.cameras[i]
        height, width = shape(own)
        rows, columns = tables.sizes[i, [3, 2]].tolist()
        depth = tables.depths[i, :rows, :columns]
        depth = continued(torch.where(depth < NOTHING, depth, torch.inf))
        away = enlarged(1 / depth.clamp_min(1e-6), (height, width)).reciprocal().flatten()
        rays = own.rays(own.pixels())
        usable = (away > 1e-5) & away.isfinite()
        points = rays.at(away)[usable]
        colours = tables.pictures[i, :height, :width].flatten(0, 1)[usable].float() / 255
        places, valid = camera.project(points)
        distance = (points - camera.position).norm(dim=-1)
        footprint = away[usable] * focal_length(camera) / (distance * focal_length(own))
        values = torch.cat([distance[:, None], colours], -1)[valid]
        importance = -OCCLUSION * distance[valid].log()
        found, cover = soft_splat(places[valid], values, importance, shape(camera), float(footprint.median()))
        return found[..., 1:], found[..., 0], cover

    def _closed(self, rgb: Tensor, away: Tensor, seen: Tensor) -> Rendering:
        """Fill holes from their surroundings, the background first; an object's surroundings stay empty."""
        if rgb.shape[-1] > 3:
            opacity, rgb = (
                torch.where(seen, rgb[..., 3], 0),
                torch.where(seen[..., None], rgb[..., :3], self.background),
            )
            return Rendering(rgb, torch.where(opacity > 0, away, torch.inf), opacity)
        if not seen.any():
            return Rendering(self.background.expand(*seen.shape, 3).clone(), away + torch.inf, seen.float())
        filled = behind(torch.cat([rgb, away[..., None]], -1), away, seen)
        return Rendering(filled[..., :3].clamp(0, 1), filled[..., 3], torch.ones_like(away))

    def _by_flow(self, camera: Camera) -> Rendering:
        """Two photographs warped along their flow to the position between them nearest to the camera, then rotated by
        the homography of the plane at infinity."""
        tables = self.views.tables
        i, j, share = self._pair(camera)
        first, second = tables.cameras[i], tables.cameras[j]
        height, width = shape(first)
        layers = []
        for a, b, t in ((i, j, share), (j, i, 1 - share)):
            flow, back = self._flow(a, b), self._flow(b, a)
            pixels = tables.cameras[a].pixels().to(self.device)
            error = round_trip_error(pixels, flow, back.view(height, width, 2))
            picture = tables.pictures[a, :height, :width, :3].reshape(-1, 3).float() / 255
            importance = -error / FLOW_DISAGREEMENT
            found, cover = soft_splat(pixels + t * flow, picture, importance, (height, width), 1.0)
            layers.append(((1 - t) * cover.clamp_max(1), found))
        total = layers[0][0] + layers[1][0]
        found = sum(weight[..., None] * colours for weight, colours in layers) / total.clamp_min(1e-12)[..., None]
        found = pushed(found, (total > 0.5 * MIN_COVER).float())
        middle = replace(first, pose=between_poses(first.pose, second.pose, share))
        turned = camera.rays(camera.pixels()).directions
        places, valid = middle.project(middle.position + turned)
        rgb = sampled(found, places).clamp(0, 1)
        rgb = torch.where(valid[:, None], rgb, self.background).view(*shape(camera), 3)
        depth = tables.middle / camera.cosines().clamp_min(1e-2)
        return Rendering(rgb, depth, torch.ones_like(depth))

    def _pair(self, camera: Camera) -> tuple[int, int, float]:
        """Two photographs nearly on either side of the camera, and its share of the way from the first."""
        tables = self.views.tables
        near = tables.nearest(camera, 8)
        best = (math.inf, near[0], near[0], 0.0)
        for n, i in enumerate(near):
            for j in near[n + 1 :]:
                if tables.sizes[i, :2].tolist() != tables.sizes[j, :2].tolist():
                    continue
                a, b = tables.cameras.position[i], tables.cameras.position[j]
                way, own = b - a, camera.position[0] - a
                share = float(((own @ way) / (way @ way).clamp_min(1e-12)).clamp(0, 1))
                off = float((own - share * way).norm() + 0.1 * way.norm())
                best = min(best, (off, i, j, share))
        return best[1], best[2], best[3]

    def _flow(self, i: int, j: int) -> Float[Tensor, "pixel 2"]:
        """Dense flow from one photograph to another, cached."""
        if (i, j) not in self._flows:
            tables = self.views.tables
            (width, height) = tables.sizes[i, :2].tolist()
            first, second = (tables.pictures[k, :height, :width, :3].contiguous().cpu() for k in (i, j))
            flow = torch.zeros(height, width, 2) if i == j else optical_flow(first, second)
            self._flows[i, j] = flow.reshape(-1, 2).to(self.device)
        return self._flows[i, j]


def enlarged(values: Float[Tensor, "rows columns"], size: tuple[int, int]) -> Float[Tensor, "height width"]:
    """Inverse depth, resized bilinearly; across edges that of the nearest pixel."""
    smooth = interpolate(values[None, None], size, mode="bilinear")[0, 0]
    nearest = interpolate(values[None, None], size, mode="nearest-exact")[0, 0]
    return torch.where((smooth - nearest).abs() < 0.02 * nearest, smooth, nearest)


def between_poses(a: Float[Tensor, "1 3 4"], b: Float[Tensor, "1 3 4"], share: float) -> Float[Tensor, "1 3 4"]:
    """Positions and rotations (as quaternions) interpolated linearly."""
    first, second = to_quaternion(a[:, :, :3]), to_quaternion(b[:, :, :3])
    second = torch.where((first * second).sum(-1, keepdim=True) < 0, -second, second)
    turn = to_matrix(normalize((1 - share) * first + share * second, dim=-1))
    return torch.cat([turn.to(a), ((1 - share) * a + share * b)[:, :, 3:]], -1)
