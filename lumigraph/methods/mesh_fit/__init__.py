"""Mesh fitting: triangles fitted to photographs by gradients, in large steps (Nicolet et al. 2021)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
import trimesh
from scipy.ndimage import gaussian_filter
from torch import Tensor

from ...budget import BY_PHOTOGRAPH, Efforts
from ...camera import Camera
from ...camera.rays import Rendering
from ...color.blending import over
from ...components.fields.level_set import level_set
from ...components.fields.mesh_picture import Picture, picture
from ...components.image_based.depth import HULL_BLUR, hull_surface
from ...components.training.schedules import falling
from ...datasets.mesh import Mesh
from ...datasets.scene import Frame, Photograph, Scene
from ...depth_maps import TSDF, Tolerance, fused_colours, render_depth_maps
from ...errors import LumigraphError
from ...files.ranges import LearningRate, NonNegative, Share, between
from ...method import BaseConfig, Method
from ...method.capabilities import HasMesh, can, needs
from ...system.work import at_work
from .optimizer import UniformAdam
from .surface import MeshSurface, face_normals, remeshed, vertex_normals

MASK_WEIGHT = 1.0  # weight of the silhouettes' absolute error


@dataclass(frozen=True)
class Config(BaseConfig):
    """Numbers of the paper's experiments; colours and weights of terms are ours, for it fits to shaded pictures."""

    start: Literal["sphere", "hull"] = "sphere"  # first mesh: a sphere, or the hull of the photographs' silhouettes
    smoothness: NonNegative = 19.0  # lambda of I + lambda L, eq. 9; larger moves more of the surface at once
    learning_rate: LearningRate = 0.3  # of u, in scene units; larger is faster, and folds the mesh
    final_learning_rate: LearningRate = 0.03  # at the end of the budget; smaller settles finer detail
    colour_learning_rate: LearningRate = 0.03  # of the vertices' colours
    first_cells: Annotated[int, between(8, 256)] = 64  # cells of first triangles along the longest side
    cells: Annotated[int, between(8, 512)] = 128  # of the last ones; more show more detail, and cost time and noise
    remeshings: Annotated[int, between(0, 20)] = 2  # from the first to the last; 0 keeps the first triangles
    remeshing_until: Share = 0.6  # share of the budget in which they happen
    views_per_step: Annotated[int, between(1, 64)] = 8  # photographs of a step; more are steadier, and cost time
    laplacian_weight: NonNegative = 0.0  # of |L x|^2 over squared edges; larger is smoother
    normal_weight: NonNegative = 0.0  # of 1 - cosine between neighbours' normals; larger is flatter

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.cells < self.first_cells:
            raise LumigraphError("The last triangles cannot be larger than the first; give --cells more")


SOURCES = {  # of the numbers of `paper`; the others are ours
    "rgl-epfl/large-steps-pytorch, figures/comparison/generate_data.py (1d72dc4)": (
        "start smoothness laplacian_weight normal_weight"
    ),
}
SPHERE_RADIUS = 0.5  # of half the box of interest along each axis
HULL_FINER = 2  # cells of the hull for one of the first mesh
TEACHER_VIEWS, TEACHER_SIZE = 32, 200  # depth maps of a teacher, and pixels of their longer side
NEAR_PLANE_SCALE = 0.1  # of the scene's near distance
SOLID = (0.5, 0.5, 0.5)  # grey of a mesh that no photograph has coloured


@dataclass(frozen=True)
class Views:
    """Photographs of one step."""

    unit: ClassVar[str] = "rays"

    photographs: Sequence[Photograph]

    def __len__(self) -> int:
        return sum(map(len, self.photographs))


