"""Evaluate a trained method's surface against its training shapes, under a stated protocol."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from ..camera import Camera, dome, ring
from ..camera.crop import CropBox
from ..datasets.mesh import Mesh
from ..datasets.scene import Frame
from ..datasets.shapes import Shape, Shapes
from ..errors import LumigraphError
from ..export.mesh import POINTS_PER_CHUNK, extract_mesh, find_surface, from_distance, make_grid
from ..export.options import MeshOptions
from ..figures import Row, contact_sheet
from ..geometry import evenly
from ..method import Method
from ..method.capabilities import HasDistance, HasMesh, can, needs
from ..metrics import Score, chamfer_distance, intersection_over_union, normal_consistency
from ..system.progress import track
from ..system.work import at_work
from .baseline import in_hull
from .options import EvaluationOptions
from .views import reveal

POINTS = 100_000  # in the volume, and on each surface (Mescheder 2019)
CELLS = 128  # along the longest side, of the grid that the surface is found with
SHEET_SHAPES, PICTURE_SIZE = 8, 256  # shapes of the contact sheet, and pixels of their pictures
# Steps of a ray towards a surface; distances in scene units at which it meets the surface, and beyond which it misses.
STEPS, TOUCHING_DISTANCE, MAX_OVERSHOOT = 200, 2e-3, 6.0


@dataclass(frozen=True)
class ShapeScore:
    """Scores of one shape. iou is None for a point cloud, which has no inside; normals if it has none.

    baselines: IoU of trivial stand-ins, see `baseline`
    """

    name: str
    chamfer: float
    accuracy: float
    completeness: float
    iou: float | None
    normals: float | None
    baselines: dict[str, float] = field(default_factory=dict)

    @property
    def scores(self) -> list[Score]:
        found = [
            ("IoU", self.iou, "higher"),
            ("chamfer-L1", self.chamfer, "lower"),
            ("normal consistency", self.normals, "higher"),
        ]
        return [Score(name, value, "", better) for name, value, better in found if value is not None]  # type: ignore[arg-type]


@dataclass(frozen=True)
class ShapesEvaluation:
    """Scores of all shapes of a split, and the protocol. shown: some shapes' pictures: true, learnt, rendered"""

    shapes: list[ShapeScore]
    protocol: dict[str, Any]
    shown: dict[str, list[Float[Tensor, "height width 3"]]]
    members: tuple[ShapesEvaluation, ...] = ()  # of a collection, whose means are averaged

    @property
    def scores(self) -> list[Score]:
        """Means over the shapes, or members, that have each."""
        every = [score for each in self.members or self.shapes for score in each.scores]
        by_name = {score.name: [other.value for other in every if other.name == score.name] for score in every}
        return [
            Score(name, sum(values) / len(values), "", next(x.better for x in every if x.name == name))
            for name, values in by_name.items()
        ]

    @property
    def baselines(self) -> dict[str, float]:
        """Means of the baselines, where all shapes, or members, have them."""
        every = [each.baselines for each in self.members or self.shapes]
        return {
            name: float(np.mean([one[name] for one in every])) for name in every[0] if all(name in x for x in every)
        }

    @property
    def compared(self) -> str:
        count = len(self.shapes)
        return f"{count} shape{'' if count == 1 else 's'}"

    def to_json(self) -> dict[str, Any]:
        return {
            "scores": [score.to_json() for score in self.scores],
            **({"baselines": self.baselines} if self.baselines else {}),
            "protocol": self.protocol,
            "shapes": [asdict(shape) for shape in self.shapes],
        }

    def contact_sheet(self, title: str) -> Image.Image:
        """Normals of the true and of the learnt surface of some shapes, and the method's renderings."""
        about = {shape.name: shape for shape in self.shapes}
        rows = []
        for name, pictures in self.shown.items():
            label = " · ".join([name, *(f"{score.name} {score}" for score in about[name].scores)])
            rows.append(Row(label, pictures))
        return contact_sheet(title, ["shape", "learnt", "rendering"], rows)


@torch.no_grad()
@at_work()
def evaluate_shapes(
    method: Method,
    shapes: Shapes,
    options: EvaluationOptions = EvaluationOptions(),
    points: int = POINTS,
    cells: int = CELLS,
    size: int = PICTURE_SIZE,
) -> ShapesEvaluation:
    """Compare a method's surface with the shapes of a split, each in its own scene units.

    points: in the volume, and on each surface
    cells:  along the longest side of the box of surface extraction
    size:   pixels of the pictures
    With several shapes, a method that accepts Shapes gets each as evidence first. Raises LumigraphError for a split
    without shapes, and for a method without a surface.
    """
    split, most = options.split, options.views
    chosen = shapes.splits.get(split)
    if chosen is None or not len(chosen):
        raise LumigraphError(f"{shapes.source} has no shapes in the split {split!r}; choose one of: train, test")
    if most is not None and most < 1:
        raise LumigraphError(f"{most} shapes cannot be compared; give --views a number above 0")
    compared = evenly(chosen.tolist(), most or len(chosen))
    method.eval()
    shown, scores = set(evenly(compared, SHEET_SHAPES)), []
    pictured: dict[str, list[Tensor]] = {}
    for number in track(compared, "Comparing shapes", len(compared)):
        true = shapes.members[number]
        single = Shapes([true], {"train": torch.tensor([0])}, shapes.source)
        told = reveal(method, single) if len(shapes) > 1 else method
        learnt = Shape(true.name, surface_of(told, true.frame, cells), true.frame)
        scores.append(compare_shapes(true, learnt, told, points))
        if number in shown:
            camera = ring(true.frame.bounds, size=size)[1]
            rendering = told.render(camera).rgb.cpu().clamp(0, 1)
            pictured[true.name] = [portrait(true, camera), portrait(learnt, camera), rendering]
    return ShapesEvaluation(scores, protocol(shapes, split, compared, points, cells), pictured)


