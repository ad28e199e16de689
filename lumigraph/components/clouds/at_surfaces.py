"""A cloud of Gaussians where a method that is taken over has its surfaces: flat discs that lie on them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import LumigraphError
from ...gaussians import Gaussians
from ...method.capabilities import HasGaussians, can
from ..fields.taken_over import TakenOver
from .initial_cloud import nearest_distance

OPACITY = 0.8  # of each Gaussian at first
BANDS = 2  # of harmonics that begin as what cameras see; more would be guessed between their few directions
WIDTH = 0.6  # deviation of a disc, in distances to its nearest neighbours
FLATNESS = 0.2  # of a disc's thickness to its width


def at_surfaces(held: TakenOver, most: int, degree: int, generator: torch.Generator) -> Gaussians:
    """At most so many Gaussians on what cameras see: discs across the surface's normal that reach one another, of the
    colours that cameras see them in. Raises LumigraphError where there is no surface."""
    seen = held.surface
    seen = seen[torch.randperm(len(seen), generator=generator)[:most]]
    if len(seen) < 2:
        raise LumigraphError(
            "Cameras agree on no surface, so there are no places for Gaussians; train for longer first"
        )
    wide = WIDTH * nearest_distance(seen.points).clamp_min(1e-4)
    scales = torch.stack([wide, wide, FLATNESS * wide], -1)
    harmonics = torch.zeros(len(seen), (degree + 1) ** 2, 3)
    bands = min(degree + 1, BANDS)
    harmonics[:, : bands**2] = held.harmonics(seen.points, bands, lambda rgb: rgb - 0.5)
    opacities = torch.full((len(seen),), OPACITY).logit()
    return Gaussians(seen.points, facing(seen.normals), scales.log(), opacities, harmonics)


def of_cloud(teacher: object, most: int, degree: int) -> Gaussians | None:
    """The teacher's own cloud with other harmonics, where it is one: at most so many Gaussians, the largest and most
    solid ones. None where it is none."""
    if not can(teacher, HasGaussians):
        return None
    cloud: Gaussians = teacher.gaussians()  # type: ignore[attr-defined]
    count = (degree + 1) ** 2
    harmonics = torch.zeros(len(cloud), count, 3).to(cloud.harmonics)
    shared = min(count, cloud.harmonics.shape[1])
    harmonics[:, :shared] = cloud.harmonics[:, :shared]
    weight = cloud.opacities.sigmoid() * cloud.log_scales.topk(2, -1).values.sum(-1).exp()
    kept = weight.topk(min(most, len(cloud))).indices.sort().values
    made = Gaussians(cloud.means, cloud.quaternions, cloud.log_scales, cloud.opacities, harmonics, cloud.antialiased)
    return made[kept]


def facing(normals: Float[Tensor, "point 3"]) -> Float[Tensor, "point 4"]:
    """Quaternions (w, x, y, z) of the smallest rotations that turn +z onto normals, or onto their opposites."""
    x, y, z = torch.where(normals[:, 2:] < 0, -normals, normals).unbind(-1)
    return torch.nn.functional.normalize(torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1), dim=-1)
