"""The viewer without a browser: its parts, and what raw connections are sent."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import threading
import time
import urllib.request
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from balls import RED, Splatted
from budgets import budget
from torch import nn
from viewer_client import Client
from waiting import until

import lumigraph.methods
import lumigraph.viewer.viewer as viewer_module
from lumigraph.camera.crop import CropBox
from lumigraph.camera.rays import Rendering
from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.figures import EMPTY_COLOUR, RAMP, hex_colour
from lumigraph.files.ranges import changed
from lumigraph.gaussians import Gaussians, splatting
from lumigraph.gaussians.cloud import cleaned
from lumigraph.method import Method, RayMethod
from lumigraph.paths.opening import opening_of_scene
from lumigraph.run import Run
from lumigraph.training import fit
from lumigraph.viewer import Subject, Viewer, choose_address
from lumigraph.viewer.cameras import ViewRequest, angle_for, angles, pose_of, rows, upwards
from lumigraph.viewer.modes import PALETTE, along_axis, extra_modes, normals, picture
from lumigraph.viewer.painter import FRAME_SECONDS, MOVING_SECONDS, MovingPace, Pace, Painter
from lumigraph.viewer.shared import render_inside
from lumigraph.viewer.turns import RENDER_SHARE, NotWantedError, Turns
from lumigraph.viewer.visitor import UNIT_SCALE, splats

WHITE = (1.0, 1.0, 1.0)
# A client may leave at any moment; viser warns of what was still on its way.
pytestmark = [budget("exports", 10), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]


@pytest.fixture(scope="module")
def learnt(ball_run):
    """The tiny scene, and a method that has learnt it."""
    return tiny.scene(), ball_run.method()


def subject(scene, folder, **changes) -> Subject:
    cameras = {name: scene.cameras[index] for name, index in scene.splits.items()}
    return replace(Subject("ball", scene.frame, cameras, folder / "paths", "lumigraph render RUN"), **changes)


def request_of(camera, canvas) -> ViewRequest:
    pose = tuple(tuple(row) for row in camera.pose[0].tolist())
    return ViewRequest(pose, angles(camera)[1], canvas, 1024, "colour", WHITE)


# Cameras


def test_a_browsers_camera_is_the_scenes(learnt):
    """Quaternion and angle of view as a browser has them give the rays of the photograph's own camera."""
    scene, _ = learnt
    camera = scene.cameras[2]
    rotation = camera.pose[0, :, :3].double()
    from viser.transforms import SO3

    pose = pose_of(SO3.from_matrix(rotation.numpy()).wxyz, camera.position[0].numpy())
    seen = ViewRequest(pose, angles(camera)[1], (240, 240), 1024, "colour", WHITE).camera((24, 24))
    a, b = (c.rays(camera.pixels()) for c in (seen, camera))
    assert torch.allclose(a.directions, b.directions, atol=1e-5)
    assert torch.allclose(a.origins, b.origins, atol=1e-5)


def test_bands_make_the_whole_picture(learnt):
    scene, method = learnt
    camera = request_of(scene.cameras[0], (40, 30)).camera((40, 30))
    whole = method.render(camera)
    parts = [method.render(rows(camera, a, b)) for a, b in ((0, 7), (7, 23), (23, 30))]
    assert torch.allclose(Rendering.cat(parts).rgb, whole.rgb, atol=1e-5)


def test_the_window_holds_the_photograph(learnt):
    camera = learnt[0].cameras[0]
    own = 2 * math.atan(tiny.SIZE / 2 / tiny.FOCAL)
    assert angle_for(camera, 2.0) == pytest.approx(own, abs=1e-4)
    assert math.tan(angle_for(camera, 0.5) / 2) == pytest.approx(2 * math.tan(own / 2), abs=1e-4)


def test_up_keeps_the_roll():
    """What the browser makes of a place, a goal and `up` is the pose itself, its roll included."""
    generator = np.random.default_rng(0)
    for _ in range(20):
        rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        up = upwards(np.concatenate([rotation, np.zeros((3, 1))], 1))
        right = np.cross(rotation[:, 2], up)
        assert np.allclose(right / np.linalg.norm(right), rotation[:, 0], atol=1e-6)


# The opening and its limits


