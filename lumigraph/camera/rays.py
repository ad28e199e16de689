"""Rays, samples along them, field values there, and renderings: the data types of every ray method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..figures import colour_depth, depth_range, png
from .loops import fill_midpoints


@dataclass(frozen=True)
class Rays:
    """Rays through the scene.

    origins:     scene units
    directions:  unit length
    radius:      pixel footprint's radius at distance one, in scene units (cones, Barron 2021)
    time:        time of exposure, for a dynamic capture
    image_index: photograph of a ray, if any (appearance, exposure, pose corrections)
    """

    origins: Float[Tensor, "ray 3"]
    directions: Float[Tensor, "ray 3"]
    radius: Float[Tensor, " ray"]
    time: Float[Tensor, " ray"] | None = None
    image_index: Int[Tensor, " ray"] | None = None

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, index: slice | Tensor) -> Rays:
        """The rays that a slice, mask or index tensor picks."""
        return self._map(lambda x: x[index])

    def to(self, device: torch.device | str) -> Rays:
        """The same rays on a device; tensors that are there already are not copied."""
        return self._map(lambda x: x.to(device))

    def at(self, t: Float[Tensor, " ray"]) -> Float[Tensor, "ray 3"]:
        """The point at distance t along each ray."""
        return self.origins + t[:, None] * self.directions

    def through_box(self, box: Float[Tensor, "2 3"]) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Entry and exit distances of each ray in a box (slabs, Kay & Kajiya 1986); exit is before entry for a miss."""
        slow = self.directions.abs() < 1e-9
        inverse = 1 / torch.where(slow, 1e-9, self.directions)
        a, b = (box[0] - self.origins) * inverse, (box[1] - self.origins) * inverse
        return torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)

    def _map(self, change: Callable[[Tensor], Tensor]) -> Rays:
        time, image_index = (None if x is None else change(x) for x in (self.time, self.image_index))
        return Rays(change(self.origins), change(self.directions), change(self.radius), time, image_index)


@dataclass(frozen=True)
class Samples:
    """Intervals along rays, packed end to end: ray r owns samples ray_starts[r] to ray_starts[r + 1].

    Distances are along the ray, in scene units. Dense sampling is the case of equal lengths.
    """

    t_start: Float[Tensor, " sample"]
    t_end: Float[Tensor, " sample"]
    ray_starts: Int[Tensor, " ray_plus_one"]

    def __len__(self) -> int:
        return len(self.t_start)

    @property
    def t(self) -> Float[Tensor, " sample"]:
        """Midpoints."""
        return 0.5 * (self.t_start + self.t_end)

    @property
    def length(self) -> Float[Tensor, " sample"]:
        return self.t_end - self.t_start

    @property
    def ray_index(self) -> Int[Tensor, " sample"]:
        """The ray that each sample lies on."""
        counts = self.ray_starts.diff()
        rays = torch.arange(len(counts), device=counts.device)
        return torch.repeat_interleave(rays, counts, output_size=len(self))

    @staticmethod
    def rows(t: Float[Tensor, "ray count"], end: Float[Tensor, " ray"]) -> Samples:
        """Samples of equal count per ray, each from one distance to the next, the last one to `end`."""
        ends = torch.cat([t[:, 1:], end[:, None]], -1)
        starts = torch.arange(len(t) + 1, device=t.device) * t.shape[1]
        return Samples(t.flatten(), ends.flatten(), starts)

    def keep(self, mask: Bool[Tensor, " sample"]) -> Samples:
        """The samples that a mask picks, still packed by ray."""
        before = torch.nn.functional.pad(mask.cumsum(0), (1, 0))
        kept = mask.nonzero()[:, 0]
        return Samples(self.t_start.index_select(0, kept), self.t_end.index_select(0, kept), before[self.ray_starts])

    def along(self, rays: Rays) -> tuple[Float[Tensor, "sample 3"], Float[Tensor, "sample 3"]]:
        """Positions of the midpoints, and the ray direction of each."""
        given = rays.origins, rays.directions, self.t_start, self.t_end
        if not rays.origins.is_cuda and not (torch.is_grad_enabled() and any(x.requires_grad for x in given)):
            positions, directions = (self.t_start.new_empty(len(self), 3) for _ in range(2))
            tensors = *given, self.ray_starts, positions, directions
            fill_midpoints(*(x.detach().contiguous().numpy() for x in tensors))
            return positions, directions
        ray = self.ray_index
        directions = rays.directions.index_select(0, ray)
        return rays.origins.index_select(0, ray) + self.t[:, None] * directions, directions


@dataclass(frozen=True)
class Look:
    """Samples of rays in one pass of a method, with the density and colour of its field at each.

    name:    of the pass, e.g. "coarse" and "fine"
    density: per scene unit, constant over each sample
    rgb:     sRGB-encoded, of each sample
    """

    name: str
    samples: Samples
    density: Float[Tensor, " sample"]
    rgb: Float[Tensor, "sample 3"]


@dataclass(frozen=True)
class Rendering:
    """Output of rendering a camera or a batch of rays. Leading axes are (height, width) or (ray,).

    rgb:     sRGB-encoded, composited over the background
    depth:   expected distance along the ray in scene units, over its opacity; infinity for empty rays
    opacity: accumulated opacity, in [0, 1]
    extra:   anything else by name, with the same leading axes (normals, features, uncertainty)
    """

    rgb: Float[Tensor, "*pixels 3"]
    depth: Float[Tensor, "*pixels"]
    opacity: Float[Tensor, "*pixels"]
    extra: dict[str, Tensor] = field(default_factory=dict)

    def with_extra(self, **extra: Tensor) -> Rendering:
        return replace(self, extra={**self.extra, **extra})

    def reshape(self, *shape: int) -> Rendering:
        """The same pixels under other leading axes, e.g. (height, width)."""
        extra = {k: v.reshape(*shape, *v.shape[self.depth.ndim :]) for k, v in self.extra.items()}
        return Rendering(self.rgb.reshape(*shape, 3), self.depth.reshape(shape), self.opacity.reshape(shape), extra)

    def _repr_png_(self) -> bytes | None:
        """Picture for a notebook: colours, and depth beside them. None for rays."""
        if self.depth.ndim != 2:
            return None
        depth = colour_depth(self.depth, self.opacity, depth_range(self.depth, self.opacity))
        return png(torch.cat([self.rgb, depth], 1))

    def cpu(self) -> Rendering:
        extra = {k: v.cpu() for k, v in self.extra.items()}
        return Rendering(self.rgb.cpu(), self.depth.cpu(), self.opacity.cpu(), extra)

    @staticmethod
    def cat(parts: list[Rendering]) -> Rendering:
        """Join renderings of consecutive rays."""
        extra = {k: torch.cat([p.extra[k] for p in parts]) for k in parts[0].extra}
        rgb, depth, opacity = (torch.cat([getattr(p, k) for p in parts]) for k in ("rgb", "depth", "opacity"))
        return Rendering(rgb, depth, opacity, extra)
