"""Composed: several placed methods as one, which offers what all of them offer.

Parts that march give their samples, and `union` puts all samples along a ray in order. Clouds become one cloud, whose
Gaussians the rasteriser puts in order. Where both meet, and for methods that do neither, a part is rendered first and
stands in the picture as a thin surface at the depth that it rendered. That is exact in front of, between and behind
opaque things. Where such a part is see-through, all of it stands at its mean depth: what lies between its near and its
far side is hidden by all or by none of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering, Samples
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..gaussians import Gaussians, joined, splatting
from ..method import Method, RayMethod
from ..method.capabilities import HasDensity, HasGaussians, HasLooks, can
from ..method.controls import Control, Value
from ..volume import composite, packed
from .placed import Placed
from .union import union

NEAR_PLANE_SCALE = 0.1  # of the frame's near distance: how near to a camera Gaussians are still drawn
THICKNESS_SHARE = 1e-3  # of its distance: how thick a surface is that a rendered part stands as
MIN_OPACITY = 1e-3  # opacity below which there is no surface
OPAQUE_THRESHOLD = 1 - 1e-6  # opacity that counts as fully so


def compose(frame: Frame, parts: Sequence[Placed]) -> Method:
    """Several methods in one picture, in a frame of their own. Ready to render, and nothing else.

    It has Gaussians if all parts have, looks if all march, and density if all of these know theirs.
    """
    methods = [part.method for part in parts]
    if all(can(method, HasGaussians) for method in methods):
        return ComposedCloud(frame, parts)
    if not all(can(method, HasLooks) for method in methods):
        return ComposedMixture(frame, parts)
    return (ComposedField if all(can(method, HasDensity) for method in methods) else ComposedRays)(frame, parts)


class Composed(Method):
    """Base of compositions: parts at places, not trainable."""

    def __init__(self, frame: Frame, parts: Sequence[Placed]):
        super().__init__(frame, None)
        self.pieces = tuple(parts)
        self.methods = nn.ModuleList(part.method for part in parts)  # so that they move to devices together
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

    def given(self, *evidence: Any, **controls: Value) -> Method:
        """The same composition, each part told what it has a control for."""
        told = super().given(*evidence, **controls)
        assert isinstance(told, Composed)
        told.pieces = tuple(part.given(controls) for part in self.pieces)
        return told

    def refined(self, cameras: Camera) -> Camera:
        """Cameras as the part that leads sees them, whose they are."""
        return next((part.refined(cameras) for part in self.pieces if part.leads), cameras)

    def batch(self, data: Any, generator: torch.Generator) -> NoReturn:
        raise LumigraphError("A composition does not learn; train its parts, each by itself")


class ComposedRays(Composed, RayMethod):
    """Parts that all march."""

    def looks(self, rays: Rays) -> list[Look]:
        """The union of every part's last look."""
        return [union([part.look(rays) for part in self.pieces])]


class ComposedField(ComposedRays):
    """Parts that all march and know their density."""

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit, the sum of the parts'."""
        return torch.stack([part.density(points) for part in self.pieces]).sum(0)


class ComposedCloud(Composed):
    """Parts that are clouds: one cloud."""

    def gaussians(self) -> Gaussians:
        """All parts' Gaussians, in the scene's frame."""
        return joined([part.gaussians() for part in self.pieces])

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        near = NEAR_PLANE_SCALE * self.frame.near
        return splatting.render(self.gaussians(), camera.to(self.device), self.frame.background, near)


class ComposedMixture(Composed):
    """Parts of several kinds: some march, the rest are rendered first and stand as surfaces."""

    rays_per_chunk: int = RayMethod.rays_per_chunk

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
    """A rendered part as a thin sample at its depth. rgb: over black."""
    hit = (opacity > MIN_OPACITY) & depth.isfinite()
    rgb, depth, opacity = rgb[hit], depth[hit], opacity[hit]
    half = 0.5 * THICKNESS_SHARE * depth
    samples = Samples(depth - half, depth + half, packed(hit.long()))
    density = -torch.log1p(-opacity.clamp_max(OPAQUE_THRESHOLD)) / samples.length
    return Look("surface", samples, density, rgb / opacity[:, None])
