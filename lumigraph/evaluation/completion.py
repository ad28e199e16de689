"""Shape completion of held-out shapes from partial evidence, compared with retrieval of the best training shape."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera, ring
from ..components.sampling.coded_surface import CodedSurface, Evidence
from ..datasets.mesh import Mesh
from ..datasets.scene import Photograph
from ..datasets.shapes import Shape, Shapes
from ..datasets.shapes.pictures import picture_of
from .shapes import ShapeScore, compare_shapes, seen_points, surface_of

SCAN_SIZE, SCAN_CAMERA = 128, 3  # pixels of the camera that scans a shape, and its number among a ring's
CLOUD_POINTS = 300  # points of a cloud as evidence (Mescheder 2019, section 4.3)
AWAY_COSINE = -0.3  # between a scanned normal and the way to the camera below which its face is turned
PICTURE_SIZE, PICTURE_VIEWS = 64, 24  # pixels of a picture, and views of training shapes that it is compared with
RETRIEVAL_POINTS = 2000  # points of each training shape that a cloud is compared with


@dataclass(frozen=True)
class Known:
    """Evidence of a shape. piece: input of `Method.given`; points: of the surface, if it has them"""

    kind: Evidence
    piece: Shapes | Photograph
    points: Float[Tensor, "point 3"] | None = None


@dataclass(frozen=True)
class Completed:
    """Scores of a held-out shape, by a method or by retrieval, and seconds of inference."""

    by: str
    evidence: Evidence
    score: ShapeScore
    seconds: float


def known_of(shape: Shape, kind: Evidence, generator: torch.Generator) -> Known:
    """Evidence of a shape: itself; the points and normals that one camera sees; 300 points; or one picture.

    Points are in the frame of the whole shape, as in the papers: its place and size are known.
    """
    if kind == "picture":
        return Known(kind, picture_of(shape, camera_of(shape), generator))
    if kind == "mesh":
        surface = shape.surface(RETRIEVAL_POINTS, generator).points
        return Known(kind, Shapes([shape], single(), shape.name), surface)
    if kind == "points":
        points, normals = shape.surface(CLOUD_POINTS, generator).points, None
    else:
        camera = ring(shape.frame.bounds, size=SCAN_SIZE)[SCAN_CAMERA]
        points, _ = seen_points(shape, camera)
        facing = shape.normals_near(points)  # turned as a scanner gives them: faces of a mesh may look away
        towards = torch.nn.functional.normalize(camera.position - points, dim=-1)
        away = (facing * towards).sum(-1, keepdim=True) < AWAY_COSINE
        normals = torch.where(away, -facing, facing).double().numpy()
    mesh = Mesh(points.double().numpy(), np.zeros((0, 3), np.int64), np.full((len(points), 3), 160, np.uint8))
    cloud = Shape(shape.name, mesh, shape.frame, normals)
    return Known(kind, Shapes([cloud], single(), shape.name), points)


def single() -> dict[str, Tensor]:
    return {"train": torch.tensor([0])}


def camera_of(shape: Shape) -> Camera:
    """Camera of the picture, between those of training pictures."""
    return ring(shape.frame.bounds, size=PICTURE_SIZE, count=2 * PICTURE_VIEWS + 1)[PICTURE_VIEWS // 3]


class Retrieval:
    """Retrieval of the training shape nearest to evidence, by mean distance of points or grey of a picture."""

    def __init__(self, shapes: Shapes):
        self.members = [shapes.members[i] for i in shapes.splits["train"].tolist()]

    def nearest(self, known: Known) -> Shape:
        errors = [self._error(number, known) for number in range(len(self.members))]
        return self.members[int(np.argmin(errors))]

    def _error(self, number: int, known: Known) -> float:
        if isinstance(known.piece, Photograph):
            return float((self._pictures[number] - seen(known.piece)).square().mean((1, 2)).min())
        assert known.points is not None
        error = float(self.members[number].distance(known.points).abs().mean())
        if known.kind == "half scan":  # which says nothing of the other half
            return error
        return error + float(torch.cdist(self._points[number], known.points).amin(1).mean())

    @cached_property
    def _points(self) -> list[Float[Tensor, "point 3"]]:
        generator = torch.Generator().manual_seed(0)
        return [member.surface(RETRIEVAL_POINTS, generator).points for member in self.members]

    @cached_property
    def _pictures(self) -> list[Float[Tensor, "view height width"]]:
        generator, found = torch.Generator().manual_seed(0), []
        for member in self.members:
            cameras = ring(member.frame.bounds, size=PICTURE_SIZE, count=PICTURE_VIEWS)
            found.append(torch.stack([seen(picture_of(member, cameras[i], generator)) for i in range(len(cameras))]))
        return found


def seen(picture: Photograph) -> Float[Tensor, "height width"]:
    return picture.before((1.0, 1.0, 1.0)).mean(-1)


def completions(
    named: Sequence[tuple[str, Any]], shapes: Shapes, members: Sequence[int], points: int, cells: int
) -> Iterator[Completed]:
    """Each held-out member completed by methods from every kind of evidence they accept, and by retrieval.

    named:  methods by name, trained on the shapes; others than CodedSurface are skipped
    points: number of compared points in the volume and on each surface
    cells:  of the grid of surface extraction
    """
    priors = [(name, method.eval()) for name, method in named if isinstance(method, CodedSurface)]
    kinds = dict.fromkeys(kind for _, method in priors for kind in method.taken_kinds)
    retrieval = Retrieval(shapes)
    for number in members:
        true = shapes.members[number]
        for kind in kinds:
            known = known_of(true, kind, torch.Generator().manual_seed(number))
            begin = time.perf_counter()
            found = replace(retrieval.nearest(known), frame=true.frame)
            seconds = time.perf_counter() - begin
            yield Completed("retrieval", kind, compare_shapes(true, found, object(), points), seconds)
            for name, method in priors:
                if kind not in method.taken_kinds:
                    continue
                begin = time.perf_counter()
                told = method.given(known.piece)
                seconds = time.perf_counter() - begin
                told.frame = true.frame
                learnt = Shape(true.name, surface_of(told, true.frame, cells), true.frame)
                yield Completed(name, kind, compare_shapes(true, learnt, told, points), seconds)
