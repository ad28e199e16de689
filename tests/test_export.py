"""Camera paths, films, pictures and the report."""

from __future__ import annotations

import html.parser
import json
import math
import re
from dataclasses import replace

import av
import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from listing import names
from PIL import Image, ImageSequence

from lumigraph.camera import Camera
from lumigraph.camera.lens import Equirectangular, Pinhole
from lumigraph.commands.cli import main
from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.report import write_report
from lumigraph.evaluation.views import evaluate
from lumigraph.export.film import film
from lumigraph.export.options import FilmOptions
from lumigraph.export.video import open_video
from lumigraph.figures import EMPTY_COLOUR, RAMP, colour_depth, colour_error, depth_range, hex_colour, save_picture
from lumigraph.geometry import look_at, unit
from lumigraph.paths import (
    PATHS,
    Surroundings,
    angle_of_view,
    camera_path,
    film_size,
    fitting,
)
from lumigraph.paths.keyframes import CameraPath, Keyframe
from lumigraph.paths.opening import pivot
from lumigraph.run.settings import Source

pytestmark = budget("exports")


def cameras(positions, targets) -> Camera:
    """Upright cameras of 40 x 30 pixels."""
    positions, targets = torch.as_tensor(positions).double(), torch.as_tensor(targets).double()
    pose = look_at(positions, targets - positions, torch.tensor([0.0, 0.0, 1.0]).double()).float()
    count = len(pose)
    lens = Pinhole(torch.full((count, 2), 40.0), torch.tensor([[20.0, 15.0]]).expand(count, 2))
    return Camera(pose, lens, torch.tensor([[40, 30]]).expand(count, 2))


def ring(degrees: float = 360.0, count: int = 24, height: float = 1.0, radius: float = 3.0) -> Camera:
    angle = torch.linspace(-0.5, 0.5, count + 1)[:-1] * math.radians(degrees)
    positions = torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full_like(angle, height)], -1)
    return cameras(positions, torch.zeros(count, 3))


FRAME = Frame()


@pytest.mark.parametrize("kind", PATHS)
@pytest.mark.parametrize("around", [ring(), ring(90), ring(20, 7)], ids=["ring", "arc", "front"])
def test_paths_are_smooth_and_upright_and_see_the_middle(kind, around):
    path = camera_path(kind, around, FRAME, 60, (64, 48))
    assert len(path) == 60 and path.size.unique(dim=0).tolist() == [[64, 48]]
    rotation = path.pose[:, :, :3].double()
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(60, 3, 3), atol=1e-5, rtol=0)
    assert (torch.linalg.det(rotation) > 0.99).all() and (path.pose[:, 2, 1] < 0).all()  # its down is not up
    step = path.position.diff(dim=0).norm(dim=-1)
    assert step.max() < 3.5 * step.median() + 1e-3
    pixels, seen = path.project(torch.zeros(60, 3), torch.arange(60))
    assert seen.all() and (pixels > 8).all() and (pixels < torch.tensor([56, 40])).all()


def test_an_orbit_keeps_the_cameras_height_and_distance_and_closes():
    path = camera_path("orbit", ring(), FRAME, 36, (64, 48))
    distance = path.position.norm(dim=-1)
    assert (distance - math.sqrt(10)).abs().max() < 0.02 and (path.position[:, 2] - 1).abs().max() < 0.02
    step = (path.position - path.position.roll(1, 0)).norm(dim=-1)  # the last beside the first
    assert step.max() < 1.05 * step.min()
    turned = torch.atan2(path.position[:, 1], path.position[:, 0]).sort().values.diff()
    assert turned.max() < 2 * math.pi / 36 * 1.05  # all the way round


def test_an_orbit_stays_where_photographs_were_taken():
    path = camera_path("orbit", ring(100), FRAME, 36, (64, 48))
    azimuth = torch.atan2(path.position[:, 1], path.position[:, 0]).rad2deg()
    assert azimuth.abs().max() < 50 and azimuth.max() > 30 and azimuth.min() < -30
    assert (path.position[0] - path.position[-1]).norm() < 0.6  # and comes back


