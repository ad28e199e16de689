"""HyP-NeRF: tensors that a code means, codes found again, and runs made of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import tiny_collection
import torch
from budgets import budget

from lumigraph import kernels
from lumigraph.commands.cli import main
from lumigraph.components.fields.instance_codes import FOUND, InstanceCodes
from lumigraph.datasets.collection import Collection
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Scene
from lumigraph.derive.conversion import way
from lumigraph.errors import LumigraphError
from lumigraph.files.ranges import changed
from lumigraph.kernels import HashLevels
from lumigraph.method.controls import AVERAGE
from lumigraph.methods import find
from lumigraph.methods.hyp_nerf import HypNeRF, around, in_cells, patch
from lumigraph.methods.hyp_nerf.networks import HashInstance, HashShape, HyperNetwork
from lumigraph.metrics import psnr
from lumigraph.run import Run, State

pytestmark = budget("methods", 10)

SHAPE = HashShape(HashLevels(2, 2, 6, 3, 8), (4, 6, 5), (5 + 1, 6, 3), 1)


def hyp_nerf(**numbers) -> HypNeRF:
    return HypNeRF(tiny_collection.collection().frame, changed(HypNeRF.smallest(), **numbers))


@pytest.fixture(scope="module")
def learnt() -> HypNeRF:
    """A method whose codes mean three fields that differ: bodies of other colours and densities."""
    torch.manual_seed(0)
    method = hyp_nerf(code_steps=60, tune_steps=10, code_prior=0.0, empty_points=0)
    method.begin(tiny_collection.collection())
    with torch.no_grad():
        method.codes.rows[1:4] = torch.randn(3, 8)
        for last in method.hyper.last:
            torch.nn.init.normal_(last.weight, std=0.35)
        method.hyper.last[0].bias.uniform_(-1, 1)
    return method.eval()


def photographed(method: HypNeRF) -> Scene:
    """The tiny scene's cameras, and what a method shows them."""
    scene = tiny.scene()
    seen = [method.render(scene.cameras[i]).rgb for i in range(len(scene))]
    opaque = [torch.cat([rgb, torch.ones_like(rgb[..., :1])], -1) for rgb in seen]
    pictures = [picture.mul(255).round().byte().numpy() for picture in opaque]
    return replace(scene, images=ImageStore.from_arrays(pictures), source="rendered")


# The hypernetwork


def test_tables_and_layers_reach_the_kernels_with_right_gradients():
    """Of a code and of the hypernetwork's weights, against the reference kernels in float64 and finite differences."""
    torch.manual_seed(0)
    hyper = HyperNetwork([3 if colour else 4 for colour in SHAPE.of_colour], 8, 2, SHAPE.tensors)
    with torch.no_grad():
        hyper.last[0].weight.normal_(std=0.3)
    code = torch.randn(2, 7)
    points, directions = 2 * torch.rand(40, 3) - 1, torch.nn.functional.normalize(torch.randn(40, 3), dim=-1)
    weights = torch.randn(40, 4)

    def total(code: torch.Tensor, *parts: torch.Tensor) -> torch.Tensor:
        shape, colour = code.split([4, 3], -1)
        made = hyper([colour if of_colour else shape for of_colour in SHAPE.of_colour])
        sums = []
        for tensors in made:
            density, rgb = HashInstance(SHAPE, tensors)(points.to(code), directions.to(code))
            sums.append((torch.cat([density.log()[:, None], rgb], -1) * weights.to(code)).sum())
        return torch.stack(sums)

    parameters = [*hyper.parameters()]
    fast = torch.autograd.grad(total(code.requires_grad_()).sum(), [code, *parameters])
    hyper.double()
    exact = code.detach().double().requires_grad_()
    with kernels.using("reference"):
        slow = torch.autograd.grad(total(exact).sum(), [exact, *parameters])
        assert torch.autograd.gradcheck(total, exact, eps=1e-6, atol=1e-4)
    for a, b in zip(fast, slow, strict=True):
        torch.testing.assert_close(a.double(), b, atol=2e-3 * float(b.abs().max()) + 1e-6, rtol=2e-3)
        assert b.any()


