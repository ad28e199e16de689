"""The viewer's tab Select: clicks are strokes on the client's view, undo takes them back, and the part is saved."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import torch
from balls import RED, Splatted
from budgets import budget
from test_viewer import subject, until
from viewer_client import Client

from lumigraph.viewer import Viewer, choose_address

pytestmark = [budget("exports"), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]


def test_clicks_select_and_undo_takes_them_back(tmp_path):
    kept: dict[str, torch.Tensor] = {}

    def keep(name, reasons):
        kept[name] = next(iter(reasons.values()))
        return name

    about = replace(subject(tiny.scene(), tmp_path), open_scene=tiny.scene, keep=keep)
    method = Splatted(RED, 0.6).eval()
    with Viewer(method, about, choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        until(lambda: bool(viewer._everyone()))
        panel = viewer._everyone()[0].strokes
        assert panel is not None
        client.turn(panel._draw, True)
        until(lambda: "Click along" in panel._about.content)
        client.click((0.02, 0.02), (0, 0, 3), (0, 0, 1))  # beside the ball
        client.click((0.5, 0.5), (0, 0, 3), (0, 0, 1))
        until(lambda: panel.is_drawn)
        assert 0 < int(panel._part.sum()) and len(panel._selection) == 1
        panel._save(part=True)
        assert torch.equal(kept[panel._name.value], ~panel._part)
        client.turn(panel._undo, True)
        until(lambda: not panel.is_drawn)
        assert not panel._part.any()
        client.close()


def test_no_tab_without_photographs(tmp_path):
    about = replace(subject(tiny.scene(), tmp_path), open_scene=None)
    with Viewer(Splatted(RED, 0.6).eval(), about, choose_address(port=0)) as viewer:
        assert "Select" not in viewer._shared.tabs


def test_a_stroke_is_the_line_between_two_clicks(tmp_path):
    from lumigraph.viewer.cameras import ViewRequest
    from lumigraph.viewer.strokes_panel import BRUSH_PIXELS, StrokesPanel

    row = (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)
    request = ViewRequest(row, 0.8, (800, 400), 800, "colour", (0.0, 0.0, 0.0))
    strokes = StrokesPanel._strokes(object.__new__(StrokesPanel), request, (0.25, 0.5), (0.75, 0.5), True)
    rows, columns = strokes.wanted.nonzero().unbind(-1)
    assert strokes.wanted.shape == (200, 400) and not strokes.unwanted.any()
    assert columns.min() <= 100 and columns.max() >= 299 and strokes.wanted[100, 100:300].all()
    assert (rows - 100).abs().max() <= BRUSH_PIXELS