def compare_shapes(true: Shape, learnt: Shape, method: object, points: int) -> ShapeScore:
    """Compare a shape with the learnt one. A method's distances, if it has them, determine what is inside."""
    generator = torch.Generator().manual_seed(0)
    a, b = learnt.surface(points, generator), true.surface(points, generator)
    size = float(np.ptp(true.mesh.vertices, 0).max())
    chamfer, accuracy, completeness = chamfer_distance(a.points, b.points, size)
    iou, normals, baselines = None, None, dict[str, float]()
    if not true.is_cloud:
        low, high = torch.tensor(true.frame.bounds)
        places = low + (high - low) * torch.rand(points, 3, generator=generator)
        inside = distances(method, places) < 0 if can(method, HasDistance) else learnt.inside(places)
        solid, hull = true.inside(places), in_hull(true.mesh.vertices, places)
        iou = intersection_over_union(inside, solid)
        baselines = {} if hull is None else {"convex hull": intersection_over_union(hull, solid)}
    if a.normals is not None and b.normals is not None:
        normals = normal_consistency(a.points, a.normals, b.points, b.normals)
    return ShapeScore(true.name, chamfer, accuracy, completeness, iou, normals, baselines)


def surface_of(method: Method, frame: Frame, cells: int) -> Mesh:
    """Surface of a method: its own mesh, the zero level of its distance, or that of `export mesh`. Raises
    LumigraphError for an empty one."""
    if can(method, HasMesh):
        return needs(method, HasMesh).mesh()
    box = CropBox(*frame.bounds)
    cell = max(b - a for a, b in zip(box.lower, box.upper, strict=True)) / cells
    if not can(method, HasDistance):
        options = MeshOptions(cell_size=cell * method.frame.to_export.scale, smooth=0)
        return extract_mesh(method, dome(ring(frame.bounds)), options)

    vertices, faces = find_surface(make_grid(box, cell), 2, box.holds, from_distance(method, cell), -1.0)
    if not len(faces):
        raise LumigraphError("The learnt distance is nowhere zero, so there is no surface to compare; train for longer")
    return Mesh(vertices, faces, np.full((len(vertices), 3), 160, np.uint8))


def distances(method: Any, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
    """A method's distances, evaluated on its device in chunks."""
    return torch.cat([method.distance(part.to(method.device)).cpu().float() for part in points.split(POINTS_PER_CHUNK)])


def portrait(shape: Shape, camera: Camera) -> Float[Tensor, "height width 3"]:
    """The normals of a surface as colours."""
    width, height = camera.size[0].tolist()
    points, hit = seen_points(shape, camera)
    rgb = torch.ones(len(hit), 3)
    rgb[hit] = 0.5 + 0.5 * shape.normals_near(points)
    return rgb.reshape(height, width, 3)


def seen_points(shape: Shape, camera: Camera) -> tuple[Float[Tensor, "hit 3"], Bool[Tensor, " pixel"]]:
    """Visible surface points of a camera, by sphere tracing (Hart 1996), and a mask of pixels that hit."""
    rays = camera.rays(camera.pixels())
    depth, walking = torch.zeros(len(rays)), torch.arange(len(rays))
    for _ in range(STEPS):
        away = shape.distance(rays[walking].at(depth[walking])).abs()
        depth[walking] += away
        walking = walking[(away > TOUCHING_DISTANCE) & (depth[walking] < MAX_OVERSHOOT)]
    depth[walking] = MAX_OVERSHOOT  # rays along the surface, undecided
    hit = depth < MAX_OVERSHOOT
    return rays[hit].at(depth[hit]), hit


def protocol(shapes: Shapes, split: str, compared: list[int], points: int, cells: int) -> dict[str, Any]:
    """Protocol: everything needed to compare these figures with others."""
    return {
        "split": split,
        "shapes": len(compared),
        "of": len(shapes.splits[split]),
        "surface": f"marching cubes, {cells} cells along the longest side of the box of interest; a mesh as it is",
        "iou": f"{points} points evenly in the box of interest; inside: negative distance, or winding number > 0.5",
        "chamfer-L1": f"{points} points on each surface; mean of accuracy and completeness, tenths of the longest side",
        "normal consistency": "the same points; mean |cosine| to the nearest one on the other surface, both ways",
        "source": "Mescheder 2019, Occupancy Networks",
    }