def test_a_page_and_the_viewer_begin_and_end_alike(learnt, tmp_path):
    """A client that goes too far comes back, is not held where it does not want to be, and finds home."""
    scene, method = learnt
    about = subject(scene, tmp_path)
    opening = about.opening
    assert opening == opening_of_scene("ball", about.cameras["train"], scene.frame)
    with Viewer(method, about, choose_address(port=0)) as viewer:
        first = viewer._server.initial_camera
        assert np.allclose(first.position, opening.position) and np.allclose(first.look_at, opening.target)
        assert first.fov == pytest.approx(math.radians(opening.angle))
        client = Client(viewer.address.url, opening.position)
        client.picture()
        (visitor,) = viewer._everyone()

        def away() -> float:
            return float(np.linalg.norm(np.array(visitor.request().pose)[:, 3]))

        client.look_from((20.0, 0.0, 0.5))
        until(lambda: away() == pytest.approx(opening.farthest, rel=1e-3))
        client.turn(visitor.controls._stays, False)
        client.look_from((21.0, 0.0, 0.5))
        time.sleep(0.5)
        assert away() > 20
        visitor._go_home()
        assert np.allclose(np.array(visitor.request().pose), opening.pose, atol=1e-5)
        client.close()


def test_limits_of_an_opening(learnt, tmp_path):
    opening = replace(subject(learnt[0], tmp_path).opening, floor=-0.5)
    target = np.array(opening.target)
    for position in (opening.position, 0.5 * np.array(opening.position)):  # as it is within them
        assert np.allclose(opening.limited(np.array(position), target), (position, target))
    for sideways in (0.0, 30.0):
        goal = target + np.array([0.0, sideways, 0.0])
        position, ahead = opening.limited(goal + np.array([0.1, 0.2, -9.0]), goal)
        offset = position - ahead
        assert ahead[1] <= max(1.0, target[1]) + 1e-9 and position[2] >= -0.5 - 1e-9
        assert np.linalg.norm(offset) == pytest.approx(min(opening.farthest, math.hypot(0.1, 0.2, 9.0)))
        assert math.degrees(math.acos(offset[2] / np.linalg.norm(offset))) <= opening.lowest + 1e-6
    outward = replace(opening, inward=False)
    assert np.array_equal(outward.limited(9 * target + 9, target)[0], 9 * target + 9)


def test_a_slow_browser_has_a_picture_from_the_beginning(tmp_path):
    """Behind splats there is our own rendering until the client moves, and a colour from then on."""
    kind = lumigraph.methods.find("gaussian-splatting")
    method = kind(tiny.scene().frame, changed(kind.Config(), sh_degree=0))
    method.cloud.replace(some_cloud(200, degree=0))
    about = subject(tiny.scene(), tmp_path)
    with Viewer(method.eval(), about, choose_address(port=0)) as viewer:
        client = Client(viewer.address.url, about.opening.position)
        still = client.picture(90, width=120)  # the renderer may have to be compiled
        (visitor,) = viewer._everyone()
        camera = visitor.request().camera((120, 90))
        assert np.abs(still / 255 - method.render(camera).rgb.clamp(0, 1).numpy()).mean() < 0.02
        until(visitor.painter.settled.is_set)
        assert visitor.controls.status.content == "200 Gaussians, drawn by the browser"
        client.look_from((0.5, 3.0, 0.5))
        assert client.picture(width=2).min() == 255
        client.look_from(about.opening.position)
        until(lambda: np.allclose(visitor.request().pose, about.opening.pose, atol=1e-3))
        until(visitor.painter.settled.is_set)
        assert visitor._flat == WHITE
        client.close()


# Modes


def test_normals_and_depth_of_a_plane(learnt):
    camera = learnt[0].cameras[1]
    position, forward = camera.position[0], camera.forward[0]
    normal = torch.nn.functional.normalize(-forward + 0.4 * camera.pose[0, :, 0], dim=0)
    rays = camera.rays(camera.pixels())
    distance = ((0 - position) @ normal) / (rays.directions @ normal)  # of the plane through the origin
    depth = distance.view(tiny.SIZE, tiny.SIZE)
    seen = Rendering(torch.zeros(tiny.SIZE, tiny.SIZE, 3), depth, torch.ones_like(depth))
    assert torch.allclose(normals(seen, camera), normal.expand(tiny.SIZE, tiny.SIZE, 3), atol=1e-3)
    along = ((rays.at(distance) - position) @ forward).view_as(depth)
    assert torch.allclose(along_axis(seen, camera), along, atol=1e-4)