class MeshFit(Method):
    """One mesh with a colour at each vertex. It covers no background: photographs need alpha, or a plain one."""

    Config = Config
    efforts: ClassVar[Efforts] = BY_PHOTOGRAPH
    remeshings: Tensor  # done so far

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.surface = MeshSurface(sphere(frame, c.first_cells), c.smoothness)
        self.register_buffer("remeshings", torch.tensor(0))
        self._optimizers: tuple[torch.optim.Optimizer | None, ...] = (None, None)

    @classmethod
    def cpu_preset(cls) -> Any:
        """From the hull, with a photograph or two a step and a little smoothness against the noise of that."""
        return Config(start="hull", first_cells=48, cells=80, views_per_step=2, learning_rate=6e-2,
            final_learning_rate=6e-3, colour_learning_rate=0.1, laplacian_weight=0.01, normal_weight=0.02)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Some hundred triangles that are remeshed once."""
        return Config(first_cells=16, cells=18, remeshings=1, remeshing_until=0.5, views_per_step=2, learning_rate=3e-2,
            final_learning_rate=3e-3, colour_learning_rate=0.2, laplacian_weight=0.01, normal_weight=0.01)  # fmt: skip

    @property
    def near_plane(self) -> float:
        """Depth at which triangles are cut off."""
        return NEAR_PLANE_SCALE * self.frame.near

    # First mesh

    def compile_begin(self) -> None:
        super().compile_begin()
        remeshed(sphere(self.frame, 8), 8)

    def check_data(self, data: Scene) -> None:
        if data.frame.is_open:
            raise LumigraphError(
                "mesh-fit fits one closed surface, and this capture goes on to the horizon; train a radiance field, "
                "or cut the photographs out and give them an alpha channel"
            )

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        if self.config.start == "hull" and data.images.has_alpha:
            self._begin_with(hull(data, self.config.first_cells))

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Begin with the teacher's mesh, or the surface that its depth maps are fused to."""
        c = self.config
        if can(teacher, HasMesh):
            self._begin_with(needs(teacher, HasMesh).mesh())
        else:
            self._begin_with(surface_of(teacher, cameras, c.first_cells))
        self.remeshings.fill_(0)

    def _begin_with(self, mesh: Mesh) -> None:
        self.surface.replace(mesh, self._optimizers)

    # Learning

    def steps_per_pass(self, data: Any) -> float:
        return len(data.splits["train"]) / self.config.views_per_step

    def batch(self, data: Scene, generator: torch.Generator) -> Views:
        """Photographs without repetition, at random."""
        train = data.splits["train"]
        chosen = torch.randperm(len(train), generator=generator)[: self.config.views_per_step]
        return Views([data.photograph(int(i)).to(self.device) for i in train[chosen]])

    def loss(self, batch: Views, step: int) -> dict[str, Tensor]:
        """Absolute errors of colours and silhouettes, and the terms that keep triangles even."""
        c, surface = self.config, self.surface
        vertices, rgb, background = surface.vertices(), surface.rgb(), self.background[0]
        colour, silhouette, square = [], [], []
        for photograph in batch.photographs:
            seen = self._picture(vertices, rgb, photograph.camera)
            found, target = over(seen.values, seen.opacity, background), photograph.before(background)
            error = photograph.trusted(found - target)
            colour.append(error.abs().mean())
            square.append(error.detach().square().mean())
            if photograph.alpha is not None:
                off = (seen.opacity - photograph.alpha).abs()
                silhouette.append((off if photograph.mask is None else off[photograph.mask]).mean())
        terms = {"colour": torch.stack(colour).mean()}
        if silhouette:
            terms["mask"] = MASK_WEIGHT * torch.stack(silhouette).mean()
        if c.laplacian_weight:
            terms["laplacian"] = c.laplacian_weight * surface.roughness(vertices)
        if c.normal_weight:
            normals = torch.nn.functional.normalize(face_normals(vertices, surface.faces), dim=-1)
            terms["normals"] = c.normal_weight * surface.bending(normals)
        self.figures = {"mse": float(torch.stack(square).mean()), "triangles": len(surface.faces)}
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        """The paper's Adam for vertices, with one step length for all of them; Adam for colours."""
        places = UniformAdam([{"params": [self.surface.places], "name": "places"}])
        colours = torch.optim.Adam([{"params": [self.surface.colours], "name": "colours"}])
        self._optimizers = places, colours
        return [places, colours]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c = self.config
        return {
            "places": falling(c.learning_rate, c.final_learning_rate, progress),
            "colours": falling(c.colour_learning_rate, 0.1 * c.colour_learning_rate, progress),
        }

    def before_step(self, step: int, progress: float) -> None:
        """Remesh at even shares of the budget, each time with smaller triangles."""
        super().before_step(step, progress)
        c = self.config
        due = min(c.remeshings, int(progress / max(c.remeshing_until, 1e-9) * (c.remeshings + 1)))
        if due > int(self.remeshings):
            cells = round(c.first_cells * (c.cells / c.first_cells) ** (due / c.remeshings))
            self.surface.replace(remeshed(self.surface.mesh(), cells), self._optimizers)
            self.remeshings.fill_(due)

    # Rendering

    def _picture(self, vertices: Tensor, attributes: Tensor, camera: Camera) -> Picture:
        surface = self.surface
        return picture(vertices, attributes, surface.faces, surface.neighbours, camera, self.near_plane)

    @at_work()
    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        camera, vertices = camera.to(self.device), self.surface.vertices()
        normals = vertex_normals(vertices, self.surface.faces)
        seen = self._picture(vertices, torch.cat([self.surface.rgb(), normals], -1), camera)
        rgb, normals = seen.values.split(3, -1)
        depth = torch.where(seen.opacity > 0, seen.depth, torch.inf)
        normals = torch.nn.functional.normalize(normals, dim=-1)
        return Rendering(over(rgb, seen.opacity, self.background[0]), depth, seen.opacity, {"normals": normals})

    def mesh(self) -> Mesh:
        """The mesh in the scene's frame."""
        return self.surface.mesh()


