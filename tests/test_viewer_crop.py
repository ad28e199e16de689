"""The viewer's tab Crop: what a client crops and cleans it sees, and saves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from solids import Seen, ball
from test_viewer import some_cloud, subject, until
from viewer_client import Client

import lumigraph.methods
from lumigraph.camera.crop import CropBox, Sphere
from lumigraph.composition.floaters import CANDIDATE_COLOUR, evidence
from lumigraph.errors import LumigraphError
from lumigraph.files.ranges import changed
from lumigraph.gaussians.cloud import cleaned, gone
from lumigraph.paths import Surroundings
from lumigraph.paths.opening import subject_of
from lumigraph.viewer import Viewer, choose_address
from lumigraph.viewer.crop_panel import ALL, BOX, SPHERE, circles, edges
from lumigraph.viewer.shared import CROPPED_MAX_SCALE

# A client may leave at any moment; viser warns of what was still on its way.
pytestmark = [budget("exports"), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]


@pytest.fixture
def cloud_viewer(tmp_path):
    """Viewer of 200 Gaussians, one alone before a camera, and a list of what it saves."""
    cloud = some_cloud(200, degree=0)
    cloud.means[0] = 0.6 * tiny.scene().cameras.position[0]
    cloud.log_scales[0] = -4.0
    kind = lumigraph.methods.find("gaussian-splatting")
    method = kind(tiny.scene().frame, changed(kind.Config(), sh_degree=0))
    method.cloud.replace(cloud)
    saved = []

    def keep(name, reasons) -> str:
        if name == "taken":
            raise LumigraphError("taken is there already")
        saved.append((name, gone(reasons)))
        return f"runs/{name}"

    about = subject(tiny.scene(), tmp_path, keep=keep, open_scene=tiny.scene)
    with Viewer(method.eval(), about, choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        until(lambda: viewer._everyone() and viewer._everyone()[0]._splats is not None)
        yield viewer._everyone()[0], client, method.gaussians(), saved
        client.close()


def test_a_cloud_is_cropped_cleaned_and_saved(cloud_viewer):
    visitor, client, cloud, saved = cloud_viewer
    panel = visitor.crop
    assert visitor.request().crop is None and not visitor.request().part

    client.turn(panel._radius, 0.5)
    client.turn(panel._shape, SPHERE)
    until(lambda: visitor.request().crop == Sphere((0.0, 0.0, 0.0), 0.5))
    inside = cleaned(cloud, visitor.request().crop, CROPPED_MAX_SCALE)  # Gaussians that stick out of a crop are gone
    assert 10 < len(inside) < 190
    until(lambda: len(visitor._splats.buffer) == len(inside))

    client.turn(panel._shape, ALL)
    until(lambda: len(visitor._splats.buffer) == len(cloud))
    plain = visitor._splats.rgbs.copy()
    client.turn(panel._strength, 0.7)
    found = evidence(cloud, visitor._shared.subject.cameras["train"], tiny.scene().frame).floaters(0.7)
    assert found[0] and found.sum() < 20
    until(lambda: np.array_equal((visitor._splats.rgbs != plain).any(-1), found.numpy()))  # coloured, and still there
    assert np.allclose(visitor._splats.rgbs[0] / 255, CANDIDATE_COLOUR, atol=0.01)
    assert not gone(visitor._shared.unwanted(visitor.request())).any()
    client.turn(panel._remove, True)
    until(lambda: len(visitor._splats.buffer) == int((~found).sum()))
    assert visitor._shared.cloud(visitor.request()).means.shape == cloud[~found].means.shape

    panel._name.value = "part"
    panel._save()
    assert [(name, lost.tolist()) for name, lost in saved] == [("part", found.tolist())]
    assert "runs/part" in panel._about.content
    panel._name.value = "taken"
    panel._save()  # says so, and goes on
    assert len(saved) == 1
    client.turn(panel._remove, True)
    until(lambda: len(visitor._splats.buffer) == len(cloud))


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
    inside = cleaned(cloud, visitor.request().crop, CROPPED_MAX_SCALE)
    until(lambda: len(visitor._splats.buffer) == len(inside))
    client.turn(panel._upper, (0.3, 0.3, 0.3))  # by its number: the handle follows
    until(lambda: np.allclose(panel._nodes["upper"].position, 0.3))
    client.turn(panel._shape, SPHERE)
    until(lambda: panel._nodes.keys() == {"middle", "outline"})


def test_a_double_click_moves_the_crop_to_the_surface(tmp_path):
    """An exact ball of radius 0.6: two clicks apart change nothing, nor do two beside the ball."""
    scene = tiny.scene()
    with Viewer(Seen(ball(0.6), scene.frame).eval(), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        until(lambda: bool(viewer._everyone()))
        panel = viewer._everyone()[0].crop
        client.turn(panel._shape, SPHERE)
        until(lambda: panel._listening)
        for place, y in ((0.9, 0.0), (0.6, 0.0), (0.2, 0.9), (0.2, 0.9), (0.5, 0.3), (0.5, 0.3)):
            client.click((place, 0.5), (3.0, y, 0.0), (-1.0, 0.0, 0.0))
        until(lambda: np.allclose(panel._middle.value, (math.sqrt(0.6**2 - 0.3**2), 0.3, 0.0), atol=5e-3))
        assert np.allclose(np.add(panel._lower.value, panel._upper.value) / 2, panel._middle.value, atol=1e-5)
        client.turn(panel._shape, ALL)
        until(lambda: not panel._listening)
        client.close()


def test_outlines_lie_on_what_they_outline():
    sphere = Sphere((0.1, -0.2, 0.3), 0.5)
    ends = torch.from_numpy(circles(sphere)).reshape(-1, 3)
    assert torch.allclose((ends - torch.tensor(sphere.middle)).norm(dim=-1), torch.tensor(0.5).double())
    box = CropBox((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    lengths = np.linalg.norm(np.diff(edges(box), axis=1)[:, 0], axis=-1)
    assert sorted(lengths) == [1] * 4 + [2] * 4 + [3] * 4


def test_a_crop_begins_at_the_subject(tmp_path):
    """Sparse points on a small ball beside the middle of the scene, and more of them far behind it."""
    scene = tiny.scene()
    frame = replace(scene.frame, reach=4.0, has_alpha=False)
    spread = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    ball = torch.tensor([0.1, 0.0, 0.05]) + 0.2 * torch.nn.functional.normalize(spread, dim=-1)
    points = torch.cat([ball, 3 + spread[:200]])
    sphere = subject_of(Surroundings(scene.cameras, frame), points)
    assert sphere.middle == pytest.approx((0.1, 0.0, 0.05), abs=0.03) and 0.19 < sphere.radius < 0.26
    assert sphere.radius < subject_of(Surroundings(scene.cameras, frame)).radius < tiny.DISTANCE * 12 / tiny.FOCAL

    opened = replace(scene, frame=frame, points=points)
    about = subject(opened, tmp_path, open_scene=lambda: opened)
    with Viewer(tiny.method(frame).eval(), about, choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        client.picture(width=120)
        (visitor,) = viewer._everyone()
        radius = pytest.approx(sphere.radius, abs=1e-3)
        until(lambda: visitor.crop._radius.value == radius)  # once the photographs have been opened
        client.turn(visitor.crop._radius, 0.5)
        client.turn(visitor.crop._fit, True)
        until(lambda: visitor.request().crop is not None and visitor.request().crop.radius == radius)
        assert visitor.request().crop.middle == pytest.approx(sphere.middle, abs=1e-3)
        client.close()


def test_other_methods_crop_and_save_nothing(tmp_path):
    scene = tiny.scene()
    with Viewer(tiny.method(scene.frame).eval(), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        client.picture(width=120)
        (visitor,) = viewer._everyone()
        assert not visitor.crop._strength.visible and not hasattr(visitor.crop, "_name")
        client.turn(visitor.crop._shape, SPHERE)
        until(lambda: isinstance(visitor.request().crop, Sphere))
        client.close()
