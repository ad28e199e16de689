"""Meshes in a field, lit by its probes: irradiance at their points, and their shadows on the field.

    mesh:    L(x) = albedo / pi  E(x, n)                                                    with E from the probes
    shadow:  S(x) = sum_w L(x, w) (n . w) (1 - O(x, w)) / sum_w L(x, w) (n . w),   n . w > 0     for each channel

w runs over directions spread evenly over the sphere, L(x, w) is the probes' radiance and O(x, w) is 1 where the mesh
occludes x in direction w (ambient occlusion weighted by the light of each direction). O comes from a depth map of the
mesh for each direction. The field's picture is decoded, multiplied by S, and encoded again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from .. import kernels
from ..camera import Camera
from ..camera.lens import Pinhole
from ..camera.rays import Rendering
from ..color.blending import over
from ..components.fields.mesh_picture import picture, projected
from ..components.training.development import decoded, encoded
from ..datasets.mesh import Mesh
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..geometry import Similarity, look_at, normals_from_depth, unit
from ..light.probes import ProbeGrid
from ..method import Method
from . import loops
from .composed import Composed, compose
from .placed import Placed

DIRECTIONS = 192  # from which light comes, for shadows
MAP_SIDE = 96  # pixels along a side of each direction's depth map
MAP_DISTANCE = 200.0  # of its camera from the mesh, in radii of the mesh
MAP_MARGIN = 1.1  # radii of the mesh that half a map shows
BIAS, NORMAL_OFFSET = 0.01, 0.04  # radii of the mesh by which an occluder must be nearer, and a point is raised
MAP_SCALE = MAP_SIDE / 2 / MAP_MARGIN * MAP_DISTANCE  # pixels of a map for a slope of 1 in its camera
MIN_SHADOW = 1 / 100  # share of a point's irradiance; a mesh that can take no more casts no shadow there
CREASE = math.cos(math.radians(40))  # cosine between faces from which on their common edge looks sharp
NEAR_SCALE = 0.1  # of the frame's near distance: how near to a camera a mesh is still drawn
MIN_SURFACE_OPACITY = 0.5
NORMAL_WINDOW = 5  # pixels a side over which the field's normals are averaged
POINTS_PER_CHUNK = 1 << 15


@dataclass(frozen=True)
class ShadedMesh:
    """Triangles with shading normals; corners are split at creases.

    vertices: in the frame of its source
    albedo:   diffuse reflectance, linear
    """

    vertices: Float[Tensor, "vertex 3"]
    normals: Float[Tensor, "vertex 3"]
    albedo: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]

    @staticmethod
    def of(mesh: Mesh) -> ShadedMesh:
        """Normals of corners: the sum, by area, of faces at the same place that differ by less than CREASE."""
        faces = mesh.faces
        a, b, c = mesh.vertices[faces].swapaxes(0, 1)
        across = np.cross(b - a, c - a)
        outward = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-30)
        _, place = np.unique(mesh.vertices.round(9), axis=0, return_inverse=True)
        corners, of_face = place.ravel()[faces].ravel(), np.repeat(np.arange(len(faces)), 3)
        ones = np.ones(len(corners))
        at_place = sparse.csr_array((ones, (corners, of_face)), (len(mesh.vertices), len(faces)))
        pairs = (sparse.csr_array((ones, (np.arange(len(corners)), corners)), (len(corners), len(mesh.vertices)))
                 @ at_place).tocoo()  # fmt: skip
        alike = (outward[of_face[pairs.row]] * outward[pairs.col]).sum(-1) > CREASE
        total = np.stack([np.bincount(pairs.row[alike], across[pairs.col[alike], k], len(corners)) for k in range(3)])
        normals = total.T / np.maximum(np.linalg.norm(total.T, axis=-1, keepdims=True), 1e-30)
        rows = np.hstack([mesh.vertices[faces.ravel()], normals.round(6), mesh.colours[faces.ravel()]])
        kept, number = np.unique(rows, axis=0, return_inverse=True)
        columns = torch.from_numpy(kept).float()
        albedo = decoded(columns[:, 6:] / 255)
        return ShadedMesh(columns[:, :3], columns[:, 3:6], albedo, torch.from_numpy(number.reshape(-1, 3)))

    def transformed(self, place: Similarity) -> ShadedMesh:
        return replace(self, vertices=place.points(self.vertices), normals=place.directions(self.normals))


class LitMesh(Method):
    """A mesh lit by probes, for rendering only.

    mesh:    in the frame of the method
    grid:    the probes
    to_grid: from the frame of the method to that of the probes
    """

    def __init__(self, frame: Frame, mesh: ShadedMesh, grid: ProbeGrid, to_grid: Similarity):
        super().__init__(frame, None)
        self.grid, self.to_grid = grid, to_grid
        self.mesh = mesh
        self.shadows = ShadowMaps.of(mesh.transformed(to_grid))
        places = mesh.vertices.unique(dim=0, return_inverse=True)[1]
        self.neighbours = kernels.neighbours(places[mesh.faces])  # across creases, too
        self.eval()

    @cached_property
    def openness(self) -> Float[Tensor, "vertex 3"]:
        """Share of each vertex's irradiance that is not self-occluded."""
        there = self.mesh.transformed(self.to_grid)
        return self.shadows.shares(there.vertices, there.normals, self.grid)

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        mesh, camera = self.mesh, camera.to("cpu")
        columns = torch.cat([mesh.albedo * self.openness, mesh.normals, mesh.vertices], -1)
        seen = picture(mesh.vertices, columns, mesh.faces, self.neighbours, camera, NEAR_SCALE * self.frame.near)
        hit = seen.opacity > 0
        albedo, normals, points = (seen.values[hit] / seen.opacity[hit][:, None]).split(3, -1)
        there = self.to_grid.points(points), self.to_grid.directions(unit(normals))
        light = albedo / math.pi * self.grid.irradiance(*there)
        rgb = torch.zeros(*hit.shape, 3)
        rgb[hit] = encoded(light.clamp(0, 1)) * seen.opacity[hit][:, None]
        depth = filled(seen.depth, hit)
        return Rendering(over(rgb, seen.opacity, self.background[0]), depth, seen.opacity)

    def batch(self, data: Any, generator: torch.Generator) -> NoReturn:
        raise LumigraphError("A mesh does not learn; train the scene around it")