def test_modes_differ_and_the_background_is_exchanged(learnt):
    scene, method = learnt
    camera = scene.cameras[0]
    seen = method.render(camera)
    shown = {mode: picture(seen, camera, mode, WHITE, WHITE) for mode in ("colour", "depth", "opacity", "normals")}
    for a, b in ((a, b) for a in shown for b in shown if a < b):
        assert (shown[a] - shown[b]).abs().mean() > 0.05
    black = tiny.method(replace(scene.frame, background=(0.0, 0.0, 0.0)))
    black.load_state_dict(method.state_dict())
    exchanged = picture(seen, camera, "colour", WHITE, (0.0, 0.0, 0.0))
    assert torch.allclose(exchanged, black.eval().render(camera).rgb, atol=1e-5)


class Labelled(Method):
    """A grey wall in every column but the first, with extras of many shapes."""

    def batch(self, scene, generator):
        raise NotImplementedError

    loss = optimizers = batch

    def render(self, camera):
        width, height = camera.size[0].tolist()
        right = (torch.arange(width) >= width // 2).expand(height, width)
        opacity = torch.ones(height, width)
        opacity[:, 0] = 0
        share = torch.linspace(0, 1, width).expand(height, width)
        return Rendering(
            torch.full((height, width, 3), 0.5),
            torch.where(opacity > 0, 2.0, torch.inf),
            opacity,
            {
                "heat": (100 * share - 30)[..., None],
                "tint": torch.stack([2 * share, share, -share], -1),
                "Labels": torch.where(right, 3, -1),
                "normals": torch.zeros(height, width, 3),
                "features": torch.zeros(height, width, 8),
                "bytes": torch.zeros(height, width, 3, dtype=torch.uint8),
            },
        )


def test_extras_are_modes_by_their_names(learnt):
    scene, _ = learnt
    camera = scene.cameras[0].resized(2)
    seen = Labelled(scene.frame, None).render(camera)
    assert extra_modes(seen) == ["heat", "tint", "Labels"]
    heat, tint, labels = (picture(seen, camera, mode, WHITE, WHITE) for mode in extra_modes(seen))
    nothing, dark, bright = (hex_colour(text) for text in (EMPTY_COLOUR, RAMP[-1], RAMP[0]))
    middle = seen.depth.shape[1] // 2
    assert torch.equal(heat[:, 0], nothing.expand_as(heat[:, 0]))  # the scene is not there
    assert torch.allclose(heat[0, 1], dark, atol=1e-6) and torch.allclose(heat[0, -1], bright, atol=1e-6)
    assert (heat[0, 1:].sum(-1).diff() > -1e-3).all() and heat[0, middle].sum() > dark.sum() + 0.3
    assert torch.equal(tint, seen.extra["tint"].clamp(0, 1))
    assert torch.equal(labels[0, middle], hex_colour(PALETTE[3]))
    assert torch.equal(labels[0, middle - 1], nothing)  # labels below zero are none
    odd = replace(seen, extra={"Labels": seen.extra["Labels"] + len(PALETTE)})
    assert torch.equal(picture(odd, camera, "Labels", WHITE, WHITE)[0, middle], hex_colour(PALETTE[3]))
    with pytest.raises(LumigraphError, match="gives no heat"):
        picture(odd, camera, "heat", WHITE, WHITE)


def test_extras_without_a_range(learnt):
    """One number everywhere, or none that is finite, still gives a picture."""
    scene, _ = learnt
    camera = scene.cameras[0]
    solid = torch.ones(tiny.SIZE, tiny.SIZE)
    for value, colour in ((4.0, RAMP[-1]), (math.nan, EMPTY_COLOUR), (math.inf, EMPTY_COLOUR)):
        seen = Rendering(torch.zeros(*solid.shape, 3), solid, solid, {"flat": value * solid})
        shown = picture(seen, camera, "flat", WHITE, WHITE)
        assert torch.allclose(shown, hex_colour(colour).expand_as(shown))


def test_extras_are_offered_once_a_rendering_has_them(learnt, tmp_path):
    scene, _ = learnt
    with Viewer(Labelled(scene.frame, None), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        client.picture(width=120)
        (visitor,) = viewer._everyone()
        dropdown = visitor.controls._mode
        assert dropdown.options == ("Colour", "Depth", "Opacity", "Normals", "heat", "tint", "Labels")
        assert visitor.request().mode == "colour"  # until another is chosen
        dropdown.value = "Labels"
        assert visitor.request().mode == "Labels"
        visitor.painter.request()
        label = 255 * hex_colour(PALETTE[3]).numpy()
        deadline = time.monotonic() + 20
        while np.abs(client.picture(width=120)[45, 90] - label).max() > 8:  # JPEG's loss
            assert time.monotonic() < deadline
        client.close()


# Crop


class Wall(Method):
    """A black wall at x = 0, seen by a method that is told nothing but the camera."""

    def batch(self, scene, generator):
        raise NotImplementedError

    loss = optimizers = batch

    def render(self, camera):
        rays = camera.rays(camera.pixels())
        width, height = camera.size[0].tolist()
        distance = -rays.origins[:, 0] / rays.directions[:, 0]
        depth = torch.where(distance > 0, distance, torch.inf)
        return Rendering(torch.zeros(len(rays), 3), depth, torch.ones(len(rays))).reshape(height, width)


class Walls(RayMethod):
    """A red wall at x = 0.4 and a blue one at x = -0.4; nothing nearer than the frame says is seen."""

    def __init__(self, frame):
        super().__init__(frame, None)
        self.places = nn.Parameter(torch.tensor([0.4, -0.4]))

    def batch(self, scene, generator):
        raise NotImplementedError

    loss = optimizers = batch

    def render_rays(self, rays, background):
        distance = (self.places - rays.origins[:, :1]) / rays.directions[:, :1]
        depth, which = torch.where(distance > self.frame.near, distance, torch.inf).min(-1)
        rgb = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])[which]
        return Rendering(rgb, depth, depth.isfinite().float())


