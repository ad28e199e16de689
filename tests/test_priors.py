"""Priors: what learns across a collection, and the ordinary runs that it makes of single scenes."""

from __future__ import annotations

import json
import shutil

import pytest
import tiny
import tiny_collection
import tiny_shapes
import torch
from budgets import budget
from PIL import Image

from lumigraph import methods
from lumigraph.commands.cli import main
from lumigraph.datasets.collection import MAX_OPEN, Collection
from lumigraph.datasets.scene import Scene
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation.views import reveal
from lumigraph.method.prior import Prior
from lumigraph.opening import kind_of, open_dataset
from lumigraph.run import Run, State, build
from lumigraph.run.derived import Inferred
from lumigraph.system import memory

pytestmark = budget("capture", 20)

CPU = torch.device("cpu")


def prior_run(folder, name: str = "tinted-grid") -> Run:
    kind, data = methods.find(name), tiny_collection.collection()
    method = build(kind, data.frame, kind.smallest(), CPU, 0)
    method.begin(data)
    run = Run.create(folder, method, data)
    run.save(State(), method, method.optimizers(), torch.Generator())
    return run


@pytest.fixture(params=["tinted-grid", "pixelnerf"])
def prior(request, tmp_path):
    return prior_run(tmp_path / "prior", request.param)


def said(capsys, *command: object) -> str:
    """The one sentence that refuses a command."""
    capsys.readouterr()
    assert main([str(word) for word in command]) == 2
    (told,) = capsys.readouterr().err.strip().splitlines()
    return told


# Runs of one scene


def test_a_prior_makes_an_ordinary_run(prior, ball_folder, tmp_path, capsys):
    photographs, found = tmp_path / "photographs", tmp_path / "found"
    shutil.copytree(ball_folder, photographs)
    assert main(["infer", str(prior.folder), str(photographs), "--views", "2", "--output", str(found)]) == 0
    assert "2 photographs" in capsys.readouterr().out
    run = Run(found)
    assert run.kind == Scene.kind and run.method_name == prior.method_name and run.settings.splits["train"] == 2
    assert Inferred.of(run.settings, found).views == 2
    told = prior.method().given(open_dataset(photographs, views=2))
    camera = run.cameras()["test"][0]
    assert main(["eval", str(found), "--views", "1"]) == 0 and run.evaluation()["protocol"]["views"] == 1
    shutil.rmtree(photographs)
    assert torch.equal(run.method().render(camera).rgb, told.render(camera).rgb)
    assert main(["info", str(found)]) == 0
    assert str(prior.folder.name) in said(capsys, "resume", found, "--steps", 3)


@pytest.fixture(scope="module")
def three(ball_folder, tmp_path_factory):
    """A folder of three photographs whose source says nothing of which are for testing."""
    place = tmp_path_factory.mktemp("three") / "photographs"
    shutil.copytree(ball_folder, place, ignore=shutil.ignore_patterns("transforms_*.json", "test"))
    said_so = json.loads((ball_folder / "transforms_train.json").read_text())
    (place / "transforms.json").write_text(json.dumps(said_so | {"frames": said_so["frames"][:3]}))
    return place


def test_three_photographs_are_all_looked_at(prior, three, tmp_path, capsys):
    """Where there are no more than a prior takes, none is held out; a run of them opens and evaluates as any other."""
    found, asked = tmp_path / "found", tmp_path / "asked"
    takes = prior.method().evidence_views
    assert main(["infer", str(prior.folder), str(three), "--output", str(found)]) == 0
    told = capsys.readouterr().out
    looked_at = 2 if takes == 2 else 3  # what pixelnerf's smallest learnt with
    assert f"{looked_at} photographs" in told and ("held out" in told) == (looked_at == 3)
    assert Run(found).settings.splits["train"] == looked_at
    assert main(["infer", str(prior.folder), str(three), "--views", "3", "--output", str(asked)]) == 0
    assert "3 photographs" in capsys.readouterr().out and Run(asked).settings.splits["train"] == 3
    assert main(["eval", str(asked)]) == 0
    assert "cannot be 4" in said(capsys, "infer", prior.folder, three, "--views", 4, "--output", tmp_path / "no")


