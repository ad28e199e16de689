"""NGLOD: cells around the surface, sums of codes, space outside of the octree, levels, and rays through cells."""

from __future__ import annotations

import pytest
import tiny_shapes
import torch
from budgets import budget

from lumigraph.camera import ring
from lumigraph.errors import LumigraphError
from lumigraph.files.ranges import changed
from lumigraph.method.capabilities import HasLevels, can
from lumigraph.methods.nglod import NGLOD

pytestmark = budget("methods", 10)


@pytest.fixture(scope="module")
def learnt() -> NGLOD:
    """Three levels that have learnt a ball."""
    shapes = tiny_shapes.shapes()
    method = NGLOD(shapes.frame, changed(NGLOD.smallest(), levels=3, points_per_step=1024))
    optimizers = method.optimizers()
    method.begin(shapes)
    generator = torch.Generator().manual_seed(0)
    for step in range(120):
        for optimizer in optimizers:
            optimizer.param_groups[0]["lr"] = 1e-2 * 0.05 ** (step / 120)
            optimizer.zero_grad()
        torch.stack([*method.loss(method.batch(shapes, generator), step).values()]).sum().backward()
        for optimizer in optimizers:
            optimizer.step()
    return method.eval()


def points(count: int, spread: float = 1.0) -> torch.Tensor:
    return spread * (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) - 1)


def test_cells_hold_the_surface_and_nest(learnt):
    """All points of the surface lie in cells of every level, and each cell in one of the level before."""
    surface = tiny_shapes.ball().surface(5000, torch.Generator().manual_seed(0)).points
    for level in learnt.octree:
        assert (level.cells.row(surface) >= 0).all()
    for coarse, fine in zip(learnt.octree.levels, learnt.octree.levels[1:], strict=False):
        middles = (fine.cells.where + 0.5) * (2 / fine.cells.resolution) - 1
        assert (coarse.cells.row(middles) >= 0).all()
    counts = [len(level.cells.rows) for level in learnt.octree]
    assert counts[0] == 64 and counts[2] < 0.6 * 16**3


def test_a_code_is_the_sum_over_levels(learnt):
    """Eq. 3 at a corner: the sum of that corner's codes; and eq. 4."""
    first, second = learnt.octree.levels[0], learnt.octree.levels[1]
    corner = first.cells.where[0] * (2 / first.cells.resolution) - 1
    place = corner[None].float() + 1e-6
    number, n = (second.cells.where * (2 / second.cells.resolution) - 1 == corner).all(-1).nonzero(), 9
    if len(number):
        x, y, z = (second.cells.where[number[0, 0]]).tolist()
        row = int((second.cells.corners == (x * n + y) * n + z).nonzero())
        torch.testing.assert_close(second.feature(place)[0], second.features[row], atol=1e-4, rtol=1e-3)
    summed = first.feature(place) + second.feature(place)
    expected = second.decoder(torch.cat([summed, place], -1))[:, 0]
    held, predicted = learnt.octree.predictions(place)[1]
    if len(held):
        torch.testing.assert_close(predicted, expected)


def test_space_outside_of_the_octree_has_the_octrees_sign(learnt):
    """Decoders never saw it."""
    places = points(4000, 0.99)
    finest = learnt.octree.levels[-1].cells.row(places) >= 0
    with torch.no_grad():
        for level in (1, 2, 3):
            told = learnt.given(level=level)
            distance = told.distance(places)
            empty = learnt.octree.levels[level - 1].cells.row(places) < 0
            inside = tiny_shapes.ball().inside(places)
            assert torch.equal(distance[empty] < 0, inside[empty])
    assert (~finest).float().mean() > 0.5 and inside[~finest].any()


def test_the_level_blends(learnt):
    places = points(500, 0.9)
    with torch.no_grad():
        one, two, between = (learnt.given(level=x).distance(places) for x in (1, 2, 1.25))
    torch.testing.assert_close(between, torch.lerp(one, two, 0.25))
    assert not torch.allclose(one, two)


def test_finer_levels_are_closer_and_larger(learnt):
    surface = tiny_shapes.ball().surface(2000, torch.Generator().manual_seed(0)).points
    with torch.no_grad():
        errors = [float(learnt.given(level=level).distance(surface).abs().mean()) for level in (1, 3)]
    assert errors[1] < errors[0] and can(learnt, HasLevels)
    assert learnt.level_bytes(1) < learnt.level_bytes(2) < learnt.level_bytes(3)


@pytest.mark.parametrize("level", [1, 3])
def test_loops_trace_as_tensors_do(learnt, level):
    """Distance and normals, in the same cells; and both close to the ball's."""
    told = learnt.given(level=level)
    camera = ring(told.frame.bounds, size=40)[1]
    rays = camera.rays(camera.pixels())
    t, normals = told._traced_by_loops(rays)
    with torch.no_grad():
        expected, slopes = told.with_normals(rays, told._traced(rays))
    both = t.isfinite() & expected.isfinite()
    assert (t.isfinite() != expected.isfinite()).float().mean() < 0.01 and both.float().mean() > 0.1
    assert float((t - expected)[both].abs().quantile(0.95)) < 1e-3
    assert float((normals * slopes).sum(-1)[both].quantile(0.05)) > 0.99
    if level == 3:
        radius = rays[both].at(t[both]).norm(dim=-1)
        assert float((radius - tiny_shapes.RADIUS).abs().median()) < 0.03


def test_a_picture_of_a_blend_lies_between(learnt):
    camera = ring(learnt.frame.bounds, size=24)[1]
    depths = [learnt.given(level=x).render(camera).depth for x in (1, 1.5, 2)]
    hit = torch.stack(depths).isfinite().all(0)
    a, b, c = (x[hit] for x in depths)
    assert float(((b - (a + c) / 2).abs()).median()) < 0.5 * float((a - c).abs().median()) + 1e-3


def test_several_shapes_and_deep_octrees_are_refused():
    shapes = tiny_shapes.several()
    with pytest.raises(LumigraphError, match="learns one shape"):
        NGLOD(shapes.frame, NGLOD.smallest()).begin(shapes)
    with pytest.raises(LumigraphError, match="deeper than"):
        changed(NGLOD.smallest(), levels=8, base_level=6).check()
