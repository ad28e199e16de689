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
from test_web import cloud
from windows import psnr, some_camera

import lumigraph
from lumigraph import exchange
from lumigraph.camera.rays import Rendering
from lumigraph.commands import notebook_page

pytestmark = budget("house", 10)


def test_a_picture_shows_itself_beside_its_depth():
    rgb = torch.linspace(-0.2, 1.2, 4 * 6 * 3).view(4, 6, 3)
    depth = torch.linspace(1, 4, 6).expand(4, 6)
    seen = Rendering(rgb, depth, torch.ones(4, 6))
    shown = np.asarray(Image.open(io.BytesIO(seen._repr_png_())))
    assert np.array_equal(shown[:, :6], (rgb.clamp(0, 1) * 255).round().byte().numpy())
    brightness = shown[:, 6:].astype(int).sum(-1)
    assert shown.shape == (4, 12, 3) and (np.diff(brightness) < 0).all()  # near is bright, far is dark
    assert seen.reshape(24)._repr_png_() is None  # rays are no picture


def test_a_run_is_a_page_to_turn_above_a_still(ball_run, monkeypatch):
    shown = lumigraph.Model(ball_run)._repr_html_()
    assert "voxel-grid" in shown and "60 steps in " in shown
    assert 'sandbox="allow-scripts"' in shown and "&quot;pictures&quot;" in shown  # views, for a field
    assert still_of(shown).size == (tiny.SIZE, tiny.SIZE)
    for limit in ("MAX_PAGE_BYTES", "MAX_SECONDS"):
        with monkeypatch.context() as patch:
            patch.setattr(notebook_page, limit, 0)
            shown = lumigraph.Model(ball_run)._repr_html_()
        assert "<iframe" not in shown and still_of(shown).size == (tiny.SIZE, tiny.SIZE)


def still_of(shown: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(re.search('src="data:image/png;base64,([^"]+)"', shown)[1])))


def test_names_cannot_break_the_view(ball_run, monkeypatch):
    strange = replace(ball_run.settings, scene=replace(ball_run.settings.scene, source="<script>"))
    monkeypatch.setattr(ball_run, "settings", strange)
    monkeypatch.setattr(notebook_page, "MAX_SECONDS", 0)
    assert "<script>" not in lumigraph.Model(ball_run)._repr_html_()


def test_splats_are_drawn_inside_a_notebook(tmp_path, page, faults):
    """In a frame that may neither read the notebook nor ask a network."""
    exchange.write_gaussians(tmp_path / "<b>.ply", cloud())
    opened = lumigraph.open(tmp_path / "<b>.ply")
    style = "<style>div { width: 256px !important; height: 256px !important }</style>"
    (tmp_path / "notebook.html").write_text(style + opened._repr_html_())
    page.goto((tmp_path / "notebook.html").as_uri())
    (frame,) = page.main_frame.child_frames
    frame.locator("body.open").wait_for()
    frame.add_style_tag(content="#caption, #buttons, #wait { display: none } * { transition: none !important }")
    camera = some_camera()
    frame.evaluate("([pose, angle]) => lumigraph.setCamera(pose, angle)", [camera.pose[0].tolist(), 45.0])
    drawn = np.asarray(Image.open(io.BytesIO(page.locator("iframe").screenshot())).convert("RGB")) / 255
    assert psnr(drawn, opened.render(camera).rgb.clamp(0, 1).numpy()) > 38  # .spz rounds the harmonics, turned upright
    assert frame.evaluate("(() => { try { return parent.document.title } catch { return 'refused' } })()") == "refused"
    assert faults == []


def test_a_run_before_its_first_state_shows_itself(tmp_path):
    assert "0 steps" in lumigraph.Model(tiny.new_run(tmp_path / "run"))._repr_html_()


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
    assert sizes == [(2 * tiny.SIZE, tiny.SIZE)] * 2
    assert 5 < float(re.search(r"([\d.]+) dB", score["text/plain"])[1]) < 60
    assert 'src="page.html"' in "".join(page["text/html"]) and (tmp_path / "page.html").stat().st_size > 10_000
