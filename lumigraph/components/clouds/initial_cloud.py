"""Where a cloud begins: at the points that structure from motion found, or at random where something may be."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...gaussians import Gaussians
from ...kernels.spherical_harmonics import K00
from ...scene import Frame, Scene
from ..sampling.carving import visual_hull

OPACITY = 0.1  # of each Gaussian at first (Kerbl 2023; the original release)
HULL_CELLS = 64  # along an axis
NEIGHBOURS = 3


def initial_cloud(scene: Scene, count: int, most: int, degree: int, generator: torch.Generator) -> Gaussians:
    """A cloud at the scene's sparse points, at most `most` of them; without any, `count` random Gaussians.

    Random ones lie inside the silhouettes of photographs with alpha, otherwise inside the box of interest.
    """
    if scene.points is not None and len(scene.points) >= 2:
        inside = (scene.points.abs().amax(-1) <= scene.frame.reach) & scene.points.isfinite().all(-1)
        chosen = inside.nonzero()[:, 0]
        chosen = chosen[torch.randperm(len(chosen), generator=generator)[:most]]
        colours = torch.full((len(scene.points), 3), 0.5)
        if scene.point_colours is not None:
            colours = scene.point_colours.float() / 255
        return round_gaussians(scene.points[chosen], colours[chosen], degree)
    means = random_points(scene, min(count, most), generator)
    return round_gaussians(means, torch.rand(len(means), 3, generator=generator), degree)


def random_cloud(frame: Frame, count: int, degree: int, generator: torch.Generator) -> Gaussians:
    """Random Gaussians in the box of interest."""
    means = points_in_box(frame, count, generator)
    return round_gaussians(means, torch.rand(count, 3, generator=generator), degree)


def random_points(scene: Scene, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
    if not scene.images.has_alpha or scene.frame.reach > 1:
        return points_in_box(scene.frame, count, generator)
    cells = visual_hull(scene, HULL_CELLS).nonzero()
    chosen = cells[torch.randint(len(cells), (count,), generator=generator)]
    return (chosen + torch.rand(count, 3, generator=generator)) * (2 / HULL_CELLS) - 1


def points_in_box(frame: Frame, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
    low, high = torch.tensor(frame.bounds)
    return low + (high - low) * torch.rand(count, 3, generator=generator)


def round_gaussians(means: Float[Tensor, "gaussian 3"], colours: Float[Tensor, "gaussian 3"], degree: int) -> Gaussians:
    """Balls as large as the mean distance to their three nearest neighbours, of one colour from all sides."""
    count = len(means)
    scales = nearest_distance(means).clamp_min(1e-4)
    harmonics = torch.zeros(count, (degree + 1) ** 2, 3)
    harmonics[:, 0] = (colours - 0.5) / K00
    return Gaussians(
        means,
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales.log()[:, None].repeat(1, 3),
        torch.full((count,), OPACITY).logit(),
        harmonics,
    )


def nearest_distance(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
    """Root mean square distance to the nearest other points (at most all of them); 1 for a point alone."""
    from scipy.spatial import KDTree

    known = min(NEIGHBOURS, len(points) - 1)
    if known < 1:
        return torch.ones(len(points))
    distance, _ = KDTree(points.numpy()).query(points.numpy(), known + 1)
    return torch.from_numpy(distance[:, 1:]).square().mean(1).sqrt().float()
