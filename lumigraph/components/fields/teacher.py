"""Teachers: density and colour of another method at points in its cameras' view, and distillation from these.

A teacher with a `field` is evaluated. One without, such as a cloud of Gaussians, is rendered to depth maps, which are
fused into a shell of density around its surfaces (Curless and Levoy 1996). Free space of the cameras is always empty: a
field is arbitrary where its own pictures never sample it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...camera import Camera
from ...depth_maps import DEPTH_EDGE, TSDF, DepthMap, SurfacePoints, Tolerance, free, render_depth_maps, surface_points
from ...geometry import evenly, unit
from ...kernels import spherical_harmonics
from ...method.capabilities import HasDensity, HasField, can
from ...method.field import Colours, Densities, Directions, Points
from ...system.progress import track
from ..training.schedules import hold_and_decay
from .spaces import Space

AT_ONCE = 1 << 17  # points
VIEWS, SIZE = 24, 128  # depth maps of a teacher at most, and pixels of their longer side
ASKED = 12  # views whose directions tell how a colour depends on them
UNSEEN = 0.02  # weight of a view that does not see a point, which then has some colour at least
STIFFNESS = 0.1  # views that hold harmonics beyond the first at zero
TRUNCATION = Tolerance(per_distance=0.015)  # half the thickness of a shell
SPENT = 8.0  # optical thickness of half a shell, where it is solid
COARSE, PROBES = 64, 8  # cells per axis that are looked at first, and places in each
SPREAD = 0.01  # of its distance, by which places near a surface are scattered
EDGE = 2e-3  # coordinates by which a place may miss its own and still be one


def teacher_of(teacher: Any, cameras: Camera) -> Teacher:
    """Teacher with depth maps of cameras around it. Raises LumigraphError if they show no surface."""
    depth_maps = render_depth_maps(teacher.render, cameras, teacher.frame.background, VIEWS, SIZE)
    return FieldTeacher(depth_maps, teacher) if can(teacher, HasField) else DepthTeacher(depth_maps)


class Teacher(ABC):
    """Density and colour of a teacher at points of the scene, on the CPU.

    depth_maps: of cameras around it
    """

    def __init__(self, depth_maps: Sequence[DepthMap]):
        self.depth_maps = depth_maps

    @abstractmethod
    def _density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit, without removing free space."""

    @abstractmethod
    def glance(self, points: Float[Tensor, "point 3"], depth_map: DepthMap) -> Float[Tensor, "point 3"]:
        """Colours of points, sRGB-encoded, seen from one camera."""

    @cached_property
    def surface(self) -> SurfacePoints:
        """Points of the surfaces in the cameras' view."""
        return surface_points(self.depth_maps)

    @torch.no_grad()
    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit; zero in the cameras' free space."""
        found = []
        for part in points.split(AT_ONCE):
            there = (~free(part, self.depth_maps)).nonzero()[:, 0]
            found.append(part.new_zeros(len(part)).index_copy(0, there, self._density(part[there])))
        return torch.cat(found) if found else points.new_zeros(0)

    @torch.no_grad()
    def density_around(
        self, points: Float[Tensor, "point 3"], size: Float[Tensor, " point"], chance: torch.Generator, count: int = 4
    ) -> Float[Tensor, " point"]:
        """Density per scene unit of a homogeneous cube with the mean opacity of the cube around each point, sampled at
        some random positions in it."""
        passed = torch.zeros(len(points))
        for _ in track(range(count), "Taking over density", count):
            moved = points + (torch.rand(points.shape, generator=chance) - 0.5) * size[:, None]
            passed += torch.exp(-self.density(moved) * size) / count
        return -passed.clamp_min(1e-6).log() / size

    @torch.no_grad()
    def harmonics(
        self, points: Float[Tensor, "point 3"], bands: int, of: Callable[[Tensor], Tensor]
    ) -> Float[Tensor, "point coefficient 3"]:
        """Spherical harmonics of a function of each point's colour, by regularised least squares over the directions of
        cameras that see it."""
        chosen, width = evenly(self.depth_maps, ASKED), bands**2
        held = torch.cat([torch.tensor([1e-4]), torch.full((width - 1,), STIFFNESS)]).diag()
        found = []
        parts = points.split(AT_ONCE)
        for part in track(parts, "Taking over colour", len(parts)):
            squares, products = held.repeat(len(part), 1, 1), part.new_zeros(len(part), width, 3)
            seen = torch.stack([depth_map.sees(part, edge=None) for depth_map in chosen])
            for i, depth_map in enumerate(chosen):
                asked = (seen[i] | ~seen.any(0)).nonzero()[:, 0]  # what nobody sees is asked for all the same
                basis = spherical_harmonics(unit(part[asked] - depth_map.camera.position), bands)
                weight = torch.where(seen[i][asked], 1.0, UNSEEN)[:, None]
                colour = of(self.glance(part[asked], depth_map))
                squares.index_add_(0, asked, (weight * basis)[:, :, None] * basis[:, None])
                products.index_add_(0, asked, (weight * basis)[:, :, None] * colour[:, None])
            found.append(torch.linalg.solve(squares, products))
        return torch.cat(found) if found else points.new_zeros(0, width, 3)

    @torch.no_grad()
    def occupied(
        self, space: Space, cells: int, thickness: float, chance: torch.Generator
    ) -> Bool[Tensor, "cell cell cell"]:
        """Mask of the occupied cells of a space's [-1, 1]^3, dilated by one, from coarse to fine. cells: along an axis

        thickness: optical thickness across an occupied cell
        """
        n = min(cells, COARSE)
        held = torch.ones(n, n, n, dtype=torch.bool)
        while True:
            index = held.nonzero()
            dense = torch.zeros(len(index), dtype=torch.bool)
            for _ in range(PROBES if n == min(cells, COARSE) else PROBES // 2):
                left = (~dense).nonzero()[:, 0]
                places = (index[left] + torch.rand(len(left), 3, generator=chance)) * (2 / n) - 1
                points = space.unwarp(places)
                dense[left] = self.density(points) * (2 / n) > thickness * space.stretch(points)
                dense[left] &= (space.warp(points) - places).abs().amax(-1) < EDGE
            held = torch.zeros_like(held)
            held[tuple(index[dense].t())] = True
            held[tuple(cells_of(space.warp(self.surface.points), n).t())] = True
            held = torch.nn.functional.max_pool3d(held[None].float(), 3, 1, 1)[0] > 0
            if n >= cells:
                return held
            n *= 2
            held = held.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)

    @torch.no_grad()
    def places(self, space: Space, count: int, chance: torch.Generator) -> Float[Tensor, "point 3"]:
        """Random training points: half of them near surfaces, a quarter between cameras and surfaces, and a quarter
        uniform in the space's [-1, 1]^3."""
        near, before = count // 2, count // 4
        known = self.surface
        if not len(known):
            near = before = 0
        chosen = torch.randint(max(len(known), 1), (near + before,), generator=chance)
        ways = known.points[chosen] - known.origins[chosen]
        shares = torch.cat(
            [1 + SPREAD * torch.randn(near, generator=chance), torch.rand(before, generator=chance).sqrt()]
        )
        anywhere = 2 * torch.rand(count - near - before, 3, generator=chance) - 1
        return torch.cat([known.origins[chosen] + shares[:, None] * ways, space.unwarp(anywhere)])