def test_colours_are_the_colour_codes_and_shapes_the_shape_codes():
    method = hyp_nerf()
    points, directions = torch.rand(30, 3) - 0.5, torch.nn.functional.normalize(torch.randn(30, 3), dim=-1)
    code = torch.randn(1, 8)
    for part, same in ((slice(0, 4), False), (slice(4, 8), True)):
        other = code.clone()
        other[:, part] += 3.0
        (a, ra), (b, rb) = (method._made(x)[0](points, directions) for x in (code, other))
        assert torch.equal(a, b) == same and not torch.equal(ra, rb)


# Codes


def test_the_gaussian_fits_the_codes():
    codes = InstanceCodes(40, 3)
    codes.begin(torch.arange(30), 1.0, torch.Generator().manual_seed(0))
    with torch.no_grad():
        codes.rows[:30] = codes.rows[:30] * torch.tensor([3.0, 1.0, 0.1]) + torch.tensor([5.0, 0.0, -2.0])
    known = codes.rows.detach()[:30]
    assert codes.names == tuple(map(str, range(30))) and torch.equal(codes.code_of(AVERAGE), known.mean(0))
    torch.testing.assert_close(codes.axes.T @ codes.axes, known.T.cov())
    torch.testing.assert_close(codes.average + codes.along(known[4]) @ codes.axes, known[4])
    drawn = torch.stack([codes.draw_code(seed) for seed in range(400)])
    torch.testing.assert_close(drawn.std(0), known.std(0), rtol=0.15, atol=0.01)
    torch.testing.assert_close(codes.code_of("3:7:0.25"), torch.lerp(known[3], known[7], 0.25))


def test_a_code_is_found_again_from_one_picture(learnt):
    """Of an object that lies between two members, which it has rendered itself."""
    true = learnt.given(instance="1:2:0.3")
    scene = photographed(true)
    told = learnt.given(replace(scene, splits={"train": torch.tensor([1])}))
    camera = scene.cameras[6]  # from the other side
    found, nearest = (psnr(x.render(camera).rgb, true.render(camera).rgb) for x in (told, learnt.given(instance="1")))
    assert found > 24 and found > nearest + 3


def test_tuning_goes_with_what_was_found(learnt):
    """It is there where the object is shown, and fades on the way to a member."""
    told = learnt.given(replace(photographed(learnt.given(instance="3")), splits={"train": torch.tensor([1])}))
    (made,) = told._made(told.found.rows)
    whole, half, none = (told.given(instance=x)._told() for x in (FOUND, f"{FOUND}:1:0.5", "1"))
    change = whole.tensors[0] - made.tensors[0]
    assert change.abs().max() > 1e-3
    (between,) = told._made(told.codes.code_of(f"{FOUND}:1:0.5", told.found.rows)[None])
    torch.testing.assert_close(half.tensors[0] - between.tensors[0], change / 2, atol=1e-5, rtol=1e-4)
    assert torch.equal(none.tensors[0], learnt.given(instance="1")._told().tensors[0])
    assert told.control("instance") == FOUND and learnt.control("instance") == AVERAGE


# Learning


def test_no_density_is_learnt_where_photographs_see_through():
    method = hyp_nerf(empty_weight=1.0)
    lesson = method.batch(tiny_collection.collection(), torch.Generator().manual_seed(0))
    cells = lesson.evidence[0].cells
    inside = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1]])
    assert (
        in_cells(cells, inside).all() and not in_cells(cells, torch.tensor([[0.9, 0.9, 0.9], [-1.0, 1.0, 1.0]])).any()
    )
    assert 0.02 < cells.share < 0.5
    method.codes.begin(torch.arange(1, 4), 0.1, torch.Generator())
    term = method.loss(lesson, 0)["empty"]
    (gradient,) = torch.autograd.grad(term, [method.hyper.last[0].bias])
    assert float(term.detach()) > 0 and gradient.any()


