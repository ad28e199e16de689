"""`lumigraph convert`: a method begins as what another one holds, learns on, and says how alike they are."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.camera import ring
from lumigraph.camera.rays import Look, Samples
from lumigraph.commands.cli import main
from lumigraph.commands.convert import kept, verdict
from lumigraph.components.clouds.initialization import rotation_to_normal
from lumigraph.components.fields.spaces import space_of
from lumigraph.components.fields.teacher import DepthTeacher, FieldTeacher, logit, teacher_of
from lumigraph.datasets.scene import Frame
from lumigraph.derive import conversion
from lumigraph.derive.conversion import between, convert, rendered_scene, ways
from lumigraph.derive.options import ConvertOptions
from lumigraph.errors import LumigraphError
from lumigraph.exchange import write_gaussians
from lumigraph.geometry import to_matrix, unit
from lumigraph.kernels import spherical_harmonics
from lumigraph.large import open_any
from lumigraph.method import RayMethod
from lumigraph.method.capabilities import FromField, HasField, HasGaussians, can
from lumigraph.metrics import psnr
from lumigraph.run import Run, build
from lumigraph.run.derived import Converted, MeasuredModel
from lumigraph.system.signals import Stopped
from lumigraph.training import fit

pytestmark = budget("runs", 15)

STUDENTS = [name for name in methods.available() if can(methods.find(name), FromField)]
RADIUS, DENSITY = 0.6, 40.0


class Ball(RayMethod):
    """The tiny scene as a field: a ball whose colour is where it is.

    rubbish: density that its field claims elsewhere, where no picture of it asks
    """

    def __init__(self, frame: Frame, rubbish: float = 0.0):
        super().__init__(frame, None)
        self.rubbish = rubbish

    def batch(self, data, generator):
        raise NotImplementedError

    def density(self, points):
        return torch.where(points.norm(dim=-1) < RADIUS, DENSITY, self.rubbish)

    def field(self, points, directions):
        return self.density(points), (0.5 + points / 1.2).clamp(0, 1)

    def looks(self, rays):
        t = torch.linspace(2.3, 3.7, 57).expand(len(rays), -1)
        samples = Samples.rows(t[:, :-1], t[:, -1])
        points, directions = samples.along(rays)
        density, rgb = self.field(points, directions)
        return [Look("only", samples, density * (points.norm(dim=-1) < RADIUS), rgb)]


@dataclass(frozen=True)
class Painted:
    """A teacher whose field is transparent paint: colours are harmonics that the test knows."""

    harmonics: torch.Tensor
    device: torch.device = torch.device("cpu")

    def density(self, points):
        return torch.ones(len(points))

    def field(self, points, directions):
        return self.density(points), (spherical_harmonics(directions, 3) @ self.harmonics).sigmoid()


@pytest.fixture(scope="module")
def ball() -> Ball:
    return Ball(tiny.scene().frame).eval()


@pytest.fixture(scope="module")
def known(ball) -> FieldTeacher:
    return teacher_of(ball, tiny.scene().cameras)


def student_of(name: str):
    kind = methods.find(name)
    return build(kind, tiny.scene().frame, kind.smallest(), torch.device("cpu"), 0)


def likeness(one, other) -> float:
    cameras = tiny.scene().cameras
    return psnr(*(torch.stack([x.eval().render(cameras[i]).rgb.clamp(0, 1) for i in (0, 4, 8)]) for x in (one, other)))


# What is taken over


@pytest.mark.parametrize("name", STUDENTS)
def test_a_method_begins_as_what_another_holds(name, ball):
    fresh, student = student_of(name), student_of(name)
    student.from_field(ball, tiny.scene().cameras)
    before, after = likeness(fresh, ball), likeness(student, ball)
    assert after > max(14.0, before + 5)


def test_nothing_is_taken_where_cameras_see_past(ball, generator):
    full = Ball(ball.frame, rubbish=50.0).eval()
    points = 2 * torch.rand(4000, 3, generator=generator) - 1
    away, density = points.norm(dim=-1), teacher_of(full, tiny.scene().cameras).density(points)
    assert (full.density(points) > 0).all() and (density[away < RADIUS - 0.05] == DENSITY).all()
    assert (density[away > RADIUS + 0.25] == 0).float().mean() > 0.99


def test_surfaces_are_where_cameras_see_them(known):
    seen = known.surface
    assert len(seen) > 500 and (seen.points.norm(dim=-1) - RADIUS).abs().median() < 0.05
    along = (unit(seen.points) * seen.normals).sum(-1).abs()
    assert along.median() > 0.9
    turned = to_matrix(rotation_to_normal(seen.normals))[:, :, 2]
    torch.testing.assert_close((turned * seen.normals).sum(-1).abs(), torch.ones(len(seen)))


def test_pictures_with_depth_become_a_shell(ball, known, generator):
    shell = DepthTeacher(known.depth_maps)
    ways = unit(torch.randn(500, 3, generator=generator))
    ways = ways[(ways[:, 2].abs() < 0.6)]  # where the ring of cameras looks squarely
    thickness = sum(shell.density(r * ways) * 0.01 for r in torch.linspace(1.2, 0.4, 81).tolist())
    before = sum(shell.density(r * ways) * 0.01 for r in torch.linspace(1.2, 0.75, 46).tolist())
    assert thickness.median() > 2 and before.max() < 0.5
    colour = torch.stack([shell.glance(RADIUS * ways, seen) for seen in shell.depth_maps])
    sees = torch.stack([seen.sees(RADIUS * ways) for seen in shell.depth_maps])
    error = (colour - (0.5 + RADIUS * ways / 1.2)).abs().mean(-1)
    assert error[sees].median() < 0.06
    density, rgb = shell.field(RADIUS * ways, -ways)
    assert can(shell, HasField) and density.equal(shell.density(RADIUS * ways))
    assert (rgb - (0.5 + RADIUS * ways / 1.2)).abs().mean(-1)[sees.any(0)].median() < 0.06


def test_harmonics_are_found_again(known, generator):
    wanted = 0.3 * torch.randn(9, 3, generator=generator)
    points = 0.1 * torch.randn(50, 3, generator=generator)
    depth_maps = [replace(seen, depth=torch.full_like(seen.depth, torch.inf)) for seen in known.depth_maps]
    found = FieldTeacher(depth_maps, Painted(wanted)).harmonics(points, 3, logit)
    directions = unit(points - known.depth_maps[3].camera.position)
    seen = (spherical_harmonics(directions, 3)[:, None] @ found)[:, 0]
    torch.testing.assert_close(seen, spherical_harmonics(directions, 3) @ wanted, atol=0.05, rtol=0)


def test_density_in_a_cube_stops_what_its_parts_stop(known, generator):
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.95]])
    density = known.density_around(points, torch.tensor([0.1, 0.1]), generator)
    torch.testing.assert_close(density, torch.tensor([DENSITY, 0.0]), atol=1e-3, rtol=1e-3)


def test_cells_hold_what_there_is(known, generator):
    held = known.occupied(space_of(tiny.scene().frame), 32, 0.5, generator)
    centres = (held.nonzero() + 0.5) / 16 - 1
    assert held[16, 16, 16] and held[16, 16, 24] and not held[2, 2, 2]
    assert centres.norm(dim=-1).max() < 1.2


# Pictures to learn from


def test_a_teachers_renderings_are_a_scene(ball):
    cameras = tiny.scene().cameras
    scene = rendered_scene(ball, cameras, "a ball", float("inf"))
    assert len(scene) == 24 and scene.images.has_alpha
    shown = scene.photograph(3).before(scene.frame.background)
    assert psnr(shown, ball.render(scene.cameras[3]).rgb) > 40
    assert len(rendered_scene(ball, cameras, "a ball", 0.0)) == 8


def test_cameras_between_others_look_the_same_way():
    cameras = tiny.scene().cameras
    aside = between(cameras)
    moved = (aside.position - cameras.position).norm(dim=-1)
    assert (moved > 0.1).all() and (aside.forward * cameras.forward).sum(-1).min() > 0.9
    torch.testing.assert_close(aside.pose[:, :, :3].mT @ aside.pose[:, :, :3], torch.eye(3).expand(12, 3, 3))


# The command


def test_what_goes_into_what_follows_from_capabilities(capsys):
    found = ways()
    for name, into in found.items():
        for other, how in into.items():
            if other in STUDENTS and how is not None:
                cloud = all(can(methods.find(x), HasGaussians) for x in (name, other))
                assert how == ("gaussians" if cloud else "field" if can(methods.find(name), HasField) else "depth")
    assert found["voxel-grid"]["plenoxels"] == "depth" and found["plenoxels"]["voxel-grid"] == "pictures"
    assert found["plenoxels"]["fourier-features"] is None and found["nerf"]["instant-ngp"] == "field"
    assert main(["convert", "--list"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in methods.available())


@pytest.fixture(scope="module")
def made(ball_run, tmp_path_factory) -> Run:
    """A run without photographs as splats."""
    folder = tmp_path_factory.mktemp("made") / "splats"
    kind = methods.find("gaussian-splatting")
    convert(ball_run, "gaussian-splatting", folder, ConvertOptions(steps=72, views=3), config=kind.smallest())
    return Run(folder)


def test_a_run_becomes_one_of_another_method(made, ball_run, capsys):
    said = Converted.read(made.folder)
    assert (said.how, said.learnt_from, said.views, said.steps) == ("depth", "renderings of the source", 3, 72)
    assert said.student.bytes == made.model_bytes and said.teacher.bytes == ball_run.model_bytes
    assert said.teacher.psnr is None and said.student.method == "gaussian-splatting"
    views = [
        torch.stack([x.render(c).rgb.clamp(0, 1) for c in held_out(ball_run)])
        for x in (made.method(), ball_run.method())
    ]
    assert said.psnr == pytest.approx(psnr(*views), abs=1.0) and said.psnr > 20  # 23.4, whatever the seed
    assert main(["info", str(made.folder)]) == 0
    assert "converted" in capsys.readouterr().out
    assert made.cameras()["test"].pose.equal(ball_run.cameras()["test"].pose)


def held_out(run: Run):
    cameras = run.cameras()["test"]
    return [cameras[i] for i in range(len(cameras))]


def test_schedules_go_on_from_the_middle(made):
    assert made.settings.budget == {"steps": 72, "joined": [0.0, 0.5]}
    first = made.metrics()[0]
    before = first["step"] - 1
    assert first["learning_rate"][0] == pytest.approx(
        made.method().learning_rates(before, 0.5 + 0.5 * before / 72)["means"]
    )


@pytest.mark.parametrize(
    ("name", "given", "steps", "seconds", "own"),
    [
        ("plenoctrees", [], 800, None, {"octree_depth": 9}),
        ("plenoctrees", ["--octree-depth", "5", "--seconds", "7"], None, 7.0, {"octree_depth": 5}),
        ("snerg", [], 800, None, {"voxel_learning_rate": 0.003, "resolution": 400}),
        ("plenoxels", [], None, 30.0, {}),
    ],
)
def test_defaults_follow_another_method(name, given, steps, seconds, own, ball_run, tmp_path, monkeypatch):
    """The octree's depth, and steps, where the user names none."""
    aims = []

    def noted(source, name, output, aim, device, show, config):
        aims.append((aim.limited(methods.find(name).taught_steps), config))
        raise LumigraphError("noted")

    monkeypatch.setattr(conversion, "convert", noted)
    words = ["convert", str(ball_run.folder), name, "--output", str(tmp_path / "new"), "--device", "cpu", *given]
    assert main(words) == 2
    assert (aims[0][0].steps, aims[0][0].seconds) == (steps, seconds)
    assert {key: getattr(aims[0][1], key) for key in own} == own
    assert methods.find("plenoctrees").preset(torch.device("cpu")).octree_depth == 8  # of training


