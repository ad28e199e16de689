"""The method, its files, its commands: it learns, resumes to the bit while its cloud grows, and exports in place."""

from __future__ import annotations

import warnings

import pytest
import tiny
import torch
from budgets import budget
from test_gaussians import NAMES, cloud, similarity

from lumigraph import methods
from lumigraph.commands import cli
from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation.views import evaluate
from lumigraph.exchange import read_gaussians, write_gaussians
from lumigraph.files.ranges import changed
from lumigraph.gaussians.splatting import render
from lumigraph.method.capabilities import HasGaussians, needs
from lumigraph.metrics import psnr
from lumigraph.run import Run, build
from lumigraph.run.files import SplatFile
from lumigraph.system import memory
from lumigraph.training import fit

pytestmark = [budget("methods", 10), pytest.mark.filterwarnings("ignore:The cloud stops growing")]
GROWING = {
    "densify_grad_threshold": 1e-5,
    "max_gaussians": 600,
    "cap_ramp": True,
    "initial_gaussians": 300,
    "opacity_reset_interval": 25,
}


def new(folder=None, **config):
    """A method that changes its cloud early and often, and a run for it."""
    kind, scene = methods.find("gaussian-splatting"), tiny.scene()
    method = build(kind, scene.frame, changed(kind.Config(), **GROWING | config), torch.device("cpu"), 0)
    return method, None if folder is None else Run.create(folder, method, scene)


@pytest.mark.parametrize(
    "config", [{}, {"strategy": "mcmc"}, {"strategy": "error", "filter_3d": True, "antialiased": True}]
)
def test_it_learns_a_scene(config):
    method, _ = new(opacity_reset_interval=1000, **config)
    fit(method, tiny.scene(), steps=1, show=False, rehearsal=False)
    before = evaluate(method, tiny.scene()).psnr
    method, _ = new(opacity_reset_interval=1000, **config)
    fit(method, tiny.scene(), steps=160, show=False, rehearsal=False)
    after = evaluate(method, tiny.scene()).psnr
    assert after > 20 and after > before + 8, (before, after)
    assert 300 < len(method.cloud) <= 600


@pytest.mark.parametrize(
    "config", [{}, {"strategy": "mcmc", "few_views": "yes"}, {"strategy": "error", "filter_3d": True}]
)
def test_resuming_across_a_growing_cloud_is_exact(config, tmp_path):
    """Stopped after the cloud has grown, and before it grows again."""
    config = {"refine_until": 0.9, "max_gaussians": 2000, "densify_grad_threshold": 1e-3, **config}
    (a, straight), (b, broken) = new(tmp_path / "a", **config), new(tmp_path / "b", **config)
    fit(a, tiny.scene(), straight, steps=60, show=False, rehearsal=False)
    fit(b, tiny.scene(), broken, steps=60, pause_at=25, show=False, rehearsal=False)
    assert 300 != len(broken.method().cloud) != len(straight.method().cloud)
    again = broken.new_method()
    fit(again, tiny.scene(), Run(broken.folder), steps=60, show=False, rehearsal=False)
    expected, actual = straight.method().state_dict(), Run(broken.folder).method().state_dict()
    assert expected.keys() == actual.keys()
    for name in expected:
        assert torch.equal(expected[name], actual[name]), name


@pytest.mark.parametrize("strategy", ["error", "mcmc"])
def test_where_memory_is_short_it_stops_growing_and_says_so(strategy, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 0)
    method, _ = new(strategy=strategy)
    with pytest.warns(LumigraphWarning, match="memory is short"):
        fit(method, tiny.scene(), steps=60, show=False, rehearsal=False)
    assert len(method.cloud) <= 300


def test_masked_pixels_teach_nothing():
    method, _ = new()
    scene = tiny.scene()
    method.optimizers()
    method.begin(scene)
    method.before_step(0, 0.0)
    photograph = scene.photograph(1)
    blind = type(photograph)(photograph.camera, photograph.rgb, None, torch.zeros(24, 24, dtype=torch.bool))
    sum(method.loss(blind, 0).values()).backward()
    taught = max(getattr(method.cloud, name).grad.abs().max().item() for name in NAMES)
    seeing = type(photograph)(photograph.camera, photograph.rgb)
    method.cloud.zero_grad()
    sum(method.loss(seeing, 0).values()).backward()
    assert taught < 1e-4 * max(getattr(method.cloud, name).grad.abs().max().item() for name in NAMES)