def test_cameras_that_look_outward_give_a_turn_on_the_spot():
    angle = torch.arange(16) * (2 * math.pi / 16)
    out = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    path = camera_path("orbit", cameras(0.2 * out, 5 * out), FRAME, 30, (64, 48))
    assert path.position.norm(dim=-1).max() < 0.21
    seen = torch.atan2(path.forward[:, 1], path.forward[:, 0]).sort().values
    assert seen.diff().max() < 0.25 and path.forward[:, 2].abs().max() < 0.05


def test_an_orbit_goes_around_what_half_of_the_photographs_look_at():
    """Somebody walked around a fountain and photographed it and the houses around: nobody stood in the fountain."""
    inward, place = ring(), ring().position
    around = Camera.cat([inward, cameras(1.1 * place, 2 * place)])
    path = camera_path("orbit", around, FRAME, 36, (64, 48))
    assert (path.position.norm(dim=-1) - math.sqrt(10)).abs().max() < 0.05
    pixels, seen = path.project(torch.zeros(36, 3), torch.arange(36))
    assert seen.all() and (pixels - torch.tensor([32.0, 24.0])).abs().max() < 3


def test_cameras_that_look_outward_turn_where_one_of_them_stood():
    angle = torch.arange(16) * (2 * math.pi / 16)
    out = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    path = camera_path("orbit", cameras(0.2 * out, 5 * out), FRAME, 6, (64, 48))
    assert torch.cdist(path.position, 0.2 * out).min(-1).values.max() < 1e-5  # the middle may be a pillar


def test_a_camera_turns_about_what_the_photographs_look_at():
    around = Surroundings(ring(), FRAME)
    for i, eye in enumerate(around.position):
        assert pivot(around, eye, around.forward[i]).norm() < 0.05
    aside = unit(torch.tensor([[0.3, 0.2, -0.4]]).double() - around.position[0])[0]  # past it, so not exactly
    point = pivot(around, around.position[0], aside)
    assert (point - around.position[0]) @ aside > 2.9 and (point @ aside).abs() < 0.05  # where the axis is nearest
    back = pivot(around, around.position[0], -around.forward[0])
    assert 0.2 < (back - around.position[0]).norm() < 0.4  # ahead of it, not in its lens


def test_a_sweep_stays_among_cameras_that_look_the_same_way():
    """A drone's photographs, straight down and a little askew: an orbit about them would turn on the spot."""
    x, y = torch.meshgrid(torch.linspace(-2, 2, 5), torch.linspace(-1, 1, 4), indexing="ij")
    place = torch.stack([x, y, 3 + 0.1 * x], -1).view(-1, 3)
    askew = torch.stack([0.1 * y, 0.1 * x, 0 * x], -1).view(-1, 3)
    drone = cameras(place, place * torch.tensor([1.0, 1.0, 0.0]) + askew)
    assert fitting(drone, FRAME) == "sweep" and fitting(ring(), FRAME) == "orbit"
    path = camera_path("sweep", drone, FRAME, 36, (64, 48))
    across = path.position.abs()
    assert across[:, 0].max() < 2 and across[:, 0].max() > 0.6 and across[:, 1].max() < 1
    assert (path.position[:, 2] - 3).abs().max() < 0.2 and path.forward[:, 2].max() < -0.99
    up = -path.pose[:, :, 1]
    assert (up[1:] * up[:-1]).sum(-1).min() > 0.99 and (up[0] * up[-1]).sum() > 0.99  # it does not turn
    assert (path.position - path.position.roll(1, 0)).norm(dim=-1).max() < 0.4  # and closes


def test_a_far_stray_camera_does_not_pull_the_orbit():
    stray = cameras([[-30.0, 0.0, 1.0]], [[0.0, 0.0, 0.0]])
    path = camera_path("orbit", Camera.cat([ring(), stray]), FRAME, 36, (64, 48))
    assert path.position.norm(dim=-1).max() < 3.6