def test_photographs_are_learnt_from_where_they_are(ball_folder, tmp_path, capsys):
    words = [
        "train",
        "voxel-grid",
        str(ball_folder),
        "--steps",
        "40",
        "--output",
        str(tmp_path / "a"),
        "--device",
        "cpu",
    ]
    assert main(words) == 0
    words = ["convert", str(tmp_path / "a"), "voxel-grid", "--output", str(tmp_path / "b"), "--device", "cpu"]
    assert main([*words, "--steps", "30", "--views", "2", "--rays", "128"]) == 0
    printed = capsys.readouterr().out
    said = Converted.read(tmp_path / "b")
    assert said.how == "pictures" and said.learnt_from == "photographs" and said.views == 2
    assert said.student.psnr > 15 and "PSNR against photographs" in printed
    assert re.search(r"cost +-?\d+\.\d\d dB, .*B instead of .*B, \d+ s", printed)
    assert Run(tmp_path / "b").settings.config["rays"] == 128
    assert main(["eval", str(tmp_path / "b"), "--views", "1"]) == 0


def test_a_splat_file_is_a_teacher(made, tmp_path, monkeypatch):
    monkeypatch.setattr("lumigraph.run.opened.ring", partial(ring, size=48))
    write_gaussians(tmp_path / "cloud.ply", made.method().gaussians().transformed(made.frame.to_source.matrix))
    kind = methods.find("plenoxels")
    said = convert(
        open_any(tmp_path / "cloud.ply"),
        "plenoxels",
        tmp_path / "out",
        ConvertOptions(steps=4, views=1),
        config=kind.smallest(),
    )
    assert said.how == "depth" and said.teacher.bytes == (tmp_path / "cloud.ply").stat().st_size
    assert Run(tmp_path / "out").method().render(held_out(made)[0].resized(0.5)).rgb.isfinite().all()


