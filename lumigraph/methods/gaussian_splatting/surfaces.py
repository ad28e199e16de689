"""A cloud on the surfaces of a teacher: flat discs that lie on them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...components.fields.teacher import Teacher
from ...errors import LumigraphError
from ...gaussians import Gaussians
from ...method.capabilities import HasGaussians, can
from .initialization import nearest_distance

INITIAL_OPACITY = 0.8
INITIAL_BANDS = 2  # of harmonics, fitted to what cameras see; their directions are too few for more
DISC_WIDTH = 0.6  # deviation, in distances to the nearest neighbours
DISC_THICKNESS = 0.2  # of the width


def surface_cloud(teacher: Teacher, max_count: int, degree: int, generator: torch.Generator) -> Gaussians:
    """Discs on the surfaces that cameras see, across their normals, which reach one another, in the colours that
    cameras see. Raises LumigraphError where there is no surface."""
    seen = teacher.surface
    seen = seen[torch.randperm(len(seen), generator=generator)[:max_count]]
    if len(seen) < 2:
        raise LumigraphError(
            "Cameras agree on no surface, so there are no places for Gaussians; train for longer first"
        )
    wide = DISC_WIDTH * nearest_distance(seen.points).clamp_min(1e-4)
    scales = torch.stack([wide, wide, DISC_THICKNESS * wide], -1)
    harmonics = torch.zeros(len(seen), (degree + 1) ** 2, 3)
    bands = min(degree + 1, INITIAL_BANDS)
    harmonics[:, : bands**2] = teacher.harmonics(seen.points, bands, lambda rgb: rgb - 0.5)
    opacities = torch.full((len(seen),), INITIAL_OPACITY).logit()
    return Gaussians(seen.points, rotation_to_normal(seen.normals), scales.log(), opacities, harmonics)


def cloud_of(teacher: object, max_count: int, degree: int) -> Gaussians | None:
    """The teacher's own Gaussians, the largest and most opaque ones, with harmonics of another degree; None where it
    has none."""
    if not can(teacher, HasGaussians):
        return None
    cloud: Gaussians = teacher.gaussians()  # type: ignore[attr-defined]
    count = (degree + 1) ** 2
    harmonics = torch.zeros(len(cloud), count, 3).to(cloud.harmonics)
    shared = min(count, cloud.harmonics.shape[1])
    harmonics[:, :shared] = cloud.harmonics[:, :shared]
    weight = cloud.opacities.sigmoid() * cloud.log_scales.topk(2, -1).values.sum(-1).exp()
    kept = weight.topk(min(max_count, len(cloud))).indices.sort().values
    made = Gaussians(cloud.means, cloud.quaternions, cloud.log_scales, cloud.opacities, harmonics, cloud.antialiased)
    return made[kept]


def rotation_to_normal(normals: Float[Tensor, "point 3"]) -> Float[Tensor, "point 4"]:
    """Quaternions (w, x, y, z) of the smallest rotations that turn +z onto normals, or onto their opposites."""
    x, y, z = torch.where(normals[:, 2:] < 0, -normals, normals).unbind(-1)
    return torch.nn.functional.normalize(torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1), dim=-1)
