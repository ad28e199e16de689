"""Pages of baked volumes: octrees and atlases are seen in a browser as their rays say, whatever leaps are taken."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
import tiny
import torch
import volumes
from budgets import budget
from test_viewer import subject
from test_web import OPENING
from windows import SIZE, psnr, some_camera

import lumigraph.derive.conversion
import lumigraph.methods
from lumigraph.camera import Camera
from lumigraph.camera.rays import Rays
from lumigraph.commands.cli import main
from lumigraph.derive.conversion import convert
from lumigraph.derive.options import ConvertOptions
from lumigraph.errors import LumigraphError
from lumigraph.exchange.baked import Octree, atlas_for_browser, breadth_first, clearance, octree_for_browser
from lumigraph.export import page as pages
from lumigraph.export.page import volume_bytes, volume_page
from lumigraph.large import open_any
from lumigraph.viewer import Viewer, choose_address

pytestmark = budget("exports", 30)

GROUND = torch.tensor(OPENING.background)
LEVELS = 5
PHONE = {"viewport": {"width": 130, "height": 280}, "device_scale_factor": 2, "has_touch": True, "is_mobile": True}
SLOW = """{ // 200 pixels in a millisecond, whatever draws them
  const { readPixels, scissor } = WebGL2RenderingContext.prototype;
  let pixels = 0;
  WebGL2RenderingContext.prototype.scissor = function (...all) {
    pixels = all[2] * all[3];
    scissor.apply(this, all);
  };
  WebGL2RenderingContext.prototype.readPixels = function (...all) {
    readPixels.apply(this, all);
    for (const end = performance.now() + pixels / 200; performance.now() < end; );
  };
  const { viewport } = WebGL2RenderingContext.prototype;
  window.sizes = [];
  WebGL2RenderingContext.prototype.viewport = function (...all) {
    sizes.push(all[2]);
    viewport.apply(this, all);
  };
}"""


def some_rays(camera: Camera) -> Rays:
    """Those of every eighth row."""
    return camera.rays(camera.pixels()[8 * SIZE * torch.arange(SIZE // 8)[:, None] + torch.arange(SIZE)].flatten(0, 1))


def agreement(shown: np.ndarray, rgb: torch.Tensor) -> float:
    """PSNR between those rows of a picture and what their rays see."""
    return psnr(shown[::8].reshape(-1, 3), rgb.clamp(0, 1).numpy())


def test_an_octree_is_seen_as_its_rays_say(tmp_path, window):
    tree = volumes.octree(LEVELS)
    volume_page(tmp_path / "page.html", octree_for_browser(tree), OPENING)
    volume_page(tmp_path / "plain.html", octree_for_browser(tree, degree=0), OPENING)
    opened = window(tmp_path / "page.html")
    for index in (1, 4):
        camera = some_camera(index)
        ours = volumes.octree_seen(tree, some_rays(camera), LEVELS, GROUND)
        assert agreement(opened.look(camera), ours) > 50
    assert agreement(window(tmp_path / "plain.html").look(camera), ours) < 35  # the harmonics are seen


def test_from_inside_a_cell(tmp_path, window):
    tree = volumes.octree(LEVELS)
    volume_page(tmp_path / "page.html", octree_for_browser(tree), dataclasses.replace(OPENING, near=0.01))
    pose = some_camera(2).pose.clone()
    pose[0, :, 3] = torch.tensor([0.9, 0.9, 0.9])  # in the fog
    camera = dataclasses.replace(some_camera(2), pose=pose)
    rays = some_rays(camera)
    rays = dataclasses.replace(rays, origins=rays.origins + 0.01 * rays.directions)
    ours = volumes.octree_seen(tree, rays, LEVELS, GROUND)
    assert agreement(window(tmp_path / "page.html").look(camera), ours) > 45


def test_an_open_atlas_is_seen_along_curved_rays(tmp_path, window):
    made = volumes.open_atlas()
    volume_page(tmp_path / "page.html", atlas_for_browser(made), OPENING)
    opened = window(tmp_path / "page.html")
    for index in (1, 4):
        camera = some_camera(index)
        shown, rays = opened.look(camera), some_rays(camera)
        assert agreement(shown, volumes.atlas_seen(made, rays, OPENING.near, GROUND)) > 45
        straight = dataclasses.replace(made, contracted=False)
        assert agreement(shown, volumes.atlas_seen(straight, rays, OPENING.near, GROUND)) < 25


@pytest.mark.parametrize("network", [False, True])
def test_an_atlas_is_seen_as_its_rays_say(tmp_path, window, network):
    made = volumes.atlas(network=network)
    volume_page(tmp_path / "page.html", atlas_for_browser(made), OPENING)
    opened = window(tmp_path / "page.html")
    for index in (1, 4):
        camera = some_camera(index)
        shown, rays = opened.look(camera), some_rays(camera)
        assert agreement(shown, volumes.atlas_seen(made, rays, OPENING.near, GROUND)) > 50
    other = dataclasses.replace(made, network=None if network else volumes.shades())
    assert agreement(shown, volumes.atlas_seen(other, rays, OPENING.near, GROUND)) < 30  # the network is seen


@pytest.fixture(scope="module")
def grid(ball_run, tmp_path_factory):
    """The folder of a run that knows density and colour at points."""
    folder = tmp_path_factory.mktemp("grid") / "run"
    convert(open_any(ball_run.folder), "plenoxels", folder, **small("plenoxels"))
    return folder


def small(name: str, steps: int = 24) -> dict[str, Any]:
    """The least conversion, as arguments of `convert`."""
    return {"aim": ConvertOptions(steps=steps, views=1), "config": lumigraph.methods.find(name).smallest()}


@pytest.mark.parametrize(("name", "holds"), [("plenoctrees", "leaves of an octree"), ("snerg", "blocks of")])
def test_a_baked_run_is_seen_as_it_renders(grid, tmp_path, window, capsys, name, holds):
    convert(open_any(grid), name, tmp_path / "run", **small(name))
    assert main(["export", "web", str(tmp_path / "run"), str(tmp_path / "page.html")]) == 0
    assert holds in capsys.readouterr().out
    opened, method = window(tmp_path / "page.html"), open_any(tmp_path / "run").method()
    for index in (1, 4):
        camera = some_camera(index)
        ours = method.render(camera).rgb.clamp(0, 1).numpy()
        assert psnr(ours, np.broadcast_to(method.frame.background, ours.shape)) < 30  # there is something
        assert psnr(opened.look(camera), ours) > 40


def test_a_field_becomes_an_octree_on_the_way(grid, tmp_path, capsys, monkeypatch):
    quick = lambda *told, **more: convert(*told[:3], device=told[4], **small("plenoctrees", 4))  # noqa: E731
    monkeypatch.setattr(lumigraph.derive.conversion, "convert", quick)
    assert main(["export", "web", str(grid), str(tmp_path / "page.html")]) == 0
    told = capsys.readouterr().out
    assert "leaves of an octree" in told and "--as views is quicker" in told and "dB to plenoxels" in told
    assert (tmp_path / "page.html").is_file()


def test_a_volume_is_shown_whole(ball_run, tmp_path, capsys):
    told = ["--as", "volume", "--box", "0", "0", "0", "1", "1", "1"]
    assert main(["export", "web", str(ball_run.folder), str(tmp_path / "page.html"), *told]) == 2
    assert "--as views" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


# A client may leave at any moment; viser warns of what was still on its way.
@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")
def test_the_viewer_leads_to_a_page(tmp_path, page, faults):
    made = octree_for_browser(volumes.octree(LEVELS))
    about = dataclasses.replace(subject(tiny.scene(), tmp_path), page=lambda: volume_bytes(made, OPENING))
    with Viewer(tiny.method(), about, choose_address(port=0)) as viewer:
        page.goto(viewer.address.url)
        link = page.get_by_role("link", name="Drawn by this browser")
        with page.context.expect_page() as opened:
            link.click()
        opened.value.wait_for_load_state()
        opened.value.evaluate("lumigraph.ready")
        opened.value.wait_for_selector("body.open canvas")
        assert opened.value.url.startswith(viewer.address.url.partition("?")[0])
    assert faults == []


def test_coarse_while_moving_and_sharp_at_rest(tmp_path, window):
    volume_page(tmp_path / "page.html", octree_for_browser(volumes.octree(LEVELS)), OPENING)
    quick = window(tmp_path / "page.html").settled()
    (tmp_path / "slow.html").write_text(
        (tmp_path / "page.html").read_text("utf-8").replace("<head>", f"<head><script>{SLOW}</script>"), "utf-8"
    )
    slow = window(tmp_path / "slow.html")
    first = slow.settled()
    assert psnr(first, quick) > 50
    slow.page.evaluate("sizes.length = 0")
    slow.drag(0.25)
    turned = slow.settled()
    sizes = slow.page.evaluate("sizes")
    assert min(sizes) < SIZE / 2 and max(sizes) == SIZE
    slow.page.keyboard.press("r")
    assert psnr(slow.settled(), first) > 50 > 30 > psnr(turned, first)


def test_a_phone(tmp_path, window):
    volume_page(tmp_path / "page.html", atlas_for_browser(volumes.atlas()), OPENING)
    opened = window(tmp_path / "page.html", **PHONE)
    first = opened.settled()
    assert first.shape == (560, 260, 3)
    assert psnr(first, np.broadcast_to(OPENING.background, first.shape)) < 25
    opened.drag(0.4)
    assert psnr(opened.settled(), first) < 40


@pytest.mark.parametrize(
    ("lacking", "told"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "WebGL 2"),
        ("WebGL2RenderingContext.prototype.getParameter = ((f) => function (name) { return name === "
         "WebGL2RenderingContext.MAX_3D_TEXTURE_SIZE ? 16 : f.call(this, name) })"
         "(WebGL2RenderingContext.prototype.getParameter)", "another one"),
    ],
    ids=["webgl", "large"],
)  # fmt: skip
def test_what_a_browser_lacks_is_a_sentence(tmp_path, page, faults, lacking, told):
    volume_page(tmp_path / "page.html", atlas_for_browser(volumes.atlas()), OPENING)
    page.add_init_script(lacking)
    page.goto((tmp_path / "page.html").as_uri())
    page.wait_for_selector("body.failed")
    assert told in page.inner_text("#wait")
    assert len(faults) == 1


def test_a_page_says_its_size_and_has_a_limit(tmp_path, monkeypatch):
    path = tmp_path / "page.html"
    volume_page(path, octree_for_browser(volumes.octree(3)), OPENING)
    size = re.search(r"Opening ([\d.]+) MB", path.read_text("utf-8"))
    assert size and float(size[1]) == pytest.approx(path.stat().st_size / 1e6, abs=0.06)
    path.unlink()
    monkeypatch.setattr(pages, "MAX_PAGE_BYTES", 1000)
    with pytest.raises(LumigraphError, match="--degree 1"):
        volume_page(path, octree_for_browser(volumes.octree(4)), OPENING)
    with pytest.raises(LumigraphError, match="--as views"):
        volume_page(path, atlas_for_browser(volumes.atlas()), OPENING)
    assert not path.exists()


def test_nodes_in_any_order_come_level_by_level():
    tree = volumes.octree(3, bands=1)
    kinds, cells, levels = breadth_first(tree)
    assert levels == 3 and len(kinds) == 8 * len(tree.child)
    assert (tree.density.flatten()[cells] > 0).equal(kinds == 1)
    assert (tree.child.flatten()[cells] != 0).equal(kinds == 2)
    empty = Octree(torch.zeros(1, 2, 2, 2).int(), torch.zeros(1, 2, 2, 2), torch.zeros(1, 2, 2, 2, 1, 3), tree.low, 2.0)
    assert octree_for_browser(empty).settings["leaves"] == 0


def test_clearance_is_the_distance_of_chess():
    occupied = torch.zeros(9, 7, 5, dtype=torch.bool)
    occupied[2, 1, 4] = occupied[8, 6, 0] = True
    places = torch.stack(torch.meshgrid(*map(torch.arange, occupied.shape), indexing="ij"), -1)
    away = torch.stack([(places - place).abs().amax(-1) for place in occupied.nonzero()]).amin(0)
    assert clearance(occupied).equal(away.to(torch.uint8))