def test_the_same_command_goes_on_where_it_was_stopped(ball_run, tmp_path, monkeypatch):
    aim = {"aim": ConvertOptions(steps=12, views=1), "config": methods.find("plenoxels").smallest()}
    straight = convert(ball_run, "plenoxels", tmp_path / "straight", **aim)
    stopping = lambda *told, **more: replace(fit(*told, **more, pause_at=5), signal=2)  # noqa: E731
    monkeypatch.setattr(sys.modules["lumigraph.derive.conversion"], "fit", stopping)  # the function has its name
    with pytest.raises(Stopped):
        convert(ball_run, "plenoxels", tmp_path / "broken", **aim)
    assert Converted.read(tmp_path / "broken") is None and Run(tmp_path / "broken").state.step == 5
    assert kept(tmp_path / "broken") == "Stopped and saved after step 5 of training; the same command goes on"
    assert kept(tmp_path / "none") == "Stopped before training, so nothing is kept; the same command begins anew"
    monkeypatch.undo()
    broken = convert(ball_run, "plenoxels", tmp_path / "broken", **aim)
    one, other = (Run(tmp_path / name).method().state_dict() for name in ("straight", "broken"))
    assert all(torch.equal(value, other[name]) for name, value in one.items())
    assert broken.psnr == straight.psnr and broken.steps == 12
    with pytest.raises(LumigraphError, match="already holds a run"):
        convert(ball_run, "plenoxels", tmp_path / "broken", **aim)