def test_interpolation_begins_and_ends_at_photographs_and_passes_close_to_those_between():
    around = ring(200, 9)
    path = camera_path("interpolate", around, FRAME, 400, (64, 48))
    torch.testing.assert_close(path.pose[0], around.pose[0], atol=1e-4, rtol=0)
    torch.testing.assert_close(path.pose[-1], around.pose[-1], atol=1e-4, rtol=0)
    assert torch.cdist(around.position, path.position).min(-1).values.max() < 0.02


def test_interpolation_orders_scattered_photographs_into_a_walk():
    order = torch.randperm(24, generator=torch.Generator().manual_seed(3))
    path = camera_path("interpolate", ring()[order], FRAME, 144, (64, 48))
    length = path.position.diff(dim=0).norm(dim=-1).sum()
    assert length < 1.1 * 2 * math.pi * 3 and path.position.norm(dim=-1).min() > 2.8


def test_few_cameras_are_enough():
    for count in (1, 2):
        for kind in PATHS:
            path = camera_path(kind, ring(30, count), FRAME, 5, (64, 48))
            assert path.pose.isfinite().all() and len(path) == 5


def test_the_angle_of_view_is_the_photographs_own():
    assert angle_of_view(ring()) == pytest.approx(2 * math.atan(15 / 40), abs=1e-4)
    sphere = Camera(ring().pose, Equirectangular(torch.tensor([[80.0, 40.0]]).expand(24, 2)), ring().size)
    assert angle_of_view(sphere) <= math.radians(75.1)


def test_films_have_the_photographs_shape_and_even_sides():
    assert film_size(ring(), 40) == (40, 30) and film_size(ring(), 480) == (480, 360)
    assert film_size(ring(), 21) == (20, 16)
    with pytest.raises(LumigraphError, match="cannot have 0 frames"):
        camera_path("orbit", ring(), FRAME, 0, (64, 48))


def test_the_middle_is_found_from_optical_axes():
    target = torch.tensor([0.3, -0.2, 0.1])
    positions = ring().position
    found = Surroundings(cameras(positions, target.expand(24, 3)), FRAME).focus
    assert (found - target).norm() < 0.05


def frames_of(path) -> list[torch.Tensor]:
    with av.open(str(path)) as container:
        return [torch.from_numpy(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]


def test_a_video_holds_its_frames_in_their_colours(tmp_path):
    colours = torch.tensor([[200, 30, 40], [30, 180, 60], [250, 250, 250], [8, 8, 8], [40, 60, 220]])
    with open_video(tmp_path / "a.mp4", fps=12) as video:
        for colour in colours:
            video.add(colour.byte().expand(33, 47, 3))  # odd on purpose
    frames = frames_of(tmp_path / "a.mp4")
    assert len(frames) == 5 and frames[0].shape == (34, 48, 3)
    for frame, colour in zip(frames, colours, strict=True):
        assert (frame.float().mean((0, 1)) - colour).abs().max() < 5
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate or 0) == 12


@pytest.mark.parametrize(("absent", "coding"), [(["libx264"], "vp9"), (["libx264", "libvpx-vp9"], "mpeg4")])
def test_without_h264_a_film_says_what_it_holds(tmp_path, monkeypatch, absent, coding):
    """PyAV's wheel brings the encoder, which is under the GPL; other builds may have none."""
    monkeypatch.setattr("lumigraph.export.video.has_encoder", lambda name: name not in absent)
    given = moving_ramp(5)
    said = pytest.warns(LumigraphWarning, match=r"no H\.264 here, so .*a\.mp4 holds")
    with said, open_video(tmp_path / "a.mp4") as video:
        for frame in given:
            video.add(frame)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].codec_context.name == coding
    for frame, found in zip(given, frames_of(tmp_path / "a.mp4"), strict=True):
        assert (frame.float() - found.float()).abs().mean() < 6


def moving_ramp(count: int) -> list[torch.Tensor]:
    """A colour ramp that drifts over a grey one that stays, so that both motion and stillness show."""
    x = torch.linspace(0, 1, 90)
    frames = []
    for i in range(count):
        moving = torch.stack([x, (x + 0.05 * i) % 1, 1 - x], -1).expand(40, 90, 3)
        frames.append((torch.cat([moving, (0.2 + 0.5 * x)[None, :, None].expand(40, 90, 3)]) * 255).byte())
    return frames


