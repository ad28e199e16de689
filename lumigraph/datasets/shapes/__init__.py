"""Shapes: training meshes or point clouds, with distance and occupancy of the space around them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ...camera import Camera, ring
from ...camera.camera import join
from ...geometry import Similarity
from ..mesh import Mesh
from ..scene import Frame
from .triangles import Triangles

HALF_SIDE = 0.9  # half of the longest side after normalisation
BOX_MARGIN = 0.05  # scene units between the shape and the box of interest
PROBE_POINTS, PROBE_SEED = 256, 0  # points at which a closed surface has an integer winding number
INTEGER_TOLERANCE, MIN_CLOSED_SHARE = 0.05, 0.97  # distance to an integer, and the share of probe points within it
PROBE_REACH = 6.0  # radii of a box of triangles away from which they count together: millions take minutes else
CUBE = Frame(background=(1.0, 1.0, 1.0))  # of many shapes, each of which has a frame of its own


@dataclass(frozen=True)
class PointBatch:
    """Points in scene units, with distance and occupancy.

    member:    number of each point's shape
    distance:  to the surface; negative inside of closed meshes
    occupancy: 1 inside, 0 outside; None for clouds of points, which have no inside
    normals:   unit length, of points on a surface
    """

    unit: ClassVar[str] = "points"

    points: Float[Tensor, "point 3"]
    member: Int[Tensor, " point"]
    distance: Float[Tensor, " point"] | None = None
    occupancy: Float[Tensor, " point"] | None = None
    normals: Float[Tensor, "point 3"] | None = None

    def __len__(self) -> int:
        return len(self.points)

    def to(self, device: torch.device | str) -> PointBatch:
        distance, occupancy, normals = (
            None if x is None else x.to(device) for x in (self.distance, self.occupancy, self.normals)
        )
        return PointBatch(self.points.to(device), self.member.to(device), distance, occupancy, normals)

    def __getitem__(self, index: Tensor) -> PointBatch:
        """The points that a mask or index tensor picks."""
        known = (self.distance, self.occupancy, self.normals)
        return PointBatch(self.points[index], self.member[index], *(None if x is None else x[index] for x in known))

    @property
    def signed(self) -> Float[Tensor, " point"]:
        """Signed distance, negative where occupied; for a surface with holes by its winding number."""
        assert self.distance is not None and self.occupancy is not None
        return self.distance.abs() * (1 - 2 * self.occupancy)

    @staticmethod
    def cat(parts: list[PointBatch]) -> PointBatch:
        """Concatenate batches; an optional field must be in all of them."""
        points, member = torch.cat([x.points for x in parts]), torch.cat([x.member for x in parts])
        known = (join(getattr(x, name) for x in parts) for name in ("distance", "occupancy", "normals"))
        return PointBatch(points, member, *known)


@dataclass(frozen=True)
class Shape:
    """A mesh in scene units. One without faces is a cloud of points.

    frame:   bounds, and the similarity to its file's frame
    normals: of a cloud's points, if the file has them
    partial: whether it is a scan of some sides, so that position and size of the whole are unknown
    """

    name: str
    mesh: Mesh
    frame: Frame = Frame()
    normals: Float[np.ndarray, "vertex 3"] | None = None
    partial: bool = False

    @property
    def is_cloud(self) -> bool:
        return not len(self.mesh.faces)

    @cached_property
    def closed(self) -> bool:
        """True for an almost everywhere integer winding number. Unlike in a watertight mesh, parts may intersect."""
        if self.is_cloud:
            return False
        low, high = np.array(self.frame.bounds)
        points = np.random.default_rng(PROBE_SEED).uniform(low, high, (PROBE_POINTS, 3))
        found = self._triangles.winding(points, PROBE_REACH)
        return bool((np.abs(found - found.round()) < INTEGER_TOLERANCE).mean() >= MIN_CLOSED_SHARE)

    def distance(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Distance to the surface, in scene units: signed, negative inside, if it is closed."""
        away = self._away(points)
        return torch.where(self.inside(points), -away, away) if self.closed else away

    def _away(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Unsigned distance."""
        places = points.detach().cpu().double().numpy()
        away = self._cloud.query(places)[0] if self.is_cloud else self._triangles.nearest(places)[0]
        return torch.from_numpy(away).float()

    def inside(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        """True for points with a winding number above 1/2. A point cloud has no inside."""
        if self.is_cloud:
            return torch.zeros(len(points), dtype=torch.bool)
        return torch.from_numpy(self._triangles.winding(points.detach().cpu().double().numpy()) > 0.5)

    def known(self, points: Float[Tensor, "point 3"], member: int = 0) -> PointBatch:
        """Points with their distance and occupancy."""
        inside, away = self.inside(points), self._away(points)
        distance = torch.where(inside, -away, away) if self.closed else away
        occupancy = None if self.is_cloud else inside.float()
        return PointBatch(points, torch.full((len(points),), member), distance, occupancy)

    def surface(self, count: int, generator: torch.Generator, member: int = 0) -> PointBatch:
        """Random surface points, uniform by area, with normals; of a cloud random points. Their distance is 0."""
        members, zero = torch.full((count,), member), torch.zeros(count)
        if self.is_cloud:
            chosen = torch.randint(len(self.mesh.vertices), (count,), generator=generator).numpy()
            normals = None if self.normals is None else torch.from_numpy(self.normals[chosen]).float()
            return PointBatch(torch.from_numpy(self.mesh.vertices[chosen]).float(), members, zero, None, normals)
        areas, directions = self._facing
        draw = torch.rand(count, 3, generator=generator, dtype=torch.float64).numpy()
        face = np.searchsorted(areas, draw[:, 0] * areas[-1], side="right").clip(max=len(areas) - 1)
        root = np.sqrt(draw[:, 1])  # Osada 2002, eq. 1
        shares = np.stack([1 - root, root * (1 - draw[:, 2]), root * draw[:, 2]], -1)
        points = (self._corners[face] * shares[:, :, None]).sum(1)
        normals = torch.from_numpy(directions[face]).float()
        return PointBatch(torch.from_numpy(points).float(), members, zero, None, normals)

    def normals_near(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Normals of the surface nearest to points; upwards where a cloud has none."""
        places = points.detach().cpu().double().numpy()
        if not self.is_cloud:
            return torch.from_numpy(self._facing[1][self._triangles.nearest(places)[1]]).float()
        if self.normals is None:
            return torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(points), 1)
        return torch.from_numpy(self.normals[self._cloud.query(places)[1]]).float()

    @cached_property
    def _corners(self) -> Float[np.ndarray, "face 3 3"]:
        return self.mesh.vertices[self.mesh.faces]

    @cached_property
    def _triangles(self) -> Triangles:
        return Triangles(self._corners)

    @cached_property
    def _cloud(self) -> cKDTree:
        return cKDTree(self.mesh.vertices)

    @cached_property
    def _facing(self) -> tuple[Float[np.ndarray, " face"], Float[np.ndarray, "face 3"]]:
        """Cumulative areas and unit normals of the faces."""
        a, b, c = self._corners.transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        areas = np.linalg.norm(normals, axis=-1)
        return np.cumsum(areas), normals / np.maximum(areas, 1e-300)[:, None]


