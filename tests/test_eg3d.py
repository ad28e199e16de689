"""EG3D: its layers, three different planes, the adversaries' step, swapped poses, drawings, an inversion."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import tiny_collection
import torch
from budgets import budget
from torch.nn.functional import conv2d, conv_transpose2d

from lumigraph import methods
from lumigraph.camera import Camera
from lumigraph.commands.cli import main
from lumigraph.components.training import adversarial
from lumigraph.components.training.adversarial import Discriminator, doubled, halved, r1_penalty, widths_of
from lumigraph.errors import LumigraphError
from lumigraph.method import frozen
from lumigraph.method.controls import Value
from lumigraph.methods import eg3d as module
from lumigraph.methods.eg3d import EG3D, labels
from lumigraph.methods.eg3d.fields import PlaneField
from lumigraph.methods.eg3d.networks import ModulatedConvolution, SuperResolution, blurred
from lumigraph.metrics import psnr
from lumigraph.run import Run, State, build

pytestmark = budget("methods", 8)


def eg3d(**changes) -> EG3D:
    kind = methods.find("eg3d")
    frame = tiny_collection.collection().frame
    method = build(kind, frame, replace(kind.smallest(), **changes), torch.device("cpu"), 0)
    method.begin(tiny_collection.collection())
    return method


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def some_cameras(count: int) -> Camera:
    return tiny_collection.tinted("blue").cameras[slice(count)].resized(16 / 24)


# Adversarial layers


def test_losses_are_logarithms_of_probabilities():
    real, fake = random(5), random(5, seed=1)
    expected = -real.sigmoid().log().mean() - (1 - fake.sigmoid()).log().mean()
    torch.testing.assert_close(adversarial.discriminator_loss(real, fake), expected)
    torch.testing.assert_close(adversarial.generator_loss(fake), -fake.sigmoid().log().mean())


def test_r1_of_a_linear_function_is_half_its_squared_slope():
    """Logits a . x + b . y have the gradient (a, b) at every picture, and the penalty reaches a and b."""
    a, b = random(3, 4, 4).requires_grad_(), random(3, 2, 2, seed=1).requires_grad_()
    x, y = random(6, 3, 4, 4).requires_grad_(), random(6, 3, 2, 2, seed=2).requires_grad_()
    penalty = r1_penalty((a * x).sum((1, 2, 3)) + (b * y).sum((1, 2, 3)), [x, y])
    torch.testing.assert_close(penalty, 0.5 * (a.square().sum() + b.square().sum()))
    penalty.backward()
    torch.testing.assert_close(a.grad, a.detach())


def test_filters_keep_means_and_are_each_others_adjoints():
    """1 3 3 1: halving and doubling are transposes of each other, up to a factor of four, and keep a constant."""
    x, y = random(2, 3, 8, 8), random(2, 3, 4, 4, seed=1)
    torch.testing.assert_close((halved(x) * y).sum(), (x * doubled(y)).sum() / 4)
    for change in (halved, doubled):
        inner = change(torch.full((1, 2, 8, 8), 0.7))[..., 1:-1, 1:-1]
        torch.testing.assert_close(inner, torch.full_like(inner, 0.7))


def test_a_frozen_network_passes_gradients_on_and_gets_none():
    network, x = Discriminator(3, [4, 4], label=5, layers=1), random(2, 3, 8, 8).requires_grad_()
    with frozen(network):
        network(x, random(2, 5)).sum().backward()
    assert x.grad.abs().sum() > 0 and all(p.grad is None and p.requires_grad for p in network.parameters())


def test_the_average_follows_by_its_share():
    a, b = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    before = a.weight.detach().clone()
    adversarial.follow(a, b, 0.75)
    torch.testing.assert_close(a.weight, 0.75 * before + 0.25 * b.weight)


def test_the_discriminator_looks_at_the_label_and_at_the_group():
    torch.manual_seed(0)
    network, x = Discriminator(3, [4, 4, 4], label=5, layers=2), random(4, 3, 16, 16)
    one, other = network(x, random(4, 5)), network(x, random(4, 5, seed=1))
    assert one.shape == (4,) and (one != other).all()
    alone = network(x[:1], random(4, 5)[:1])  # no deviation among one picture
    assert (alone - one[:1]).abs() > 1e-6
    assert widths_of(64, 1024, 128) == [16, 32, 64, 128, 128]


# The generator


def test_a_modulated_convolution_is_one_with_other_weights():
    """Scaling inputs and outputs equals the paper's modulated and demodulated weights (Karras 2020, eqs. 1 to 3)."""
    torch.manual_seed(0)
    layer, x, style = ModulatedConvolution(5, 6, 4), random(2, 5, 7, 7), random(2, 4, seed=1)
    for i in range(2):
        w = layer.scale * layer.weight * layer.style(style[i])[None, :, None, None]
        w = w / (w.square().sum((1, 2, 3), keepdim=True) + 1e-8).sqrt()
        torch.testing.assert_close(layer(x, style)[i], conv2d(x[i : i + 1], w, padding=1)[0])


