"""The viewer's controls of a method: each client has its own, and what it turns it sees."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from test_viewer import until
from viewer_client import Client

from lumigraph import methods
from lumigraph.gaussians import Gaussians, splatting
from lumigraph.method import Method
from lumigraph.method.controls import Control
from lumigraph.run import build
from lumigraph.viewer import Subject, Viewer, choose_address

# A client may leave at any moment; viser warns of what was still on its way.
pytestmark = [budget("exports"), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]


def subject(scene, folder) -> Subject:
    cameras = {name: scene.cameras[index] for name, index in scene.splits.items()}
    return Subject("ball", scene.frame, cameras, folder / "paths", "lumigraph render RUN")


def two_moments(frame) -> Method:
    kind = methods.find("two-moments")
    return build(kind, replace(frame, times=(2.0, 5.0)), kind.Config(), torch.device("cpu"), 0).eval()


class Swollen(Method):
    """One red Gaussian, as large as a control says."""

    @property
    def controls(self):
        return (Control("size", 0.1, (0.05, 0.3), unit="scene units"),)

    def batch(self, data, generator):
        raise NotImplementedError

    def gaussians(self):
        size = torch.full((1, 3), float(self.control("size"))).log()
        red = torch.tensor([[[1.7, -1.7, -1.7]]])
        return Gaussians(torch.zeros(1, 3), torch.eye(4)[:1], size, torch.full((1,), 5.0), red)

    def render(self, camera):
        return splatting.render(self.gaussians(), camera, self.frame.background)


def test_a_client_sees_what_it_turns_and_nobody_else_does(tmp_path):
    scene = tiny.scene()
    method = two_moments(scene.frame).given(brightness=0.8)
    with Viewer(method, subject(scene, tmp_path), choose_address(port=0)) as viewer:
        clients = [Client(viewer.address.url) for _ in range(2)]
        for client in clients:
            client.picture(width=120)
        until(lambda: len(viewer._everyone()) == 2 and all(x.painter.settled.is_set() for x in viewer._everyone()))
        one, other = viewer._everyone()
        handles = one.method_controls._handles
        assert {name: handle.value for name, handle in handles.items()} == {
            "brightness": 0.8,  # as the method was told
            "ink": "colour",
            "time": 2.0,
        }
        assert one.request().settings == other.request().settings == ()
        before = method.render(one.request().camera((120, 90))).rgb
        clients[0].turn(handles["ink"], "grey")
        clients[0].turn(handles["time"], 5.0)
        clients[0].turn(handles["brightness"], 2.0000000001)  # a browser's rounding beyond the end
        told = (("brightness", 2.0), ("ink", "grey"), ("time", 5.0))
        until(lambda: one.request().settings == told)
        expected = method.given(**dict(told)).render(one.request().camera((120, 90))).rgb
        until(lambda: np.abs(clients[0].picture(width=120) / 255 - expected.clamp(0, 1).numpy()).mean() < 0.02)
        assert (expected - before).abs().mean() > 0.05
        assert other.request().settings == () and method.settings == {"brightness": 0.8}
        clients[0].turn(handles["ink"], "colour")  # back where it began
        until(lambda: one.request().settings == (told[0], told[2]))
        assert one.path._here().time == 5.0 and other.path._here().time == 2.0  # a keyframe keeps the moment
        for client in clients:
            client.close()


def test_moments_play_and_pause(tmp_path):
    scene = tiny.scene()
    with Viewer(two_moments(scene.frame), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        until(lambda: viewer._everyone())
        (visitor,) = viewer._everyone()
        slider, playback = visitor.method_controls._handles["time"], visitor.method_controls._playback
        client.turn(playback._seconds, 0.5)
        until(lambda: playback._seconds.value == 0.5)
        playing = threading.Thread(target=playback.play)
        playing.start()
        seen = set()

        def all_moments() -> bool:
            seen.add(int(3 * (slider.value - 2.0)))  # ninths of the span from 2 to 5
            return len(seen) >= 7

        until(all_moments)
        assert min(seen) >= 0 and max(seen) <= 9
        client.close()
    playing.join(5)  # a visitor who leaves plays no more
    assert not playing.is_alive()


def test_a_cloud_is_sent_anew_when_told_otherwise(tmp_path):
    scene = tiny.scene()
    with Viewer(Swollen(scene.frame, None), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        until(lambda: viewer._everyone() and viewer._everyone()[0]._splats is not None)
        (visitor,) = viewer._everyone()
        until(visitor.painter.settled.is_set)
        sent = visitor._splats.buffer.copy()
        client.turn(visitor.method_controls._handles["size"], 0.2)
        until(lambda: not np.array_equal(visitor._splats.buffer, sent))
        covariance = visitor._splats.buffer[0, 4:7].view(np.float16)[0]
        assert float(covariance) == pytest.approx((0.2 * 16) ** 2, rel=0.01)  # in the browser's smaller units
        client.close()


def test_a_method_without_controls_has_no_folder(tmp_path):
    scene = tiny.scene()
    with Viewer(tiny.method(scene.frame).eval(), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        client.picture(width=120)
        (visitor,) = viewer._everyone()
        assert visitor.method_controls._handles == {} and visitor.request().settings == ()
        assert visitor.path._here().time is None
        client.close()
