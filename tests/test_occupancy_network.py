"""Occupancy networks: encoders, conditional normalisation, the threshold's surface, evidence and what is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny_shapes
import torch
from budgets import budget
from PIL import Image

from lumigraph.camera import ring
from lumigraph.datasets.shapes import Shapes
from lumigraph.datasets.shapes.pictures import picture_of
from lumigraph.errors import LumigraphError
from lumigraph.methods.occupancy_network import OccupancyNetwork, Warp, voxels_of
from lumigraph.methods.occupancy_network.networks import ConditionalNorm, PointEncoder, joined
from lumigraph.metrics import intersection_over_union
from lumigraph.readers import single_image

pytestmark = budget("methods", 12)
BOTH = {"train": torch.tensor([0, 1]), "test": torch.tensor([0, 1])}


def single(shape) -> Shapes:
    return Shapes([shape], {"train": torch.tensor([0])}, shape.name)


@pytest.fixture(scope="module", params=["points", "voxels", "picture"])
def learnt(request) -> OccupancyNetwork:
    """Small networks that have learnt to tell a ball from a box."""
    shapes = replace(tiny_shapes.several(), splits=BOTH)
    c = replace(OccupancyNetwork.smallest(), input=request.param, encoder_width=16, hidden_width=24, code=8)
    c = replace(c, picture_size=32, shapes_per_step=4, points_per_shape=256)
    method = OccupancyNetwork(shapes.frame, c).train()
    (adam,) = method.optimizers()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lumigraph.methods.occupancy_network.VIEWS", 4)
        method.begin(shapes)
    generator = torch.Generator().manual_seed(0)
    for step in range(150):
        adam.param_groups[0]["lr"] = 2e-2 * 0.05 ** (step / 150)
        adam.zero_grad()
        torch.stack([*method.loss(method.batch(shapes, generator), step).values()]).sum().backward()
        adam.step()
    return method.eval()


def agreement(method, shape) -> float:
    points = 2 * torch.rand(6000, 3, generator=torch.Generator().manual_seed(1)) - 1
    with torch.no_grad():
        return intersection_over_union(method.distance(points) < 0, shape.inside(points))


def test_evidence_is_told_apart(learnt):
    """A ball is a ball and a box a box, from points, voxels or a picture of it."""
    ball, box = tiny_shapes.ball(), tiny_shapes.box()
    for shape, other in ((ball, box), (box, ball)):
        told = learnt.given(single(shape))
        assert agreement(told, shape) > max(0.6, agreement(told, other))


def test_points_in_any_order_have_one_code():
    """The largest features of all points: a PointNet."""
    encoder, points = PointEncoder(4, 8), torch.randn(2, 20, 3)
    order = torch.randperm(20)
    torch.testing.assert_close(encoder(points), encoder(points[:, order]))
    assert not torch.allclose(encoder(points)[0], encoder(points)[1])


def test_a_layer_of_points_and_their_cloud_is_that_of_both_joined():
    layer, x, whole = torch.nn.Linear(7, 3), torch.randn(2, 5, 4), torch.randn(2, 3)
    expected = layer(torch.cat([x, whole[:, None].expand(-1, 5, -1)], -1))
    torch.testing.assert_close(joined(layer, x, whole), expected)


def test_a_warp_keeps_the_inside_and_the_longest_side():
    """A box under a warp is a box: its corners, and points beside its faces, say which."""
    box = torch.tensor([[[-0.9, -0.5, -0.2], [0.9, 0.3, 0.2]], [[-0.3, -0.9, -0.9], [0.3, 0.9, 0.1]]])
    bend, stretch = (0.8 * torch.rand(2, 2, 1, 3, generator=torch.Generator().manual_seed(0)) - 0.4).unbind(0)
    warp, centred = Warp.drawn(box, bend, stretch.exp()), torch.tensor([[[-0.9, -0.5, -0.2], [0.9, 0.5, 0.2]]])
    low, high = warp(box).split(1, 1)
    torch.testing.assert_close((high - low).amax(-1), torch.full((2, 1), 1.8))
    torch.testing.assert_close(low, -high)
    points = 2 * torch.rand(2, 4000, 3, generator=torch.Generator().manual_seed(1)) - 1
    inside = ((points > box[:, :1]) & (points < box[:, 1:])).all(-1)
    assert torch.equal(((warp(points) > low) & (warp(points) < high)).all(-1), inside)
    torch.testing.assert_close(Warp.drawn(centred, 0 * bend[:1], 1 + 0 * bend[:1])(points[:1]), points[:1])


def test_codes_are_kept_of_members_as_they_are():
    """Clouds of other members are warped with their points, whose occupancy stays."""
    shapes = replace(tiny_shapes.several(), splits=BOTH)
    c = replace(OccupancyNetwork.smallest(), cloud_points=2000, shapes_per_step=32, bend=0.5, stretch=0.3)
    method = OccupancyNetwork(shapes.frame, c)
    method.begin(shapes)
    lesson = method.batch(shapes, torch.Generator().manual_seed(0))
    assert 0 < int(lesson.plain.sum()) < 32
    reach = lesson.evidence.abs().amax((1, 2))
    assert float((reach - 0.9).abs().max()) < 0.1, "each is normalised again"
    of_ball = lesson.points.member.view(32, -1)[:, 0] == 0
    spread = lesson.evidence.std(1)
    uneven = spread.amax(-1) / spread.amin(-1)
    assert float(uneven[of_ball & lesson.plain].max()) < 1.2 < float(uneven[of_ball & ~lesson.plain].max())
    method.loss(lesson, 0)
    kept = set(lesson.points.member.view(32, -1)[lesson.plain, 0].tolist())
    assert set(method.codes.learnt.nonzero()[:, 0].tolist()) == kept


def test_the_surface_is_fitted_to_a_cloud(learnt):
    """A code that an encoder got a little wrong: its surface passes through the cloud's points again."""
    if learnt.config.input != "points":
        pytest.skip("clouds alone are fitted to")
    learnt.config = replace(learnt.config, code_steps=60)
    cloud = tiny_shapes.box().surface(300, torch.Generator().manual_seed(0)).points
    right = learnt.encoder(cloud[None])[0].detach()
    wrong = right + 0.4 * learnt.codes.rows[learnt.codes.learnt].std(0)

    def off(code):
        return float(learnt.decoder(cloud[None], code[None]).abs().mean())

    with torch.no_grad():
        assert off(learnt._through(cloud, wrong)) < 0.9 * off(wrong)
    learnt.config = replace(learnt.config, code_steps=0)
    assert torch.equal(learnt._through(cloud, wrong), wrong)


