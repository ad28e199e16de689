"""Initial cloud: Gaussians at points of structure from motion and of plane sweeps, or at random."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...datasets.scene import Frame, Scene
from ...errors import LumigraphError
from ...gaussians import Gaussians
from ...kernels.spherical_harmonics import K00
from ...method.capabilities import HasGaussians, can
from ..fields.teacher import Teacher
from ..sampling.occupancy import visual_hull
from ..training.dense_points import Points, seen_points, thinned

Initialization = Literal["dense", "sparse", "random"]

INITIAL_OPACITY = 0.1  # Kerbl 2023; the original release
HULL_CELLS = 64  # along an axis
NEIGHBOURS = 3
MIN_DENSE_POINTS = 100
MAX_DENSE_SHARE = 1 / 3  # of the cap: points that plane sweeps fill up to, as each makes steps slower
BACKDROP_SHARE = 0.2  # of the random Gaussians: how many lie far out behind dense points, where nothing else is known


def initial_cloud(
    scene: Scene,
    initialization: Initialization,
    count: int,
    max_count: int,
    degree: int,
    generator: torch.Generator,
    sweep: Callable[[], Points] | None = None,
) -> Gaussians:
    """Initial cloud of at most `max_count` Gaussians at known points, or without any, `count` random ones.

    initialization: "dense" adds points of plane sweeps to the scene's sparse points, "sparse" takes only the sparse
                    points, or plane sweeps without any, "random" takes neither
    sweep:          returns points of plane sweeps; `seen_points` by default
    Random ones lie inside the silhouettes of photographs with alpha, otherwise inside the box of interest.
    """
    means, colours = torch.zeros(0, 3), torch.zeros(0, 3)
    if initialization != "random":
        means, colours = sparse_points(scene, max_count, generator)
    dense_count = math.ceil(MAX_DENSE_SHARE * max_count)
    if may_sweep(initialization, scene.frame) and len(means) < (dense_count if initialization == "dense" else 2):
        found = thinned((sweep or partial(seen_points, scene))())
        means, colours = with_dense_points(scene, means, colours, count, dense_count, generator, found)
    if len(means) < 2:
        means = random_points(scene, min(count, max_count), generator)
        colours = torch.rand(len(means), 3, generator=generator)
    return round_gaussians(means, colours, degree)


def may_sweep(initialization: Initialization, frame: Frame) -> bool:
    """True if an initial cloud may use plane sweeps: a dense one, or one without sparse points."""
    return initialization == "dense" or initialization == "sparse" and frame.is_open


def sparse_points(scene: Scene, max_count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Positions and colours of the scene's own points within reach, at most `max_count`; maybe none."""
    if scene.points is None or len(scene.points) < 2:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    inside = (scene.points.abs().amax(-1) <= scene.frame.reach) & scene.points.isfinite().all(-1)
    chosen = inside.nonzero()[:, 0]
    chosen = chosen[torch.randperm(len(chosen), generator=generator)[:max_count]]
    colours = torch.full((len(scene.points), 3), 0.5)
    if scene.point_colours is not None:
        colours = scene.point_colours.float() / 255
    return scene.points[chosen], colours[chosen]


def with_dense_points(
    scene: Scene,
    means: Tensor,
    colours: Tensor,
    count: int,
    max_count: int,
    generator: torch.Generator,
    found: Points,
) -> tuple[Tensor, Tensor]:
    """Sparse points and dense ones; without sparse ones also some far out, where sweeps find nothing consistent."""
    inside = (found.positions.abs().amax(-1) <= scene.frame.reach).nonzero()[:, 0]
    if len(inside) < MIN_DENSE_POINTS:
        return means, colours
    far = torch.zeros(0, 3)
    if not len(means) and scene.frame.is_open:
        far = backdrop(scene.frame, min(int(BACKDROP_SHARE * count), max_count // 2), generator)
    chosen = inside[torch.randperm(len(inside), generator=generator)[: max_count - len(means) - len(far)]]
    guessed = torch.rand(len(far), 3, generator=generator)
    return torch.cat([means, found.positions[chosen], far]), torch.cat([colours, found.colours[chosen], guessed])


def backdrop(frame: Frame, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
    """Random positions outside the box of interest, log-uniform in distance up to the scene's end."""
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    nearest = max(float(torch.tensor(frame.bounds).norm(dim=-1).max()), 0.1 * frame.reach)
    distances = torch.exp(math.log(frame.reach / nearest) * torch.rand(count, 1, generator=generator)) * nearest
    return directions * distances


def random_cloud(frame: Frame, count: int, degree: int, generator: torch.Generator) -> Gaussians:
    """Random Gaussians in the box of interest."""
    means = points_in_box(frame, count, generator)
    return round_gaussians(means, torch.rand(count, 3, generator=generator), degree)


def random_points(scene: Scene, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
    if not scene.images.has_alpha or scene.frame.is_open or scene.frame.times is not None:
        return points_in_box(scene.frame, count, generator)
    cells = visual_hull(scene, HULL_CELLS).nonzero()
    chosen = cells[torch.randint(len(cells), (count,), generator=generator)]
    return (chosen + torch.rand(count, 3, generator=generator)) * (2 / HULL_CELLS) - 1


def points_in_box(frame: Frame, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
    low, high = torch.tensor(frame.bounds)
    return low + (high - low) * torch.rand(count, 3, generator=generator)


def round_gaussians(means: Float[Tensor, "gaussian 3"], colours: Float[Tensor, "gaussian 3"], degree: int) -> Gaussians:
    """Isotropic Gaussians of the mean distance to their three nearest neighbours, with view-independent colour."""
    count = len(means)
    scales = nearest_distance(means).clamp_min(1e-4)
    harmonics = torch.zeros(count, (degree + 1) ** 2, 3)
    harmonics[:, 0] = (colours - 0.5) / K00
    return Gaussians(
        means,
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales.log()[:, None].repeat(1, 3),
        torch.full((count,), INITIAL_OPACITY).logit(),
        harmonics,
    )


def nearest_distance(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
    """Root mean square distance to the nearest other points (at most all of them); 1 for a single point."""
    from scipy.spatial import KDTree

    known = min(NEIGHBOURS, len(points) - 1)
    if known < 1:
        return torch.ones(len(points))
    distance, _ = KDTree(points.numpy()).query(points.numpy(), known + 1)
    return torch.from_numpy(distance[:, 1:]).square().mean(1).sqrt().float()


SURFACE_OPACITY = 0.8
INITIAL_BANDS = 2  # of harmonics, fitted to what cameras see; their directions are too few for more
DISC_WIDTH = 0.6  # deviation, in distances to the nearest neighbours
DISC_THICKNESS = 0.2  # of the width


def surface_cloud(teacher: Teacher, max_count: int, degree: int, generator: torch.Generator) -> Gaussians:
    """Overlapping discs on surfaces seen by cameras, with normals and colours. Raises LumigraphError without any."""
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
    opacities = torch.full((len(seen),), SURFACE_OPACITY).logit()
    return Gaussians(seen.points, rotation_to_normal(seen.normals), scales.log(), opacities, harmonics)


def cloud_of(teacher: object, max_count: int, degree: int) -> Gaussians | None:
    """The teacher's largest, most opaque Gaussians, with harmonics of another degree; None without Gaussians."""
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
    """Quaternions (w, x, y, z) of the smallest rotations from +z to normals, or to their opposites."""
    x, y, z = torch.where(normals[:, 2:] < 0, -normals, normals).unbind(-1)
    return torch.nn.functional.normalize(torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1), dim=-1)
