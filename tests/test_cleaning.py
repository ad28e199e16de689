"""Cropping and cleaning: what a box and a sphere hold, which Gaussians go, and what is kept of a run."""

from __future__ import annotations

import itertools
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from balls import RED, WHITE, Dense, Splatted, eye
from test_gaussian_splatting import new

from lumigraph.camera import Camera
from lumigraph.camera.crop import Crop, CropBox, Sphere
from lumigraph.camera.rays import Rays
from lumigraph.commands import cli
from lumigraph.commands.export_menu import export_menu
from lumigraph.composition import PickedCloud, cropped
from lumigraph.composition.floaters import STRENGTH, evidence
from lumigraph.evaluation.photographs import of_floaters
from lumigraph.exchange import read_gaussians, write_gaussians
from lumigraph.files.ply import read_header, read_rows
from lumigraph.gaussians import Gaussians
from lumigraph.gaussians.cloud import cleaned, extent, joined, unwanted
from lumigraph.geometry import Similarity, to_matrix
from lumigraph.large import open_any
from lumigraph.run import Run
from lumigraph.training import fit
from lumigraph.viewer.cameras import ViewRequest

CROPS: dict[str, Crop] = {
    "box": CropBox((-0.3, -0.5, -0.2), (0.4, 0.1, 0.6)),
    "sphere": Sphere((0.1, -0.2, 0.3), 0.45),
}


def place() -> Similarity:
    rotation = to_matrix(torch.tensor([[0.8, 0.3, -0.4, 0.2]], dtype=torch.float64))[0]
    return Similarity.make(1.7, rotation, torch.tensor([0.3, -0.2, 0.5]))


@pytest.mark.parametrize("kind", CROPS)
def test_a_crop_is_the_same_part_of_space_in_every_frame(kind, generator):
    crop, points = CROPS[kind], 2 * torch.rand(4000, 3, generator=generator) - 1
    inside = crop.holds(points)
    assert 0.02 < inside.float().mean() < 0.3
    moved = crop.transformed(place())
    assert torch.equal(moved.holds(place().points(points.double())), inside)
    low, high = torch.tensor(moved.bounds)
    there = place().points(points)[inside]
    assert (there >= low - 1e-6).all() and (there <= high + 1e-6).all()
    assert (there.amin(0) - low).max() < 0.3 and (high - there.amax(0)).max() < 0.3
    assert moved.transformed(place().inverse).holds(points).ne(inside).sum() <= 1


@pytest.mark.parametrize("kind", CROPS)
def test_rays_are_inside_between_where_they_enter_and_leave(kind, generator):
    crop = CROPS[kind].transformed(place())
    origins = 3 * torch.randn(300, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator) - origins, dim=-1)
    rays = Rays(origins, directions, torch.zeros(300))
    enter, leave = crop.through(rays)
    t = torch.linspace(-2, 12, 400)
    within = crop.holds(origins[:, None] + t[:, None] * directions[:, None])
    expected = (t > enter[:, None]) & (t < leave[:, None])
    at_edge = ((t - enter[:, None]).abs() < 1e-4) | ((t - leave[:, None]).abs() < 1e-4)
    assert 40 < (enter < leave).sum() < 290
    assert torch.equal(within | at_edge, expected | at_edge)
    begin, hits = crop.entered(rays)
    assert torch.equal(hits, enter.clamp_min(0) < leave) and (begin >= 0).all()


@pytest.mark.parametrize("method", [Dense(RED), Splatted(RED)], ids=["ray", "cloud"])
def test_a_cropped_method_shows_what_lies_inside(method):
    half = cropped(method, CropBox((-1.0, 0.0, -1.0), (1.0, 1.0, 1.0)))
    camera = eye((-3.0, 0, 0))
    whole, seen = method.render(camera).opacity, half.render(camera).opacity
    y = camera.rays(camera.pixels()).at(torch.full((whole.numel(),), 3.0))[:, 1].view_as(whole)
    assert (seen - whole)[y > 0.1].abs().max() < 0.05
    assert seen[y < -0.1].max() < 0.05 < 0.9 < whole[y < -0.1].max()


def soiled() -> Gaussians:
    """A shell of 1500 Gaussians, and after them ten faint ones, ten large ones and ten isolated ones."""
    shell, chance = Splatted(RED).cloud, torch.Generator().manual_seed(1)
    away = torch.nn.functional.normalize(torch.randn(30, 3, generator=chance), dim=-1)
    bad = replace(
        shell[:30],
        means=torch.cat([0.5 * away[:20], 1.5 * away[20:]]),
        opacities=torch.cat([torch.full((10,), -6.0), torch.full((20,), 5.0)]),
        log_scales=torch.cat([torch.full((10, 3), 0.025), torch.full((10, 3), 3.0), torch.full((10, 3), 0.025)]).log(),
    )
    tensors = ("means", "quaternions", "log_scales", "opacities", "harmonics")
    both = {name: torch.cat([getattr(shell, name), getattr(bad, name)]) for name in tensors}
    return Gaussians(**both)


