"""Which way is up, of captures by hand and by drone, in frames turned anyhow."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from captures import HEIGHT, WIDTH, Tiny, write_nerfstudio

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.errors import LumigraphError
from lumigraph.geometry import look_at
from lumigraph.opening import open_scene
from lumigraph.readers import Before
from lumigraph.readers.up import common_up

GROUND = np.random.default_rng(0).uniform([-6, -6, 0], [6, 6, 0.3], (500, 3))
Z = np.array([0.0, 0.0, 1.0])


def survey(rows: int, heading, pitch: float) -> np.ndarray:
    """A drone's grid of places, 5 above the ground. heading: radians, of a row; pitch: degrees below level."""
    poses = []
    for row in range(rows):
        ahead = np.array([math.cos(heading(row)), math.sin(heading(row)), 0])
        down = math.radians(pitch)
        for column in range(8):
            eye = np.array([row - rows / 2, column - 3.5, 5 + 0.1 * math.sin(7 * row + 3 * column)])
            gaze = math.cos(down) * ahead - math.sin(down) * Z
            poses.append(posed(eye, gaze, math.sin(down) * ahead + math.cos(down) * Z))
    return np.stack(poses)


def ring(count: int, radius: float, height: float, whole: float = 2 * math.pi) -> np.ndarray:
    eyes = [np.array([radius * math.cos(a), radius * math.sin(a), height]) for a in whole * np.arange(count) / count]
    return np.stack([posed(eye, -eye, Z) for eye in eyes])


def wall(width: float, height: float) -> np.ndarray:
    """Seen from in front, four away."""
    spots = [np.array([x, -4.0, z]) for x in np.linspace(-1, 1, 6) for z in np.linspace(-1, 1, 4)]
    return np.stack([posed(spot * [width, 1, height], np.array([0.0, 1.0, 0.0]), Z) for spot in spots])


def posed(eye: np.ndarray, gaze: np.ndarray, up: np.ndarray) -> np.ndarray:
    return look_at(*(torch.from_numpy(x).double() for x in (eye, gaze, up))).numpy()


CAPTURES = {
    "straight down, to and fro": survey(8, lambda row: row % 2 * math.pi, 90),
    "straight down, always one way": survey(8, lambda row: 0.3, 90),
    "straight down, mostly one way": survey(8, lambda row: (row % 3 == 0) * math.pi, 90),
    "straight down, anyhow": survey(8, lambda row: 2.4 * row, 90),
    "ahead and down": survey(8, lambda row: 0.3, 50),
    "straight down, and a ring": np.concatenate([survey(8, lambda row: 0.3, 90), ring(10, 7, 4)]),
    "around something": ring(20, 4, 1),
    "an arc from high above": ring(20, 3, 4, 1.0),
    "a wall": wall(1, 0.6),
    "a facade": wall(3, 1.5),
}


@pytest.mark.parametrize("name", CAPTURES)
def test_up_is_found_in_a_frame_turned_anyhow(name):
    poses, chance = CAPTURES[name], np.random.default_rng(1)
    points = GROUND if "wall" not in name and "facade" not in name else GROUND[:, [0, 2, 1]]
    for _ in range(3):
        turn = np.linalg.qr(chance.normal(size=(3, 3)))[0]
        turn *= np.linalg.det(turn)
        found = common_up(cameras(turn @ poses), points @ turn.T)
        assert found is not None and np.degrees(np.arccos(np.clip(found @ turn @ Z, -1, 1))) < 3


def cameras(poses: np.ndarray) -> Camera:
    ones = torch.ones(len(poses), 2)
    return Camera(torch.from_numpy(poses).float(), Pinhole(ones, ones), ones.long())


def test_a_file_of_poses_may_say_which_way_is_up(tmp_path):
    folder = write_nerfstudio(tmp_path, Tiny())
    path = folder / "transforms.json"
    said = json.loads(path.read_text())
    path.write_text(json.dumps(said | {"up": [0.0, 3.0, 4.0]}))
    up = open_scene(folder).frame.to_source.rotation[:, 2]
    torch.testing.assert_close(up, torch.tensor([0.0, 0.6, 0.8], dtype=torch.double))
    faults = {"points nowhere": [0, 0, 0], "up is 'up', and should be": "up", "of length 3, got 2": [0, 1]}
    for words, wrong in faults.items():
        path.write_text(json.dumps(said | {"up": wrong}))
        with pytest.raises(LumigraphError, match=words):
            open_scene(folder)


def test_a_run_finds_its_photographs_in_the_order_and_turn_of_its_beginning(tmp_path):
    folder = write_nerfstudio(tmp_path, Tiny())
    now = open_scene(folder)
    names = now.names[::-1]
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ now.frame.to_source.rotation.T.numpy()
    again = open_scene(folder, before=Before(names, turn))
    assert again.names == names and again.splits["test"].tolist() == now.splits["test"].tolist()
    assert WIDTH > HEIGHT and torch.equal(again.images[0], now.images[len(now) - 1])
    torch.testing.assert_close(again.frame.to_source.rotation, torch.from_numpy(turn.T))
