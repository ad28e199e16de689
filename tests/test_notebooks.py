"""Renderings and runs show themselves in notebooks."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from PIL import Image

from lumigraph.camera.rays import Rendering

pytestmark = budget("house")


def test_a_picture_shows_itself():
    rgb = torch.linspace(-0.2, 1.2, 4 * 6 * 3).view(4, 6, 3)
    seen = Rendering(rgb, torch.ones(4, 6), torch.ones(4, 6))
    shown = np.asarray(Image.open(io.BytesIO(seen._repr_png_())))
    assert np.array_equal(shown, (rgb.clamp(0, 1) * 255).round().byte().numpy())
    assert seen.reshape(24)._repr_png_() is None  # rays are no picture


def test_a_run_shows_its_preview_and_what_it_is(ball_run):
    shown = ball_run._repr_html_()
    assert "voxel-grid" in shown and "60 steps in " in shown and 'src="data:image/png;base64,' in shown
    strange = replace(ball_run.settings, scene=replace(ball_run.settings.scene, source="<script>"))
    ball_run.settings, before = strange, ball_run.settings
    try:
        assert "<script>" not in ball_run._repr_html_()
    finally:
        ball_run.settings = before


def test_a_run_before_its_first_state_shows_itself(tmp_path):
    assert "0 steps" in tiny.new_run(tmp_path / "run")._repr_html_()


def test_the_notebook_of_the_documents_runs(ball_folder, tmp_path, monkeypatch):
    """Executed as Jupyter does, on a small scene with poses and for few steps."""
    nbformat, _ = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    import notebook

    monkeypatch.setenv("PYTHONPATH", str(notebook.ROOT))
    (tmp_path / "photographs").symlink_to(ball_folder)
    changes = {
        "lumigraph.capture(": "lumigraph.open_scene(",
        "seconds=60": "steps=40, initial_gaussians=400",
        "seconds=30": "steps=2, initial_gaussians=400",
    }
    done = notebook.execute(nbformat.read(notebook.NOTEBOOK, 4), tmp_path, changes, 300)
    scene, run, view, score, page, own = (notebook.outputs(cell) for cell in done.cells if cell.cell_type == "code")
    assert re.search(r"\d+ photographs of \[\d+, \d+\] pixels", scene["text/plain"])
    shown = "".join(run["text/html"])
    assert "gaussian-splatting" in shown and "40 steps in" in shown
    bar = next(one for cell in done.cells for one in cell.get("outputs", ()) if "<progress" in str(one))
    assert "100 % · step 40" in str(bar)
    sizes = [Image.open(io.BytesIO(base64.b64decode(one["image/png"]))).size for one in (view, own)]
    assert sizes == [(tiny.SIZE, tiny.SIZE)] * 2
    assert 5 < float(re.search(r"([\d.]+) dB", score["text/plain"])[1]) < 60
    assert 'src="page.html"' in "".join(page["text/html"]) and (tmp_path / "page.html").stat().st_size > 10_000