@pytest.mark.parametrize("unit", [1.0, 700.0])
def test_gaussians_go_each_for_its_first_reason_in_any_unit(unit):
    cloud = soiled().transformed(Similarity.make(unit).matrix)
    assert extent(cloud) == pytest.approx(unit, rel=0.15)  # of a ball of radius 0.5
    floating = evidence(cloud, None, WHITE).floaters(STRENGTH)
    assert floating[1520:].all() and not floating[:1500].any()
    reasons = unwanted(cloud, Sphere((0.0, 0.0, 0.0), unit), 1.0, floating | (cloud.means.norm(dim=-1) > 0.9 * unit))
    assert (
        [some.nonzero()[:, 0].tolist() for some in reasons.values()]
        == [
            list(range(1520, 1530)),  # outside the crop, whatever else
            list(range(1510, 1520)),
            floating[:1510].nonzero()[:, 0].tolist(),
        ]
    )
    assert len(cleaned(cloud)) == len(cloud) and len(cleaned(cloud, None, 1.0)) == len(cloud) - 10


@pytest.fixture(scope="module")
def cloud_run(tmp_path_factory) -> Run:
    """Gaussians that have learnt the tiny scene for some steps of sixty."""
    method, run = new(tmp_path_factory.mktemp("runs") / "cloud")
    fit(method, tiny.scene(), run, steps=60, pause_at=40, show=False, rehearsal=False)
    return run


def test_a_cleaned_run_opens_renders_and_goes_on(cloud_run, tmp_path, capsys):
    before = sorted(path.read_bytes() for path in cloud_run.folder.rglob("*") if path.is_file())
    said = ["clean", str(cloud_run.folder), "--box", *"-1 -1 -1 1 1 0".split(), "--output", str(tmp_path / "half")]
    assert cli.main([*said, "--device", "cpu"]) == 0
    told = capsys.readouterr().out
    run = open_any(tmp_path / "half")
    whole, half = cloud_run.method().gaussians(), run.method().gaussians()
    assert 0 < len(half) < len(whole) and half.means[:, 2].max() <= 0
    assert f"{len(half):,} of {len(whole):,} stay" in told and "outside the crop" in told
    assert (tmp_path / "half" / "clean.png").stat().st_size > 1000
    assert json.loads((tmp_path / "half" / "config.json").read_text())["cleaned"]["removed"]["outside the crop"] > 0
    method = run.new_method()
    outcome = fit(method, tiny.scene(), run, steps=60, show=False, rehearsal=False)
    assert outcome.finished and outcome.state.step == 60 and run.state.step == 60
    assert sorted(path.read_bytes() for path in cloud_run.folder.rglob("*") if path.is_file()) == before
    assert cli.main([*said]) == 2  # not over what is there
    assert "already holds a run" in capsys.readouterr().err


def test_the_moments_of_those_left_stay_with_them(cloud_run):
    method, generator = cloud_run.method(), torch.Generator()
    optimizers = method.optimizers()
    cloud_run.restore_training(optimizers, generator)
    optimizer = optimizers[0]
    moments = optimizer.state[method.cloud.means]["mean"].clone()
    assert moments.abs().max() > 0
    keep = torch.rand(len(method.cloud), generator=generator) < 0.5
    method.prune(keep)
    assert torch.equal(optimizer.state[method.cloud.means]["mean"], moments[keep])
    assert len(method.density_control.positional_gradient_sum) == int(keep.sum()) == len(method.gaussians())


def test_exports_of_a_part_hold_as_many_as_another_reader_counts(cloud_run, tmp_path, capsys):
    frame, cloud = cloud_run.frame, cloud_run.method().gaussians()
    corners = torch.tensor([[-1.0, -1, -1], [1, 1, 0]])
    source = frame.to_source.points(corners)
    low, high = source.amin(0), source.amax(0)
    numbers = [str(x) for x in torch.cat([low, high]).tolist()]
    folder = str(cloud_run.folder)
    assert cli.main(["export", "splats", folder, str(tmp_path / "a.ply"), "--box", *"-1 -1 -1 1 1 0".split()]) == 0
    assert cli.main(["export", "splats", folder, str(tmp_path / "b.ply"), "--units", "source", "--box", *numbers]) == 0
    expected = int(CropBox((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0)).holds(cloud.means).sum())
    for name in ("a.ply", "b.ply"):
        assert read_header(tmp_path / name).counts["vertex"] == expected
    assert cli.main(["clean", str(tmp_path / "a.ply"), "--sphere", *"0 0 0 0.8".split(), "--units", "source",
                     "--strength", "0", "--output", str(tmp_path / "c.ply")]) == 0  # fmt: skip
    there = read_rows(tmp_path / "c.ply", ["vertex"])["vertex"]
    positions = np.stack([there[k] for k in "xyz"], -1)
    assert 0 < len(positions) < expected and np.linalg.norm(positions, axis=-1).max() <= 0.8
    assert len(read_gaussians(tmp_path / "c.ply")) == len(positions)
    assert f"{len(positions):,} of {expected:,} stay" in capsys.readouterr().out