def pictures_of(path) -> list[np.ndarray]:
    with Image.open(path) as image:
        return [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(image)]


@pytest.mark.parametrize(("ending", "error"), [("gif", 12), ("webp", 5)])
def test_moving_pictures_hold_their_frames_and_last_as_long(ending, error, tmp_path):
    given = moving_ramp(9)
    with open_video(tmp_path / f"a.{ending}", fps=30) as video:
        for frame in given:
            video.add(frame)
    with Image.open(tmp_path / f"a.{ending}") as image:
        assert image.n_frames == 9 and image.size == (90, 80)
        assert image.info["loop"] == 0  # for ever
        times = []
        for i in range(9):
            image.seek(i)
            image.load()
            times.append(image.info["duration"])
    assert sum(times) == pytest.approx(300, abs=10) and max(times) <= 40
    for a, b in zip(pictures_of(tmp_path / f"a.{ending}"), given, strict=True):
        blurred = (a - b.numpy()).reshape(10, 8, 15, 6, 3).mean((1, 3))  # what dithering keeps
        assert np.abs(a - b.numpy()).mean() < error and np.abs(blurred).mean() < 3
    assert names(tmp_path) == [f"a.{ending}"]


def test_a_gifs_dithering_stands_still_and_spends_one_palette(tmp_path):
    with open_video(tmp_path / "a.gif", fps=20) as video:
        for frame in moving_ramp(6):
            video.add(frame)
    frames = pictures_of(tmp_path / "a.gif")
    for frame in frames[1:]:
        assert np.array_equal(frame[41:], frames[0][41:])
    shades = np.unique(np.concatenate(frames).reshape(-1, 3), axis=0)
    assert 100 < len(shades) <= 255
    steps = np.abs(np.diff(frames[0][60:].mean((0, 2)).reshape(15, 6).mean(1)))
    assert steps.max() < 20  # dithered: eyes see a ramp, not bands


def test_films_that_cannot_be(tmp_path):
    with (
        pytest.raises(LumigraphError, match=r"a\.avi should end in \.mp4, \.gif, \.webp"),
        open_video(tmp_path / "a.avi"),
    ):
        pass
    with pytest.raises(LumigraphError, match="60 frames per second"), open_video(tmp_path / "a.gif", fps=60):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ["mp4", "gif", "webp"])
