"""The viewer's tab Crop: what a client crops and cleans it sees, and saves."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from test_viewer import some_cloud, subject
from viewer_client import Client

import lumigraph.methods
from lumigraph.camera.crop import CropBox, Sphere
from lumigraph.errors import LumigraphError
from lumigraph.gaussians.cloud import ISOLATION, MAX_SCALE, cleaned
from lumigraph.viewer import Viewer, choose_address
from lumigraph.viewer.crop_panel import BOX, SPHERE, circles, edges

# A client may leave at any moment; viser warns of what was still on its way.
pytestmark = [budget("exports"), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]


def until(happens, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def cloud_viewer(tmp_path):
    """Of 200 Gaussians, some faint, one alone; what it is told to save it notes."""
    cloud = some_cloud(200, degree=0)
    cloud.means[0] = 40.0
    kind = lumigraph.methods.find("gaussian-splatting")
    method = kind(tiny.scene().frame, kind.Config(sh_degree=0))
    method.cloud.replace(cloud)
    saved = []

    def keep(name, crop, floaters) -> str:
        if name == "taken":
            raise LumigraphError("taken is there already")
        saved.append((name, crop, dict(floaters)))
        return f"runs/{name}"

    about = subject(tiny.scene(), tmp_path, keep=keep)
    with Viewer(method.eval(), about, choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        until(lambda: viewer._everyone() and viewer._everyone()[0]._splats is not None)
        yield viewer._everyone()[0], client, method.gaussians(), saved
        client.close()


def test_a_cloud_is_cropped_cleaned_and_saved(cloud_viewer):
    visitor, client, cloud, saved = cloud_viewer
    panel = visitor.crop
    assert visitor.request().crop is None and visitor.request().floaters == ()

    client.turn(panel._radius, 0.5)
    client.turn(panel._shape, SPHERE)
    until(lambda: visitor.request().crop == Sphere((0.0, 0.0, 0.0), 0.5))
    inside = cleaned(cloud, visitor.request().crop)
    assert 10 < len(inside) < 190
    until(lambda: len(visitor._splats.buffer) == len(inside))

    client.turn(panel._floaters["min_opacity"], 0.5)
    client.turn(panel._clean, True)
    floaters = {"min_opacity": 0.5, "max_scale": MAX_SCALE, "isolation": ISOLATION}
    until(lambda: dict(visitor.request().floaters) == floaters)
    solid = cleaned(cloud, visitor.request().crop, **floaters)
    assert 0 < len(solid) < len(inside)
    until(lambda: len(visitor._splats.buffer) == len(solid))

    camera = visitor.request().camera((60, 45))
    drawn = visitor._shared.render(camera, visitor.request()).opacity  # as `Draw exactly` does
    assert 0.05 < drawn.mean() < visitor._shared.render(camera, replace(visitor.request(), floaters=())).opacity.mean()

    panel._name.value = "part"
    panel._save()
    assert saved == [("part", Sphere((0.0, 0.0, 0.0), 0.5), floaters)]
    assert "runs/part" in panel._about.content
    panel._name.value = "taken"
    panel._save()  # says so, and goes on
    assert len(saved) == 1


def test_a_box_is_dragged_by_its_corners(cloud_viewer):
    visitor, client, cloud, _ = cloud_viewer
    panel = visitor.crop
    client.turn(panel._shape, BOX)
    until(lambda: {"lower", "upper", "outline"} <= panel._nodes.keys())
    lower, upper = visitor._shared.subject.frame.bounds
    assert visitor.request().crop == CropBox(lower, upper) and visitor.request().depth
    client.drag(panel._nodes["upper"], (0.25, 0.0, 0.5))
    until(lambda: visitor.request().crop == CropBox(lower, (0.25, 0.0, 0.5)))
    assert panel._upper.value == (0.25, 0.0, 0.5)
    assert np.allclose(panel._nodes["outline"].points.reshape(-1, 3).max(0), (0.25, 0.0, 0.5))
    until(lambda: len(visitor._splats.buffer) == len(cleaned(cloud, visitor.request().crop)))
    client.turn(panel._upper, (0.3, 0.3, 0.3))  # by its number: the handle follows
    until(lambda: np.allclose(panel._nodes["upper"].position, 0.3))
    client.turn(panel._shape, SPHERE)
    until(lambda: panel._nodes.keys() == {"middle", "outline"})


def test_outlines_lie_on_what_they_outline():
    sphere = Sphere((0.1, -0.2, 0.3), 0.5)
    ends = torch.from_numpy(circles(sphere)).reshape(-1, 3)
    assert torch.allclose((ends - torch.tensor(sphere.middle)).norm(dim=-1), torch.tensor(0.5).double())
    box = CropBox((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    lengths = np.linalg.norm(np.diff(edges(box), axis=1)[:, 0], axis=-1)
    assert sorted(lengths) == [1] * 4 + [2] * 4 + [3] * 4


def test_other_methods_crop_and_save_nothing(tmp_path):
    scene = tiny.scene()
    with Viewer(tiny.method(scene.frame).eval(), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        client.picture(width=120)
        (visitor,) = viewer._everyone()
        assert not visitor.crop._clean.visible and not hasattr(visitor.crop, "_name")
        client.turn(visitor.crop._shape, SPHERE)
        until(lambda: isinstance(visitor.request().crop, Sphere))
        client.close()
