"""Composed: several placed methods as one method with their common capabilities; and crops of one method.

Parts that march give their samples, and `union` merges all samples along a ray. Clouds become one cloud, which the
rasteriser sorts. Where both meet, and for methods that do neither, a part is rendered first and becomes a thin surface
at its rendered depth. That is exact in front of, between and behind opaque objects. A translucent part of that kind is
at its mean depth: objects within it are in front of all of it or behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NoReturn

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..camera import Camera
from ..camera.crop import Crop
from ..camera.rays import Look, Rays, Rendering, Samples
from ..color.blending import over
from ..components.clouds.moved_cloud import seen_from
from ..datasets.scene import Frame, Photograph
from ..errors import LumigraphError
from ..gaussians import Gaussians, joined, splatting
from ..geometry import Similarity
from ..method import Method, RayMethod
from ..method.capabilities import ColourPairs, HasDensity, HasGaussians, HasLooks, can
from ..method.controls import Control, Value
from ..volume import composite, packed
from .placed import Placed

NEAR_PLANE_SCALE = 0.1  # of the frame's near distance: how near to a camera Gaussians are still drawn
MIN_CHUNK_RAYS = 256  # rays of many parts that are looked along together; more parts have more samples on each ray
THICKNESS_SHARE = 1e-3  # of its distance: how thick a surface is that a rendered part stands as
MIN_OPACITY = 1e-3  # opacity below which there is no surface
OPAQUE_THRESHOLD = 1 - 1e-6  # opacity that counts as fully so


def compose(frame: Frame, parts: Sequence[Placed]) -> Method:
    """Several methods in one picture, in a frame of their own. For rendering only.

    It has Gaussians if all parts have, looks if all march, and density if all of these have it.
    """
    methods = [part.method for part in parts]
    if all(can(method, HasGaussians) for method in methods):
        return ComposedCloud(frame, parts)
    if not all(can(method, HasLooks) for method in methods):
        return ComposedMixture(frame, parts)
    return (ComposedField if all(can(method, HasDensity) for method in methods) else ComposedRays)(frame, parts)


def cropped(method: Method, crop: Crop) -> Method:
    """Method restricted to a crop in its frame, for rendering only.

    Samples along rays are clipped to the crop; Gaussians are selected by their centres; for methods with neither,
    pixels by their depth.
    """
    return compose(method.frame, [Placed(method, Similarity.make(1.0), crop, leads=True)]).to(method.device)


class Composed(Method):
    """Base class of compositions, not trainable. count: number of parts, those of nested compositions included"""

    count: int
    rays_per_chunk: int

    def __init__(self, frame: Frame, parts: Sequence[Placed]):
        super().__init__(frame, None)
        self.pieces = tuple(parts)
        self.methods = nn.ModuleList(part.method for part in parts)  # so that they move to devices together
        self.count = sum(part.method.count if isinstance(part.method, Composed) else 1 for part in parts)
        self.rays_per_chunk = max(MIN_CHUNK_RAYS, RayMethod.rays_per_chunk // max(self.count, 1))
        self.eval()

    @property
    def controls(self) -> tuple[Control, ...]:
        """Controls of all parts; those that name photographs, of the leading part only."""
        found: dict[str, Control] = {}
        for part in self.pieces:
            for control in part.method.controls:
                if part.leads or not control.of_photographs:
                    found.setdefault(control.name, control)
        return tuple(found.values())

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Give each part its values of controls."""
        self.pieces = tuple(part.with_controls(controls) for part in self.pieces)

    def refined(self, cameras: Camera) -> Camera:
        """Cameras refined by the leading part."""
        return next((part.refined(cameras) for part in self.pieces if part.leads), cameras)

    def batch(self, data: Any, generator: torch.Generator) -> NoReturn:
        raise LumigraphError("A composition does not learn; train its parts, each by itself")


class ComposedRays(Composed, RayMethod):
    """Composition of parts that all march."""

    def looks(self, rays: Rays) -> list[Look]:
        """The union of every part's last look."""
        return [union([part.look(rays) for part in self.pieces])]