def test_a_video_appears_whole_or_not_at_all(ending, tmp_path):
    path, frame = tmp_path / f"a.{ending}", torch.zeros(32, 32, 3, dtype=torch.uint8)
    with pytest.raises(RuntimeError), open_video(path) as video:
        video.add(frame)
        raise RuntimeError
    with pytest.raises(LumigraphError, match="several sizes"), open_video(path) as video:
        video.add(frame)
        video.add(frame[:16])
    with pytest.raises(LumigraphError, match="no frame"), open_video(path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_depth_is_coloured_from_near_to_far():
    depth = torch.tensor([[1.0, 10.0, 100.0, torch.inf, 5.0]])
    opacity = torch.tensor([[1.0, 1.0, 1.0, 0.0, 0.0]])
    rgb = colour_depth(depth, opacity, (1.0, 100.0))
    light = rgb.mean(-1)[0]
    assert light[0] > light[1] > light[2] and rgb.isfinite().all()
    for pixel, colour in ((0, RAMP[0]), (2, RAMP[-1]), (3, EMPTY_COLOUR), (4, EMPTY_COLOUR)):
        torch.testing.assert_close(rgb[0, pixel], hex_colour(colour), atol=1e-5, rtol=0)
    near, far = depth_range(torch.linspace(2, 4, 1001), torch.ones(1001))
    assert near == pytest.approx(2.04, abs=1e-3) and far == pytest.approx(3.96, abs=1e-3)
    assert depth_range(torch.full((4,), torch.inf), torch.zeros(4)) == (1.0, 2.0)


def test_errors_are_coloured_from_dark_to_bright():
    a = torch.zeros(1, 3, 3)
    b = torch.tensor([0.0, 0.1, 0.2])[None, :, None].expand(1, 3, 3)
    light = colour_error(a, b).mean(-1)[0]
    assert light[0] < light[1] < light[2]


def test_a_film_of_a_method(ball_run, tmp_path):
    method = ball_run.method()
    path = camera_path("orbit", ball_run.cameras()["train"], ball_run.frame, 7, (26, 24))
    about = film(method, path, tmp_path / "out" / "orbit.mp4", FilmOptions(fps=10, depth=True, pictures="png"))
    out = tmp_path / "out"
    assert names(out) == ["orbit", "orbit-depth.mp4", "orbit.json", "orbit.mp4"]
    assert len(frames_of(out / "orbit.mp4")) == len(frames_of(out / "orbit-depth.mp4")) == 7
    assert len(list((out / "orbit").glob("????.png"))) == len(list((out / "orbit").glob("????-depth.png"))) == 7
    seen = method.render(path[3]).rgb.clamp(0, 1)
    kept = torch.from_numpy(np.array(Image.open(out / "orbit" / "0003.png"))) / 255
    assert kept.shape == (24, 26, 3) and (kept - seen).abs().max() < 0.01
    assert json.loads((out / "orbit.json").read_text())["frames"] == 7 == about["frames"]
    film(method, path[:2], out / "orbit.mp4", FilmOptions(depth=True, pictures="png"))  # again: replaced, not mixed
    assert len(frames_of(out / "orbit.mp4")) == 2 and len(names(out / "orbit")) == 4


def test_a_film_as_a_moving_picture_has_a_twin_of_depth(ball_run, tmp_path):
    path = camera_path("orbit", ball_run.cameras()["train"], ball_run.frame, 3, (26, 24))
    film(ball_run.method(), path, tmp_path / "orbit.webp", FilmOptions(fps=10, depth=True))
    assert names(tmp_path) == ["orbit-depth.webp", "orbit.json", "orbit.webp"]
    assert len(pictures_of(tmp_path / "orbit.webp")) == len(pictures_of(tmp_path / "orbit-depth.webp")) == 3


def test_a_film_along_keyframes(ball_run, tmp_path, capsys):
    """The command, on a path saved by hand and on what lies beside another film."""
    poses = ball_run.cameras()["train"].pose[:2].tolist()  # this capture's frame is its source's
    keys = [Keyframe(tuple(map(tuple, pose)), 40.0, 0.2 * i) for i, pose in enumerate(poses)]
    CameraPath(tuple(keys), fps=20).save(tmp_path / "walk.json")
    command = ["render", str(ball_run.folder), "--size", "24", "--device", "cpu"]
    assert main([*command, "--path", str(tmp_path / "walk.json"), "--output", str(tmp_path / "film.gif")]) == 0
    about = json.loads((tmp_path / "film.json").read_text())
    assert (about["frames"], about["fps"], about["size"]) == (5, 20, [24, 24])
    torch.testing.assert_close(torch.tensor(about["poses"])[[0, 4]], torch.tensor(poses), atol=1e-5, rtol=0)
    again = [*command, "--path", str(tmp_path / "film.json"), "--frames", "3"]
    assert main([*again, "--output", str(tmp_path / "second.webp")]) == 0
    second = json.loads((tmp_path / "second.json").read_text())
    torch.testing.assert_close(torch.tensor(second["poses"])[[0, 2]], torch.tensor(poses), atol=1e-5, rtol=0)
    before = (tmp_path / "walk.json").read_bytes()
    capsys.readouterr()
    (tmp_path / "nonsense.json").write_text('{"format": "lumigraph camera path 1", "keyframes": [1]}')
    for name, output, words in (
        ("walk.json", "walk.mp4", "would be replaced"),
        ("nonsense.json", "a.mp4", r"nonsense.json does not hold"),
        ("none.json", "a.mp4", "does not exist"),
        ("obrit", "a.mp4", "does not exist|There is no path called"),
    ):
        assert main([*command, "--path", str(tmp_path / name), "--output", str(tmp_path / output)]) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and re.search(words, lines[0])
    assert (tmp_path / "walk.json").read_bytes() == before and not (tmp_path / "a.mp4").exists()
    assert main([*command, "--path", "obrit"]) == 2 and "orbit, sweep, spiral" in capsys.readouterr().err


def test_a_broken_film_leaves_nothing(ball_run, tmp_path, monkeypatch):
    method = ball_run.method()
    path = camera_path("orbit", ball_run.cameras()["train"], ball_run.frame, 40, (26, 24))
    render, count = type(method).render, [0]

    def fail(self, camera):
        count[0] += 1
        if count[0] == 20:
            raise KeyboardInterrupt
        return render(self, camera)

    monkeypatch.setattr(type(method), "render", fail)
    with pytest.raises(KeyboardInterrupt):
        film(method, path, tmp_path / "orbit.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_contact_sheet_shows_every_view_and_the_worst(ball_run):
    evaluation = evaluate(ball_run.method(), tiny.scene())
    worst = min(evaluation.views, key=lambda view: view.psnr).name
    assert worst in evaluation.shown and len(evaluation.shown) == 3
    sheet = evaluation.contact_sheet("ball")
    assert sheet.width > 4 * 100 and sheet.height > 3 * 24
    result = evaluation.to_json()
    assert result["psnr"] == pytest.approx(sum(view["psnr"] for view in result["views"]) / 3)
    assert result["protocol"]["resolution"] == "24x24" and result["protocol"]["background"] == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(("views", "expected"), [(1, [0]), (2, [0, 8]), (3, [0, 4, 8]), (9, [0, 4, 8])])
def test_some_views_are_compared_alone(ball_run, views, expected):
    result = evaluate(ball_run.method(), tiny.scene(), EvaluationOptions(views=views)).to_json()
    assert [view["name"] for view in result["views"]] == [f"ball_{i}" for i in expected]
    assert (result["protocol"]["views"], result["protocol"]["of"]) == (len(expected), 3)


def test_evaluation_names_the_splits_there_are(ball_run):
    with pytest.raises(LumigraphError, match=r"no views in the split 'val'; choose one of: train \(9 views\), test"):
        evaluate(ball_run.method(), tiny.scene(), EvaluationOptions("val"))


class Page(html.parser.HTMLParser):
    """What a page is made of and what it would load."""

    def __init__(self):
        super().__init__()
        self.tags: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.loads += [value for name, value in attributes if name in ("src", "href", "data", "poster")]


def test_the_report_is_one_file_that_loads_nothing(ball_run):
    path = camera_path("orbit", ball_run.cameras()["train"], ball_run.frame, 6, (24, 24))
    film(ball_run.method(), path, ball_run.folder / "renders" / "orbit.mp4", FilmOptions(depth=True))
    evaluation = evaluate(ball_run.method(), tiny.scene())
    result = evaluation.to_json() | {"evaluated_on": "cpu", "steps": 3}
    (ball_run.folder / "eval.json").write_text(json.dumps(result))
    save_picture(ball_run.folder / "eval.png", evaluation.contact_sheet("ball"))
    text = write_report(ball_run).read_text()
    page = Page()
    page.feed(text)
    assert page.loads and all(x.startswith("data:") for x in page.loads)
    assert "@import" not in text and "url(" not in text and "<script" not in text
    assert page.tags.count("video") == 2 and page.tags.count("svg") >= 4 and "img" in page.tags
    for words in (
        f"{evaluation.psnr:.2f}",
        "voxel-grid",
        "learning rate",
        "Wang 2004",
        "ball_8",
        "prefers-color-scheme",
    ):
        assert words in text, words


def test_a_report_of_a_bare_run_and_of_odd_names(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    run.settings = replace(run.settings, scene=Source("/photos/<b>me & you</b>"))
    text = write_report(run).read_text()
    assert "<b>me" not in text and "&lt;b&gt;me &amp; you&lt;" in text