def test_harmonics_rise_in_steps():
    method, _ = new(sh_degree=3)
    method.optimizers()
    raised = []
    for step, progress in [(0, 0.0), (999, 0.01), (1000, 0.01), (10, 0.3), (5000, 0.9)]:
        method.before_step(step, progress)
        raised.append(method.bands)
    assert raised == [1, 1, 2, 3, 4]


def test_exports_lie_in_the_frame_of_the_photographs(tmp_path):
    """Seen by the source's cameras, the file looks as the run does from the scene's."""
    some, matrix = cloud(), similarity()
    frame = Frame(source_from_scene=tuple(tuple(row) for row in matrix.tolist()))
    write_gaussians(tmp_path / "out.ply", some.transformed(frame.to_source.matrix))
    eye = tiny.scene().cameras[1]
    here = render(some, eye, (0.0, 0.0, 0.0))
    there = render(read_gaussians(tmp_path / "out.ply"), eye.transformed(matrix), (0.0, 0.0, 0.0))
    assert psnr(here.rgb, there.rgb) > 70 and here.opacity.max() > 0.5


def test_a_run_becomes_a_file_that_opens_as_a_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene = tiny.write_blender(tmp_path / "scene")
    options = ["--steps", "30", "--initial-gaussians", "200", "--output", str(tmp_path / "run")]
    assert cli.main(["train", "gaussian-splatting", str(scene), *options]) == 0
    count = len(Run(tmp_path / "run").method().cloud)
    assert count > 200
    for name in ("a.ply", "a.spz", "a.splat", "a.compressed.ply", "a.sog", "a.glb"):
        assert cli.main(["export", "splats", str(tmp_path / "run"), name]) == 0
        assert cli.main(["info", name]) == 0
        assert f"{count:,} Gaussians" in capsys.readouterr().out
    before = (tmp_path / "a.spz").read_bytes()
    assert cli.main(["render", "a.spz", "--frames", "2", "--size", "32"]) == 0
    assert (tmp_path / "renders/a/orbit.mp4").stat().st_size > 0 and (tmp_path / "a.spz").read_bytes() == before
    assert cli.main(["export", "splats", "a.spz", "b.ply"]) == 0
    assert len(read_gaussians(tmp_path / "b.ply")) == count
    assert cli.main(["eval", str(tmp_path / "run")]) == 0


def test_a_file_stands_upright_and_in_the_middle(tmp_path):
    """Files have y down by custom: what is up there, at negative y, is up on the picture."""
    from lumigraph.kernels.spherical_harmonics import K00

    some = cloud(200, degree=0)
    with torch.no_grad():
        some.means[:] *= torch.tensor([1.0, 3.0, 1.0])
        some.means[:] += torch.tensor([5.0, -7.0, 2.0])
        some.opacities[:] = 3.0
        some.harmonics[:, 0] = torch.where(some.means[:, 1:2] < -7.0, 1.0, -1.0) * torch.tensor([0.5, 0, -0.5]) / K00
    write_gaussians(tmp_path / "a.ply", some)
    file = SplatFile(tmp_path / "a.ply")
    seen = file.method().render(file.cameras()["train"][0].resized(0.1))
    red, blue = (seen.rgb[..., k].double() for k in (0, 2))
    rows = torch.arange(80.0).double()[:, None]
    assert (red * rows).sum() / red.sum() < (blue * rows).sum() / blue.sum() - 10
    columns = (seen.opacity * torch.arange(80.0)).sum() / seen.opacity.sum()
    assert abs(columns - 40) < 8


def test_faults_in_files_are_one_sentence(tmp_path, capsys):
    (tmp_path / "broken.spz").write_bytes(b"NGSP\x03")
    for command in (["render", str(tmp_path / "broken.spz")], ["info", str(tmp_path / "broken.spz")]):
        assert cli.main(command) == 2
        assert "broken.spz" in capsys.readouterr().err
    assert cli.main(["render", str(tmp_path / "gone.ply")]) == 2
    assert "gone.ply" in capsys.readouterr().err
    assert cli.main(["export", "splats", str(tmp_path / "gone.ply"), str(tmp_path / "x.spz")]) == 2


def test_a_method_without_gaussians_says_so():
    with pytest.raises(LumigraphError, match="holds no Gaussians"):
        needs(tiny.method(), HasGaussians)


def test_no_memory_figure_means_no_limit(monkeypatch):
    def refuse(*_, **__):
        raise OSError

    monkeypatch.setattr("builtins.open", refuse)
    assert memory.free_memory() == 1 << 50
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert memory.room_for(4096, torch.device("cpu")) > 10**9
