"""Pages to share: they open from disk in a real browser, with no network, and show what we render ourselves."""

from __future__ import annotations

import dataclasses
import functools
import gzip
import http.server
import io
import json
import math
import re
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from accessible import faults_of
from budgets import budget
from PIL import Image
from tiny import method as tiny_method
from tiny import new_run, scene
from windows import SIZE, psnr, some_camera

from lumigraph.camera import Camera
from lumigraph.commands.cli import main
from lumigraph.datasets.mesh import Mesh
from lumigraph.exchange import write_gaussians
from lumigraph.exchange.streamed_sog import Detail
from lumigraph.export.options import PageOptions
from lumigraph.export.page import (
    WEB,
    contributions,
    mesh_page,
    moving_page,
    splats_page,
    streamed_page,
    views,
    views_page,
)
from lumigraph.gaussians import Gaussians
from lumigraph.gaussians.moving import MovingGaussians
from lumigraph.gaussians.splatting import render
from lumigraph.paths import Surroundings
from lumigraph.paths.opening import Opening, opening_of_scene
from lumigraph.run import State

pytestmark = budget("exports", 15)

PACKAGES = Path(__file__).parent.parent / "web" / "package.json"
OPENING = Opening(
    "A <test> & more", (0.9, 0.8, 0.6), (0.0, -3.0, 1.0), (0.0, 0.0, 0.0), 50.0, 0.05, 100, 0.3, 9, 110, True
)


def cloud(count: int = 400, antialiased: bool = False) -> Gaussians:
    """Gaussians of many shapes and sizes in a ball, with strong harmonics, all inside what .spz can hold."""
    g = torch.Generator().manual_seed(3)
    harmonics = 0.25 * torch.randn(count, 16, 3, generator=g).clamp(-3, 3)
    harmonics[:, 0] = 1.2 * torch.randn(count, 3, generator=g).clamp(-2, 2)
    return Gaussians(
        0.35 * torch.randn(count, 3, generator=g),
        torch.randn(count, 4, generator=g),
        -3 + 0.8 * torch.randn(count, 3, generator=g),
        2 * torch.randn(count, generator=g),
        harmonics,
        antialiased,
    )


@pytest.mark.parametrize("antialiased", [False, True])
def test_splats_are_drawn_as_we_draw_them(tmp_path, window, antialiased):
    made = cloud(antialiased=antialiased)
    splats_page(tmp_path / "page.html", made, OPENING)
    assert (tmp_path / "page.html").stat().st_size < 2e6
    opened = window(tmp_path / "page.html")
    for index in (1, 4):
        camera = some_camera(index)
        shown = opened.look(camera)
        ours = render(made, camera, OPENING.background, OPENING.near).rgb.clamp(0, 1).numpy()
        assert psnr(shown, ours) > 42
        without = render(
            dataclasses.replace(made, harmonics=made.harmonics[:, :1]), camera, OPENING.background, OPENING.near
        ).rgb.clamp(0, 1)
        assert psnr(shown, without.numpy()) < 30  # the harmonics are seen


def test_a_budget_draws_the_largest_contributions(tmp_path, window):
    made = cloud()
    splats_page(tmp_path / "page.html", made, OPENING, budget=150)
    largest = made[contributions(made).argsort(descending=True)[:150]]
    camera = some_camera()
    shown = window(tmp_path / "page.html").look(camera)
    ours = [render(some, camera, OPENING.background, OPENING.near).rgb.clamp(0, 1).numpy() for some in (largest, made)]
    assert psnr(shown, ours[0]) > 42 and psnr(shown, ours[1]) < 35


