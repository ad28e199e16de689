"""What opens: one door to runs, files and compositions, and what a run says of itself."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tiny
import torch
from balls import RED, Splatted
from budgets import budget

import lumigraph
from lumigraph.commands import render
from lumigraph.errors import LumigraphError
from lumigraph.exchange import write_gaussians
from lumigraph.export.film import film
from lumigraph.files import write_json
from lumigraph.geometry import Similarity
from lumigraph.large import open_any
from lumigraph.paths import film_cameras
from lumigraph.run import Run, State
from lumigraph.run.composition import CompositionPart, write_composition
from lumigraph.run.settings import Settings

pytestmark = budget("runs")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A run with a state, a splat file, and a composition of the two."""
    folder = tmp_path_factory.mktemp("opened")
    run = tiny.new_run(folder / "ball")
    method = run.new_method()
    run.save(State(1, 0.1), method, method.optimizers(), torch.Generator())
    write_gaussians(folder / "red.compressed.ply", Splatted(RED).gaussians())
    write_composition(
        folder / "both.json",
        [CompositionPart("ball", Similarity.make(1.0)), CompositionPart("red.compressed.ply", Similarity.make(0.5))],
    )
    return folder


@pytest.mark.parametrize(
    ("name", "title", "photographed", "renders"),
    [
        ("ball", "ball", True, "ball/renders"),
        ("red.compressed.ply", "red", False, "renders/red"),
        ("both.json", "both", True, "renders/both"),
    ],
)
def test_everything_opens_by_one_door(folder, name, title, photographed, renders):
    opened = lumigraph.open_any(folder / name)
    assert isinstance(opened, lumigraph.Opened) and opened.path == folder / name
    assert (opened.title, opened.photographed) == (title, photographed)
    assert opened.renders.as_posix().endswith(renders) and opened.paths.name == "paths"
    method, cameras = opened.method(), opened.cameras()
    assert method.frame == opened.frame and not method.training
    seen = method.render(cameras["train"][0].resized(0.1 if name.endswith(".ply") else 1.0))
    assert seen.rgb.isfinite().all() and (seen.opacity > 0.5).any()
    assert (len(opened.survey(cameras["train"])) > len(cameras["train"])) != photographed
    assert (opened.open_scene is not None) == (name == "ball") and opened.metrics() == []


def test_a_film_does_not_replace_the_composition_it_is_of(folder):
    before = (folder / "both.json").read_bytes()
    with pytest.raises(LumigraphError, match=r"both\.json would be replaced"):
        render.Render(source=folder / "both.json", output=folder / "both.gif", frames=2, size=16).run()
    assert (folder / "both.json").read_bytes() == before and not (folder / "both.gif").exists()


def test_what_does_not_open_is_named(folder):
    (folder / "letter.txt").write_text("Madam")
    with pytest.raises(LumigraphError, match=r"letter\.txt is none of the files that open"):
        open_any(folder / "letter.txt")
    with pytest.raises(LumigraphError, match="nowhere does not exist"):
        open_any(folder / "nowhere")
    with pytest.raises(LumigraphError, match=r"gone\.json does not exist"):
        open_any(folder / "gone.json")


def test_python_makes_films_too(folder, tmp_path):
    opened = open_any(folder / "ball")
    cameras = film_cameras(opened.cameras(), opened.frame, "orbit", frames=2, size=16)
    assert len(cameras) == 2 and int(cameras.size.max()) == 16
    assert film(opened.method(), cameras, tmp_path / "a.gif")["frames"] == 2
    held_out = film_cameras(opened.cameras(), opened.frame, "held-out")
    assert torch.equal(held_out.pose, opened.cameras()["test"].pose)
    with pytest.raises(LumigraphError, match="no held-out views here"):
        film_cameras({"train": opened.cameras()["train"]}, opened.frame, "held-out")


# What a run says of itself


@pytest.fixture
def run(tmp_path) -> Run:
    return tiny.new_run(tmp_path / "run")


def rewrite(run: Run, change) -> dict:
    """Change a run's config.json as another version would have written it."""
    said = json.loads((run.folder / "config.json").read_text())
    change(said)
    write_json(run.folder / "config.json", said, ours=True)
    return said


def test_settings_are_written_as_they_were_read(run):
    before = (run.folder / "config.json").read_bytes()
    run.settings.write(run.folder / "config.json")
    assert (run.folder / "config.json").read_bytes() == before
    names = "format method config frame scene splits seed budget device processor versions".split()
    assert list(json.loads(before)) == names
    assert Settings.read(run.folder / "config.json") == run.settings


def test_what_a_newer_version_says_is_kept(run):
    rewrite(run, lambda said: said.update(weather={"sun": [1, 2]}))
    opened = Run(run.folder)
    opened.set_budget(seconds=3.0)
    said = json.loads((run.folder / "config.json").read_text())
    assert said["weather"] == {"sun": [1, 2]} and Run(run.folder).settings.budget == {"seconds": 3.0}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda said: said.update(seed="seven"), "seed is 'seven', and should be `int`"),
        (lambda said: said.update(config=[1, 2]), "config is .*, and should be `object`"),
        (lambda said: said.update(splits=None), "splits is None, and should be `object`"),
        (lambda said: said.update(scene="lego"), "does not hold what it should"),
        (lambda said: said.pop("method"), "method"),
        (lambda said: said.pop("frame"), "frame"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_a_sentence(run, change, words):
    rewrite(run, change)
    with pytest.raises(LumigraphError, match=words) as fault:
        Run(run.folder)
    assert "config.json does not hold what it should" in str(fault.value) and "\n" not in str(fault.value)
