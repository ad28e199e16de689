"""How many photographs methods need: members of collections, priors, what is averaged."""

from __future__ import annotations

import json
import shutil
import statistics
from pathlib import Path

import pytest
from budgets import budget
from test_benchmark import Here
from test_priors import prior_run

from lumigraph.budget import Budget
from lumigraph.commands.bench import BenchViews
from lumigraph.commands.cli import main
from lumigraph.lab.benchmark.cell import Cell, CellSettings, train_command
from lumigraph.lab.benchmark.conduct import Patience, conduct, draw_charts
from lumigraph.lab.benchmark.table import few_view_results, over_views

pytestmark = budget("runs")

SETTINGS = CellSettings(device="cpu", eval_views=1)


@pytest.fixture(scope="module")
def balls(ball_folder, tmp_path_factory) -> Path:
    """A collection of nine scenes, two of which are held out."""
    folder = tmp_path_factory.mktemp("many") / "balls"
    for number in range(9):
        shutil.copytree(ball_folder, folder / f"ball-{number}")
    return folder


def planned(monkeypatch, output, *scenes, **options) -> list[Cell]:
    """What the command would train."""
    cells: list[Cell] = []
    monkeypatch.setattr(BenchViews, "conduct", lambda self, found, settings: cells.extend(found) or 0)
    assert BenchViews(scenes=tuple(map(str, scenes)), output=output, device="cpu", **options).run() == 0
    return cells


def test_members_are_planned(balls, tmp_path, monkeypatch):
    names = ("voxel-grid", "tinted-grid")
    how = {"methods": names, "views": (1, 3), "steps": 3, "prior_steps": 2, "members": 2}
    prior, *cells = planned(monkeypatch, tmp_path, balls, **how)
    assert (prior.name, prior.budget.steps, prior.prior) == ("balls-tinted-grid-2steps-seed0", 2, None)
    expected = [(name, f"ball-{number}", views) for number in (0, 8) for views in (1, 3) for name in names]
    assert [(cell.method, cell.scene, cell.views) for cell in cells] == expected
    assert {cell.prior for cell in cells} == {None, str(tmp_path.resolve() / "runs" / prior.name)}


def test_members_are_averaged_and_priors_told(balls, tmp_path, monkeypatch):
    output = tmp_path / "out"
    how = {"methods": ("tinted-grid",), "views": (2,), "steps": 3, "prior_steps": 2, "members": 2}
    prior, *cells = planned(monkeypatch, output, balls, **how)
    here, again = Here(), Here()
    assert conduct([prior, *cells], SETTINGS, output, launch=here) == 0
    assert here.seen == ["train", "eval"] + 2 * ["infer", "eval"]
    assert conduct([prior, *cells], SETTINGS, output, launch=again) == 0 and again.seen == []

    rows, page = json.loads((output / "results.json").read_text())["cells"], (output / "results.md").read_text()
    assert not any(row["failed"] for row in rows)
    mean = statistics.fmean(row["scores"][0]["value"] for row in rows if row["views"] == 2)
    assert f"| tinted-grid | {mean:.2f} |" in page
    assert "PSNR of 2 held-out members of balls" in page and f"by {prior.name}" in page
    assert few_view_results() in page
    (chart,) = draw_charts([*rows, *(row | {"views": 5, "train_views": 5} for row in rows if row["prior"])], output)
    assert chart == "balls-members-psnr-over-views.svg" and (output / chart).read_text().count("<circle") == 2
    told = next(row["command"] for row in rows if row["prior"])
    assert told == f"lumigraph infer {prior.name} ball-0 --views 2 --device cpu"
    assert str(tmp_path) not in page + (output / "results.json").read_text()


def test_a_mean_is_of_all_members_or_none():
    def row(scene, views, psnr):
        return {
            "method": "nerf", "scene": scene, "collection": "toys-members", "views": views, "train_views": views,
            "budget": {"steps": 9}, "scores": [{"name": "PSNR", "value": psnr, "unit": "dB", "better": "higher"}],
        }  # fmt: skip

    (curve,) = over_views([row("a", 1, 10.0), row("b", 1, 14.0), row("a", 2, 20.0)])
    assert (curve.x, curve.y) == ([1], [12.0])


def test_a_prior_that_is_there_is_not_trained_again(ball_folder, tmp_path, monkeypatch):
    prior = prior_run(tmp_path / "known").folder
    how = {"methods": ("tinted-grid",), "views": (2, "all"), "steps": 3, "priors": (prior,)}
    cells = planned(monkeypatch, tmp_path / "out", ball_folder, **how)
    assert [cell.name for cell in cells] == [f"{cells[0].scene}-tinted-grid-{n}views-by-known" for n in (2, 9)]


def test_without_a_collection_there_is_no_prior(ball_folder, tmp_path, monkeypatch, capsys):
    how = {"views": (2,), "steps": 3}
    cells = planned(monkeypatch, tmp_path, ball_folder, methods=("voxel-grid", "tinted-grid"), **how)
    assert [cell.method for cell in cells] == ["voxel-grid"]
    assert "tinted-grid learns from a collection" in capsys.readouterr().err
    arguments = ["bench", "views", "--methods", "tinted-grid", "--scenes", str(ball_folder), "--output", str(tmp_path)]
    assert main(arguments) == 2
    assert "no method left" in capsys.readouterr().err.splitlines()[-1]


def test_objects_of_a_category_keep_the_size_they_were_asked_for():
    def words(source):
        return train_command(Cell("nerf", "x", source, Budget(1, None), views=2), CellSettings(downscale=8))

    assert "--downscale" in words("procedural:still-life") and "--downscale" not in words("procedural:toys,member=8")


def test_time_left_counts_no_training_of_what_a_prior_makes():
    trained, told = Cell("nerf", "a", "a", Budget(None, 60.0)), Cell("p", "a", "a", Budget(None, 60.0), prior="runs/p")
    assert Patience().left([trained, told]) == "at least 1:00 left"