def sphere(frame: Frame, cells: int) -> Mesh:
    """An ellipsoid in the middle of the box of interest, with triangles of about a cell."""
    low, high = (np.array(corner) for corner in frame.bounds)
    subdivisions = max(1, round(math.log2(max(cells, 8) * SPHERE_RADIUS * math.pi / 2 / 2.5)))
    ball = trimesh.creation.icosphere(subdivisions)
    vertices = 0.5 * (low + high) + SPHERE_RADIUS * 0.5 * (high - low) * ball.vertices
    grey = np.broadcast_to(np.array(SOLID) * 255, vertices.shape).astype(np.uint8)
    return Mesh(vertices, np.asarray(ball.faces, np.int64), grey)


def hull(scene: Scene, cells: int) -> Mesh:
    """The visual hull of photographs with alpha, its stairs smoothed. Raises LumigraphError where nothing is left."""
    resolution = 1 << max(5, math.ceil(math.log2(HULL_FINER * cells * 2 / box_side(scene.frame))))
    if (made := hull_surface(scene, resolution)) is None:
        raise LumigraphError(
            "No part of the box is opaque in all photographs, so there is no silhouettes' hull; check poses and alpha, "
            "or give --start sphere"
        )
    return remeshed(made, cells)


def surface_of(teacher: Any, cameras: Camera, cells: int) -> Mesh:
    """Surface of a method's fused depth maps with its colours, closed in regions that no camera sees."""
    frame = teacher.frame
    maps = render_depth_maps(teacher.render, cameras, frame.background, TEACHER_VIEWS, TEACHER_SIZE)
    low, high = (np.array(corner) for corner in frame.bounds)
    cell = box_side(frame) / cells
    shape = [math.ceil(side / cell) + 1 for side in high - low]
    places = torch.from_numpy(low + cell * np.argwhere(np.ones(shape, bool))).float()
    distance, _, pictured = TSDF(maps, Tolerance(3 * cell))(places)
    value = torch.where(distance.isnan(), torch.where(pictured, 1.0, -1.0), -distance).view(shape).numpy()
    if not value.min() < 0 < value.max():
        raise LumigraphError("The teacher shows no surface inside the box, so no mesh can begin; train it for longer")
    made = level_set(gaussian_filter(value, HULL_BLUR), low, cell)
    points = torch.from_numpy(made.vertices).float()
    normals = vertex_normals(points, torch.from_numpy(made.faces))
    rgb = fused_colours(points, normals, maps, Tolerance(3 * cell))
    return replace(made, colours=(rgb * 255).round().to(torch.uint8).numpy())


def box_side(frame: Frame) -> float:
    """Longest side of the box of interest."""
    return max(b - a for a, b in zip(*frame.bounds, strict=True))
