"""The viewer's tab Measure: two clicks on an exact ball, the length between them, and the scale that is kept."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
from budgets import budget
from solids import Seen, ball
from test_viewer import subject, until
from viewer_client import Client

from lumigraph.viewer import Viewer, choose_address

pytestmark = [budget("exports"), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]

MOVED = ((0.0, -2.0, 0.0, 5.0), (2.0, 0.0, 0.0, -1.0), (0.0, 0.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0))


def click(client: Client, origin: tuple[float, float, float]) -> None:
    """Click on a ray towards the middle of the scene."""
    client.click((0.5, 0.5), origin, -np.array(origin) / np.linalg.norm(origin))


def test_two_clicks_measure_and_set_the_scale(tmp_path):
    frame, kept = replace(tiny.scene().frame, source_from_scene=MOVED), []
    about = replace(subject(tiny.scene(), tmp_path), frame=frame, set_scale=kept.append)
    with Viewer(Seen(ball(0.6), frame).eval(), about, choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        until(lambda: bool(viewer._everyone()))
        ruler = viewer._everyone()[0].ruler
        click(client, (3.0, 0.0, 0.0))  # before the button is pressed it is no measurement
        client.turn(ruler._button, True)
        until(lambda: "first" in ruler._about.content)
        assert not ruler._points and not ruler.is_drawn
        click(client, (3.0, 0.0, 0.0))
        until(lambda: "second" in ruler._about.content)
        click(client, (0.0, 3.0, 0.0))
        until(lambda: ruler._set.visible)
        np.testing.assert_allclose(ruler._points, [(0.6, 0, 0), (0, 0.6, 0)], atol=0.01)
        assert ruler.length == pytest.approx(2 * 0.6 * math.sqrt(2), rel=0.01)
        until(lambda: ruler.is_drawn)
        assert "--scale-by" in ruler._about.content
        ends = np.array(ruler._about.content.split("--scale-by ")[1].split()[:6], float).reshape(2, 3)
        np.testing.assert_allclose(ends, [(5, 0.2, 0.5), (3.8, -1, 0.5)], atol=0.02)
        client.turn(ruler._known, 8.5)
        until(lambda: ruler._known.value == 8.5)
        client.turn(ruler._set, True)
        until(lambda: bool(kept))
        assert kept[0] == pytest.approx(8.5 / (1.2 * math.sqrt(2)), rel=0.01)
        until(lambda: "**8.5**" in ruler._about.content)
        client.close()