class FieldTeacher(Teacher):
    """Teacher with a field."""

    def __init__(self, depth_maps: Sequence[DepthMap], teacher: Any):
        super().__init__(depth_maps)
        self.teacher = teacher

    def _density(self, points):
        return density_of(self.teacher)(points.to(self.teacher.device)).cpu().float()

    def glance(self, points, depth_map):
        there, directions = points, unit(points - depth_map.camera.position)
        parts = zip(there.split(AT_ONCE), directions.split(AT_ONCE), strict=True)
        device = self.teacher.device
        found = [self.teacher.field(x.to(device), d.to(device))[1].cpu().float() for x, d in parts]
        return torch.cat(found) if found else points


class DepthTeacher(Teacher):
    """Teacher of depth maps: a shell around their surfaces, solid over half its thickness.

    It has a `field` itself, so it can replace its teacher wherever one is needed.
    """

    device = torch.device("cpu")

    def _density(self, points):
        distance, truncation, _ = TSDF(self.depth_maps, TRUNCATION, DEPTH_EDGE)(points)
        return ((0.5 - distance).clamp(0, 1) * SPENT / truncation).nan_to_num(0.0)

    @torch.no_grad()
    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, and the colour of the camera closest to the viewing direction."""
        best, rgb = torch.full((len(points),), -2.0), torch.full_like(points, 0.5)
        for depth_map in self.depth_maps:
            along = (unit(points - depth_map.camera.position) * directions).sum(-1)
            nearer = ((along > best) & depth_map.sees(points, edge=None)).nonzero()[:, 0]
            best[nearer], rgb[nearer] = along[nearer], self.glance(points[nearer], depth_map)
        return self.density(points), rgb

    def glance(self, points, depth_map):
        pixels, valid, _ = depth_map.project(points)
        inside = depth_map.inside(pixels, valid)[:, None]
        return torch.where(inside, depth_map.at_pixels(depth_map.rgb, pixels), 0.5)


def density_of(teacher: Any) -> Callable[[Points], Densities]:
    """Density at points, of a teacher with a `field`."""
    if can(teacher, HasDensity):
        return teacher.density
    return lambda points: teacher.field(points, torch.nn.functional.normalize(points + 1e-6, dim=-1))[0]


def logit(rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
    """Logit of colours, clamped away from black and white."""
    return rgb.clamp(0.01, 0.99).logit()


def cells_of(coordinates: Float[Tensor, "point 3"], n: int) -> Tensor:
    """Cells of coordinates, of n along each axis of [-1, 1]^3."""
    return ((coordinates + 1) * (n / 2)).long().clamp(0, n - 1)


STEPS = 240
POINTS_PER_RAY = 8  # of a step of a coordinate network: as many points are learnt from
POOL = 16  # times as many places as a step learns from: the teacher is asked about these alone
CELL = 1 / 16  # of the coordinates: a length over which densities are compared by what they stop
CLEAR = 1 / 2  # the same where the teacher holds nothing: a little fog there is much along a ray
NOTHING = 0.01  # optical thickness of CELL up to which that is so
SOLID = 8.0  # and from which on all is solid alike
FINAL = 0.1  # of the learning rates, at the end
START = 0.3  # share of the steps before they fall

Field = Callable[
    [Float[Tensor, "point 3"], Float[Tensor, "point 3"]], tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]
]


def distil(
    field: Field,
    held_by: Teacher,
    space: Space,
    optimizers: Sequence[torch.optim.Optimizer],
    points: int,
    chance: torch.Generator,
    device: torch.device | str = "cpu",
) -> None:
    """Distil a teacher into a field.

        L = mean (log(1 + sigma d) - log(1 + sigma' d))^2 + mean a' |c - c'|^2,    a' = 1 - exp(-sigma' d)

    over points near surfaces, in front of them and anywhere, colours along rays of cameras that see the point.
    d is CELL of the coordinates, or CLEAR where the teacher is empty; where it is solid, any solid density suffices.
    The optimizers' learning rates decay from their current values.
    points: number of points per step
    """
    places = held_by.places(space, POOL * points, chance)
    directions, rgb, seen = glances(held_by, places, chance)
    length = CELL / space.stretch(places)
    thickness = (held_by.density(places) * length).clamp_max(SOLID)
    length = torch.where(thickness > NOTHING, length, length * (CLEAR / CELL))
    lessons = [x.to(device) for x in (places, directions, rgb, seen, thickness, length)]
    rates = [(group, group["lr"]) for optimizer in optimizers for group in optimizer.param_groups]
    with torch.enable_grad():
        for step in track(range(STEPS), "Teaching points", STEPS):
            for group, rate in rates:
                group["lr"] = rate * hold_and_decay(1.0, FINAL, step, step / STEPS, START)
            chosen = torch.randint(len(places), (points,), generator=chance).to(device)
            place, direction, colour, sees, wanted, d = (x[chosen] for x in lessons)
            density, found = field(place, direction)
            off = torch.log1p(density * d) - torch.log1p(wanted)
            dense = torch.where(wanted < SOLID, off, off.clamp_max(0)).square().mean()
            weight = sees * -torch.expm1(-wanted)
            coloured = (weight[:, None] * (found - colour).square()).mean()
            for optimizer in optimizers:
                optimizer.zero_grad(set_to_none=True)
            (dense + coloured).backward()
            for optimizer in optimizers:
                optimizer.step()
    for optimizer in optimizers:
        optimizer.zero_grad(set_to_none=True)


@torch.no_grad()
def glances(
    held_by: Teacher, places: Float[Tensor, "point 3"], chance: torch.Generator
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3"], Float[Tensor, " point"]]:
    """For each point the direction from a random camera, the colour from there, and its visibility (0 or 1)."""
    directions, rgb, seen = torch.zeros_like(places), torch.full_like(places, 0.5), torch.zeros(len(places))
    camera = torch.randint(len(held_by.depth_maps), (len(places),), generator=chance)
    for i, depth_map in enumerate(track(held_by.depth_maps, "Asking the teacher", len(held_by.depth_maps))):
        own = (camera == i).nonzero()[:, 0]
        directions[own] = unit(places[own] - depth_map.camera.position)
        own = own[depth_map.sees(places[own], edge=None)]
        seen[own], rgb[own] = 1.0, held_by.glance(places[own], depth_map)
    return directions, rgb, seen
