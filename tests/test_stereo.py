"""Stereo of a pair: rectification, disparity against truth, holes, and faults of pairs that cannot be compared."""

from __future__ import annotations

import math

import pytest
import torch
from budgets import budget
from test_dense_start import RADIUS, ball
from torch.nn.functional import avg_pool2d

from lumigraph.commands.cli import main
from lumigraph.depth_maps import stereo
from lumigraph.depth_maps.flat_view import FlatView
from lumigraph.depth_maps.multi_view import pair_depth
from lumigraph.depth_maps.optical_flow import optical_flow, sampled
from lumigraph.errors import LumigraphError

pytestmark = budget("exports", 6)

HEIGHT, WIDTH, NEAR, FAR = 60, 90, 12, 4  # of a square before a wall, and their disparities


def square_before_a_wall():
    """Bytes of both pictures, and the true disparity of the left one."""
    generator = torch.Generator().manual_seed(0)
    wall, square = torch.randint(0, 256, (2, HEIGHT, WIDTH + FAR, 3), generator=generator, dtype=torch.uint8)
    left, right = wall[:, :WIDTH].clone(), wall[:, FAR:].clone()
    left[20:40, 40:60] = square[20:40, 40:60]
    right[20:40, 40 - NEAR : 60 - NEAR] = square[20:40, 40:60]
    truth = torch.full((HEIGHT, WIDTH), float(FAR))
    truth[20:40, 40:60] = NEAR
    return left, right, truth


def test_disparity_of_a_square_before_a_wall():
    left, right, truth = square_before_a_wall()
    found = stereo.semi_global(left, right, 0, 16)
    assert ((found.values - truth).abs() < 0.5).float().mean() > 0.99
    assert ((found.values - truth).abs() < 0.5)[found.sure].float().mean() > 0.995
    hidden = found.sure[22:38, 40 - (NEAR - FAR) : 40]  # of the wall, by the square in the right picture
    assert hidden.float().mean() < 0.2
    assert ((found.values - truth).abs() < 0.5)[22:38, 40 - (NEAR - FAR) : 40].float().mean() > 0.9


def test_a_wall_without_texture_is_not_sure():
    flat = torch.full((HEIGHT, WIDTH, 3), 128, dtype=torch.uint8)
    assert not stereo.semi_global(flat, flat, 0, 16).sure.any()


def texture(height: int, width: int) -> torch.Tensor:
    """A smooth picture of chance, as bytes."""
    noise = torch.rand(3, height, width, generator=torch.Generator().manual_seed(0))
    return (255 * avg_pool2d(noise, 5, 1, 2)).movedim(0, -1).to(torch.uint8).contiguous()


@pytest.mark.parametrize("start", [None, (-2.6, 1.7)])
def test_optical_flow_is_the_shift_of_a_picture(start):
    whole = texture(76, 96)
    first, second = whole[8:68, 8:88], whole[6:66, 11:91]  # what is at x, y is then at x - 3, y + 2
    guess = None if start is None else torch.tensor(start).expand(60, 80, 2)
    flow = optical_flow(first, second, guess)
    assert (flow - torch.tensor([-3.0, 2.0]))[8:-8, 8:-8].norm(dim=-1).median() < 0.1


def test_optical_flow_is_the_same_with_any_number_of_threads():
    import cv2

    whole, before, found = texture(120, 200), cv2.getNumThreads(), []
    for threads in (1, 2, 3, 8):
        cv2.setNumThreads(threads)
        found.append(optical_flow(whole[:, :-4].contiguous(), whole[:, 4:].contiguous()))
    cv2.setNumThreads(before)
    assert all(torch.equal(one, found[0]) for one in found)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (11, 11), (1, 64), (40, 7)])
def test_optical_flow_of_small_pictures(size):
    """Pictures too small for OpenCV's search are continued by their border."""
    flow = optical_flow(texture(*size), texture(*size), torch.zeros(*size, 2))
    assert flow.shape == (*size, 2) and flow.abs().max() < 0.1


def test_finer_disparity_of_a_slanted_wall():
    """Semi-global matching knows parts of pixels roughly; a picture stretched by 1.05 has all of them."""
    whole = texture(60, 130)
    x = torch.arange(100.0)
    truth = 3 + 0.05 * x
    places = torch.stack(torch.meshgrid(x + 0.5, torch.arange(60) + 0.5, indexing="xy"), -1)
    right = whole[:, :100]
    left = sampled(right.float(), places - torch.stack([truth.expand(60, 100), torch.zeros(60, 100)], -1))
    left = left.round().to(torch.uint8)
    found = stereo.semi_global(left, right, 0, 16).values
    errors = [(d - truth)[8:-8, 20:-8].abs().mean() for d in (found, stereo.sharpened(found, left, right))]
    assert errors[1] < min(0.5 * errors[0], 0.1)


def test_the_depth_of_a_rectified_pair_is_that_of_the_ball():
    """Two neighbours of the ring, turned to common rows; sure places lie on the ball's surface."""
    scene = ball()
    positions = scene.cameras.position
    other = int((positions - positions[0]).norm(dim=-1).argsort()[1])
    pair, found = pair_depth(scene, 0, other, 160)
    seen = pair.depth_map(found, 0)
    assert seen.solid[pair.left.trust > 0.5].float().mean() > 0.15
    off = (seen.positions().norm(dim=-1) - RADIUS / scene.frame.to_source.scale).abs()
    assert off.median() < 0.03
    rows = [view.project(seen.positions())[0][:, 1] for view in (pair.left, pair.right)]
    torch.testing.assert_close(*rows, rtol=0, atol=1e-2)


def test_distance_follows_from_disparity():
    """A point at z is at columns that differ by b f / z - d0."""
    scene = ball()
    pair, _ = pair_depth(scene, 0, 1, 80)
    point = pair.left.pose[:, 3] + 2 * pair.left.rays[10, 12]
    left, right = (view.project(point[None])[0][0, 0] for view in (pair.left, pair.right))
    assert float(pair.z((left - right)[None, None])) == pytest.approx(2, rel=1e-3)


def view(place: tuple[float, float, float], turn: float = 0.0) -> FlatView:
    """A camera at a place that looks along z, turned about the vertical by so many degrees."""
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    intrinsics = torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    pose = torch.cat([rotation, torch.tensor(place)[:, None]], 1)
    return FlatView(pose, intrinsics, torch.zeros(40, 60, 3), torch.ones(40, 60))


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (view((0, 0, 0)), "from one place"),
        (view((0, 0, 1)), "behind one another"),
        (view((1, 0, 0), 56), "do not overlap"),
        (view((1, 0, 0), 170), "directions too different|behind one another"),
    ],
)
def test_pairs_that_cannot_be_compared_are_a_fault(second, said):
    with pytest.raises(LumigraphError, match=said):
        stereo.rectify(view((0, 0, 0)), second, (2.0, 20.0), "a and b")


def test_an_unknown_photograph_is_a_fault(ball_folder, tmp_path, capsys):
    assert main(["depth", str(ball_folder), "--pair", "0", "nobody", "--output", str(tmp_path / "out")]) == 2
    assert "has no photograph 'nobody'" in capsys.readouterr().err