@pytest.mark.parametrize(
    ("student", "learnt_from", "said"),
    [
        ((500, 0.1, 31.0), "photographs", "better: 2.0 times smaller, 2.0 times faster and 1.00 dB closer to the phot"),
        ((2000, 0.1, 29.0), "photographs", "better: 2.0 times faster; worse: 2.0 times larger and 1.00 dB farther"),
        ((2000, 0.4, 29.0), "photographs", "for longer: lumigraph resume OUT --steps 30"),
        ((2000, 0.4, None), "renderings of the source", "for longer: convert again with a longer --seconds"),
    ],
    ids=["better in every row", "both", "worse in every row", "worse without photographs"],
)
def test_the_verdict_in_words(student, learnt_from, said, tmp_path):
    scene = tiny.scene()
    Run.create(tmp_path / "new", tiny.method(scene.frame), scene, budget=Budget(10).to_json())
    old, new = MeasuredModel("a", 1000, 0.2, 30.0), MeasuredModel("b", *student)
    made = Converted("RUN", "field", learnt_from, old, new, 30.0, 2, 1.0, 10, 1.0)
    told = verdict(made, Path("RUN"), tmp_path / "new").replace(str(tmp_path / "new"), "OUT")
    assert said in told and told.startswith("better" if "better" in said else "worse in every row: 2.0 times larger")
    assert "keep RUN" in told or "better" in said


REFUSED = {
    "a picture": (["RAYS", "fourier-features", "--output", "OUT"], "holds pictures, and no scene in space"),
    "a learner of shapes": (["RAYS", "distance-grid", "--output", "OUT"], "distance-grid learns from shapes"),
    "no method": (["RAYS", "plenoxel", "--output", "OUT"], "did you mean plenoxels?"),
    "no output": (["RAYS", "plenoxels"], "Name a run, a method and a new folder"),
    "no run": (["/nowhere", "plenoxels", "--output", "OUT"], "/nowhere does not exist"),
    "its own source": (["RAYS", "plenoxels", "--output", "RAYS"], "already holds a run"),
    "a composition": (["TWO", "plenoxels", "--output", "OUT"], "convert its parts"),
    "a moving scene": (["MOVING", "plenoxels", "--output", "OUT"], "of a scene that moves"),
    "other photographs": (["RAYS", "plenoxels", "--output", "OUT", "--scene", "/nowhere"], "nowhere"),
    "two budgets": (["RAYS", "plenoxels", "--output", "OUT", "--steps", "3", "--seconds", "3"], "give one of them"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(case, ball_run, made, tmp_path, capsys):
    places = {
        "RAYS": ball_run.folder,
        "OUT": tmp_path / "new",
        "TWO": tmp_path / "two.json",
        "MOVING": tmp_path / "moving",
    }
    if case == "a composition":
        assert main(["compose", str(made.folder), str(made.folder), "--output", str(places["TWO"])]) == 0
    if case == "a moving scene":
        (tmp_path / "moving").mkdir()
        for name in ("config.json", "cameras.json"):
            said = json.loads((ball_run.folder / name).read_text())
            if name == "config.json":
                said["frame"]["times"] = [0.0, 1.0]
            (tmp_path / "moving" / name).write_text(json.dumps(said))
    words, sentence = REFUSED[case]
    capsys.readouterr()
    assert main(["convert", *(str(places.get(word, word)) for word in words)]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.splitlines()[-1].startswith("lumigraph: ") and not (tmp_path / "new").exists()


def test_what_converting_came_to_is_read_by_its_layout(made, tmp_path):
    said = json.loads((made.folder / "convert.json").read_text())
    (tmp_path / "convert.json").write_text(json.dumps(said | {"how": "magic"}))
    with pytest.raises(LumigraphError, match="how"):
        Converted.read(tmp_path)
