"""Clouds that move, as files and pages: spans of even motion, the format .4dgs, a page with a clock."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from test_deformable_splatting import moving
from torch.nn.functional import normalize
from windows import psnr as apart
from windows import some_camera

from lumigraph.commands.cli import main
from lumigraph.composition import FilteredCloud, PlayedCloud
from lumigraph.errors import LumigraphError
from lumigraph.exchange import fourdgs, read_gaussians, write_gaussians
from lumigraph.export.loaded import Loaded
from lumigraph.export.options import Keeping
from lumigraph.export.page import moving_page
from lumigraph.gaussians import Gaussians
from lumigraph.gaussians.moving import MovingGaussians, fitted
from lumigraph.gaussians.splatting import render
from lumigraph.geometry import multiply
from lumigraph.large import open_any
from lumigraph.metrics import psnr
from lumigraph.paths.opening import Opening
from lumigraph.run import Run, State

pytestmark = budget("exports", 10)
BLACK = (0.0, 0.0, 0.0)
OPENING = Opening("A test", (0.9, 0.8, 0.6), (0.0, -3.0, 1.0), (0.0, 0.0, 0.0), 50.0, 0.05, 100, 0.3, 9, 110, True)


def turning(share: float, count: int = 60) -> Gaussians:
    """Small discs, of which every third stands still and the others go half around the z-axis."""
    g = torch.Generator().manual_seed(4)
    means, quaternions = 0.5 * torch.randn(count, 3, generator=g), torch.randn(count, 4, generator=g)
    angle = math.pi * share * (torch.arange(count) % 3 > 0)
    cos, sin = angle.cos(), angle.sin()
    turned = torch.stack([cos * means[:, 0] - sin * means[:, 1], sin * means[:, 0] + cos * means[:, 1], means[:, 2]], 1)
    nothing = torch.zeros(count)
    turn = torch.stack([(angle / 2).cos(), nothing, nothing, (angle / 2).sin()], 1)
    scales = torch.tensor([0.12, 0.09, 0.03]).log().repeat(count, 1)
    harmonics = 0.3 * torch.randn(count, 4, 3, generator=g)
    moves = angle[:, None] > 0
    quaternions = torch.where(moves, multiply(turn, quaternions), quaternions)
    return Gaussians(torch.where(moves, turned, means), quaternions, scales, torch.full((count,), 1.5), harmonics)


@pytest.fixture(scope="module")
def made() -> MovingGaussians:
    return fitted(turning, 3.0)


def picture(cloud: Gaussians) -> torch.Tensor:
    return render(cloud, some_camera(), BLACK).rgb


def test_spans_follow_a_motion_and_still_ones_have_one(made):
    still = (made.begins == 0) & (made.ends == 3) & (made.velocities == 0).all(1)
    assert int(still.sum()) == 20 and made.moving == len(made) - 20
    for share in (0.0, 0.13, 0.5, 0.77, 1.0):
        now, truth = made.at(3 * share), turning(share)
        assert len(now) == 60
        order = torch.cat([torch.arange(0, 60, 3), (torch.arange(60) % 3 > 0).nonzero()[:, 0]])
        assert (now.means - truth.means[order]).norm(dim=1).max() < 0.1 * 0.12
        both = normalize(now.quaternions, dim=1) * normalize(truth.quaternions[order], dim=1)
        assert both.sum(1).abs().min() > math.cos(0.1)
        assert psnr(picture(now), picture(truth)) > 38
    coarse = fitted(turning, 3.0, tolerance=0.5)
    assert len(coarse) < len(made) / 2
    assert float(made.lasting(6.0).at(3.0).means.sum()) == pytest.approx(float(made.at(1.5).means.sum()), abs=1e-3)


def test_spans_of_an_even_motion_are_one():
    def sliding(share: float) -> Gaussians:
        still = turning(0.0)
        return replace(still, means=still.means + share * torch.tensor([1.0, 0.5, 0.0]))

    made = fitted(sliding, 2.0)
    assert len(made) == 60
    torch.testing.assert_close(made.velocities, torch.tensor([[0.5, 0.25, 0.0]]).expand(60, 3), atol=1e-5, rtol=0)


def test_gaussians_that_change_in_number_are_refused():
    with pytest.raises(LumigraphError, match="not the same at every moment"):
        fitted(lambda share: turning(0, 60 if share < 0.5 else 50), 1.0)


def test_a_file_returns_within_its_bounds(made, tmp_path):
    path = tmp_path / "a.4dgs"
    fourdgs.write_moving(path, made)
    back = fourdgs.read_moving(path)
    assert (len(back), back.duration, back.moving) == (len(made), 3.0, made.moving)
    assert path.stat().st_size < 30 * len(made)
    for share in (0.0, 0.2, 0.45, 0.7, 1.0):
        assert psnr(picture(back.at(3 * share)), picture(made.at(3 * share))) > 45
    faded = replace(made, fades=torch.full_like(made.begins, 0.02))
    fourdgs.write_moving(path, faded)
    back = fourdgs.read_moving(path)
    assert psnr(picture(back.at(1.4)), picture(faded.at(1.4))) > 38 and back.fades.isfinite().all()
    assert psnr(picture(back.at(1.4)), picture(made.at(1.4))) < 35


def test_the_reference_reads_the_same(made, tmp_path):
    reference = pytest.importorskip("fourdgs")
    from fourdgs import validate

    path = tmp_path / "a.4dgs"
    fourdgs.write_moving(path, made)
    assert validate.validate(path.read_bytes()).findings == []
    theirs = reference.read(path).gaussians
    assert theirs.count == len(made)
    ours = fourdgs.read_moving(path)
    key = np.lexsort([*theirs.positions.T.round(4), theirs.win_lo])
    own = np.lexsort([*ours.cloud.means.numpy().T.round(4), ours.begins.numpy()])
    for name, values in (("positions", ours.cloud.means), ("motions", ours.velocities), ("mu_t", ours.middles)):
        np.testing.assert_allclose(getattr(theirs, name)[key], values.numpy()[own], atol=2e-5)
    np.testing.assert_allclose(theirs.scales[key], ours.cloud.log_scales.exp().numpy()[own], rtol=1e-4)
    np.testing.assert_allclose(theirs.colors[key][:, 3], ours.cloud.opacities.sigmoid().numpy()[own], atol=1e-5)
    for time in (0.0, 1.1, 2.9):
        centres = np.sort(theirs.state_at(time)["centers"], 0)
        np.testing.assert_allclose(centres, np.sort(ours.at(time).means.numpy(), 0), atol=1e-4)


def test_files_that_are_not_read_say_why(made, tmp_path):
    path = tmp_path / "a.4dgs"
    fourdgs.write_moving(path, made)
    data = path.read_bytes()

    def refusal(changed: bytes) -> str:
        path.write_bytes(changed)
        with pytest.raises(LumigraphError) as fault:
            open_any(path)
        assert str(path) in str(fault.value)
        return str(fault.value)

    assert "version 1" in refusal(b"no such file" + data)
    assert "'keyframe-delta'" in refusal(data.replace(b"gaussian-birth", b"keyframe-delta"))
    assert "'uniform-v7'" in refusal(data.replace(b"uniform-v1", b"uniform-v7"))
    assert "damaged" in refusal(data[: len(data) // 2])
    assert "no Gaussians" in refusal(data[:8] + data[8 : data.index(b"uniform-v1") - 13] + bytes(8))
    at = data.index(b"gaussian-birth") - 4 - 16
    assert "promises" in refusal(data[:at] + struct.pack("<Q", 10**12) + data[at + 8 :])
    for place in range(40, len(data), len(data) // 40):  # a wrong byte anywhere: read, or one sentence
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x5A]) + data[place + 1 :])
        try:
            fourdgs.read_moving(path)
        except LumigraphError:
            continue


def test_a_page_plays_what_we_render(made, tmp_path, window):
    moving_page(tmp_path / "page.html", made, OPENING)
    opened = window(tmp_path / "page.html")
    camera, pictures = some_camera(), []
    opened.page.add_style_tag(content="#clock { display: none !important }")
    for time in (0.0, 1.3, 2.6):
        opened.page.evaluate("(time) => lumigraph.seek(time)", time)
        pictures.append(opened.look(camera))
        ours = render(made.at(time), camera, OPENING.background, OPENING.near).rgb.clamp(0, 1).numpy()
        assert apart(pictures[-1], ours) > 38
    assert apart(pictures[0], pictures[1]) < 25 and apart(pictures[1], pictures[2]) < 25
    opened.page.evaluate("document.getElementById('moment').value = 0.5; document.getElementById('moment').oninput()")
    ours = render(made.at(1.5), camera, OPENING.background, OPENING.near).rgb.clamp(0, 1).numpy()
    assert apart(opened.look(camera), ours) > 38
    opened.page.evaluate("document.getElementById('play').click()")
    for _ in range(100):
        opened.page.wait_for_timeout(50)
        if abs(float(opened.page.evaluate("document.getElementById('moment').value")) - 0.5) > 0.02:
            break
    else:
        pytest.fail("the clock does not go on")
    assert opened.page.get_attribute("#play", "aria-label") == "Pause"
    opened.page.evaluate("document.getElementById('play').click()")


def test_a_file_opens_plays_and_is_filtered(made, tmp_path):
    fourdgs.write_moving(tmp_path / "a.4dgs", made)
    opened = open_any(tmp_path / "a.4dgs")
    method = opened.method()
    assert isinstance(method, PlayedCloud) and opened.frame.times == (0.0, 3.0)
    camera = opened.cameras()["train"][0].resized(0.1)
    begin, end = (method.given(time=t).render(camera).rgb for t in (0.0, 3.0))
    assert not torch.allclose(begin, end)
    late = replace(camera, time=torch.tensor([3.0]))
    assert torch.equal(method.render(late).rgb, end)
    every = FilteredCloud(method, torch.ones(60, dtype=torch.bool))
    assert torch.equal(every.render(late).rgb, end) and torch.equal(every.given(time=3).render(camera).rgb, end)
    few = FilteredCloud(method, torch.arange(60) < 30)
    assert not torch.allclose(few.render(late).rgb, end)
    with pytest.raises(LumigraphError, match="does not learn"):
        method.batch(None, torch.Generator())


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> str:
    """A run of deformable splatting whose Gaussians move at random."""
    method, made = moving(), tiny.scene()
    method.cloud.opacities.data.fill_(1.0)
    folder = tmp_path_factory.mktemp("moving") / "run"
    run = Run.create(folder, method, replace(made, frame=method.frame))
    run.save(State(), method, method.optimizers(), torch.Generator())
    return str(folder)


def test_every_export_takes_one_moment_or_all(run, tmp_path, capsys):
    moved, early, late = (tmp_path / name for name in ("all.4dgs", "early.spz", "late.spz"))
    assert main(["export", "splats", run, str(moved), "--duration", "2"]) == 0
    assert "spans" in capsys.readouterr().out
    for path, time in ((early, "1.2"), (late, "2.6")):
        assert main(["export", "splats", run, str(path), "--set", f"time={time}"]) == 0
    back, one, two = fourdgs.read_moving(moved), read_gaussians(early), read_gaussians(late)
    assert back.duration == 2 and len(back.at(0.2)) == len(one) == len(two)
    camera = some_camera()
    for cloud, time in ((one, 0.2), (two, 1.6)):
        assert psnr(render(back.at(time), camera, BLACK).rgb, render(cloud, camera, BLACK).rgb) > 30
    assert main(["export", "splats", run, str(moved), "--set", "time=2"]) == 2
    assert "every moment" in capsys.readouterr().err
    assert main(["export", "splats", run, str(early), "--set", "time=7"]) == 2
    assert "give a number from 1 to 3" in capsys.readouterr().err
    assert main(["export", "splats", str(moved), str(tmp_path / "part.4dgs"), "--sphere", "0", "0", "0", "0.4"]) == 0
    assert 0 < len(fourdgs.read_moving(tmp_path / "part.4dgs")) < len(back)
    assert main(["export", "web", run, str(tmp_path / "page.html")]) == 0
    assert "spans" in capsys.readouterr().out
    assert main(["export", "web", run, str(tmp_path / "still.html"), "--set", "time=2"]) == 0
    assert "spans" not in capsys.readouterr().out


def test_films_of_a_part_still_move(run, tmp_path):
    opened = open_any(run)
    for words in ([], ["--strength", "0.1"]):
        part = Keeping(box=(-0.5,) * 3 + (0.5,) * 3, strength=0.1 if words else None)
        method = Loaded.of(opened, "cpu", part=part).kept_method()
        camera = opened.cameras()["train"][0].resized(0.5)
        begin, end = (method.given(time=t).render(camera).rgb for t in (1.0, 3.0))
        assert not torch.allclose(begin, end)
    film = ["render", run, "--animate", "time=1:3", "--frames", "2", "--size", "32"]
    assert main([*film, "--output", str(tmp_path / "a.gif")]) == 0


def test_meshes_of_moments(run, tmp_path, monkeypatch):
    words = ["export", "mesh", run, str(tmp_path / "m.ply"), "--size", "40", "--views", "6", "--cell-size", "0.1"]
    assert main([*words, "--moments", "2"]) == 0
    assert sorted(x.name for x in tmp_path.glob("*.ply")) == ["m-000.ply", "m-001.ply"]
    assert (tmp_path / "m-000.ply").read_bytes() != (tmp_path / "m-001.ply").read_bytes()
    assert main([*words, "--set", "time=1"]) == 0
    assert (tmp_path / "m.ply").read_bytes() == (tmp_path / "m-000.ply").read_bytes()
    monkeypatch.setattr("lumigraph.export.collision.convex_pieces", lambda *_: {})
    assert main(["export", "collision", run, str(tmp_path / "m.glb"), *words[4:], "--moments", "2"]) == 0
    assert sorted(x.name for x in tmp_path.glob("*.glb")) == ["m-000.glb", "m-001.glb"]


def test_clean_compress_and_compose_keep_the_motion(run, tmp_path):
    cleaned, smaller, both = (str(tmp_path / name) for name in ("cleaned", "small", "both.json"))
    assert main(["clean", run, "--output", cleaned, "--strength", "0.2"]) == 0
    assert main(["compose", run, cleaned, "--output", both]) == 0
    assert main(["compress", run, "--output", smaller, "--steps", "2", "--views", "2"]) == 0
    camera = open_any(run).cameras()["train"][0].resized(0.5)
    for path in (cleaned, smaller, both):
        opened = open_any(path)
        method = opened.method()
        begin, end = (method.given(time=t).render(camera).rgb for t in (1.0, 3.0))
        assert psnr(begin, end) < 35
        assert torch.equal(method.render(replace(camera, time=torch.tensor([3.0]))).rgb, end)


def test_a_cloud_that_stands_still_is_one_span_each(tmp_path, made):
    still = MovingGaussians.still(turning(0.0), 3.0)
    fourdgs.write_moving(tmp_path / "a.4dgs", still)
    found = fourdgs.read_moving(tmp_path / "a.4dgs")
    assert found.moving == 0 and len(found) == 60 and found.duration == 3
    for time in (0.0, 1.4, 2.9):
        now, places = found.at(time).means, turning(0.0).means
        assert (now[:, None] - places).norm(dim=-1).amin(1).max() < 0.005
    write_gaussians(tmp_path / "a.ply", turning(0.0))
    assert main(["export", "splats", str(tmp_path / "a.ply"), str(tmp_path / "b.4dgs")]) == 0
    assert len(fourdgs.read_moving(tmp_path / "b.4dgs")) == 60