def test_levels_of_detail_are_loaded(tmp_path, page, faults):
    """The coarsest level opens the page, and the finest is there a little later, turned as the page says."""
    made = cloud()
    turn = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    meta = tmp_path / "a scene" / "lod-meta.json"
    write_gaussians(meta, made.transformed(turn.inverse()), Detail(levels=2, chunk=1024))
    streamed_page(tmp_path / "page.html", meta, turn, OPENING)
    handler = functools.partial(QuietHandler, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page.set_viewport_size({"width": SIZE, "height": SIZE})
        page.goto(f"http://127.0.0.1:{server.server_port}/page.html")
        page.evaluate("lumigraph.ready")
        page.add_style_tag(
            content="#caption, #buttons, #wait { display: none !important } * { transition: none !important }"
        )
        camera = some_camera(4)
        ours = render(made, camera, OPENING.background, OPENING.near).rgb.clamp(0, 1).numpy()
        for _ in range(100):
            page.evaluate("([pose, angle]) => lumigraph.setCamera(pose, angle)", [camera.pose[0].tolist(), 45.0])
            shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255
            if psnr(shown, ours) > 38:
                break
            page.wait_for_timeout(50)
        else:
            pytest.fail(f"the finest level differs: {psnr(shown, ours):.1f} dB")
        server.shutdown()
    assert faults == []


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


def test_turning_and_going_back(tmp_path, window):
    splats_page(tmp_path / "page.html", cloud(), OPENING)
    opened = window(tmp_path / "page.html")
    assert opened.page.title() == OPENING.title
    first = opened.settled()
    assert psnr(first, np.broadcast_to(OPENING.background, first.shape)) < 20  # something is there from the start
    opened.drag(0.25)
    turned = opened.settled()
    assert psnr(turned, first) < 25
    opened.page.keyboard.press("ArrowLeft")
    assert psnr(opened.settled(), turned) < 35
    opened.page.mouse.wheel(0, -300)
    assert psnr(opened.settled(), turned) < 30
    opened.page.keyboard.press("r")
    assert psnr(opened.settled(), first) > 45


def test_a_phone(tmp_path, window):
    splats_page(tmp_path / "page.html", cloud(), OPENING)
    phone = {"viewport": {"width": 130, "height": 280}, "device_scale_factor": 2, "has_touch": True, "is_mobile": True}
    opened = window(tmp_path / "page.html", **phone)
    first = opened.settled()
    assert first.shape == (560, 260, 3)
    touch = opened.context.new_cdp_session(opened.page)

    def finger(kind: str, *at: tuple[int, int]) -> None:
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(at)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    finger("touchStart", (60, 140))
    finger("touchMove", (90, 140))
    finger("touchEnd")
    turned = opened.settled()
    assert psnr(turned, first) < 25
    finger("touchStart", (50, 140), (80, 140))
    finger("touchMove", (20, 140), (110, 140))
    finger("touchEnd")
    assert psnr(opened.settled(), turned) < 25  # pinched


def test_looking_around_from_the_middle(tmp_path, window):
    opening = dataclasses.replace(
        OPENING, position=(0.0, 0.0, 0.0), target=(0.0, 0.02, 0.0), nearest=0.002, farthest=0.06
    )
    mesh_page(tmp_path / "page.html", cube(), dataclasses.replace(opening, inward=False))
    opened = window(tmp_path / "page.html")
    first = opened.settled()
    opened.drag(0.25)
    turned = opened.settled()
    assert psnr(turned, first) < 30
    assert psnr(turned, np.broadcast_to(OPENING.background, first.shape)) < 20  # still inside


def test_without_webgl_a_sentence(tmp_path, page, faults):
    mesh_page(tmp_path / "page.html", cube(), OPENING)
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto((tmp_path / "page.html").as_uri())
    page.wait_for_selector("body.failed")
    assert "WebGL 2" in page.inner_text("#wait") and "another" in page.inner_text("#wait")
    assert len(faults) == 1


LOSE = """async () => {
  const canvas = document.querySelector("canvas");
  const lost = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
  const happens = (name) => new Promise((done) => canvas.addEventListener(name, done, { once: true }));
  const gone = happens("webglcontextlost");
  lost.loseContext();
  await gone;
  const said = [document.body.className, document.getElementById("wait").textContent];
  const back = happens("webglcontextrestored");
  setTimeout(() => lost.restoreContext());
  await back;
  return said;
}"""


@pytest.mark.parametrize(
    "write",
    [
        lambda path: splats_page(path, cloud(), OPENING),
        lambda path: moving_page(path, MovingGaussians.still(cloud(), 2.0), OPENING),
        lambda path: mesh_page(path, cube(), OPENING),
    ],
    ids=["splats", "moving", "mesh"],
)
def test_a_lost_graphics_card_comes_back(tmp_path, window, write):
    write(tmp_path / "page.html")
    opened = window(tmp_path / "page.html")
    first = opened.settled()
    said = opened.page.evaluate(LOSE)
    assert "open" not in said[0].split() and "comes back" in said[1]
    opened.page.locator("body.open").wait_for()
    assert psnr(opened.settled(), first) > 45


def test_a_page_is_named_and_reached_by_the_keyboard(tmp_path, page, faults):
    moving_page(tmp_path / "page.html", MovingGaussians.still(cloud(), 2.0), OPENING)
    page.goto((tmp_path / "page.html").as_uri())
    page.evaluate("lumigraph.ready")
    assert faults_of(page) == faults == []


def cube() -> Mesh:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[a, b, c] for s in sides for a, b, c in ((s[0], s[1], s[2]), (s[0], s[2], s[3]))])
    return Mesh(0.6 * corners, faces, ((corners + 1) * 100 + 30).astype(np.uint8))