def test_parts_of_photographs_and_cameras_around():
    photograph = tiny.scene().photograph(1)
    rays, picture = patch(photograph, tiny.scene().frame, torch.Generator().manual_seed(0))
    assert picture.shape == (24, 24, 3) and len(rays) == 24 * 24
    torch.testing.assert_close(rays.directions, photograph.camera.rays(photograph.camera.pixels()).directions)
    for camera in around(photograph.camera, tiny.scene().frame, 3, torch.tensor([0.0, 0.0, 1.0])):
        assert float(camera.position.norm()) == pytest.approx(float(photograph.camera.position.norm()), rel=1e-5)
        pixel, visible = camera.project(torch.zeros(1, 3))
        assert visible.all() and torch.allclose(pixel, camera.size / 2, atol=1e-3)


def test_cameras_stand_around_the_up_of_the_collection():
    """Members in a frame whose up is +y, as many files have it."""
    turn = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # z to y
    scene = replace(tiny.scene(), cameras=tiny.scene().cameras.transformed(turn))
    method = hyp_nerf()
    method.begin(Collection.of({"a": scene, "b": scene}, "lying"))
    torch.testing.assert_close(method.up, torch.tensor([0.0, 1.0, 0.0]), atol=0.05, rtol=0)
    for camera in around(scene.cameras[0], scene.frame, 4, method.up):
        assert 0.3 < float(camera.position[0] @ method.up) / float(camera.position.norm()) < 0.75
        assert float(camera.pose[0, :, 1] @ method.up) < -0.6 and abs(float(camera.pose[0, :, 0] @ method.up)) < 1e-5


def test_more_members_than_codes_and_places_without_bounds_are_refused():
    with pytest.raises(LumigraphError, match="has 4 members, and there is room for 2 codes; give --members 4"):
        hyp_nerf(members=2).begin(tiny_collection.collection())
    open_air = replace(tiny.scene(), frame=replace(tiny.scene().frame, reach=4.0), source="a garden")
    with pytest.raises(LumigraphError, match="a garden is a place without bounds"):
        hyp_nerf().batch(Collection.of({"a": open_air, "b": open_air}, "gardens"), torch.Generator())
    with pytest.raises(LumigraphError, match="a garden is a place without bounds"):
        hyp_nerf().given(open_air)


# Runs


@pytest.fixture
def prior(learnt, tmp_path) -> Run:
    run = Run.create(tmp_path / "prior", learnt, tiny_collection.collection())
    run.save(State(), learnt, [], torch.Generator())
    return run


def test_an_object_is_drawn_saved_and_opened(prior, tmp_path, capsys):
    pictures = []
    for seed, name in ((3, "a"), (3, "b"), (4, "c")):
        assert main(["infer", str(prior.folder), "--seed", str(seed), "--output", str(tmp_path / name)]) == 0
        run = Run(tmp_path / name)
        pictures.append(run.method().render(run.cameras()["train"][0].resized(0.03)).rgb)
    assert torch.equal(pictures[0], pictures[1]) and not torch.equal(pictures[0], pictures[2])
    assert main(["info", str(tmp_path / "a")]) == 0
    told = capsys.readouterr().out
    assert "seed 3" in told and "found, average, 1, 2, 3" in told
    for command in (["eval"], ["infer", str(prior.folder)], ["infer", str(prior.folder), "--seed", "1"]):
        words = {"eval": ["eval", str(tmp_path / "a")]}.get(command[0], [*command, "procedural:toys,member=1"])
        words = words if command != ["infer", str(prior.folder)] else command
        assert main(words) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert main(["infer", str(tmp_path / "a"), "--seed", "1"]) == 2 and "is no prior" in capsys.readouterr().err


def test_what_was_found_can_be_converted():
    assert way(HypNeRF, find("instant-ngp")) == "field" and way(find("instant-ngp"), HypNeRF) is None


def test_a_prior_that_draws_nothing_says_so(tmp_path, capsys):
    from test_priors import prior_run

    run = prior_run(tmp_path / "other")
    assert main(["infer", str(run.folder), "--seed", "1", "--output", str(tmp_path / "drawn")]) == 2
    assert "draws none of its own" in capsys.readouterr().err and not (tmp_path / "drawn").exists()