def test_a_crop_begins_where_rays_enter_the_box(learnt):
    scene, _ = learnt
    camera = scene.cameras[0]  # on the side of positive x
    method = Walls(scene.frame)
    assert (method.render(camera).rgb[..., 0] == 1).all()
    seen = render_inside(method, camera, CropBox((-0.5, -1.0, -1.0), (0.0, 1.0, 1.0)))
    inside = seen.opacity == 1
    assert inside.sum() > 50
    assert (seen.rgb[inside] == torch.tensor([0.0, 0.0, 1.0])).all()
    assert (seen.rgb[~inside] == 1).all()  # the background
    x = camera.rays(camera.pixels()).at(seen.depth.reshape(-1).nan_to_num(0, 0))[:, 0].view_as(seen.depth)
    assert torch.allclose(x[inside], torch.tensor(-0.4), atol=1e-4)


def test_a_crop_keeps_extras_even_of_bands_beside_the_box(learnt):
    scene, _ = learnt
    camera = scene.cameras[0]

    class Numbered(Walls):
        def render_rays(self, rays, background):
            seen = super().render_rays(rays, background)
            return seen.with_extra(wall=1 + (seen.rgb[:, 2] > 0).long(), where=rays.origins)

    bands = [
        render_inside(Numbered(scene.frame), rows(camera, a, b), CropBox((-0.5, -1.0, -0.1), (0.0, 1.0, 0.1)))
        for a, b in ((0, 1), (1, tiny.SIZE))
    ]
    assert (bands[0].opacity == 0).all() and (bands[0].extra["wall"] == 0).all()
    seen = Rendering.cat(bands)
    inside = seen.opacity == 1
    assert 0 < inside.sum() < inside.numel()
    assert (seen.extra["wall"][inside] == 2).all() and (seen.extra["wall"][~inside] == 0).all()
    assert seen.extra["where"].shape == (tiny.SIZE, tiny.SIZE, 3) and (seen.extra["where"][~inside] == 0).all()