class ComposedField(ComposedRays):
    """Composition of parts that all march and have density."""

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit, the sum of the parts'."""
        return torch.stack([part.density(points) for part in self.pieces]).sum(0)


class ComposedCloud(Composed):
    """Composition of clouds, as one cloud."""

    def gaussians(self) -> Gaussians:
        """All parts' Gaussians, in the scene's frame."""
        return joined([part.gaussians() for part in self.pieces])

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        near, cloud = NEAR_PLANE_SCALE * self.frame.near, at_moment_of(self, camera).gaussians()
        return splatting.render(cloud, camera.to(self.device), self.frame.background, near)


class ComposedMixture(Composed):
    """Composition of several kinds of parts: some march, the rest are rendered first, as surfaces."""

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        width, height = camera.size[0].tolist()
        rays = camera.rays(camera.pixels())
        marching = [part for part in self.pieces if can(part.method, HasLooks)]
        surfaces = self._surfaces(camera)
        seen = []
        for begin in range(0, len(rays), self.rays_per_chunk):
            some = slice(begin, begin + self.rays_per_chunk)
            looks = [part.look(rays[some]) for part in marching] + [surface(*(x[some] for x in s)) for s in surfaces]
            found = union(looks)
            seen.append(composite(found.samples, found.density, found.rgb, self.background))
        return Rendering.cat(seen).reshape(height, width)

    def _surfaces(self, camera: Camera) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Colour over black, depth and opacity of every pixel: of all clouds at once, and of each other part."""
        rendered = [part for part in self.pieces if not can(part.method, HasLooks)]
        clouds = [part.gaussians() for part in rendered if can(part.method, HasGaussians)]
        seen = [part.rendering(camera) for part in rendered if not can(part.method, HasGaussians)]
        if clouds:
            seen.append(splatting.render(joined(clouds), camera, (0.0, 0.0, 0.0), NEAR_PLANE_SCALE * self.frame.near))
        return [(x.rgb.reshape(-1, 3), x.depth.reshape(-1), x.opacity.reshape(-1)) for x in seen]


def surface(rgb: Float[Tensor, "ray 3"], depth: Float[Tensor, " ray"], opacity: Float[Tensor, " ray"]) -> Look:
    """A rendered part as a thin sample at its depth. rgb: over black"""
    hit = (opacity > MIN_OPACITY) & depth.isfinite()
    rgb, depth, opacity = rgb[hit], depth[hit], opacity[hit]
    half = 0.5 * THICKNESS_SHARE * depth
    samples = Samples(depth - half, depth + half, packed(hit.long()))
    density = -torch.log1p(-opacity.clamp_max(OPAQUE_THRESHOLD)) / samples.length
    return Look("surface", samples, density, rgb / opacity[:, None])


class PickedCloud(Method):
    """A fixed cloud for rendering only. refined: whether it was trained with pose optimisation"""

    def __init__(self, frame: Frame, gaussians: Gaussians, refined: bool = False):
        super().__init__(frame, None)
        self.poses = True if refined else None
        self._antialiased = gaussians.antialiased
        self._names = [field.name for field in fields(gaussians) if field.name != "antialiased"]
        for name in self._names:
            self.register_buffer(name, getattr(gaussians, name).detach())
        self.to(gaussians.means.device).eval()

    def gaussians(self) -> Gaussians:
        """The cloud, in the scene's frame."""
        return Gaussians(**{name: getattr(self, name) for name in self._names}, antialiased=self._antialiased)

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        return splatting.render(self.gaussians(), camera.to(self.device), self.frame.background, self.near_plane)

    @property
    def near_plane(self) -> float:
        return NEAR_PLANE_SCALE * self.frame.near

    def colour_pairs(self, photograph: Photograph) -> ColourPairs:
        """Colours as a function of a photograph's pose at all of its trusted pixels; see `RefinesPoses`."""
        photograph, cloud, background = photograph.to(self.device), self.gaussians(), self.background[0]
        target = photograph.trusted(photograph.before(background))

        def pairs(poses: Any, generator: torch.Generator) -> tuple[Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"]]:
            moved, camera = seen_from(poses, cloud, photograph.camera)
            seen = splatting.splat(moved, splatting.view_of(camera, self.near_plane))
            return photograph.trusted(over(seen.rgb, seen.opacity, background)), target

        return pairs

    def batch(self, data: Any, generator: torch.Generator) -> NoReturn:
        raise LumigraphError("Gaussians that were picked from a cloud do not learn; resume the run they came from")


def at_moment_of(method: Any, camera: Camera) -> Any:
    """The method at the time of a camera, if both have one and the settings do not set it."""
    control = next((one for one in method.controls if one.name == "time"), None)
    if control is None or control.range is None or camera.time is None or "time" in method.settings:
        return method
    low, high = control.range
    return method.given(time=min(max(float(camera.time[0]), low), high))


def union(looks: Sequence[Look]) -> Look:
    """Union of looks along rays: densities add up where samples overlap, and colours are mixed by density.

    Exact: every sample is split at the ends of the others, so that density and colour are constant over each piece.
    Light of one look passes through the other's medium.
    """
    if len(looks) == 1:
        return looks[0]
    rays = len(looks[0].samples.ray_starts) - 1
    counts = torch.stack([look.samples.ray_starts.diff() for look in looks])
    shared = (counts > 0).sum(0) > 1  # rays on which there is anything to cut
    alone = [kept(look, ~shared[look.samples.ray_index]) for look in looks]
    parts = [*alone, cut([kept(look, shared[look.samples.ray_index]) for look in looks])]
    ray = torch.cat([part.samples.ray_index for part in parts])
    order = ray.argsort(stable=True)
    columns = zip(*((x.samples.t_start, x.samples.t_end, x.density, x.rgb) for x in parts), strict=True)
    begin, end, density, rgb = (torch.cat(column)[order] for column in columns)
    return Look("union", Samples(begin, end, packed(torch.bincount(ray, minlength=rays))), density, rgb)


def kept(look: Look, mask: Tensor) -> Look:
    return Look(look.name, look.samples.keep(mask), look.density[mask], look.rgb[mask])


def cut(looks: Sequence[Look]) -> Look:
    """Split samples at all interval ends; empty pieces are left out."""
    rays = len(looks[0].samples.ray_starts) - 1
    t, ray, begins = edges(looks)
    begin, end, on = t[:-1], t[1:], ray[:-1]
    piece = (end > begin) & (ray[1:] == on)
    density, colour = begin.new_zeros(len(begin)), begin.new_zeros(len(begin), 3)
    inside = torch.zeros_like(piece)
    for number, look in enumerate(looks):
        if not len(look.samples):
            continue
        latest = ((begins == number).cumsum(0) - 1)[:-1]  # the look's sample that began last, as edges are in order
        there = latest.clamp_min(0)
        holds = piece & (latest >= 0) & (look.samples.ray_index[there] == on) & (look.samples.t_end[there] > begin)
        mine = torch.where(holds, look.density[there], 0.0)
        density, colour, inside = density + mine, colour + mine[:, None] * look.rgb[there], inside | holds
    rgb = colour / density.clamp_min(torch.finfo(density.dtype).tiny)[:, None]
    starts = packed(torch.bincount(on[inside], minlength=rays))
    return Look("union", Samples(begin[inside], end[inside], starts), density[inside], rgb[inside])


def edges(looks: Sequence[Look]) -> tuple[Float[Tensor, " edge"], Int[Tensor, " edge"], Int[Tensor, " edge"]]:
    """Edges of samples: distance, ray, and the number of the look whose sample begins there, -1 for ends.

    Sorted by ray, then by distance.
    """
    parts = [(look.samples.t_start, look.samples.t_end, look.samples.ray_index) for look in looks]
    t = torch.cat([x for begin, end, _ in parts for x in (begin, end)])
    ray = torch.cat([index for _, _, index in parts for _ in range(2)])
    names = [torch.full_like(index, x) for number, (*_, index) in enumerate(parts) for x in (number, -1)]
    order = t.argsort(stable=True)
    order = order[ray[order].argsort(stable=True)]
    return t[order], ray[order], torch.cat(names)[order]