def traced(mesh: Mesh, camera: Camera) -> np.ndarray:
    """The mesh as rays meet it (Moeller and Trumbore 1997), colours interpolated across each triangle."""
    rays = camera.rays(camera.pixels())
    o, d = rays.origins.double().numpy(), rays.directions.double().numpy()
    rgb, nearest = np.tile(np.array(OPENING.background), (len(o), 1)), np.full(len(o), np.inf)
    for face in mesh.faces:
        a, b, c = mesh.vertices[face]
        p = np.cross(d, c - a)
        det = p @ (b - a)
        u = ((o - a) * p).sum(-1) / det
        q = np.cross(o - a, b - a)
        v, t = (q * d).sum(-1) / det, q @ (c - a) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < nearest)
        weights = np.stack([1 - u - v, u, v], -1)
        rgb[hit], nearest[hit] = (weights @ mesh.colours[face] / 255)[hit], t[hit]
    return rgb.reshape(SIZE, SIZE, 3)


def test_a_mesh_is_drawn_where_it_is(tmp_path, window):
    mesh_page(tmp_path / "page.html", cube(), OPENING)
    assert (tmp_path / "page.html").stat().st_size < 4e5
    opened = window(tmp_path / "page.html")
    camera = some_camera(2)
    assert psnr(opened.look(camera), traced(cube(), camera)) > 35  # all but the edges, which the page smooths
    opened.page.keyboard.press("r")
    first = opened.settled()
    opened.drag(0.25)
    assert psnr(opened.settled(), first) < 25