def test_normalisation_is_scaled_and_shifted_by_the_code():
    norm, x, code = ConditionalNorm(3, 5).train(), torch.randn(2, 40, 5) * 3 + 1, torch.randn(2, 3)
    flat = x.flatten(0, 1)
    normal = (x - flat.mean(0)) / (flat.var(0, unbiased=False) + 1e-5).sqrt()
    expected = norm.gamma(code)[:, None] * normal + norm.beta(code)[:, None]
    torch.testing.assert_close(norm(x, code), expected, atol=1e-5, rtol=1e-4)
    assert not torch.equal(norm.eval()(x, code), expected)


def test_the_surface_is_where_the_threshold_says(learnt):
    points = 2 * torch.rand(200, 3) - 1
    with torch.no_grad():
        probability = learnt.logits(points).sigmoid()
        for threshold in (0.2, 0.7):
            learnt.config = replace(learnt.config, threshold=threshold)
            inside = learnt.distance(points) < 0
            assert torch.equal(inside, probability > threshold)
    learnt.config = replace(learnt.config, threshold=0.5)


def test_a_picture_shows_the_nearest_surface():
    """Of a ball: a disc that is brightest in its middle, where it faces the camera."""
    camera = ring(tiny_shapes.ball().frame.bounds, size=48)[0]
    shot = picture_of(tiny_shapes.ball(), camera, torch.Generator().manual_seed(0))
    assert shot.alpha is not None and shot.alpha[24, 24] == 1 and shot.alpha[0, 0] == 0
    disc = (
        torch.pi * (24 / torch.tan(torch.tensor(25.0).deg2rad()) * torch.tan(torch.asin(torch.tensor(0.9 / 2.6)))) ** 2
    )
    assert float(shot.alpha.sum()) == pytest.approx(float(disc), rel=0.08)  # pixels of its edge count whole
    row = shot.rgb[24, :, 0][shot.alpha[24] > 0]
    assert row[len(row) // 2] > row[0] + 0.3 and row[len(row) // 2] > row[-1] + 0.3


def test_voxels_are_what_is_inside():
    voxels = voxels_of(tiny_shapes.ball())
    volume = float(voxels.sum()) * (2 / len(voxels)) ** 3
    assert volume == pytest.approx(4 / 3 * torch.pi * tiny_shapes.RADIUS**3, rel=0.03)


def test_other_evidence_than_the_trainings_is_refused(learnt, tmp_path):
    path = tmp_path / "one.png"
    Image.new("RGBA", (40, 30)).save(path)
    picture = single_image.photograph(path)
    assert picture.rgb.shape == (30, 40, 3) and picture.alpha is not None
    bare = replace(tiny_shapes.ball(), mesh=replace(tiny_shapes.ball().mesh, faces=tiny_shapes.ball().mesh.faces[:0]))
    kind = learnt.config.input
    if kind == "picture":
        assert len(learnt.given(picture).found.rows) == 1
        with pytest.raises(LumigraphError, match="learnt from pictures"):
            learnt.given(single(bare))
    else:
        with pytest.raises(LumigraphError, match=f"learnt from {kind}"):
            learnt.given(picture)
    if kind == "voxels":
        with pytest.raises(LumigraphError, match="no faces"):
            learnt.given(single(bare))
    with pytest.raises(LumigraphError, match="holds 2 shapes"):
        learnt.given(tiny_shapes.several())