def filled(depth: Float[Tensor, "height width"], wanted: Bool[Tensor, "height width"]) -> Tensor:
    """Depth of pixels whose centre is just outside a silhouette, from their nearest neighbour; infinity without one."""
    around = -torch.nn.functional.max_pool2d(-depth[None], 3, 1, 1)[0]
    return torch.where(wanted & depth.isinf(), around, depth)


@dataclass(frozen=True)
class ShadowMaps:
    """Depth maps of a mesh from distant lamps, one for each direction.

    toward: unit directions to the lamps
    depth:  distance from each lamp; infinity beside the mesh
    """

    centre: Float[Tensor, " 3"]
    radius: float
    toward: Float[Tensor, "lamp 3"]
    poses: Float[Tensor, "lamp 3 4"]
    depth: Float[Tensor, "lamp row column"]

    @staticmethod
    def of(mesh: ShadedMesh) -> ShadowMaps:
        """Maps of a mesh in the frame of the probes."""
        low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
        centre = (low + high) / 2
        radius = float((mesh.vertices - centre).norm(dim=-1).max())
        toward = sphere_points(DIRECTIONS)
        up = torch.where(toward[:, 2:].abs() < 0.9, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
        poses = look_at(MAP_DISTANCE * toward, -toward, up)
        local = replace(mesh, vertices=(mesh.vertices - centre) / radius)
        focal = torch.full((1, 2), MAP_SCALE)
        lens, size = Pinhole(focal, torch.full((1, 2), MAP_SIDE / 2)), torch.full((1, 2), MAP_SIDE)
        maps = []
        for pose in poses:
            corners = projected(local.vertices, Camera(pose[None], lens, size))
            _, depth, found = kernels.rasterize_mesh(corners, torch.ones(len(corners), 1), mesh.faces, (MAP_SIDE,) * 2)
            maps.append(torch.where(found >= 0, depth, torch.inf))
        return ShadowMaps(centre, radius, toward, poses, torch.stack(maps))

    def shares(
        self, points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"], grid: ProbeGrid
    ) -> Float[Tensor, "point 3"]:
        """S of each point, by channel: the unshadowed share of its irradiance. 1 far from the mesh."""
        found = torch.ones_like(points)
        away = (points - self.centre).norm(dim=-1)
        near = (self.radius / away.clamp_min(self.radius)) ** 2 > MIN_SHADOW
        basis = kernels.spherical_harmonics(self.toward, grid.order + 1)
        lamps = [x.numpy() for x in (basis, self.toward, self.poses, self.depth)]
        for some in near.nonzero()[:, 0].split(POINTS_PER_CHUNK):
            p, n, left = points[some], normals[some], torch.empty(len(some), 3)
            local = (p - self.centre) / self.radius + NORMAL_OFFSET * n
            given = [x.numpy() for x in (local, n, grid.coefficients(p, n))]
            loops.unshadowed(*given, *lamps, MAP_SCALE, BIAS, left.numpy())
            found[some] = left
        return found


def sphere_points(count: int) -> Float[Tensor, "point 3"]:
    """Unit vectors spread evenly over the sphere (Fibonacci's spiral)."""
    height = 1 - 2 * (torch.arange(count) + 0.5) / count
    angle, rim = torch.arange(count) * (math.pi * (3 - math.sqrt(5))), (1 - height**2).sqrt()
    return torch.stack([rim * angle.cos(), rim * angle.sin(), height], -1)


class LitComposition(Composed):
    """A field and meshes in its light, which cast shadows onto it. Meshes are opaque: a translucent field is in front
    of a mesh or behind it as a whole, by its mean depth."""

    def __init__(self, frame: Frame, parts: Sequence[Placed]):
        super().__init__(frame, parts)
        self.meshes = tuple(part for part in parts if isinstance(part.method, LitMesh))
        self.around = compose(frame, [part for part in parts if not isinstance(part.method, LitMesh)])

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Any]) -> None:
        self.around = self.around.given(**controls)

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        seen, camera = self.around.render(camera).cpu(), camera.to("cpu")
        solid = (seen.opacity > MIN_SURFACE_OPACITY) & seen.depth.isfinite()
        points, normals = surface_of(camera, torch.where(solid, seen.depth, 1e6))
        left = torch.ones(*solid.shape, 3)
        for part in self.meshes:
            method: Any = part.method
            to_grid = method.to_grid @ part.place.inverse
            there = to_grid.points(points[solid]), to_grid.directions(normals[solid])
            left[solid] *= method.shadows.shares(*there, method.grid)
        light = decoded(seen.rgb.clamp(0, 1))
        rgb = torch.where((left < 1).any(-1, keepdim=True), encoded(light * left), seen.rgb)
        depth, opacity = seen.depth, seen.opacity
        for part in self.meshes:
            mesh = part.rendering(camera).cpu()
            front = (mesh.opacity > 0) & ((mesh.depth < depth) | (opacity < MIN_SURFACE_OPACITY))
            cover = torch.where(front, mesh.opacity, 0.0)
            rgb = torch.where(front[..., None], mesh.rgb + (1 - cover)[..., None] * rgb, rgb)
            depth = torch.where(cover > MIN_SURFACE_OPACITY, mesh.depth, depth)
            opacity = cover + (1 - cover) * opacity
        rgb, depth, opacity = (x.to(self.device) for x in (rgb, depth, opacity))
        return Rendering(rgb, depth, opacity)


def surface_of(
    camera: Camera, depth: Float[Tensor, "height width"]
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]:
    """Points of pixels and their normals towards the camera, averaged over neighbours at about the same depth."""
    rays = camera.rays(camera.pixels())
    points = rays.at(depth.reshape(-1)).view(*depth.shape, 3)
    normals = normals_from_depth(points, depth)
    facing = (normals * rays.directions.view_as(points)).sum(-1, keepdim=True)
    normals = torch.where(facing > 0, -normals, normals).permute(2, 0, 1)[None]
    mean = torch.nn.functional.avg_pool2d(normals, NORMAL_WINDOW, 1, NORMAL_WINDOW // 2, count_include_pad=False)
    return points, unit(mean[0].permute(1, 2, 0))