def test_what_a_source_holds_out_stays_held_out(three, tmp_path, capsys):
    """As Blender's and nerfstudio's lists do."""
    place = tmp_path / "published"
    shutil.copytree(three, place)
    said_so = json.loads((place / "transforms.json").read_text())
    names = [frame["file_path"] for frame in said_so["frames"]]
    (place / "transforms.json").write_text(
        json.dumps(said_so | {"train_filenames": names[:2], "test_filenames": names[2:]})
    )
    prior = prior_run(tmp_path / "prior")
    assert main(["infer", str(prior.folder), str(place), "--output", str(tmp_path / "found")]) == 0
    assert "2 photographs" in capsys.readouterr().out


def test_evaluation_shows_no_more_than_was_learnt_with(tmp_path):
    method = prior_run(tmp_path / "prior", "pixelnerf").method()
    scene = tiny_collection.tinted("amber")
    assert len(reveal(method, scene).kept.cameras()) == method.config.source_views == 2
    assert len(reveal(method.given(views=1), scene).kept.cameras()) == 1


@pytest.mark.parametrize("scene", ["bare", "bare/one.png"])
def test_a_scene_without_poses_is_refused(tmp_path, capsys, scene):
    run = prior_run(tmp_path / "prior")
    (tmp_path / "bare").mkdir()
    for name in ("one", "two"):
        Image.new("RGB", (16, 16)).save(tmp_path / "bare" / f"{name}.png")
    told = said(capsys, "infer", run.folder, tmp_path / scene, "--output", tmp_path / "found")
    assert "holds no poses" in told and "lumigraph capture" in told and not (tmp_path / "found").exists()


def test_what_is_no_prior_is_refused(prior, ball_run, ball_folder, tmp_path, capsys):
    assert "is no prior" in said(capsys, "infer", ball_run.folder, ball_folder, "--output", tmp_path / "found")
    assert main(["infer", str(prior.folder), str(ball_folder), "--output", str(tmp_path / "found")]) == 0
    again = said(capsys, "infer", tmp_path / "found", ball_folder, "--output", tmp_path / "other")
    assert "is no prior, for it learnt from photographs" in again
    many = said(capsys, "infer", prior.folder, "procedural:toys", "--output", tmp_path / "other")
    assert "takes one scene" in many and "procedural:toys,member=0" in many


def test_more_views_than_memory_holds_are_refused(tmp_path, monkeypatch):
    method, scene = prior_run(tmp_path / "prior", "pixelnerf").method(), tiny.scene()
    one = method.evidence_bytes(scene) // len(scene.splits["train"])
    monkeypatch.setattr(memory, "free_memory", lambda: 5 * one)
    with pytest.raises(LumigraphError, match="Looking at 9 photographs .* give fewer --views; 3 would fit"):
        Prior(method).infer(scene)


# Members that cannot be read


def broken() -> Scene:
    raise LumigraphError("its poses are damaged")


def test_members_that_cannot_be_read_are_named_and_passed_over():
    openers = {name: (lambda name=name: tiny_collection.tinted(name)) for name in ("amber", "blue", "green")}
    data = Collection.of(openers | {"brown": broken}, "here")
    generator = torch.Generator().manual_seed(0)
    with pytest.warns(LumigraphWarning, match="brown cannot be read and is passed over: its poses are damaged") as told:
        numbers = {data.sample_member(generator)[0] for _ in range(20)}
    assert {data.names[number] for number in numbers} == {"blue", "green"} and len(told) == 1
    assert [name for name, _ in data.members()] == ["blue", "green"] and "brown" in data.warnings[-1]
    assert data.frame.has_alpha and data.preview() is not None


def test_a_split_without_members_is_one_sentence():
    data = Collection.of({"a": broken, "b": broken}, "here")
    for ask in (data.preview, lambda: data.frame, lambda: data.sample_member(torch.Generator())):
        with pytest.warns(LumigraphWarning), pytest.raises(LumigraphError, match="none of its 1 members in .*'train'"):
            ask()
        data._faults.clear()
    with pytest.raises(LumigraphError, match="here has no members in the split 'val'; there are: train"):
        next(data.members("val"))


def test_members_that_were_not_asked_for_are_let_go(monkeypatch):
    assert MAX_OPEN >= 8
    monkeypatch.setattr("lumigraph.datasets.collection.MAX_OPEN", 2)
    data = tiny_collection.collection()
    for name in ("amber", "blue", "amber", "green"):
        data[name]
    assert list(data._opened) == ["amber", "green"]