def test_upsampling_is_a_transposed_convolution_and_the_filter():
    torch.manual_seed(0)
    layer, x, style = (
        ModulatedConvolution(3, 4, 2, up=True, demodulated=False),
        random(1, 3, 5, 5),
        random(1, 2, seed=1),
    )
    w = layer.scale * layer.weight * layer.style(style)[0][None, :, None, None]
    line = torch.tensor([1.0, 3.0, 3.0, 1.0]) / 4
    kernel = (line[:, None] * line).expand(4, 1, 4, 4)
    expected = conv2d(conv_transpose2d(x, w.transpose(0, 1), stride=2), kernel, padding=1, groups=4)
    torch.testing.assert_close(layer(x, style), expected)
    assert layer(x, style).shape == (1, 4, 10, 10)


class Plain(torch.nn.Module):
    """Contents of the planes, unchanged."""

    def forward(self, x):
        return x[:, 0], x


def test_planes_are_three_different_ones():
    """A mark on one plane shows along the axis across it, and the three axes differ: the release reads one twice."""
    field = PlaneField(4, [4, 4], 4, 8, 4)
    field.decoder = Plain()
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 8)] * 3)
    along = []
    for plane in range(3):
        made = torch.zeros(3, 8, 8, 4)
        made[plane, 2, 5] = 1.0
        found, _ = field.found(made.view(-1, 4), grid)
        marked = grid[found > 0.3]
        assert len(marked) == 8
        spread = marked.std(0)
        along.append(int(spread.argmax()))
        assert (spread > 1e-6).sum() == 1
    assert sorted(along) == [0, 1, 2]


def test_every_plane_learns():
    field, points = PlaneField(4, [4, 4], 4, 8, 4), 2 * torch.rand(50, 3) - 1
    made = random(3 * 64, 4).requires_grad_()
    density, features = field.found(made, points)
    (density.sum() + features.sum()).backward()
    assert (made.grad.view(3, -1).abs().sum(1) > 0).all()


def test_super_resolution_has_its_factor():
    for factor in (2, 4):
        network = SuperResolution(5, (4, 4), 6, factor)
        assert network(torch.rand(2, 5, 8, 8), random(2, 6)).shape == (2, 3, 8 * factor, 8 * factor)


def test_the_blur_is_that_published():
    """2^-(x / s)^2 over three deviations: at half a pixel of deviation there is a pixel to either side."""
    x = torch.zeros(1, 1, 9, 9)
    x[..., 4, 4] = 1
    seen = blurred(x, 0.5)[0, 0, 4]
    assert seen[5] / seen[4] == pytest.approx(2**-4, rel=1e-4) and seen[6] == 0
    assert float(blurred(x, 0.5).sum()) == pytest.approx(1) and torch.equal(blurred(x, 0.1), x)


def test_labels_are_pose_and_intrinsics():
    cameras = some_cameras(3)
    found = labels(cameras)
    assert found.shape == (3, 25)
    torch.testing.assert_close(found[:, :12].view(3, 3, 4), cameras.pose)
    assert found[0, 15] == 1 and found[0, 16] == pytest.approx(32 / 24) and found[0, 18] == pytest.approx(0.5)
    torch.testing.assert_close(labels(cameras.resized(2.0)), found)


def test_the_viewpoint_is_the_camera_of_its_label():
    method = eg3d()
    torch.testing.assert_close(labels(method.viewpoint)[0], method.label)
    assert method.viewpoint.size.tolist() == [[16, 16]]


# Learning


def taught(method: EG3D, steps: int) -> list[tuple[list[str], list[int]]]:
    """Terms of each descent, and which optimizers took it."""
    optimizers, done = method.optimizers(), list[tuple[list[str], list[int]]]()
    data, generator = tiny_collection.collection(), torch.Generator().manual_seed(0)

    def descend(terms, chosen):
        for optimizer in chosen:
            optimizer.zero_grad(set_to_none=True)
        torch.stack(list(terms.values())).sum().backward()
        for optimizer in chosen:
            optimizer.step()
        done.append((list(terms), [optimizers.index(optimizer) for optimizer in chosen]))

    for step in range(steps):
        method.before_step(step, step / steps)
        method.step(method.batch(data, generator), step, descend)
        method.after_step(step)
    return done