def test_the_open_sky(tmp_path, window):
    """Overhead above, underfoot below, the background between; and the camera stays above the floor."""
    sky = (0.2, 0.4, 0.9), (0.1, 0.6, 0.2)
    opening = dataclasses.replace(OPENING, sky=sky, within=((-1.0,) * 3, (1.0,) * 3))
    mesh_page(tmp_path / "page.html", cube(), opening)
    opened = window(tmp_path / "page.html")
    level = torch.tensor([[[1.0, 0, 0, 0], [0, 0, 1, -9], [0, -1, 0, 5]]])  # above the cube, looking along +y
    shown = opened.look(dataclasses.replace(some_camera(), pose=level), 90.0)
    for row, expected in ((2, sky[0]), (SIZE // 2, OPENING.background), (SIZE - 2, sky[1])):
        np.testing.assert_allclose(shown[row, SIZE // 4], expected, atol=0.02)
    opened.page.keyboard.press("r")
    before = opened.settled()
    mesh_page(tmp_path / "lifted.html", cube(), dataclasses.replace(opening, floor=1.5))
    assert psnr(window(tmp_path / "lifted.html").settled(), before) < 30


def test_pictures_are_turned_over(tmp_path, window):
    made, cameras = tiny_method(), scene().cameras
    views_page(
        tmp_path / "page.html",
        made,
        cameras,
        opening_of_scene("ball", cameras, made.frame),
        PageOptions(views=8, size=96),
    )
    assert (tmp_path / "page.html").stat().st_size < 1e5
    opened = window(tmp_path / "page.html", viewport={"width": 96, "height": 96})
    seen_from = views(Surroundings(cameras, made.frame), 8, (96, 96))
    for i in (3, 6):
        assert psnr(opened.look(seen_from[i]), made.render(seen_from[i]).rgb.numpy()) > 35
    opened.page.keyboard.press("r")
    first = opened.settled()
    opened.drag(0.3)
    assert psnr(opened.settled(), first) < 30


def test_an_arc_has_two_ends():
    made = scene()
    arc = made.cameras[torch.tensor([0, 1, 2])]
    seen_from = views(Surroundings(arc, made.frame), 9, (32, 32))
    azimuth = torch.atan2(seen_from.position[:, 1], seen_from.position[:, 0])
    assert torch.allclose(azimuth.diff(), azimuth.diff()[0].expand(8), rtol=0.2)
    assert 0 < float(azimuth[0]) < 0.3 and math.pi / 3 - 0.3 < float(azimuth[-1]) < math.pi / 3


@pytest.fixture
def run(tmp_path):
    made = new_run(tmp_path / "run")
    method = tiny_method()
    made.save(State(), method, method.optimizers(), torch.Generator())
    return made


def test_the_command(run, tmp_path, capsys):
    assert (
        main(
            [
                "export",
                "web",
                str(run.folder),
                str(tmp_path / "a.html"),
                "--as",
                "views",
                "--views",
                "3",
                "--size",
                "32",
            ]
        )
        == 0
    )
    assert "3 views" in capsys.readouterr().out
    page = (tmp_path / "a.html").read_text("utf-8")
    settings = json.loads(re.search(r'<script id="settings" type="application/json">(.*?)</script>', page)[1])
    assert len(settings["pictures"]) == 3


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["page.txt"], ".html"),
        (["page.html", "--views", "1"], "--views"),
        (["page.html", "--size", "3"], "--size"),
        (["page.html", "--as", "splats"], "no Gaussians"),
        (["page.html", "--background", "red"], "--background"),
        (["page.html", "--budget", "many"], "--budget"),
        (["page.html", "--stream"], "--stream"),
    ],
)
def test_what_cannot_be_is_refused(run, tmp_path, capsys, arguments, told):
    assert main(["export", "web", str(run.folder), str(tmp_path / arguments[0]), *arguments[1:]]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / arguments[0]).exists()


def test_titles_cannot_break_a_page(tmp_path):
    opening = dataclasses.replace(OPENING, title="</script><b>@@data@@")
    mesh_page(tmp_path / "page.html", cube(), opening)
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "</script><b>" not in page
    assert "<title>&lt;/script&gt;&lt;b&gt;@@data@@</title>" in page


def test_programs_name_the_versions_that_are_pinned():
    pinned = json.loads(PACKAGES.read_text("utf-8"))["dependencies"]
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", version) for version in pinned.values())
    for program, names in {"stage": ["three"]}.items():
        heading = (WEB / f"{program}.js").read_text("utf-8")[:20_000]
        for name in names:
            assert f"{name} {pinned[name]}" in heading
        assert heading.count("Permission is hereby granted") >= len(names)


def test_three_js_is_bundled_once():
    holders = [path.name for path in WEB.glob("*.js") if "THREE.WebGLRenderer" in path.read_text("utf-8")]
    assert holders == ["stage.js"]


def test_the_programs_of_a_page_are_small():
    """Under a megabyte, and under 350 kB as pages hold them."""
    held = b"".join((WEB / f"{name}.js").read_bytes() for name in ("stage", "splats"))
    assert len(held) < 1e6 and len(gzip.compress(held, 9)) < 350e3


def test_the_lock_names_no_registry():
    text = PACKAGES.with_name("package-lock.json").read_text("utf-8")
    assert '"resolved"' not in text and "http" not in re.sub(r'"url": "[^"]*"', "", text)
