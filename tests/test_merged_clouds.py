"""Blocks of splats that were trained apart become one cloud: each gives what lies in its own cell."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from balls import WHITE, Pictured, Splatted, eye

from lumigraph.camera.crop import CropBox
from lumigraph.composition import PickedCloud, Placed
from lumigraph.errors import LumigraphError
from lumigraph.gaussians import Gaussians, joined
from lumigraph.geometry import Similarity, to_matrix
from lumigraph.large import merged

GREY = (0.4, 0.5, 0.6)


@pytest.fixture
def world(generator) -> Gaussians:
    """A street of 4000 small opaque Gaussians of every colour, 8 units long, with view-dependent colours."""
    count = 4000
    means = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([8.0, 1.0, 1.0])
    quaternions = torch.randn(count, 4, generator=generator)
    log_scales = torch.full((count, 3), 0.05).log() + 0.3 * torch.randn(count, 3, generator=generator)
    harmonics = 0.5 * torch.randn(count, 4, 3, generator=generator)
    return Gaussians(means, quaternions, log_scales, torch.full((count,), 3.0), harmonics)


def placed(cloud: Gaussians, place: Similarity) -> Placed:
    """A cloud of the common frame as a block that was trained in a frame of its own."""
    return Placed(PickedCloud(WHITE, cloud.transformed(place.inverse.matrix)), place)


def places() -> list[Similarity]:
    """Three frames with everything in them."""
    turns = torch.tensor([[0.8, 0.3, -0.4, 0.2], [0.1, 0.9, 0.2, 0.1], [1.0, 0.0, 0.0, -0.7]], dtype=torch.float64)
    shifts = torch.tensor([[0.3, -0.2, 0.5], [-4.0, 1.0, 0.0], [9.0, 0.0, 2.0]], dtype=torch.float64)
    return [
        Similarity.make(s, to_matrix(t[None])[0], x) for s, t, x in zip((0.5, 1.0, 3.0), turns, shifts, strict=True)
    ]


def test_overlapping_blocks_give_the_world_once(world):
    """Every block has the whole street, of which all but its own part is a stranger's: moved and painted grey."""
    centres = torch.tensor([[-3.0, 0, 0], [0.0, 0, 0], [3.0, 0, 0]])
    own = torch.bucketize(world.means[:, 0].contiguous(), torch.tensor([-1.5, 1.5]))
    grey = torch.zeros_like(world.harmonics)
    parts = []
    for i, place in enumerate(places()):
        mine = own == i
        parts.append(placed(replace(world, harmonics=torch.where(mine[:, None, None], world.harmonics, grey)), place))
    one = merged(parts, centres)
    assert len(one) == len(world)
    there = torch.cat([world.means[own == i] for i in range(3)])
    assert torch.allclose(one.means, there, atol=1e-4)
    camera = eye((1.5, -6.0, 2.0), (1.5, 0, 0), 48)
    seen, expected = (PickedCloud(WHITE, cloud).render(camera).rgb for cloud in (one, world))
    assert expected.std() > 0.1 and torch.allclose(seen, expected, atol=5e-3)


def test_crops_are_cells_where_no_centres_are_given(world):
    parts = [Placed(PickedCloud(WHITE, world), Similarity.make(1.0), CropBox(*x)) for x in CELLS]
    one = merged(parts)
    inside = world.means[:, 0] < 2.0
    assert len(one) == int(inside.sum()) and torch.allclose(one.means.amax(0)[0], world.means[inside, 0].max())


CELLS = [((-9.0, -9.0, -9.0), (0.0, 9.0, 9.0)), ((0.0, -9.0, -9.0), (2.0, 9.0, 9.0))]


def test_no_light_is_doubled_at_a_border():
    """A Gaussian as near to one centre as to the other is given once."""
    cloud = Splatted(GREY).gaussians()
    cloud = replace(cloud, means=cloud.means * torch.tensor([0.0, 1.0, 1.0]))
    parts = [placed(cloud, Similarity.make(1.0))] * 2
    assert len(merged(parts, torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]]))) == len(cloud)


def test_blocks_of_different_degrees_go_together():
    plain, rich = Splatted(GREY), Splatted(GREY, degree=2, centre=(4.0, 0, 0))
    here = Similarity.make(1.0)
    one = merged([Placed(plain, here), Placed(rich, here)], torch.tensor([[0.0, 0, 0], [4.0, 0, 0]]))
    assert one.degree == 2 and len(one) == len(joined([plain.gaussians(), rich.gaussians()]))


def test_what_is_no_block_is_refused():
    here = Similarity.make(1.0)
    with pytest.raises(LumigraphError, match="give each block its centre"):
        merged([Placed(Splatted(GREY), here)], torch.zeros(2, 3))
    with pytest.raises(LumigraphError, match="give each block its centre"):
        merged([])
    with pytest.raises(LumigraphError, match="gaussian"):
        merged([Placed(Pictured(GREY), here)], torch.zeros(1, 3))