def test_a_step_has_two_descents_and_lazy_terms(monkeypatch):
    monkeypatch.setattr(module, "R1_INTERVAL", 2)
    monkeypatch.setattr(module, "DENSITY_INTERVAL", 3)
    done = taught(eg3d(), 3)
    assert [chosen for _, chosen in done] == [[1], [0]] * 3
    assert [("r1" in terms) for terms, _ in done[::2]] == [True, False, True]
    assert [("density" in terms) for terms, _ in done[1::2]] == [True, False, False]


def test_the_generators_step_leaves_the_discriminator_alone():
    method, left = eg3d(), []
    method.optimizers()
    before = copy.deepcopy(method.discriminator.state_dict())

    def descend(terms, chosen):
        torch.stack(list(terms.values())).sum().backward()
        left.append([p.grad is None for p in method.discriminator.parameters()])
        if "generator" in terms:
            return
        method.discriminator.zero_grad(set_to_none=True)

    method.step(method.batch(tiny_collection.collection(), torch.Generator().manual_seed(0)), 0, descend)
    assert not any(left[0]) and all(left[1])
    assert all(torch.equal(before[name], value) for name, value in method.discriminator.state_dict().items())


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_the_generator_is_conditioned_on_its_own_pose_or_on_another(probability, monkeypatch):
    """From a probability of one at first to the paper's."""
    monkeypatch.setattr(module, "SWAP_PROBABILITY", probability)
    method, seen = eg3d(swap_pictures=100), []
    views, mapping = some_cameras(4), method.generator.mapping.forward
    monkeypatch.setattr(
        method.generator.mapping, "forward", lambda z, label: (seen.append(label), mapping(z, label))[1]
    )
    for step in (0, 1000):
        method._drawn(views, step, torch.Generator().manual_seed(0))
    torch.testing.assert_close(seen[0], labels(views).roll(1, 0))
    torch.testing.assert_close(seen[1], labels(views).roll(1, 0) if probability else labels(views))


def test_the_discriminator_sees_both_resolutions():
    method = eg3d()
    raw, pictures = torch.rand(2, 3, 8, 8), torch.rand(2, 3, 16, 16)
    both = method._discriminated(pictures, raw, 0.0)
    assert both.shape == (2, 6, 16, 16)
    torch.testing.assert_close(both[:, :3], 2 * pictures - 1)
    torch.testing.assert_close(both[:, 3:].mean(), (2 * raw - 1).mean(), atol=1e-2, rtol=0)
    assert eg3d(field="film")._discriminated(pictures, raw, 0.0).shape == (2, 3, 16, 16)


def test_the_rendering_grows(monkeypatch):
    monkeypatch.setattr(module, "GROWTH_START", 0.5)
    method = eg3d(rendering_size=8, final_rendering_size=16)
    sizes = []
    for progress in (0.0, 0.5, 0.5 + 0.5 / 27.5, 0.6, 1.0):
        method.before_step(0, progress)
        sizes.append(int(method.size))
    assert sizes == [8, 8, 12, 16, 16]


@pytest.mark.parametrize("field", ["planes", "film"])
def test_both_fields_learn(field):
    method = eg3d(field=field)
    before = {name: value.clone() for name, value in method.averaged.named_parameters()}
    taught(method, 3)
    for name, value in method.averaged.named_parameters():
        assert value.isfinite().all() and not torch.equal(before[name], value), name
    assert all(p.isfinite().all() for p in method.parameters())


def test_sizes_must_fit():
    with pytest.raises(LumigraphError, match="no power of two"):
        replace(EG3D.smallest(), picture_size=24).check()
    with pytest.raises(LumigraphError, match="larger than"):
        replace(EG3D.smallest(), rendering_size=32).check()


# Objects


def render(method, **controls: Value):
    return method.given(**controls).render(some_cameras(1)).rgb


def test_seeds_interpolate_and_truncation_ends_at_the_average():
    method = eg3d().eval()
    taught(method, 2)
    style = {seed: method.given(seed=seed)._style() for seed in (3.0, 3.25, 4.0)}
    torch.testing.assert_close(style[3.25], torch.lerp(style[3.0], style[4.0], 0.25))
    torch.testing.assert_close(method.given(seed=3.0, truncation=0.0)._style(), method.averaged.average)
    torch.testing.assert_close(render(method, seed=3.0), method.draw_object(3).render(some_cameras(1)).rgb)
    assert not torch.equal(render(method, seed=3.0), render(method, seed=4.0))
    assert [control.name for control in method.draw_object(3).controls] == ["truncation", "picture"]


def test_the_volume_rendering_is_what_its_field_shows():
    """The picture `volume` at the rendering's own size is the composited field, with nothing after it."""
    method = eg3d().eval()
    shown = method.given(picture="volume")
    camera = some_cameras(1).resized(0.5)
    rays = camera.rays(camera.pixels())
    with torch.no_grad():
        seen = method._seen(method.averaged.field, method.shown[0], rays)
    got = shown.render(some_cameras(1)).rgb
    small = torch.nn.functional.avg_pool2d(got.permute(2, 0, 1)[None], 2)[0].permute(1, 2, 0)
    assert psnr(small, seen.rgb.view(8, 8, 3)) > 25


