"""Antialiasing of a mesh's silhouettes: neighbouring pixels blend where an edge passes between their centres."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .._operation import Facts, door, implementation, require, require_indices, using
from ..rasterize_mesh import ball, rasterize_mesh

FACTS = Facts(unit="pixels", outputs=1, differentiable=(0, 3), typical=3, compiled=3, smooth=(1, 2), unit_axes=2)

MAX_FACES = 64  # triangles that a walk from one pixel to the next crosses at most


@door
def antialias(
    picture: Float[Tensor, "height width channel"],
    depth: Float[Tensor, "height width"],
    found: Int[Tensor, "height width"],
    corners: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    neighbours: Int[Tensor, "face 3"],
) -> Float[Tensor, "height width channel"]:
    """Picture of `rasterize_mesh` whose pixels blend across silhouettes, so that gradients reach the vertices there
    (Laine 2020, section 3.6).

    For two neighbouring pixels A and B (left and right, or above and below) with different triangles, the nearer
    surface is followed from triangle to triangle towards the other pixel's centre. It ends at a boundary or silhouette
    edge. With s the distance from the middle between A and B to that edge,

        B += s (A - B)  for s > 0      A's surface reaches into B
        A += s (A - B)  for s < 0      B's surface reaches into A

    Edges steeper than 45 degrees are used for pixels side by side, all others for pixels above each other. So the
    sum over a picture is the area that a surface covers, and its gradient the area that moving edges sweep. Following
    the surface finds edges of triangles without a pixel's centre inside; Laine 2020 looks at one triangle alone.

    depth, found: of `rasterize_mesh` for the same corners and faces
    neighbours:   of `neighbours`
    Returns the picture; differentiable in picture and corners.
    """
    require(faces.shape == neighbours.shape, "each face needs three neighbours")
    for name, indices, count in ("faces", faces, len(corners)), ("found", found + 1, len(faces) + 1):
        require_indices(name, indices.reshape(-1), count)
    require_indices("neighbours", neighbours.reshape(-1) + 1, len(faces) + 1)
    given = depth, found.int(), corners, faces.int(), neighbours.int()
    return implementation("antialias", picture)(picture, *given)


def neighbours(faces: Int[Tensor, "face 3"]) -> Int[Tensor, "face 3"]:
    """Triangle across the edge opposite each corner, int32; -1 for none or more than one."""
    edges = torch.stack([faces.roll(-1, 1), faces.roll(-2, 1)], -1).reshape(-1, 2).long().sort(-1).values
    _, number, count = edges.unique(dim=0, return_inverse=True, return_counts=True)
    order = number.argsort()
    pairs = order[(count[number] == 2)[order]].view(-1, 2)
    found = torch.full((faces.numel(),), -1, dtype=torch.int32, device=faces.device)
    found[pairs[:, 0]], found[pairs[:, 1]] = (pairs[:, 1] // 3).int(), (pairs[:, 0] // 3).int()
    return found.view(-1, 3)


def cases(generator: torch.Generator):
    """Test pictures for all engines: no triangles, few large ones, many less than a pixel, a soup."""
    scenes = [(0, (5, 3), 2), (12, (9, 7), 1), (30, (16, 12), 3), (60, (19, 27), 4), (700, (12, 12), 2)]
    for count, size, channels in scenes:
        yield _picture(*ball(count, size, generator), size, channels, generator)
    corners, faces = ball(40, (24, 20), generator)
    soup = corners[faces.reshape(-1)] * (0.6 + 0.8 * torch.rand(len(faces) * 3, 1, generator=generator))
    yield _picture(soup, torch.arange(len(soup)).view(-1, 3), (24, 20), 2, generator)
    two = torch.cat([corners, corners * torch.tensor([0.9, 1.1, 1.2])]), torch.cat([faces, faces + len(corners)])
    yield _picture(*two, (24, 20), 2, generator)
    behind = torch.tensor([[12.0, 8.0, 2.0], [-40.0, 30.0, 1.5], [9.0, -31.0, -1.0], [3.0, 2.0, -2.0]])
    yield _picture(behind, torch.tensor([[0, 1, 2], [2, 1, 3], [0, 2, 3]]), (17, 9), 2, generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A square picture of `size` pixels with six channels: a ball with one triangle for every 8 pixels."""
    width = round(size**0.5)
    corners, faces = ball(size // 16, (width, width), generator)
    picture, *given = _picture(corners, faces, (width, width), 6, generator, "cpu")
    given[2].requires_grad_()
    return picture.requires_grad_(), *given


def _picture(corners, faces, size, channels, generator, engine="reference"):
    """Randomly coloured triangles over a random background."""
    with using(engine):
        _, depth, found = rasterize_mesh(corners, corners, faces, size)
    colours = torch.rand(len(faces) + 1, channels, generator=generator)
    return colours[found.long()].contiguous(), depth, found, corners, faces, neighbours(faces)
