"""Multi-view stereo by PatchMatch: planes on surfaces that only the photographs tell."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from budgets import budget
from test_dense_start import COUNT, SIZE, ball, off_surface, texture
from torch.nn.functional import normalize

from lumigraph.depth_maps import DepthMap, multi_view
from lumigraph.depth_maps.flat_view import flat_view
from lumigraph.depth_maps.patch_match import PatchMatch, PlaneMap
from lumigraph.errors import LumigraphWarning

pytestmark = budget("exports", 8)


@cache
def matched(lens: str = "pinhole", alpha: bool = True) -> list[DepthMap]:
    """Depth maps of these photographs, in which no point is known."""
    return multi_view.multi_view_depth(ball(lens, alpha))


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_sure_pixels_lie_on_the_surface(lens):
    maps = matched(lens)
    points = torch.cat([seen.positions() for seen in maps])
    colours = torch.cat([seen.rgb[seen.solid] for seen in maps])
    off = off_surface(points)
    assert len(points) > 500 and off.median() < 0.005 and (off < 0.02).float().mean() > 0.95
    assert (colours - texture(points)).abs().mean() < 0.1


def test_one_photograph_alone_has_no_depth():
    scene = ball()
    alone = replace(scene, splits={"train": torch.arange(1), "test": torch.arange(0)})
    assert not any(seen.solid.any() for seen in multi_view.multi_view_depth(alone))


def test_a_short_budget_matches_fewer_photographs(monkeypatch):
    clock = iter(range(1000))
    monkeypatch.setattr(
        multi_view.time, "perf_counter", lambda: next(clock)
    )  # so that any piece of work takes a second
    monkeypatch.setattr(multi_view, "MIN_VIEWS", 3)
    improved = []
    monkeypatch.setattr(multi_view, "improve", lambda maps, *_: improved.append(len(maps)))
    scene = replace(ball(), points=torch.zeros(300, 3))
    for seconds, views, rounds in ((1.0, 3, 2), (math.inf, COUNT, 2)):
        improved.clear()
        short = seconds < math.inf
        with pytest.warns(LumigraphWarning, match="48 of 48 pixels, of 3 of 6") if short else contextlib.nullcontext():
            assert len(multi_view.multi_view_depth(scene, seconds=seconds)) == views
        assert improved == [views] * views * rounds


def test_a_plane_map_has_depth_and_normals_of_the_surface():
    """Sure pixels of the ball; normals are where neither random planes nor fronto-parallel ones could be."""
    maps = matched()
    assert len(maps) == COUNT
    for i, seen in enumerate(maps):
        assert seen.camera.image_index.tolist() == [i]
        assert 0.1 < float(seen.solid.float().mean()) < 0.9
        assert seen.depth[~seen.solid].isnan().all()
    points = torch.cat([seen.positions() for seen in maps])
    normals = torch.cat([seen.normals[seen.solid] for seen in maps])
    cosine = (normals * normalize(points, dim=-1)).sum(-1)
    ways = torch.cat([normalize(seen.camera.position - seen.positions(), dim=-1) for seen in maps])
    assert cosine.median() > 0.97
    assert cosine.mean() > (ways * normalize(points, dim=-1)).sum(-1).mean() + 0.02


def test_true_planes_reproject_without_error():
    """Two views of a plane agree at pixels whose place both see; with a depth that is off by a tenth they do not."""
    views = [flat_view(ball().photograph(i), SIZE) for i in (0, 1)]
    normal, distance = torch.tensor([0.0, 0.0, 1.0]), 0.2  # n . x = d in the world
    maps = []
    for view in views:
        one = PlaneMap(view, (1.0, 10.0))
        offset = distance - normal @ view.pose[:, 3]
        one.planes = (normal @ view.pose[:, :3] / offset).expand(SIZE, SIZE, 3).contiguous()
        maps.append(one)
    matching = PatchMatch(maps[0], maps[1:], torch.Generator(), geometric=True)
    pixels = torch.arange(SIZE * SIZE)
    inverse = maps[0].inverse_depth.flatten()
    error = matching.reprojection_error(
        pixels, torch.stack([inverse, 1.1 * inverse], 1), torch.zeros_like(pixels)[:, None]
    )
    there = (error[:, 0, 0] < 2.9) & (inverse > 0)
    assert there.sum() > 300
    assert error[there, 0].max() < 1e-2
    assert error[there, 1].median() > 0.5
