"""The viewer in a real browser."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from PIL import Image
from test_nerf_w import made, two_lights
from test_viewer import some_cloud, subject
from waiting import until

import lumigraph.methods
from lumigraph.datasets.scene import Frame
from lumigraph.files.ranges import changed
from lumigraph.paths.keyframes import CameraPath
from lumigraph.run import build
from lumigraph.training import fit
from lumigraph.viewer import Viewer, choose_address

# A client may leave at any moment; viser warns of what was still on its way.
pytestmark = [budget("exports", 20), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]

SIZE = (800, 420)
SHARPEST = 400  # pixels of a streamed picture's longer side, so that the tests are quick
ROWS, COLUMNS = slice(210, None), slice(0, 430)  # beside the panel, and below viser's notice of slow graphics
HARMLESS = "computeBoundingSphere"  # viser's own complaint about its splats


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    """Of the tiny scene, with its photographs."""
    scene = tiny.scene()
    method = tiny.method(scene.frame, samples=12)
    fit(method, scene, steps=80, show=False)
    about = subject(scene, tmp_path_factory.mktemp("run"), open_scene=lambda: scene)
    with Viewer(method, about, choose_address(port=0)) as made:
        yield made


def visit(viewer, page, size=SIZE):
    """Open the page in a window of (width, height); gives the visitor that the viewer has made of it, at rest."""
    page.set_viewport_size({"width": size[0], "height": size[1]})
    known = set(map(id, viewer._everyone()))
    page.goto(viewer.address.url)
    visitor = until(lambda: next((v for v in viewer._everyone() if id(v) not in known), None))
    visitor.controls._sharpest.value = SHARPEST
    until(lambda: visitor._arrived)  # a client's first camera is three.js's own
    settle(visitor)
    return visitor


def settle(visitor) -> None:
    assert visitor.painter.settled.wait(30)


def shot(page) -> np.ndarray:
    """The left of the page, in [0, 1]."""
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    return np.asarray(image)[ROWS, COLUMNS] / 255


def expected(viewer, visitor) -> np.ndarray:
    """What our own renderer sees in that place."""
    return viewer.method.render(visitor.request().camera(SIZE)).rgb.clamp(0, 1).numpy()[ROWS, COLUMNS]


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(a - b).mean()))


def shows(page, wanted: Callable[[], np.ndarray], decibels: float, seconds: float = 40.0) -> None:
    """Wait until the page looks like a picture, made anew each time: a busy browser's camera may still move, and
    browsers decode when they like."""
    end = time.monotonic() + seconds
    while (reached := psnr(shot(page), wanted())) < decibels:
        assert time.monotonic() < end, f"only {reached:.1f} dB"
        time.sleep(0.2)


def choose(page, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).first.click()
    page.get_by_role("option", name=option, exact=True).click()


def test_the_scene_appears_turns_and_changes_modes(viewer, page, faults):
    visitor = visit(viewer, page)
    page.get_by_role("checkbox", name="Cameras").click()  # so that nothing but the scene is to be seen
    before = expected(viewer, visitor)
    assert before.std() > 0.1
    shows(page, lambda: expected(viewer, visitor), 28)

    place = visitor.request().pose
    page.mouse.move(150, 300)
    page.mouse.down()
    page.mouse.move(250, 320, steps=4)
    page.mouse.up()
    until(lambda: visitor.request().pose != place)
    until(visitor.painter.settled.is_set)
    after = expected(viewer, visitor)
    assert psnr(after, before) < 25
    shows(page, lambda: expected(viewer, visitor), 28)

    seen = shot(page)
    for mode in ("Depth", "Opacity", "Normals"):
        choose(page, "Show", mode)
        until(lambda mode=mode: visitor.request().mode == mode.lower() and visitor.painter.settled.is_set())
        until(lambda seen=seen: psnr(shot(page), seen) < 20)
        seen = shot(page)
    assert faults == []


def middle(visitor) -> np.ndarray:
    """Where the window shows the middle of the ball, in half-sizes from its middle."""
    request = visitor.request()
    (place,), _ = request.camera(request.canvas).project(torch.zeros(1, 3))
    return place.numpy() / (np.array(request.canvas) / 2) - 1


def drag(page, visitor, pixels: int) -> None:
    width, height = page.viewport_size["width"], page.viewport_size["height"]
    before = visitor.request().pose
    page.mouse.move(width / 3, height / 2)
    page.mouse.down()
    page.mouse.move(width / 3 + pixels, height / 2, steps=4)
    page.mouse.up()
    until(lambda: visitor.request().pose != before)
    until(visitor.painter.settled.is_set)


@pytest.mark.parametrize("size", [SIZE, (320, 480)], ids=["desktop", "phone"])
def test_a_drag_keeps_the_ball_where_it_is(viewer, page, size):
    """On a phone the panel begins folded, opens at a touch, and stays open."""
    visitor = visit(viewer, page, size)
    until(lambda: page.title() == "ball")
    before = middle(visitor)
    eye = np.array(visitor.request().pose)[:, 3]
    assert np.abs(before).max() < 0.2
    if size != SIZE:  # until it is folded, the panel is where the drag begins
        until(lambda: page.locator(".mantine-Paper-root").first.bounding_box()["height"] < 100)
        assert page.locator(".mantine-Paper-root").first.bounding_box()["width"] == size[0]
    drag(page, visitor, 60)
    moved = np.array(visitor.request().pose)[:, 3]
    assert np.abs(middle(visitor) - before).max() < 0.1
    assert np.linalg.norm(moved - eye) > 0.2 * np.linalg.norm(eye)  # around the ball, and as far from it
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(eye), rel=0.05)

    cameras = page.get_by_role("checkbox", name="Cameras")
    if size == SIZE:
        cameras.wait_for(state="visible")
        return
    page.get_by_text("ball", exact=True).click()
    until(lambda: page.locator(".mantine-Paper-root").first.bounding_box()["height"] > 200)
    time.sleep(0.5)
    assert cameras.is_visible()


def test_a_click_on_a_camera_flies_there(viewer, page):
    visitor = visit(viewer, page)
    camera = viewer.subject.cameras["train"][1]
    away = camera.position[0] - 2.0 * camera.forward[0]
    behind = torch.cat([camera.pose[0, :, :3], away[:, None]], 1).double().numpy()  # it is in the middle of the view

    def arrived() -> bool:
        return np.abs(np.array(visitor.request().pose) - camera.pose[0].numpy()).max() < 2e-3

    for _ in range(8):  # software draws slowly: until the frustum is there to be clicked, and the last pose told
        visitor.flight.place(behind, 5.0, 0.9)
        time.sleep(1)
        page.mouse.click(SIZE[0] / 2, SIZE[1] / 2)
        try:
            until(arrived, 4)
            return
        except TimeoutError:
            continue
    pytest.fail("the camera was not reached in 8 clicks")


def test_a_path_is_set_saved_and_opened(viewer, page):
    visitor = visit(viewer, page)
    page.get_by_role("tab", name="Path").click()
    add = page.get_by_role("button", name="Add keyframe here")
    add.click()
    until(lambda: len(visitor.path._stops) == 1)
    first = np.array(visitor.request().pose)
    visitor.flight.place(viewer.subject.cameras["train"].pose[4].double().numpy(), 3.0, 0.9)
    until(lambda: np.abs(np.array(visitor.request().pose) - first).max() > 0.1)
    add.click()
    until(lambda: len(visitor.path._stops) == 2)
    page.get_by_role("button", name="Save").click()
    file = viewer.subject.paths / "path-1.json"
    until(file.exists)
    path = CameraPath.load(file)
    assert [key.seconds for key in path.keyframes] == [0.0, 2.0]
    assert np.allclose(path.keyframes[0].pose, first, atol=1e-5)
    assert path.keyframes[1].fov == pytest.approx(np.degrees(0.9), abs=0.01)
    page.get_by_text(f"lumigraph render RUN --path {file}").wait_for()

    about = json.loads(file.read_text())
    about["keyframes"][0]["pose"][0][0] = "left"
    (viewer.subject.paths / "nonsense.json").write_text(json.dumps(about))
    visitor.path._saved.options = visitor.path._names()
    visitor.path._saved.value = "nonsense"
    page.get_by_role("button", name="Open").click()
    page.get_by_text("nonsense.json").first.wait_for()  # in a sentence that says what is wrong
    assert len(visitor.path._stops) == 2

    visitor.path._saved.value = "path-1"
    page.get_by_role("button", name="✕").click()
    until(lambda: len(visitor.path._stops) == 1)
    page.get_by_role("button", name="Open").click()
    until(lambda: len(visitor.path._stops) == 2)
    page.get_by_role("button", name="Play").click()
    last = np.array(path.keyframes[1].pose)
    until(lambda: np.abs(np.array(visitor.request().pose) - last).max() < 1e-3)


def test_appearances_are_a_list_whose_choice_is_seen(page, faults, tmp_path):
    """Photographs of NeRF-W, of which number 1 is a third as bright as number 2."""
    scene = two_lights()
    method = made(scene, transient_start=1.0, samples_per_step=1 << 13)
    fit(method, scene, steps=120, show=False, rehearsal=False)
    with Viewer(method.eval(), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        visitor = visit(viewer, page)
        page.get_by_role("checkbox", name="Cameras").click()
        pictures = {}
        for photograph in ("1", "2"):
            choose(page, "Appearance", photograph)
            until(lambda n=photograph: visitor.request().settings == (("appearance", n),))
            settle(visitor)
            told = method.given(appearance=photograph).render(visitor.request().camera(SIZE)).rgb
            pictures[photograph] = told.clamp(0, 1).numpy()[ROWS, COLUMNS]
            shows(page, lambda photograph=photograph: pictures[photograph], 28)
        assert psnr(*pictures.values()) < 24
        assert page.get_by_label("Transient", exact=True).first.input_value() == "hidden"
    assert [fault for fault in faults if "WebSocket" not in fault] == []


def test_a_slider_changes_the_picture(page, tmp_path):
    scene = tiny.scene()
    kind = lumigraph.methods.find("two-moments")
    method = build(kind, replace(scene.frame, times=(2.0, 5.0)), kind.Config(), torch.device("cpu"), 0).eval()
    with Viewer(method, subject(scene, tmp_path), choose_address(port=0)) as viewer:
        visitor = visit(viewer, page)
        page.get_by_role("checkbox", name="Cameras").click()
        shows(page, lambda: expected(viewer, visitor), 28)
        slider = page.locator("[role=slider][aria-valuemax='2']").first
        slider.focus()
        slider.press("End")
        until(lambda: dict(visitor.request().settings).get("brightness") == 2.0)
        settle(visitor)
        bright = method.given(brightness=2.0).render(visitor.request().camera(SIZE)).rgb.clamp(0, 1)
        assert psnr(bright.numpy()[ROWS, COLUMNS], expected(viewer, visitor)) < 24
        shows(page, lambda: bright.numpy()[ROWS, COLUMNS], 28)


def test_gaussians_are_drawn_by_the_browser(page, faults, tmp_path):
    cloud = replace(some_cloud(300), harmonics=0.4 * some_cloud(300).harmonics)
    frame = Frame(near=0.05, background=(0.1, 0.2, 0.3))
    kind = lumigraph.methods.find("gaussian-splatting")
    method = kind(frame, changed(kind.Config(), sh_degree=3))
    method.cloud.replace(cloud)
    with Viewer(method.eval(), subject(replace(tiny.scene(), frame=frame), tmp_path), choose_address(port=0)) as viewer:
        visitor = visit(viewer, page)
        page.get_by_role("checkbox", name="Cameras").click()
        shows(page, lambda: expected(viewer, visitor), 26)  # the browser's sums are half as exact
        assert visitor.controls.status.content == "300 Gaussians, drawn by the browser"
        page.get_by_role("checkbox", name="Draw exactly").click()
        until(lambda: visitor.request().exact and visitor.painter.settled.is_set())
        shows(page, lambda: expected(viewer, visitor), 33)
    assert [fault for fault in faults if HARMLESS not in fault and "WebSocket" not in fault] == []
