"""DeepSDF: the clamped error, dropout that resumes, codes found of meshes and scans, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny_shapes
import torch
import trimesh
from budgets import budget
from PIL import Image

from lumigraph.commands.cli import main
from lumigraph.components.fields.instance_codes import FOUND
from lumigraph.components.training.shape_points import PointNumbers, sampled
from lumigraph.datasets.mesh import Mesh
from lumigraph.datasets.shapes import PointBatch, Shape, Shapes, normalised
from lumigraph.errors import LumigraphError
from lumigraph.files.ranges import changed
from lumigraph.methods.deepsdf import Config, DeepSDF
from lumigraph.metrics import intersection_over_union
from lumigraph.opening import open_dataset
from lumigraph.run import Run, State

pytestmark = budget("methods", 12)
BOTH = {"train": torch.tensor([0, 1]), "test": torch.tensor([0, 1])}


def single(shape: Shape) -> Shapes:
    return Shapes([shape], {"train": torch.tensor([0])}, shape.name)


@pytest.fixture(scope="module")
def learnt() -> DeepSDF:
    """A small network that has learnt a ball and a box."""
    shapes = replace(tiny_shapes.several(), splits=BOTH)
    c = Config(PointNumbers(8192), depth=3, hidden_width=32, skip_layer=2, octaves=2, weight_norm=False)
    c = replace(c, dropout=0.0, code=4, members=4, shapes_per_step=2, points_per_shape=512, code_steps=60)
    method = DeepSDF(shapes.frame, c)
    (adam,) = method.optimizers()
    method.begin(shapes)
    generator = torch.Generator().manual_seed(0)
    for step in range(500):
        for group in adam.param_groups:
            group["lr"] = 1e-2 * 0.05 ** (step / 500)
        adam.zero_grad()
        torch.stack([*method.loss(method.batch(shapes, generator), step).values()]).sum().backward()
        adam.step()
    return method.eval()


def agreement(method, shape: Shape) -> float:
    points = 2 * torch.rand(8000, 3, generator=torch.Generator().manual_seed(1)) - 1
    with torch.no_grad():
        return intersection_over_union(method.distance(points) < 0, shape.inside(points))


def scan(shape: Shape, keep, **about) -> Shape:
    """The points of a shape that a mask of its points keeps, with normals."""
    found = shape.surface(4000, torch.Generator().manual_seed(0))
    here = keep(found.points)
    points, normals = found.points[here].double().numpy(), found.normals[here].double().numpy()
    mesh = Mesh(points, np.zeros((0, 3), np.int64), np.zeros((len(points), 3), np.uint8))
    return Shape("scan", mesh, shape.frame, normals, **about)


# The error


def test_the_error_is_that_of_clamped_distances(monkeypatch):
    """Eq. 4 by hand: |0.03 - 0.05|, |0.1 - 0.1|, |-0.1 - 0.02|; and eq. 9's prior."""
    method = DeepSDF(tiny_shapes.shapes().frame, DeepSDF.smallest())
    method.begin(tiny_shapes.shapes())
    monkeypatch.setattr(method.decoder, "forward", lambda code, points: torch.tensor([0.03, 0.7, -0.4]))
    monkeypatch.setattr("lumigraph.methods.deepsdf.in_chunks", lambda network, *x: network(*x))
    batch = PointBatch(
        torch.zeros(3, 3), torch.zeros(3, dtype=torch.long), torch.tensor([0.05, 0.3, 0.02]), torch.zeros(3)
    )
    method.progress = 1.0
    terms = method.loss(batch, 0)
    assert float(terms["distance"]) == pytest.approx((0.02 + 0 + 0.12) / 3)
    assert float(terms["code"].detach()) == pytest.approx(1e-4 * float(method.codes.rows[0].detach().norm()))
    method.progress = 50 / 2001  # the weight grows over 100 of 2001 epochs
    assert float(method.loss(batch, 0)["code"].detach()) == pytest.approx(float(terms["code"].detach()) / 2)


def test_codes_are_not_longer_than_one():
    method = DeepSDF(tiny_shapes.shapes().frame, DeepSDF.smallest())
    method.begin(tiny_shapes.shapes())
    with torch.no_grad():
        method.codes.rows[1] = torch.tensor([3.0, 4.0, 0.0, 0.0])
    short = method.codes.rows[0].detach().clone()
    method.after_step(0)
    torch.testing.assert_close(method.codes.rows[1].detach(), torch.tensor([0.6, 0.8, 0.0, 0.0]))
    assert torch.equal(method.codes.rows[0], short)


def test_half_of_a_step_is_inside():
    """Also of a thin plate, of whose sampled points far fewer are."""
    plate = normalised("plate", tiny_shapes.made(trimesh.creation.box((1.0, 1.0, 0.02))))
    method = DeepSDF(plate.frame, changed(DeepSDF.smallest(), pool_points=4096, points_per_shape=1000))
    batch = method.batch(single(plate), torch.Generator().manual_seed(0))
    assert int((batch.occupancy > 0).sum()) == 500
    assert float((method.pools.pools[0].occupancy > 0).float().mean()) < 0.4