def test_an_export_removes_the_floaters_of_the_viewer(tmp_path):
    cloud = soiled()
    source, output = tmp_path / "soiled.ply", tmp_path / "clean.ply"
    write_gaussians(source, cloud)
    menu = export_menu(opened := open_any(source), opened.method(), (), "auto")
    defaults = {option.name: option.default for option in menu.formats["splats"].options}
    plain = ViewRequest(((1.0,),), 1.0, (9, 9), 9, "colour", (1.0, 1.0, 1.0), strength=STRENGTH)
    assert menu.command("splats", str(output), defaults, plain)[5:] == []  # coloured, and not removed
    command = menu.command("splats", str(output), defaults, replace(plain, cleaned=True))
    assert command[5:] == ["--strength=0.4"] and cli.main(command[1:]) == 0
    left = ~evidence(cloud, None, WHITE).floaters(STRENGTH)
    assert len(read_gaussians(output)) == int(left.sum()) < len(cloud)
    inside = menu.command("splats", str(output), defaults, replace(plain, crop=Sphere((0.0, 0.0, 0.0), 20.0)))
    assert inside[-1] == "--max-scale=0.25" and cli.main([*inside[1:], "--overwrite"]) == 0
    assert len(read_gaussians(output)) == len(cloud) - 10


def test_floaters_of_a_run_are_a_finding(cloud_run):
    scene, method = tiny.scene(), cloud_run.method()
    around = scene.cameras.position
    method.cloud.replace(joined([method.gaussians(), replace(soiled()[:12], means=0.7 * around[:12])]))
    [finding] = of_floaters(cloud_run, method, scene)
    gaussians, cameras = method.gaussians(), scene.cameras[scene.splits["train"]]
    count = int(evidence(gaussians, cameras, scene.frame).floaters(STRENGTH).sum())
    assert count >= 10 and finding.photograph == "" and finding.fault == "floaters"
    assert f"{count} of {len(gaussians)} Gaussians" in finding.evidence and "lumigraph clean" in finding.advice
    assert of_floaters(cloud_run, tiny.method(scene.frame), scene) == []


def test_a_run_without_its_cameras_is_left_as_it_is(cloud_run, tmp_path, capsys):
    run = shutil.copytree(cloud_run.folder, tmp_path / "run")
    (run / "cameras.json").write_text("{}")
    said = ["clean", str(run), "--strength", "0", "--box", *"-1 -1 -1 1 1 0".split()]
    assert cli.main([*said, "--output", str(tmp_path / "new")]) == 2
    assert "cameras.json" in capsys.readouterr().err and not (tmp_path / "new").exists()


REFUSED = {
    "no Gaussians": (["RAYS", "--output", "OUT"], "holds no Gaussians"),
    "a file to a run": (["FILE", "--output", "OUT"], "is no run"),
    "nothing left": (["FILE", "--sphere", "90", "0", "0", "1", "--output", "OUT.ply"], "No Gaussian is left"),
    "its own source": (["FILE", "--output", "FILE"], "is what the command reads"),
    "two crops": (["FILE", "--sphere", *"0 0 0 1".split(), "--box", *"0 0 0 1 1 1".split(), "--output", "OUT.ply"],
                  "two ways to crop"),
    "an empty box": (["FILE", "--box", *"0 0 0 1 1 -1".split(), "--output", "OUT.ply"], "holds nothing"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_cleaned_is_refused_in_a_sentence(case, ball_run, tmp_path, capsys):
    write_gaussians(tmp_path / "ball.ply", Splatted(RED).cloud)
    places = {
        "RAYS": ball_run.folder,
        "FILE": tmp_path / "ball.ply",
        "OUT": tmp_path / "new",
        "OUT.ply": tmp_path / "new.ply",
    }
    arguments, sentence = REFUSED[case]
    assert cli.main(["clean", *(str(places.get(x, x)) for x in arguments)]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1
    assert not (tmp_path / "new").exists() and not (tmp_path / "new.ply").exists()


def test_picked_gaussians_look_as_they_did():
    method, camera = Splatted(RED), eye((-3.0, 0, 0))
    seen = PickedCloud(WHITE, method.cloud).render(camera)
    assert torch.equal(seen.rgb, method.render(camera).rgb)


def test_the_score_orders_blobs_above_the_surface_and_the_strength_is_monotone():
    shell = soiled()
    around = torch.tensor([[3.0, 0, 0], [-3, 0, 0], [0, 3, 0], [0, -3, 0], [0.1, 0.1, 3], [2, 2, 1], [-2, 2, 1]])
    cameras = Camera.cat([eye(tuple(place.tolist())) for place in around])
    blobs = replace(shell[:14], means=around.repeat(2, 1) * torch.tensor([0.3] * 7 + [0.7] * 7)[:, None])
    cloud = joined([shell[:1500], blobs])
    before = cloud.means.clone()
    found = evidence(cloud, cameras, WHITE)
    assert found.score[1500:].min() > found.score[:1500].max()
    masks = [found.floaters(strength) for strength in (0.0, 0.2, 0.4, 0.7, 1.0)]
    assert not masks[0].any() and masks[2][1500:].all() and not masks[2][:1500].any()
    assert all((a <= b).all() for a, b in itertools.pairwise(masks))
    assert torch.equal(cloud.means, before)