def test_pictures_of_many_are_those_of_each():
    """One batch of cameras at once as each alone."""
    method = eg3d(pictures_per_step=2).eval()
    cameras = some_cameras(3)
    codes = torch.randn(2, 8, generator=torch.Generator().manual_seed(5))
    found = method.pictures(cameras, torch.Generator().manual_seed(5))
    assert found.shape == (3, 16, 16, 3)
    with torch.no_grad():
        style = method.averaged.mapping(codes[1:], labels(cameras[1]))
        made = method.averaged.field.made(method.averaged.repeated(style))
        alone = method._pictures(method.averaged, made, style, cameras[1])[0]
    torch.testing.assert_close(found[1], alone[0].permute(1, 2, 0))


def test_an_inversion_comes_closer_to_its_photograph(monkeypatch):
    """By the best of some styles, by descent from it, and further by the tuned generator; the prior itself is left as
    it was."""
    monkeypatch.setattr(module, "MAPPING_LAYERS", 1)
    method = eg3d(code_steps=0, tune_steps=0).eval()
    scene = tiny_collection.tinted("green")
    one = replace(scene, splits={"train": scene.splits["train"][:1]})
    camera = scene.cameras[one.splits["train"]].resized(16 / 24)
    truth = scene.photograph(int(one.splits["train"][0])).before(scene.frame.background)
    truth = torch.nn.functional.interpolate(truth.permute(2, 0, 1)[None], (16, 16), mode="area")[0].permute(1, 2, 0)
    before = {name: value.clone() for name, value in method.state_dict().items()}
    best = method.given(one)
    method.config = replace(method.config, code_steps=10)
    found = method.given(one)
    monkeypatch.setattr(module, "TUNE_LEARNING_RATE", 1e-2)
    method.config = replace(method.config, tune_steps=40)
    tuned = method.given(one)
    scores = [psnr(x.render(camera).rgb.clamp(0, 1), truth) for x in (method, best, found, tuned)]
    assert scores[0] + 1 < scores[1] and scores[1] + 0.5 < scores[2] and scores[2] + 1 < scores[3], scores
    for name, value in method.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_open_scenes_are_refused():
    scene = tiny_collection.tinted("green")
    with pytest.raises(LumigraphError, match="a place without bounds"):
        eg3d().given(replace(scene, frame=replace(scene.frame, reach=4.0)))


# The command


@pytest.fixture(scope="module")
def prior(tmp_path_factory) -> Run:
    method, data = eg3d(), tiny_collection.collection()
    run = Run.create(tmp_path_factory.mktemp("eg3d") / "prior", method, data)
    run.save(State(), method, method.optimizers(), torch.Generator())
    return run


def test_draw_writes_a_sheet_and_a_film(prior, tmp_path, capsys):
    sheet, film = tmp_path / "sheet.png", tmp_path / "film.gif"
    words = ["draw", str(prior.folder), "--seeds", "0,2", "--views", "3", "--output", str(sheet), "--film", str(film)]
    assert main([*words, "--frames", "2", "--set", "truncation=0.5"]) == 0
    assert sheet.stat().st_size > 1000 and film.stat().st_size > 100 and "4 frames" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--seeds", "5:5"], "names no seeds"),
        (["--seeds", "a"], "names no seeds"),
        (["--seeds", "0:300"], "more than 256 objects"),
        (["--inception", "file.pth"], "add --score"),
        (["--set", "no=1"], "no control"),
    ],
)
def test_draw_refuses_in_one_sentence(prior, words, sentence, tmp_path, capsys):
    assert main(["draw", str(prior.folder), *words, "--output", str(tmp_path / "sheet.png")]) == 2
    (told,) = capsys.readouterr().err.strip().splitlines()
    assert sentence in told and not (tmp_path / "sheet.png").exists()


def test_draw_refuses_what_draws_nothing(ball_run, tmp_path, capsys):
    assert main(["draw", str(ball_run.folder), "--output", str(tmp_path / "sheet.png")]) == 2
    (told,) = capsys.readouterr().err.strip().splitlines()
    assert "draws none of its own" in told


def test_cameras_turn_around_the_vertical():
    from lumigraph.commands.draw import turned

    around = turned(some_cameras(1), 4)
    heights, distances = around.position[:, 2], around.position.norm(dim=-1)
    assert (heights - heights[0]).abs().max() < 1e-6 and (distances - distances[0]).abs().max() < 1e-5
    flat = around.position[:, :2]
    assert math.isclose(float((flat[0] * flat[1]).sum()), 0, abs_tol=1e-5)