def test_a_crop_of_other_methods_goes_by_depth(learnt):
    scene, _ = learnt
    camera = scene.cameras[0]
    seen = render_inside(Wall(scene.frame, None), camera, CropBox((-0.1, -0.3, -1.0), (0.1, 0.3, 1.0)))
    y = camera.rays(camera.pixels()).at(seen.depth.reshape(-1).nan_to_num(0, 0))[:, 1].view_as(seen.depth)
    inside = seen.opacity == 1
    assert 0 < inside.sum() < inside.numel()
    assert y[inside].abs().max() < 0.31
    assert (seen.rgb[~inside] == 1).all() and seen.depth[~inside].isinf().all()


def test_a_crop_of_a_cloud_picks_centres():
    cloud = some_cloud(50)
    box = CropBox((-0.5, -1.0, -1.0), (0.5, 0.2, 1.0))
    kept = cleaned(cloud, box).means
    assert 0 < len(kept) < 50
    assert (kept[:, 0].abs() <= 0.5).all() and (kept[:, 1] <= 0.2).all()


# Splats


def some_cloud(count: int, degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.randn(*shape, generator=generator)

    means = 1.2 * torch.rand(count, 3, generator=generator) - 0.6
    harmonics = 0.5 * random(count, (degree + 1) ** 2, 3)
    return Gaussians(means, random(count, 4), math.log(0.12) + 0.3 * random(count, 3), random(count) + 1, harmonics)


def test_splats_have_the_clouds_shapes_and_colours():
    """One Gaussian drawn by our own renderer is as wide and as coloured as what the browser is told of it."""
    cloud = some_cloud(1)
    camera = tiny.scene().cameras[0].resized(8)
    lone = replace(cloud, means=cloud.means * 0, opacities=torch.tensor([20.0]), log_scales=cloud.log_scales - 1)
    told = splats(lone, camera.position[0])
    seen = splatting.render(lone, camera, (0.0, 0.0, 0.0))
    assert np.allclose(seen.rgb[96, 96].clamp(0, 1).numpy(), told.colours[0], atol=0.02)
    rotation = camera.pose[0, :, :3]
    across = rotation.T @ torch.tensor(told.covariances[0]) @ rotation / UNIT_SCALE**2
    focal = 8 * tiny.FOCAL / tiny.DISTANCE
    weight = seen.opacity / seen.opacity.sum()
    x = torch.arange(192) + 0.5 - 96
    assert float((weight.sum(0) * x * x).sum()) == pytest.approx(focal**2 * float(across[0, 0]), rel=0.05)
    assert float((weight.sum(1) * x * x).sum()) == pytest.approx(focal**2 * float(across[1, 1]), rel=0.05)


# Pace, turns, painter


def test_pace_learns_what_a_picture_costs():
    pace = Pace()
    assert max(pace.size((1600, 900), 0.1)) == 80
    for pixels in (10**6, 5_000, 40_000, 20_000, 300_000):  # the first is passed over
        pace.note(pixels, 9.0 if pixels == 10**6 else 0.02 + 1e-6 * pixels)
    assert pace.costs == pytest.approx((0.02, 1e-6), rel=1e-3)
    width, height = pace.size((1600, 900), 0.1)
    assert width * height == pytest.approx(80_000, rel=0.02)
    assert width / height == pytest.approx(16 / 9, rel=0.02)
    assert pace.size((160, 90), 0.1) == (160, 90)
    assert pace.size((480, 360), 0.1) == (480, 360)  # 0.19 s, less than two pictures take


@pytest.mark.parametrize(
    ("fixed", "a_pixel", "settled"),
    [
        (0.005, 1e-8, 1),  # all of it within FRAME_SECONDS
        (0.03, 1e-7, 2),  # half of it within MOVING_SECONDS
        (0.0, 1e-6, 3),  # rays: no fixed cost
        (0.0, 6e-6, 8),
        (0.2, 1e-7, 2),  # many Gaussians: a smaller picture would hardly be quicker
        (0.0, 1e-2, 8),  # nothing is quick enough
    ],
)
def test_the_size_of_moving_pictures_settles(fixed, a_pixel, settled):
    """It is never stuck at the first and smallest one, and changes at most now and then to try the next."""
    pace, full = MovingPace(), (800, 800)
    sizes = [pace.divisor(full)]
    for _ in range(300):
        pace.note(sizes[-1], fixed + a_pixel * 800 * 800 / sizes[-1] ** 2)
        sizes.append(pace.divisor(full))
    assert sizes[0] == 8
    assert sizes[20:].count(settled) > 270
    assert max(fixed + a_pixel * 640_000, FRAME_SECONDS) == FRAME_SECONDS or settled > 1
    if fixed == 0 and settled < 8:
        assert a_pixel * 640_000 / settled**2 <= MOVING_SECONDS


def test_moving_pictures_recover_from_a_slow_moment():
    pace, full = MovingPace(), (800, 600)
    for i in range(400):
        divisor = pace.divisor(full)
        pace.note(divisor, 1.0 if 100 <= i < 110 else 0.02)
        assert i < 20 or divisor == 1 or 100 < i < 200
    assert divisor == 1


@pytest.fixture
def now(monkeypatch):
    """A clock that stands still until it is set: `now[0]` is the time."""
    time_told = [100.0]
    monkeypatch.setattr("lumigraph.viewer.turns.time", SimpleNamespace(perf_counter=lambda: time_told[0]))
    return time_told


def test_renderings_have_no_more_than_their_share_of_training(now):
    turns = Turns(training=True)

    def render() -> None:
        for _ in range(2):
            with turns.turn():
                now[0] += 3.0

    thread = threading.Thread(target=render)
    thread.start()
    for own_time in (0.0, 3.0 * (1 / RENDER_SHARE - 1)):  # from one turn to the next
        now[0] += own_time - 0.1
        for _ in range(20):
            assert not (own_time and turns.asked)
            time.sleep(0.005)
        now[0] += 0.2
        while not turns.asked:
            time.sleep(0.005)
        before = now[0]
        turns.give_way()
        assert now[0] == before + 3.0
        now[0] -= 0.1
    thread.join(5)
    assert not turns.asked


def test_turns_come_in_the_order_of_asking_and_can_be_given_up():
    turns = Turns(training=True)
    order: list[int] = []

    def render(i: int) -> None:
        try:
            with turns.turn(lambda: i != 1):
                order.append(i)
        except NotWantedError:
            order.append(-i)

    threads = [threading.Thread(target=render, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
        time.sleep(0.02)
    time.sleep(0.2)
    assert order == [-1]
    turns.end_training()
    for thread in threads:
        thread.join(5)
    assert order == [-1, 0, 2, 3]


def test_those_at_rest_ask_seldom(now):
    turns = Turns(training=True, idle_share=0.1)
    assert turns.claim_refresh()
    assert not turns.claim_refresh()  # someone is at it
    now[0] += 0.5
    turns.refreshed(0.5)
    assert turns.until_refresh() == 1.0  # the longest
    now[0] += 4.5
    assert not turns.claim_refresh() and turns.until_refresh() == pytest.approx(0.5)
    now[0] += 1.0
    assert turns.claim_refresh()


class Easel:
    """What a painter is told to draw; pictures of `held` seconds are not done until nobody wants them."""

    def __init__(self):
        self.begun: list[float] = []
        self.done: list[float] = []
        self.faults: list[Exception] = []
        self.held: float | None = None
        self.painter = Painter(self.draw, Turns(), self.faults.append)

    def draw(self, seconds, wanted):
        self.begun.append(seconds)
        if seconds == self.held:
            while wanted():
                time.sleep(0.002)
            raise NotWantedError
        self.done.append(seconds)
        return seconds == math.inf


def test_a_painter_refines_at_rest_and_drops_what_is_out_of_date():
    easel = Easel()
    easel.painter.start()
    easel.painter.request()
    assert easel.painter.settled.wait(20)
    assert easel.done == [0.1, 0.5, math.inf]
    for held in (0.5, math.inf):
        easel.held = held
        easel.begun.clear()
        easel.done.clear()
        easel.painter.request()
        while held not in easel.begun:
            time.sleep(0.005)
        easel.painter.request()
        easel.held = None
        assert easel.painter.settled.wait(20)
        assert easel.begun == {0.5: [0.1, 0.5], math.inf: [0.1, 0.5, math.inf]}[held] + [0.1, 0.5, math.inf]
        assert easel.done == {0.5: [0.1], math.inf: [0.1, 0.5]}[held] + [0.1, 0.5, math.inf]
    easel.painter.stop()
    assert easel.faults == []


def test_a_painter_survives_a_fault():
    easel = Easel()
    good, easel.painter._draw = easel.painter._draw, lambda *_: 1 / 0
    easel.painter.start()
    easel.painter.request()
    assert easel.painter.settled.wait(20)
    assert isinstance(easel.faults[0], ZeroDivisionError)
    easel.painter._draw = good
    easel.painter.request()
    assert easel.painter.settled.wait(20)
    easel.painter.stop()
    assert easel.done[-1] == math.inf


# Addresses


def test_a_port_in_use():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LumigraphError, match=f"Port {port} is in use"):
            choose_address(port=port)


def test_without_a_port_the_next_free_one_is_taken():
    first = choose_address().port
    with socket.create_server(("127.0.0.1", first)):
        second = choose_address().port
    assert 8080 <= first < second


@pytest.mark.parametrize(("host", "port"), [("no.such.host.invalid", None), ("127.0.0.1", 65536), ("192.0.2.7", None)])
def test_nonsense_addresses(host, port):
    with pytest.raises(LumigraphError, match="give --"):
        choose_address(host, port)


def test_only_open_doors_are_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_address("localhost", 0).url.startswith("http://localhost:")
    with pytest.warns(LumigraphWarning, match=r"can reach this machine.*http://127\.0\.0\.1:\d+"):
        choose_address("0.0.0.0", 0)


# A server and its clients


def test_twenty_clients_and_some_that_leave(learnt, tmp_path):
    """All are served, those that vanish in mid-stream are forgotten, and the others go on."""
    scene, method = learnt
    with Viewer(method, subject(scene, tmp_path), choose_address(port=0)) as viewer:
        clients = [Client(viewer.address.url, (3.0, 0.3 * i - 3, 0.5)) for i in range(20)]
        pictures = [client.picture(width=120) for client in clients]
        for client in clients[:5]:
            client.look_from((0.5, 3.0, 0.5))
            client.vanish()
        for client in clients[5:10]:
            client.close()
        assert abs(pictures[0].astype(int) - pictures[-1]).mean() > 1
        deadline = time.monotonic() + 10
        while len(viewer._everyone()) > 10 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(viewer._everyone()) == 10
        clients[-1].look_from((-3.0, 0.0, 0.5))

        def moved() -> bool:
            """The next picture is of the new view, within JPEG's loss; one of the old view may be under way."""
            picture, camera = clients[-1].picture(width=120), viewer._everyone()[-1].request().camera((120, 90))
            return bool(abs(picture / 255 - method.render(camera).rgb.numpy()).mean() < 0.02)

        until(moved)
        for client in clients[10:]:
            client.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "painter" and not stopped(thread)]


def stopped(thread: threading.Thread) -> bool:
    thread.join(5)
    return not thread.is_alive()


def test_what_was_kept_for_clients_goes_when_the_last_has_left(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer_module, "FORGET_SECONDS", 0.1)
    given_back = threading.Event()
    monkeypatch.setattr("lumigraph.viewer.shared.give_back_memory", given_back.set)
    cloud = Splatted(RED)
    with Viewer(cloud, subject(tiny.scene(), tmp_path), choose_address(port=0)) as viewer:
        one, other = Client(viewer.address.url), Client(viewer.address.url)
        for client in (one, other):
            client.picture()  # it is there
        viewer._shared._picked = ("a crop", cloud.gaussians())
        one.close()
        assert not given_back.wait(0.5) and viewer._shared._picked is not None  # somebody is still there
        other.close()
        assert given_back.wait(10) and viewer._shared._picked is None


def test_a_fault_in_rendering_is_told(learnt, tmp_path, capfd):
    scene, _ = learnt

    class Broken(Wall):
        def render(self, camera):
            raise LumigraphError("The lens is dusty; clean it")

    with Viewer(Broken(scene.frame, None), subject(scene, tmp_path), choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        told = next(m for m in client.messages(10) if m["type"] == "NotificationShowMessage")
        client.close()
    assert "clean it" in json.dumps(told["props"])
    out, err = capfd.readouterr()
    assert "clean it" in err and out == ""


# While training


def test_who_looks_on_changes_nothing(learnt, tmp_path):
    scene, _ = learnt
    plain, watched = tiny.method(scene.frame), tiny.method(scene.frame)
    fit(plain, scene, steps=40, show=False)
    with Viewer(watched, subject(scene, tmp_path), choose_address(port=0), training=True) as viewer:
        client = Client(viewer.address.url)
        busy = threading.Thread(target=lambda: [client.look_from((3.0, 0.1 * i, 0.5)) for i in range(100)])
        busy.start()
        fit(watched, scene, steps=40, show=False, watch=viewer)
        viewer.end_training()
        busy.join()
        client.picture(width=120)  # as sharp as can be, now that nobody trains
        client.close()
    for name, value in plain.state_dict().items():
        assert torch.equal(value, watched.state_dict()[name]), name


def test_pausing_takes_no_training_time(learnt):
    scene, _ = learnt

    class Pausing:
        paused = 0.0
        rows = 0

        @property
        def asked(self):
            return self.rows == 2 and not self.paused

        def give_way(self, stopping):
            assert not method.training
            time.sleep(0.5)
            self.paused = 0.5

        def note(self, step, progress, row):
            self.rows += bool(row)

    method, watch = tiny.method(scene.frame), Pausing()
    begin = time.perf_counter()
    outcome = fit(method, scene, steps=30, show=False, watch=watch)
    assert watch.paused and time.perf_counter() - begin > 0.5 + outcome.state.seconds
    assert outcome.saving_seconds < 0.4


def test_a_paused_training_can_be_interrupted(learnt, tmp_path):
    scene, _ = learnt
    method = tiny.method(scene.frame)
    with Viewer(method, subject(scene, tmp_path), choose_address(port=0), training=True) as viewer:
        viewer.turns.paused = True
        timer = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
        timer.start()
        outcome = fit(method, scene, steps=10_000, show=False, watch=viewer)
    assert outcome.signal == signal.SIGINT and not outcome.finished


# Commands


def interrupt_after(work) -> threading.Thread:
    """Do some work in a thread, then press Ctrl-C."""

    def go() -> None:
        try:
            work()
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=go)
    thread.start()
    return thread


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


def wait_for(url: str) -> str:
    for _ in range(200):
        try:
            return urllib.request.urlopen(url, timeout=5).read().decode()
        except OSError:
            time.sleep(0.1)
    raise AssertionError(f"nobody answers at {url}")


def test_view_and_train_view(ball_folder, tmp_path, capsys):
    """Training is watched, goes on being shown when it is over, and ends by Ctrl-C; its run is then viewed."""
    folder, url, seen = tmp_path / "run", f"http://127.0.0.1:{free_port()}", []
    port = url.rpartition(":")[2]

    def watch() -> None:
        wait_for(url)
        client = Client(url)
        for message in client.messages(30):
            if "Done · step 30" in str(message.get("updates")):
                seen.append("done")
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"] and seen:
                seen.append("picture")
                break
        until((folder / "photographs.json").exists)  # meanwhile the photographs are examined
        time.sleep(1)  # and the report is printed
        client.close()

    thread = interrupt_after(watch)
    arguments = ["voxel-grid", str(ball_folder), "--steps", "30", "--output", str(folder), "--view", "--port", port]
    assert main(["train", *arguments]) == 0
    thread.join()
    assert seen == ["done", "picture"]
    assert url in capsys.readouterr().out
    assert Run(folder).state.step == 30

    thread = interrupt_after(lambda: seen.append(wait_for(url)))
    assert main(["view", str(folder), "--port", port]) == 0
    thread.join()
    assert "<html" in seen[-1]


def test_view_says_what_is_wrong(tmp_path, capsys):
    assert main(["view", str(tmp_path / "nothing")]) == 2
    assert "nothing does not exist" in capsys.readouterr().err
    folder = tmp_path / "run"
    run = tiny.new_run(folder)
    fit(tiny.method(), tiny.scene(), run, steps=1, show=False)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert main(["view", str(folder), "--port", str(taken.getsockname()[1])]) == 2
    assert "is in use" in capsys.readouterr().err
