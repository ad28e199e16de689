"""Renderings and runs show themselves in notebooks."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
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