def normalised(
    name: str,
    mesh: Mesh,
    normals: Float[np.ndarray, "vertex 3"] | None = None,
    upright: Float[np.ndarray, "3 3"] | None = None,
) -> Shape:
    """A mesh as a Shape: its longest side from -0.9 to 0.9, centred at the origin.

    upright: rotation from the mesh's own frame to +z up; None if it is upright
    """
    turn = torch.eye(3, dtype=torch.float64) if upright is None else torch.from_numpy(np.asarray(upright, np.float64))
    places = np.asarray(mesh.vertices, np.float64) @ turn.numpy().T
    low, high = places.min(0), places.max(0)
    scale = 2 * HALF_SIDE / max(float((high - low).max()), 1e-12)
    scene_from_file = Similarity.make(scale, turn, torch.from_numpy(-scale * (low + high) / 2))
    made = mesh.transformed(scene_from_file.matrix.numpy())
    a, b, c = made.vertices[made.faces].transpose(1, 0, 2)
    if (a * np.cross(b, c)).sum() < 0:  # the enclosed volume: it was inside out
        made = replace(made, faces=made.faces[:, ::-1].copy())
    half = np.minimum(scale * (high - low) / 2 + BOX_MARGIN, 1.0)
    corner = (float(half[0]), float(half[1]), float(half[2]))
    frame = Frame(
        bounds=((-corner[0], -corner[1], -corner[2]), corner),
        background=(1.0, 1.0, 1.0),
        source_from_scene=scene_from_file.inverse.rows,
    )
    return Shape(name, made, frame, None if normals is None else normals @ turn.numpy().T)


@dataclass(frozen=True)
class Shapes:
    """Training shapes; shape i is members[i]. A single one is also its own test, at other points.

    frame:    of a single shape its own; of many the cube that each of them fills
    splits:   numbers of members by purpose
    """

    kind: ClassVar[str] = "shapes"

    members: list[Shape]
    splits: dict[str, Int[Tensor, " member"]]
    source: str = ""

    def __len__(self) -> int:
        return len(self.members)

    @property
    def frame(self) -> Frame:
        return self.members[0].frame if len(self.members) == 1 else CUBE

    @property
    def names(self) -> list[str]:
        return [member.name for member in self.members]

    @property
    def warnings(self) -> list[str]:
        clouds = [member.name for member in self.members if member.is_cloud]
        open_ones = [member.name for member in self.members if not member.is_cloud and not member.closed]
        found = []
        if clouds:
            found.append(
                f"{listed(clouds)}: a cloud of points has no inside; distances are unsigned, and there is no occupancy"
            )
        if open_ones:
            found.append(
                f"{listed(open_ones)}: the surface is not closed; distances are unsigned, and occupancy is where the "
                "winding number is above a half"
            )
        return found

    def preview(self) -> Camera:
        """A camera of 128 pixels in front of a shape."""
        return ring(self.frame.bounds, size=128)[0]

    def sample(
        self,
        count: int,
        generator: torch.Generator,
        near: float = 0.5,
        spread: float = 0.05,
        split: str = "train",
        members: int = 1,
    ) -> PointBatch:
        """Random points with their distance and occupancy.

        near:    share of points near the surface, with Gaussian offsets; the others are uniform in [-1, 1]^3
        spread:  deviation of these offsets along each axis, scene units
        members: shapes of this batch; the points are divided evenly among them
        """
        there = self.splits[split]
        drawn = there[torch.randint(len(there), (members,), generator=generator)].tolist()
        parts = []
        for place, number in enumerate(drawn):
            shape, own = self.members[number], count * (place + 1) // members - count * place // members
            close = round(near * own)
            offsets = spread * torch.randn(close, 3, generator=generator)
            elsewhere = 2 * torch.rand(own - close, 3, generator=generator) - 1
            points = torch.cat([shape.surface(close, generator).points + offsets, elsewhere])
            parts.append(shape.known(points, number))
        return PointBatch.cat(parts)


def listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
