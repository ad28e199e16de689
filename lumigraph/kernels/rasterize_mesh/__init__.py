"""Rasterising triangles: attributes and depth of the nearest triangle at each pixel's centre."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull
from torch import Tensor

from .._operation import Facts, door, implementation, require, require_indices

FACTS = Facts(unit="triangles", outputs=3, differentiable=(0, 1), typical=3, compiled=3, smooth=(2, 3))

NEAR = 1e-4  # depth at which triangles are cut off


@door
def rasterize_mesh(
    corners: Float[Tensor, "vertex 3"],
    attributes: Float[Tensor, "vertex channel"],
    faces: Int[Tensor, "face 3"],
    size: tuple[int, int],
    near: float = NEAR,
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width"], Int[Tensor, "height width"]]:
    """Attributes, depth and number of the nearest triangle at pixels' centres, in homogeneous coordinates, so that
    triangles that reach behind the camera need no clipping (Olano 1997).

        M = [h_0 h_1 h_2]      the corners of a triangle, h = K x in the camera's frame: pixels times depth, depth
        u = M^-1 (x, y, 1)     at a pixel's centre; inside where all are at least 0
        b = u / sum u          barycentric coordinates, perspective-correct
        z = 1 / sum u          depth; the triangle of least z beyond `near` is visible

    corners: h of each vertex
    faces:   two-sided; a triangle seen edge-on is invisible
    size:    (width, height) of the picture in pixels
    Returns sum b_i attributes_i, sum b_i z_i and the triangle's number (int32), or 0, 0 and -1 where there is none.
    Attributes and depth are differentiable in corners and attributes. Visibility is not: see `antialias`.
    Neighbours leave no gap: a pixel on their common edge belongs to both, and equal depths to the lower number.
    """
    require(min(size) > 0, f"a picture cannot have {size[0]} x {size[1]} pixels")
    require(attributes.shape[1] > 0, "attributes have no channels")
    require_indices("faces", faces.reshape(-1), len(corners))
    return implementation("rasterize_mesh", corners)(corners, attributes, faces.int(), size, near)


def cases(generator: torch.Generator):
    """Test pictures for all engines, without pixels close to an edge or to equal depths."""
    scenes = [(0, (5, 3), 2), (5, (1, 1), 3), (8, (9, 7), 1), (40, (31, 40), 5), (400, (40, 37), 3)]
    for count, size, channels in scenes:
        yield _steady(*ball(count, size, generator), size, channels, generator)
    corners, faces = ball(20, (24, 20), generator)
    soup = corners[faces.reshape(-1)] * (0.6 + 0.8 * torch.rand(len(faces) * 3, 1, generator=generator))
    yield _steady(soup, torch.arange(len(soup)).view(-1, 3), (24, 20), 4, generator)  # through each other
    behind = torch.tensor([[12.0, 8.0, 2.0], [-40.0, 30.0, 1.5], [9.0, -31.0, -1.0], [3.0, 2.0, -2.0]])
    yield _steady(behind, torch.tensor([[0, 1, 2], [2, 1, 3], [0, 2, 3]]), (17, 9), 2, generator)
    flat = torch.cat([corners, torch.tensor([[0.0, 0.0, 3.0], [30.0, 30.0, 3.0], [60.0, 60.0, 3.0]])])
    none = torch.tensor([[0, 0, 1], [len(corners), len(corners) + 1, len(corners) + 2]])  # without any area
    yield _steady(flat, torch.cat([faces, none]), (24, 20), 1, generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A square picture of `size` pixels with six attributes: a ball with one triangle for every 8 pixels."""
    width = round(size**0.5)
    corners, faces = ball(size // 16, (width, width), generator)
    attributes = torch.rand(len(corners), 6, generator=generator)
    return corners.requires_grad_(), attributes.requires_grad_(), faces, (width, width)


def ball(count: int, size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Projected corners of `count` vertices, and faces, of a closed, dented ball that fills most of a picture."""
    height = 1 - 2 * (torch.arange(count) + 0.5) / max(count, 1)
    angle, rim = torch.arange(count) * 2.399963, (1 - height**2).sqrt()  # golden angle
    points = torch.stack([rim * angle.cos(), rim * angle.sin(), height], -1)
    faces = torch.zeros(0, 3, dtype=torch.int64)
    if count:
        faces = torch.from_numpy(ConvexHull(points.numpy()).simplices).long()
        a, b, c = points[faces].unbind(1)
        outward = (torch.linalg.cross(b - a, c - a) * a).sum(-1, keepdim=True) > 0
        faces = torch.where(outward, faces, faces.flip(-1))
    dents = (4 * points + 6.3 * torch.rand(3, generator=generator)).sin().prod(-1, keepdim=True)
    x, y, depth = (points * (1 - 0.4 * dents)).unbind(-1)
    depth, focal = 0.8 * depth + 3, 1.4 * min(size)
    return torch.stack([focal * x + size[0] / 2 * depth, focal * y + size[1] / 2 * depth, depth], -1), faces


def _steady(corners, faces, size, channels, generator):
    """The scene, shifted until no pixel's centre lies on an edge and no two triangles have equal depth at one."""
    from .reference import planes

    attributes = torch.rand(len(corners), channels, generator=generator)
    width, height = size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x.flatten(), y.flatten(), torch.ones(width * height)], -1).double()
    while True:
        moved = corners + 0.3 * torch.rand(3, generator=generator) * torch.tensor([1.0, 1.0, 0.0]) * corners[:, 2:]
        matrix, steep = planes(moved.double()[faces])
        u = (matrix @ pixels.T).where(steep[:, None, None], -1.0)
        w = u.sum(1)
        # An edge's distance in pixels is u over its slope.
        off = u / matrix[..., :2].norm(dim=-1, keepdim=True).clamp_min(1e-12)
        on_edge = ((off.abs() < 3e-4) & (off.amin(1, keepdim=True) > -1e-2)).any()
        two = w.where(u.amin(1) >= 0, 0).topk(min(2, len(w)), 0).values if len(w) else w
        tie = len(two) == 2 and bool(((two[0] - two[1]) < 1e-4 * two[0]).logical_and(two[0] > 0).any())
        if not on_edge and not tie:
            return moved, attributes, faces, size
