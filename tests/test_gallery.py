"""The gallery: a place for every method, and the page of one."""

from __future__ import annotations

from pathlib import Path

import pytest
from budgets import budget
from test_benchmark import Here

from lumigraph import methods
from lumigraph.errors import LumigraphError
from lumigraph.lab.benchmark import gallery as room
from lumigraph.lab.benchmark.cell import read_rows
from lumigraph.lab.benchmark.published import Published

pytestmark = budget("runs", 4)


def test_every_method_has_a_place():
    papers = Path(methods.__file__).parent.iterdir()
    assert {path.stem.replace("_", "-") for path in papers if path.name[0] not in "_."} == set(room.SHOWPIECES)


def test_a_page_has_picture_idea_and_figures(ball_folder, tmp_path, monkeypatch):
    piece = room.Showpiece(str(ball_folder), "Voxels & colours.")
    known = Published("voxel-grid", "99", "PSNR, dB", "no scene", "no pixels", "Nobody 1999", "nowhere")
    monkeypatch.setattr(room, "first_of", {"voxel-grid": known}.get)
    monkeypatch.setattr(room, "SECTIONS", {"Grids": {"voxel-grid": piece}})
    monkeypatch.setattr(room, "SHOWPIECES", {"voxel-grid": piece})
    here = Here()
    assert room.gallery(["voxel-grid"], 0.01, tmp_path / "out", launch=here) == 0
    page = (tmp_path / "out" / "gallery.html").read_text()
    owner = "published, of other data: 99 dB: no scene, no pixels (measured by Nobody 1999)"
    for part in ("<h2>Grids</h2>", "Voxels &amp; colours.", "PSNR", owner, "data:image/jpeg", "load "):
        assert part in page, part
    (row,) = read_rows(tmp_path / "out").values()
    assert f"{row['steps']} steps in {row['training_seconds']:.0f} s from {row['train_views']} views" in page
    again = Here()
    assert room.gallery(["voxel-grid"], 0.01, tmp_path / "out", launch=again) == 0 and again.seen == []


def test_the_model_of_captions_is_made_first(tmp_path, monkeypatch):
    small = ("--pictures", "4", "--steps", "1", "--batch", "2", "--width", "2", "--embedding", "2")
    monkeypatch.setattr(room, "CAPTION_NUMBERS", small)
    assert room.prepare(set(), True, tmp_path, print, Here()) == 0
    assert any((tmp_path / room.CAPTIONS).iterdir())


def test_a_cell_that_fails_says_why(tmp_path, monkeypatch):
    piece = room.Showpiece(str(tmp_path / "nowhere"), "")
    monkeypatch.setattr(room, "SECTIONS", {"Grids": {"voxel-grid": piece}})
    monkeypatch.setattr(room, "SHOWPIECES", {"voxel-grid": piece})
    assert room.gallery(["voxel-grid"], 0.01, tmp_path / "out", launch=Here()) == 0
    assert "failed: " in (tmp_path / "out" / "gallery.html").read_text()


def test_a_method_without_a_place_is_named(tmp_path):
    with pytest.raises(LumigraphError, match="voxel-grid has no place in the gallery"):
        room.gallery(["voxel-grid"], 1.0, tmp_path)
    assert not list(tmp_path.iterdir())