# Procedural ones


def test_a_category_is_a_collection_and_a_member_a_scene():
    assert kind_of("procedural:toys") is Collection and kind_of("procedural:toys,member=3") is Scene
    data = open_dataset("procedural:toys,count=9,size=16,views=3")
    assert data.names[8] == "toys-0008" and data.splits["test"].tolist() == [0, 8]
    member, alone = data["toys-0003"], open_dataset("procedural:toys,member=3,size=16,views=3")
    assert torch.equal(member.cameras.pose, alone.cameras.pose) and len(member.splits["train"]) == 3
    assert torch.equal(member.images[0], alone.images[0]) and member.frame.bounds == data["toys-0001"].frame.bounds
    assert not torch.equal(member.images[0], data["toys-0004"].images[0])
    assert member.frame.reach == 1 and member.frame.has_alpha


def test_a_folder_of_a_categorys_name_stands_in_nobodys_way(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "toys").mkdir()
    assert kind_of("procedural:toys") is Collection and kind_of("procedural:toys,member=3") is Scene
    assert kind_of("procedural:./toys") is Collection


@pytest.mark.parametrize("name", ["toys", "chairs", "cars"])
def test_objects_keep_within_their_category_and_differ(name):
    from lumigraph.synthetic import categories

    stages = [categories.stage(name, member, 16, 2, 0) for member in range(60)]
    for stage in stages:
        low, high = stage.world.bounds()
        assert (low > stage.bounds[0]).all() and (high < stage.bounds[1]).all()
        assert abs(low[2] + high[2]) < 0.25
    assert len({repr(stage.world) for stage in stages}) == 60
    assert categories.stage(name, 7, 16, 2, 0).world == stages[7].world
    assert categories.stage(name, 7, 16, 2, 1).world != stages[7].world


def test_meshes_are_photographed(tmp_path):
    tiny_shapes.write(tmp_path / "meshes")
    asked = f"procedural:{tmp_path / 'meshes'},size=24,views=3"
    assert kind_of(asked) is Collection and kind_of(f"procedural:{tmp_path / 'meshes' / 'ball.obj'}") is Scene
    data = open_dataset(asked)
    assert data.names == ["ball", "box", "cloud"] and data.splits["test"].tolist() == [0]
    box = data["box"]
    shot = box.photograph(int(box.splits["train"][0]))
    assert 0.02 < float((shot.alpha > 0.5).float().mean()) < 0.5 and box.frame.reach == 1
    (tmp_path / "none").mkdir()
    with (
        pytest.warns(LumigraphWarning, match="cloud cannot be read"),
        pytest.raises(LumigraphError, match="no surface"),
    ):
        assert [name for name, _ in data.members()] == ["box"]
        data["cloud"]
    with pytest.raises(LumigraphError, match="holds no meshes to photograph"):
        open_dataset(f"procedural:{tmp_path / 'none'}")


@pytest.mark.parametrize("asked", ["toys,count=0", "toys,colour=3", "toys,member=x", "toys,count=3,member=1"])
def test_what_a_category_does_not_know_is_refused(asked):
    with pytest.raises(LumigraphError, match="procedural:toys"):
        open_dataset(f"procedural:{asked}")


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        ("empty", "is empty"),
        ("nothing", "holds no camera poses"),
        ("procedural:toyz", "of the collections cars, chairs, toys"),
    ],
)
def test_where_there_is_nothing_it_is_said_to_be_of_no_kind(tmp_path, monkeypatch, capsys, scene, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "nothing" / "within").mkdir(parents=True)
    told = said(capsys, "train", "pixelnerf", scene, "--steps", 2, "--output", "run")
    assert sentence in told and "learns from" not in told and not (tmp_path / "run").exists()


def test_a_run_that_cannot_begin_is_taken_back(tmp_path, monkeypatch, capsys):
    """A file that is found missing once the run has been made leaves nothing behind."""
    monkeypatch.setattr("lumigraph.training.loop.rehearse", lambda *_: 0.0)
    asked, output = "procedural:toys,count=2,size=8,views=2", tmp_path / "run"
    assert (
        main(["train", "pixelnerf", asked, "--steps", "2", "--encoder-weights", "none.pth", "--output", str(output)])
        == 2
    )
    assert "none.pth does not exist" in capsys.readouterr().err and not output.exists()
