"""ProbeGrid: light probes on a grid, interpolated with visibility (Greger 1998; Majercik 2019, DDGI)."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from . import octahedral
from .harmonics import convolved, evaluated

FREE, MATTER, UNSEEN = 0, 1, 2  # states of a probe
NORMAL_BIAS = 0.15  # of the shortest step: distance above the surface at which visibility is asked for
BACKFACE_FLOOR = 0.2  # weight of a probe behind the surface
CHEBYSHEV_FLOOR = 0.05  # weight of a probe behind an occluder
CRUSH_THRESHOLD = 0.2  # weights below it are reduced further, so that light leaks less
FALLBACK_WEIGHT = 1e-4  # of probes that are not free, whose light is that of the nearest free one
POINTS_PER_CHUNK = 1 << 16


@dataclass(frozen=True)
class ProbeGrid:
    """Probes at `origin + i a_0 + j a_1 + k a_2`; probe (i, j, k) is row i + n_0 (j + n_1 k).

    origin:   position of probe (0, 0, 0), in the frame of exports
    axes:     a_0, a_1, a_2, orthogonal: from a probe to the next along each axis of the grid
    counts:   n_0, n_1, n_2
    radiance: L_lm of linear radiance, 1 for white, along directions of the frame of exports
    mean:     mean distance to surfaces, bordered octahedral maps; no more than `far`
    squared:  mean squared distance, likewise
    state:    FREE, MATTER (in a solid), or UNSEEN (hidden from all cameras)
    far:      upper limit of distances
    up:       unit vector upwards
    """

    origin: Float[Tensor, " 3"]
    axes: Float[Tensor, "3 3"]
    counts: tuple[int, int, int]
    radiance: Float[Tensor, "probe coefficient 3"]
    mean: Float[Tensor, "probe wide wide"]
    squared: Float[Tensor, "probe wide wide"]
    state: Int[Tensor, " probe"]
    far: float
    up: Float[Tensor, " 3"]

    def __len__(self) -> int:
        return math.prod(self.counts)

    @property
    def order(self) -> int:
        """Highest band of the harmonics."""
        return math.isqrt(self.radiance.shape[1]) - 1

    @property
    def positions(self) -> Float[Tensor, "probe 3"]:
        return self.origin + lattice(self.counts).to(self.origin) @ self.axes

    @property
    def step(self) -> float:
        """Length of the shortest axis."""
        return float(self.axes.norm(dim=-1).min())

    @cached_property
    def filled_radiance(self) -> Float[Tensor, "probe coefficient 3"]:
        """Radiance, with that of the nearest free probe for probes that are not free."""
        free = self.state == FREE
        if free.all() or not free.any():
            return self.radiance
        places, found = self.positions, self.radiance.clone()
        nearest = cKDTree(places[free].numpy()).query(places[~free].numpy())[1]
        found[~free] = self.radiance[free][torch.from_numpy(nearest)]
        return found

    def weights(
        self, points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"]
    ) -> tuple[Int[Tensor, "point 8"], Float[Tensor, "point 8"]]:
        """The eight probes around each point and their weights, whose sum is 1 (Majercik 2019, section 4.3).

        w = trilinear * (((d . n + 1) / 2)^2 + 0.2) * max(v^3, 0.05),    v = s^2 / (s^2 + (r - m)^2) where r > m

        with the direction d to the probe, the probe's distance r from a point slightly above the surface, mean m and
        variance s^2 of the probe's distances in that direction (Chebyshev's inequality).
        """
        lengths = self.axes.norm(dim=-1)
        last = torch.tensor(self.counts, dtype=points.dtype) - 1
        place = ((points - self.origin) @ self.axes.T / lengths**2).clamp_min(0).minimum(last)
        first = place.floor().minimum((last - 1).clamp_min(0))
        share = place - first
        corner = lattice((2, 2, 2)).to(points)
        index3 = (first[:, None] + corner).minimum(last)
        trilinear = torch.where(corner > 0, share[:, None], 1 - share[:, None]).prod(-1)
        index = (index3 @ points.new_tensor([1, self.counts[0], self.counts[0] * self.counts[1]])).long()
        probes = self.positions[index]
        toward = torch.nn.functional.normalize(probes - points[:, None], dim=-1)
        facing = ((toward * normals[:, None]).sum(-1) + 1) / 2
        away = (points + NORMAL_BIAS * self.step * normals)[:, None] - probes
        r = away.norm(dim=-1)
        seen = [octahedral.looked_up(x, index.flatten(), away.flatten(0, 1) / r.flatten().clamp_min(1e-9)[:, None])
                for x in (self.mean, self.squared)]  # fmt: skip
        mean, squared = (x.view(r.shape) for x in seen)
        variance = (squared - mean**2).abs()
        beyond = (r.clamp_max(self.far) - mean).clamp_min(0)
        visible = (variance / (variance + beyond**2).clamp_min(1e-12)) ** 3
        visible = torch.where(beyond > 0, visible.clamp_min(CHEBYSHEV_FLOOR), 1.0)
        weight = (facing**2 + BACKFACE_FLOOR) * visible
        weight = weight * (weight / CRUSH_THRESHOLD).clamp_max(1) ** 2
        weight = trilinear * torch.where(self.state[index] == FREE, weight, FALLBACK_WEIGHT) + 1e-9
        return index, weight / weight.sum(-1, keepdim=True)

    def irradiance(
        self, points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        """Linear irradiance E(n) at surface points: pi times the radiance of a white diffuse surface there."""
        return self._interpolated(points, normals, normals, convolved)

    def coefficients(
        self, points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point coefficient 3"]:
        """Interpolated L_lm."""
        index, weight = self.weights(points, normals)
        return torch.einsum("pe,pekc->pkc", weight, self.filled_radiance[index])

    def _interpolated(
        self, points: Tensor, normals: Tensor, directions: Tensor, kind: Callable[[Tensor], Tensor]
    ) -> Tensor:
        parts = [x.split(POINTS_PER_CHUNK) for x in (points, normals, directions)]
        found = [evaluated(kind(self.coefficients(p, n)), d) for p, n, d in zip(*parts, strict=True)]
        return torch.cat(found) if found else torch.zeros_like(points)


def lattice(counts: tuple[int, int, int]) -> Int[Tensor, "probe 3"]:
    """Integer coordinates (i, j, k) of a grid, i the fastest."""
    k, j, i = torch.meshgrid(*(torch.arange(n) for n in reversed(counts)), indexing="ij")
    return torch.stack([i, j, k], -1).reshape(-1, 3)
