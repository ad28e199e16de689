"""The procedural city: its plan, its drive, and what is known of its photographs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lumigraph import synthetic as procedural
from lumigraph.datasets.images import ImageSource, load
from lumigraph.errors import LumigraphError
from lumigraph.opening import open_scene
from lumigraph.synthetic import Lamp, Material, Object, Pose, World, scenes
from lumigraph.synthetic.rendering import render, signed_distance
from lumigraph.synthetic.scenes.city import Drive, plan
from lumigraph.synthetic.shapes import Ball, Cuboid
from lumigraph.synthetic.textures import Checker, Plain
from lumigraph.synthetic.world import joined

SMALL = "procedural:city,crossings=2,size=24,views=14"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return open_scene(SMALL, cache=tmp_path_factory.mktemp("cache"))


@pytest.mark.parametrize("count", [2, 3, 4, 6, 7, 16])
def test_a_drive_goes_along_every_street_once_in_each_direction(count):
    places = plan.crossings(count)
    assert len(set(places)) == count
    tour = plan.tour(places)
    driven = list(zip(tour, tour[1:], strict=False))
    asked = [(here, there) for here, others in plan.neighbours(places).items() for there in others]
    assert sorted(driven) == sorted(asked) and tour[0] == tour[-1]


def test_people_drive_on_the_right_and_stop_at_even_distances():
    places = plan.crossings(6)
    stops, headings, length = plan.stops(places, 300)
    step = np.linalg.norm(np.diff(stops, axis=0), axis=-1)
    assert step.max() < 1.001 * length / 300 and np.median(step) == pytest.approx(length / 300, rel=1e-6)
    across = stops - plan.PITCH * np.round(stops / plan.PITCH)  # from the nearest crossing
    straight = np.abs(across).max(-1) > plan.ROAD + 1
    right = np.stack([np.sin(headings), -np.cos(headings)], -1)
    aside = (across * right).sum(-1)[straight]
    assert straight.mean() > 0.5
    np.testing.assert_allclose(aside, plan.LANE, atol=1e-6)


def test_nothing_is_nearer_to_a_camera_than_promised():
    stage = scenes.stage("city", size=24, views=140, crossings=2)
    nearest = [
        signed_distance(stage.world_of(camera), camera.position)
        for camera in (stage.cameras["train"][i] for i in range(0, 140, 9))
    ]
    assert torch.cat(nearest).min() > stage.near


def test_held_out_photographs_are_spread_along_the_drive_and_nobody_drives_there(scene):
    train, test = scene.splits["train"], scene.splits["test"]
    assert (len(train), len(test)) == (14, 2)
    time = scene.about["time"]
    assert (time[train].diff() >= 0).all() and time[train].min() < time[test].min() < time[train].max()
    shown = torch.stack([scene.photograph(i).rgb for i in range(len(scene))])
    clean = torch.stack([scene.photograph(i, layers=("clean",)).extra["clean"] for i in range(len(scene))])
    labels = torch.stack([scene.photograph(i, layers=("labels",)).extra["labels"] for i in range(len(scene))])
    moving = labels == scene.layer("labels").names.index("traffic")
    assert torch.equal(shown[test], clean[test]) and not moving[test].any()
    difference = (shown - clean)[train].abs().amax(-1)
    assert difference[moving[train]].mean() > 10 * difference[~moving[train]].mean() > 0  # their shadows


def test_photographs_say_how_they_were_exposed(scene):
    """Where film is linear, twice the exposure is twice the light."""
    drive = Drive(2, 16, 0)
    light = [drive.exposure(number) for number in range(16)]
    assert sorted(scene.about["exposure"].tolist()) == pytest.approx(sorted(light))
    assert max(light) > 2 * min(light)
    stage = scenes.stage("city", size=24, views=14, crossings=2)
    camera, world = stage.cameras["train"][1], drive.world(1, lasting=True)
    dim = drive.exposure(1) / 4
    darker = joined([World(world.objects)], world.lights, world.sky.__class__(**{**vars(world.sky), "exposure": dim}))
    once, fourth = (render(w, camera, more=0).rgb.double() for w in (world, darker))
    linear, less = (torch.where(x > 0.04045, ((x + 0.055) / 1.055) ** 2.4, x / 12.92) for x in (once, fourth))
    unbent = linear.amax(-1) < 0.5
    assert unbent.float().mean() > 0.3
    assert ((linear[unbent] / less[unbent] - 4).abs() < 0.02).float().mean() > 0.98


def test_the_sun_moves_and_the_same_place_looks_different_later():
    drive = Drive(2, 90, 0)
    first, last = drive.world(1, True), drive.world(88, True)
    toward = [np.array(w.lights[0].direction) / np.linalg.norm(w.lights[0].direction) for w in (first, last)]
    assert toward[0] @ toward[1] < np.cos(np.radians(60))


@pytest.mark.parametrize(
    "source", [SMALL, *(f"procedural:{name},size=16,views=4" for name in ("still-life", "swing", "night"))]
)
def test_pictures_are_traced_once(source, tmp_path, monkeypatch):
    first = open_scene(source, cache=tmp_path)
    monkeypatch.setattr(procedural, "picture", lambda *_: pytest.fail("traced again"))
    again = open_scene(source, cache=tmp_path)
    assert torch.equal(first.photograph(3).rgb, again.photograph(3).rgb)
    part = {"photographs": [first.names[i] for i in (0, 1, 3)], "centre": (0.0, 0.0, 0.0), "radius": 1.0}
    some = open_scene(source, cache=tmp_path, part=part)
    assert torch.equal(first.photograph(3).rgb, some.photograph(2).rgb)  # whichever scene asks
    with pytest.raises(pytest.fail.Exception):
        open_scene(f"{source},seed=1", cache=tmp_path)


def test_poses_are_off_by_shares_of_a_street():
    exact, off = (procedural.read(f"{SMALL.partition(':')[2]}{more}") for more in ("", ",jitter_poses=1"))
    moved = [np.linalg.norm(a.pose[:, 3] - b.pose[:, 3]) for a, b in zip(exact.shots, off.shots, strict=True)]
    assert moved == pytest.approx([0.1] * 14 + [0.0] * 2, abs=1e-4)
    for a, b in zip(exact.shots, off.shots, strict=True):
        np.testing.assert_allclose(b.about["true_pose"], a.pose)
        assert a.identity == b.identity


def test_joined_worlds_look_like_one():
    ball = World((Object(Ball(0.4), Material(Checker((0.9, 0.8, 0.7), (0.2, 0.3, 0.4))), name="ball"),))
    box = Object(Cuboid((0.3, 0.2, 0.5)), Material(Plain((0.8, 0.2, 0.1))), Pose.at(0.6, 0.2, 0, turn=30), "box")
    plate = Object(Cuboid((1.0, 1.0, 0.1)), Material(Plain((0.5, 0.5, 0.5))), Pose.at(0, 0, -0.6), "plate")
    lamp = Lamp((1.0, -2.0, 3.0), 0.1, 9.0)
    one = World((*ball.objects, box, plate), (lamp,))
    several = joined([ball, World(()), World((box, plate))], (lamp,), one.sky)
    assert several == one
    camera = scenes.stage("still-life", size=32, views=2).cameras["train"][0]
    a, b = render(one, camera), render(several, camera)
    assert torch.equal(a.rgb, b.rgb) and torch.equal(a.extra["ids"], b.extra["ids"])
    assert {0, 1, 2} <= set(a.extra["ids"].unique().tolist())


def test_options_are_named():
    with pytest.raises(LumigraphError, match="there are size, views, seed, jitter_poses, crossings"):
        open_scene("procedural:city,blocks=3")
    with pytest.raises(LumigraphError, match="crossings is 1, and should be from 2"):
        open_scene("procedural:city,crossings=1")


def test_a_picture_that_is_kept_is_made_once_even_where_it_fits(tmp_path):
    pixels, made = np.arange(5 * 4 * 3, dtype=np.uint8).reshape(5, 4, 3), []

    def make():
        made.append(True)
        return pixels, None

    for keep, times in ((False, 1), (True, 2), (True, 2), (False, 3)):
        store = load([ImageSource((4, 5), make, "these")], memory=1 << 20, cache=tmp_path, keep=keep)
        assert not store.shuffled and torch.equal(store[0], torch.from_numpy(pixels)) and len(made) == times
    (file,) = (tmp_path / "pictures").iterdir()
    file.write_bytes(file.read_bytes()[:40])  # damaged: made again
    load([ImageSource((4, 5), make, "these")], memory=1 << 20, cache=tmp_path, keep=True)
    assert len(made) == 4
    load([ImageSource((4, 5), make, "others")], memory=1 << 20, cache=tmp_path, keep=True)
    assert len(made) == 5
