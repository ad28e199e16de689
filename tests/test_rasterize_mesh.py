"""Rasterising and antialiasing of meshes: planes seen through a camera, areas that edges sweep, finite differences."""

from __future__ import annotations

import pytest
import torch
from budgets import budget
from scipy.spatial import Delaunay

from lumigraph.kernels import antialias, neighbours, rasterize_mesh

pytestmark = budget("kernels", 4)

SIZE = (40, 32)


def fan(sides: int, radius: float, depth: float = 2.0, inside: int = 0, seed: int = 0):
    """Projected corners and faces of a flat polygon around the picture's middle, of (inside) further vertices."""
    generator = torch.Generator().manual_seed(seed)
    angle = torch.arange(sides) / sides * 2 * torch.pi + 0.3
    rim = radius * torch.stack([angle.cos(), angle.sin()], -1)
    points = torch.cat([rim, 0.9 * radius * (torch.rand(inside, 2, generator=generator) - 0.5)])
    corners = torch.cat([points + torch.tensor(SIZE) / 2, torch.ones(len(points), 1)], -1) * depth
    return corners, torch.from_numpy(Delaunay(points.double().numpy()).simplices).long()


def seen(corners, faces, colours):
    """Antialiased picture of coloured vertices."""
    picture, depth, found = rasterize_mesh(corners, colours, faces, SIZE)
    return antialias(picture, depth, found, corners, faces, neighbours(faces))


def shifts(count: int, seed: int = 1):
    """Movements of a mesh by parts of a pixel, in homogeneous coordinates of depth 1."""
    random = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.pad(random, (0, 1))


def test_attributes_and_depth_of_a_tilted_plane_are_those_of_its_points():
    """Interpolation is linear in space, not on the picture."""
    points = torch.tensor([[-2.0, -2, 2], [3, -2, 5], [0, 4, 3]])
    inward = torch.tensor([[20.0, 0, 20], [0, 20, 16], [0, 0, 1]])
    values, depth, found = rasterize_mesh(points @ inward.T, points, torch.tensor([[0, 1, 2]]), SIZE)
    row, column = (found >= 0).nonzero().unbind(-1)
    ray = torch.stack([(column + 0.5 - 20) / 20, (row + 0.5 - 16) / 20, torch.ones(len(row))], -1)
    normal = torch.linalg.cross(points[1] - points[0], points[2] - points[0])
    z = (points[0] @ normal) / (ray @ normal)
    assert len(z) > 200
    torch.testing.assert_close(depth[row, column], z)
    torch.testing.assert_close(values[row, column], z[:, None] * ray, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("inside", [0, 30, 3000], ids=["large", "pixels", "tenth of a pixel"])
def test_sums_are_areas_and_gradients_the_areas_that_edges_sweep(inside):
    """Of a polygon, in the mean over its places on the grid of pixels, also with triangles smaller than a pixel."""
    corners, faces = fan(7, 11.0, inside=inside)
    colours, sums, gradients = torch.ones(len(corners), 1), [], []
    for shift in shifts(60):
        moved = (corners + 2 * shift).requires_grad_()
        total = seen(moved, faces, colours).sum()
        sums.append(total.detach())
        gradients.append(torch.autograd.grad(total, moved)[0][:7])
    rim = (corners[:7, :2] / 2).requires_grad_()
    x, y = rim.unbind(-1)
    area = 0.5 * (x * y.roll(-1) - x.roll(-1) * y).sum()
    (expected,) = torch.autograd.grad(area, rim)
    assert float(torch.stack(sums).mean()) == pytest.approx(float(area.detach()), rel=3e-3)
    assert float((torch.stack(sums) - area.detach()).abs().max()) < 2  # of 300 pixels, without antialiasing about 10
    found = torch.stack(gradients).mean(0)[:, :2] * 2  # of places on the picture, half of h
    torch.testing.assert_close(found, expected, atol=0.35, rtol=0.05)


def test_gradients_are_finite_differences_across_edges_and_occlusion():
    """One square hides a part of another and moves over it, through many centres of pixels."""
    corners, faces = fan(4, 13.0, depth=3.0)
    front, its = fan(4, 7.0, depth=2.0)
    both, all_faces = torch.cat([corners, front]), torch.cat([faces, its + 4])
    colours = torch.tensor([[0.2, 0.9]] * 4 + [[0.7, 0.1]] * 4)
    weights = torch.randn(SIZE[1], SIZE[0], 2, generator=torch.Generator().manual_seed(0))
    weights = torch.nn.functional.avg_pool2d(weights.movedim(-1, 0), 9, 1, 4).movedim(0, -1)  # smooth, as errors are

    def loss(place):
        moved = torch.cat([both[:4], both[4:] + 2 * torch.nn.functional.pad(place, (0, 1))])
        return (weights * seen(moved, all_faces, colours)).sum()

    slopes, differences, step = [], [], 0.5
    for shift in shifts(80)[:, :2]:
        place = (4 * shift - 2).requires_grad_()
        slopes.append(torch.autograd.grad(loss(place), place)[0])
        with torch.no_grad():
            moves = step * torch.eye(2)
            differences.append(torch.stack([(loss(place + m) - loss(place - m)) / (2 * step) for m in moves]))
    slopes, differences = torch.stack(slopes), torch.stack(differences)
    assert torch.corrcoef(torch.stack([slopes.flatten(), differences.flatten()]))[0, 1] > 0.97
    torch.testing.assert_close(slopes.mean(0), differences.mean(0), atol=0.05, rtol=0.05)


def test_pictures_change_evenly_while_an_edge_passes_pixels():
    """No jump as large as a pixel: a centre that an edge passes changes hands without changing its colour."""
    corners, faces = fan(4, 9.0)
    places = torch.linspace(0, 1, 41)
    pictures = [
        seen(corners + 2 * torch.tensor([float(x), 0.4 * float(x), 0.0]), faces, torch.ones(4, 1)) for x in places
    ]
    jumps = torch.stack([(b - a).abs().max() for a, b in zip(pictures, pictures[1:], strict=False)])
    assert float(jumps.median()) < 0.06 and float(jumps.max()) < 0.6  # at the polygon's corners


def test_neighbours_share_edges():
    faces = torch.tensor([[0, 1, 2], [2, 1, 3], [3, 1, 4], [1, 3, 5]])  # the edge 1 to 3 has three triangles
    assert neighbours(faces).tolist() == [[1, -1, -1], [-1, -1, 0], [-1, -1, -1], [-1, -1, -1]]
