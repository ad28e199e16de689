"""Few views: regularisation of a cloud that is learnt from few photographs.

Each step drops some Gaussians, so that those behind them learn too, and looks at an unobserved view between two
photographs. There depth is to be smooth, and where plane sweeps have found a surface, the view is to show it: whatever
floats in front is carved away.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from ...camera import Camera
from ...components.clouds.addition import Addition, Step, TrainingViews
from ...components.clouds.cloud import Cloud
from ...components.training.dense_points import Points, compile_sweep
from ...components.training.regularizers import camera_between, normalized_distance, roughness
from ...datasets.scene import Scene
from ...exchange.packing import Stored
from ...gaussians import Gaussians
from ...gaussians.splatting import Splatted, splat, view_of

MAX_SPARSE_VIEWS = 40  # training photographs up to which an open capture may be sparse
MAX_SURFACE_SHARE = 0.2  # share of pixels whose surface plane sweeps find, from which on a capture is not sparse
MAX_PLAIN_VIEWS = 6  # training photographs up to which colours do not depend on the direction, which would explain
# wrong depth away
MAX_DROP_RATE = 0.3  # share of Gaussians at the end of training, to which it grows evenly (Park 2025, section 3.2)
DROPPED_OPACITY = -30.0  # logit
MAX_OPACITY = 0.999
UNOBSERVED_PIXELS = 128  # along the shorter side of an unobserved view
DEPTH_WEIGHT = 0.1  # of the depth error at known surfaces, in terms of the colour error there
OPACITY_WEIGHT = 0.1  # of light that passes a known surface, in terms of the depth error
MAX_LOG_ERROR = 2.0  # of depth; an error beyond has no gradient
OCCLUSION = 1.03  # times the least depth of the pixels around, beyond which a point is hidden
ROUGHNESS_WEIGHT = 0.5  # weight of depth's roughness at unobserved views
SURFACE_WEIGHT = 0.2  # weight of swept surfaces at unobserved views


@dataclass(frozen=True)
class FewViewNumbers:
    """A Config's numbers for few photographs."""

    few_views: Literal["auto", "yes", "no"] = "no"  # few photographs; auto: where plane sweeps agree little


class FewViews(Addition):
    """Dropout of Gaussians, smooth depth and known surfaces at unobserved views.

    active: whether the capture is sparse
    plain:  whether colours stay plain
    surface, surface_colours: points that plane sweeps have found
    """

    grows = ("surface", "surface_colours")

    active: Tensor
    plain: Tensor
    surface: Tensor
    surface_colours: Tensor

    def __init__(self, numbers: FewViewNumbers):
        super().__init__()
        self.numbers = numbers
        self.register_buffer("active", torch.tensor(numbers.few_views == "yes"))
        self.register_buffer("plain", torch.tensor(False))
        for name in self.grows:
            self.register_buffer(name, torch.zeros(0, 3))

    @property
    def base_colours(self) -> bool:  # type: ignore[override]
        return bool(self.plain)

    @property
    def few_view_priors(self) -> tuple[str, ...]:
        surface = ("plane-sweep surfaces at unobserved views",) if len(self.surface) else ()
        return ("dropout of Gaussians", "smooth depth", *surface) if self.active else ()

    def compile_begin(self) -> None:
        compile_sweep()

    def begin_scene(self, cloud: Cloud, views: TrainingViews, data: Scene, sweep: Callable[[], Points]) -> None:
        """Decide whether the capture is sparse, and keep what plane sweeps have found."""
        if views.move:
            return
        count = len(data.splits["train"])
        if self.numbers.few_views == "auto":
            few = data.frame.is_open and not data.frame.has_alpha and count <= MAX_SPARSE_VIEWS
            self.active.fill_(few and sweep().share < MAX_SURFACE_SHARE)
        if self.active:
            self.plain.fill_(count <= MAX_PLAIN_VIEWS)
            found = sweep()
            self.surface, self.surface_colours = (x.to(self.surface) for x in (found.positions, found.colours))

    def before_raster(self, step: Step) -> None:
        if self.active:
            step.cloud = drop_gaussians(step.cloud, MAX_DROP_RATE * step.progress, step.chance)

    def regularize(self, step: Step) -> None:
        if not self.active or step.views.cameras is None:
            return
        camera = camera_between(step.views.cameras, step.chance).to(step.whole.means.device)
        camera = camera.resized(min(UNOBSERVED_PIXELS / float(camera.size.min()), 1.0))
        seen = splat(step.whole, view_of(camera, step.views.near_plane), bands=1)
        step.terms["depth"] = ROUGHNESS_WEIGHT * depth_roughness(seen)
        if len(self.surface):
            place, depth, index = visible_points(self.surface, camera)
            if len(index):
                error = surface_error(seen, place, depth, self.surface_colours[index])
                step.terms["surface"] = SURFACE_WEIGHT * error

    def storage(self) -> dict[str, Stored]:
        """Rendering needs none of it."""
        return dict.fromkeys(self.grows, Stored("nothing"))


def drop_gaussians(cloud: Gaussians, share: float, generator: torch.Generator) -> Gaussians:
    """The cloud without a random share of its Gaussians. The others are as much more opaque, o / (1 - share), so that
    light gets as far on average (Park 2025, arXiv 2504.00773, eq. 4)."""
    there = (torch.rand(len(cloud), generator=generator) >= share).to(cloud.means.device)
    opacity = (cloud.opacities.sigmoid() / (1 - share)).clamp(max=MAX_OPACITY)
    return replace(cloud, opacities=torch.where(there, opacity.logit(), DROPPED_OPACITY))


def depth_roughness(seen: Splatted) -> Float[Tensor, ""]:
    """Roughness of a picture's depth (Niemeyer 2022, eq. 6, over the whole of it)."""
    place = normalized_distance(seen.depth / seen.opacity.clamp_min(1e-3))
    return roughness(place[None], seen.opacity[None])


def visible_points(
    points: Float[Tensor, "point 3"], camera: Camera
) -> tuple[tuple[Tensor, Tensor], Float[Tensor, " seen"], Int[Tensor, " seen"]]:
    """Row and column, depth along the axis, and index of the points visible in one camera, with occlusion by other
    points within a pixel."""
    width, height = camera.size[0].tolist()
    place, inside = camera.locate(points)
    depth = (points - camera.position[0]) @ camera.forward[0]
    index = (inside & (depth > 0)).nonzero()[:, 0]
    (row, column), depth = place[index].unbind(-1), depth[index]
    cell = row * width + column
    least = depth.new_full((height * width,), torch.inf).scatter_reduce(0, cell, depth, "amin")
    front = -max_pool2d(-least.view(1, 1, height, width), 3, 1, 1).view(-1)
    seen = depth < OCCLUSION * front[cell]
    return (row[seen], column[seen]), depth[seen], index[seen]


def surface_error(
    seen: Splatted, place: tuple[Tensor, Tensor], depth: Float[Tensor, " point"], colours: Float[Tensor, "point 3"]
) -> Float[Tensor, ""]:
    """Error of a picture at known surface points: of colours, of log depth, and transmittance."""
    opacity = seen.opacity[place]
    ratio = (seen.depth[place] / opacity.clamp_min(1e-3)).clamp_min(1e-4) / depth
    off = (ratio.log().abs().clamp(max=MAX_LOG_ERROR) * opacity.detach()).mean()
    colour = (seen.rgb[place] - colours).abs().mean()
    return colour + DEPTH_WEIGHT * (off + OPACITY_WEIGHT * (1 - opacity).mean())