def test_dropout_follows_the_step_alone_and_ends_with_it():
    method = DeepSDF(tiny_shapes.shapes().frame, replace(DeepSDF.smallest(), dropout=0.5))
    method.begin(tiny_shapes.shapes())
    batch = method.batch(tiny_shapes.shapes(), torch.Generator().manual_seed(0))
    first, again, other = (float(method.loss(batch, step)["distance"].detach()) for step in (3, 3, 4))
    assert first == again != other
    with torch.no_grad():
        assert torch.equal(method.distance(batch.points), method.distance(batch.points))


def test_hidden_layers_have_normalised_weights_in_the_paper():
    """The direction's length does not matter."""
    method = DeepSDF(tiny_shapes.shapes().frame, replace(DeepSDF.smallest(), weight_norm=True))
    dense = method.decoder.before[0][0]
    before = dense.weight.detach().clone()
    with torch.no_grad():
        dense.parametrizations.weight.original1.mul_(3)
    torch.testing.assert_close(dense.weight, before)


# Codes


def test_a_code_means_its_shape_and_blends(learnt):
    ball, box = tiny_shapes.ball(), tiny_shapes.box()
    assert agreement(learnt.given(instance="0"), ball) > 0.93 and agreement(learnt.given(instance="1"), box) > 0.9
    between = learnt.given(instance="0:1:0.5")
    assert agreement(learnt.given(instance="1"), ball) < agreement(between, ball) < 0.97


def test_the_code_of_a_mesh_is_found(learnt):
    told = learnt.given(single(tiny_shapes.box()))
    assert told.control("instance") == FOUND and agreement(told, tiny_shapes.box()) > 0.9
    assert len(learnt.found.rows) == 0, "the prior itself stays as it is"


def test_half_a_scan_is_completed(learnt):
    half = scan(tiny_shapes.box(), lambda points: points[:, 0] > 0)
    assert agreement(learnt.given(single(half)), tiny_shapes.box()) > 0.85


def test_a_partial_scan_finds_its_place_in_the_whole(learnt):
    """Half of the ball, normalised by itself, has another middle than the whole; what is found lies around the ball."""
    half = scan(tiny_shapes.ball(), lambda points: points[:, 2] > 0)
    again = normalised("half", half.mesh, half.normals)
    told = learnt.given(single(replace(again, partial=True)))
    middle = told.frame.to_source.points(torch.zeros(1, 3))[0]
    assert float(middle.norm()) < 0.05 and float(again.frame.to_source.points(torch.zeros(1, 3)).norm()) > 0.4
    assert told.frame.to_source.scale == pytest.approx(1.0, abs=0.1)


def test_a_shape_is_drawn(learnt):
    one, other = learnt.draw_object(1), learnt.draw_object(2)
    assert not torch.equal(one.code, other.code) and one.control("instance") == FOUND


# What is refused


def test_shapes_without_an_inside_are_refused():
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    flat = normalised("sheet", tiny_shapes.made(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)))
    cloud = scan(tiny_shapes.ball(), lambda points: points[:, 0] < 9)
    for shape, fault in ((flat, "encloses none"), (cloud, "points and no faces")):
        with pytest.raises(LumigraphError, match=fault):
            sampled(shape, PointNumbers(512), "deepsdf", torch.Generator().manual_seed(0))


def test_a_surface_with_a_hole_is_signed_by_its_winding_number():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.25)
    holed = normalised("holed", tiny_shapes.made(trimesh.Trimesh(ball.vertices, ball.faces[4:], process=False)))
    found = sampled(holed, PointNumbers(4000), "deepsdf", torch.Generator().manual_seed(0))
    assert not holed.closed
    radius = found.points.norm(dim=-1)
    sure = (radius - 0.9).abs() > 0.15
    assert torch.equal(found.signed[sure] < 0, radius[sure] < 0.9)


def test_points_need_normals(learnt):
    bare = replace(scan(tiny_shapes.ball(), lambda points: points[:, 0] > 0), normals=None)
    with pytest.raises(LumigraphError, match="without normals"):
        learnt.given(single(bare))


def test_infer_makes_a_run_of_a_mesh(learnt, tmp_path, capsys):
    """Also from a scan; pictures and options of photographs are refused."""
    folder = tiny_shapes.write(tmp_path / "meshes")
    run = Run.create(tmp_path / "prior", learnt, replace(tiny_shapes.several(), source=str(folder)))
    run.save(State(), learnt, learnt.optimizers(), torch.Generator())
    assert main(["infer", str(run.folder), str(folder / "ball.obj"), "--output", str(tmp_path / "found")]) == 0
    found = Run(tmp_path / "found").method()
    assert agreement(found, open_dataset(folder / "ball.obj").members[0]) > 0.9
    scanned = ["infer", str(run.folder), str(folder / "cloud.ply"), "--partial", "--output", str(tmp_path / "scan")]
    assert main(scanned) == 0
    capsys.readouterr()
    assert main(["eval", str(tmp_path / "scan")]) == 2 and "no whole shape" in capsys.readouterr().err
    picture = tmp_path / "one.png"
    Image.new("RGB", (32, 32)).save(picture)
    for words, fault in (
        (["--views", "2", str(folder / "ball.obj")], "about photographs"),
        ([str(picture)], "picture"),
    ):
        assert main(["infer", str(run.folder), *words, "--output", str(tmp_path / "no")]) == 2
        assert fault in capsys.readouterr().err
