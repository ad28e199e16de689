"""Captures of what moves: features that move by their epipolar residuals, and rigs of videos filmed at once."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
from budgets import budget

from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.export.video import open_video
from lumigraph.opening import open_scene
from lumigraph.sfm.moving import MovingFeatures, check_still, check_times, leave_out_moving
from lumigraph.sfm.options import MotionOptions
from lumigraph.sfm.photos import Intake, Photo
from lumigraph.sfm.reconstruction import nothing_fits
from lumigraph.sfm.rig import CLOCKS_FILE, capture_rig, common_moments, films_of, is_rig

pytestmark = budget("capture", 5)
STILL, MOVING, VIEWS, FOCAL = 60, 20, 4, 300.0


@pytest.fixture
def database(tmp_path) -> Path:
    """Views of points from places a step apart, of which the last ones move across the camera's way."""
    random = np.random.default_rng(0)
    points = random.uniform((-1, -1, 3), (1, 1, 5), (STILL + MOVING, 3))
    path = tmp_path / "database.db"
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    with closing(pycolmap.Database.open(path)) as opened:
        lens = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, 640, 480)
        lens.has_prior_focal_length = True
        opened.write_camera(lens)
        seen = []
        for i in range(VIEWS):
            there = points - (0.3 * i, 0, 0)
            there[STILL:, 1] += 0.35 * np.sin(2.0 * i)
            pixels = (FOCAL * there[:, :2] / there[:, 2:] + (320, 240)).astype(np.float32)
            opened.write_image(pycolmap.Image(f"{i}.jpg", camera_id=1, image_id=i + 1))
            opened.write_keypoints(i + 1, pixels)
            seen.append(pixels.astype(float))
        every = np.arange(STILL + MOVING, dtype=np.uint32)
        matches = np.stack([every, every], 1)
        for a in range(VIEWS):
            for b in range(a + 1, VIEWS):
                opened.write_matches(a + 1, b + 1, matches)
                found = pycolmap.estimate_calibrated_two_view_geometry(lens, seen[a], lens, seen[b], matches, options)
                opened.write_two_view_geometry(a + 1, b + 1, found)
    return path


def test_features_that_move_are_left_out(database):
    with closing(pycolmap.Database.open(database)) as opened:
        before = sum(len(x.inlier_matches) for x in opened.read_two_view_geometries()[1])
    found = leave_out_moving(database)
    assert found.judged == VIEWS * (STILL + MOVING)
    assert VIEWS * MOVING * 0.9 <= found.moving <= VIEWS * MOVING
    with closing(pycolmap.Database.open(database)) as opened:
        _, geometries = opened.read_two_view_geometries()
        left = np.concatenate([x.inlier_matches[:, 0] for x in geometries])
        raw = opened.read_all_matches()[1]
    assert len(geometries) == 6 and STILL * 6 * 0.98 <= (left < STILL).sum() <= before
    assert (left >= STILL).sum() < 0.1 * 6 * MOVING
    assert all(len(x) == STILL + MOVING for x in raw)  # what was found is kept
    assert "80 of" in MovingFeatures(80, 320).say() and "nothing was found to move" in MovingFeatures(0, 320).say()


def test_what_cannot_be_captured_is_refused_in_a_sentence():
    check_still("film.mp4", MovingFeatures(100, 300))
    with pytest.raises(LumigraphError, match=r"film.mp4: 80 % of what is seen again moves"):
        check_still("film.mp4", MovingFeatures(240, 300))
    photos = [Photo("a.jpg", Path("a.jpg"), (9, 9), time=1.0), Photo("b.jpg", Path("b.jpg"), (9, 9))]
    with pytest.raises(LumigraphError, match=r"1 photograph.* no time of exposure, b.jpg first"):
        check_times("folder", photos)
    turned = SimpleNamespace(features={p.name: 900 for p in photos}, shared={("a.jpg", "b.jpg"): 90})
    turned.are_turned = lambda: True
    assert "taken from one place" in nothing_fits(Intake("film.mp4", photos), photos, turned)


def film(path: Path, frames: int, rate: float, level: int) -> None:
    """Frames whose grey rises by 4 from one to the next, over a pattern."""
    pattern = torch.from_numpy(np.random.default_rng(level).uniform(0, 60, (32, 48, 1)).astype(np.float32))
    with open_video(path, rate) as video:
        for i in range(frames):
            video.add((pattern + level + 4 * i).expand(32, 48, 3).clamp(0, 255).byte())


def rig(folder: Path) -> Path:
    folder.mkdir()
    film(folder / "left.mp4", 20, 10, 60)
    film(folder / "right.mp4", 36, 20, 60)
    pose = np.eye(4).tolist()
    lens = {"fl_x": 40.0, "cx": 24.0, "cy": 16.0, "w": 48, "h": 32}
    shifted = [[1, 0, 0, 0.5], *pose[1:]]
    frames = [{"file_path": "left.mp4", "transform_matrix": pose}]
    frames += [{"file_path": "right.mp4", "transform_matrix": shifted, "fl_x": 45.0}]
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder


def test_a_rig_of_videos_becomes_a_scene_with_times(tmp_path, capsys):
    source = rig(tmp_path / "rig")
    (source / CLOCKS_FILE).write_text(json.dumps({"right.mp4": 0.3}))
    assert is_rig(source) and not is_rig(tmp_path)
    films = films_of(source)
    assert [f.rate for f in films] == [10, 20] and [f.begin for f in films] == [0, 0.3]
    assert main(["capture", str(source), "--moving", "--output", str(tmp_path / "scene"), "--frames", "6"]) == 0
    told = capsys.readouterr()
    assert "different lengths" in told.err and "10 to 20 frames per second" in told.err and "2 of 2" in told.out
    made = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    assert len(made["frames"]) == 12 and {frame["fl_x"] for frame in made["frames"]} == {40.0, 45.0}
    times = [frame["time"] for frame in made["frames"]]
    assert times[:6] == times[6:] and times[0] == 0 and times[5] == pytest.approx(1.6, abs=0.11)
    scene = open_scene(str(tmp_path / "scene"))
    assert scene.frame.times == pytest.approx((0, times[5]))
    cameras = scene.cameras
    left = cameras.position[:, 0] == cameras.position[0, 0]
    grey = torch.tensor([float(scene.photograph(i).rgb.mean()) for i in range(12)])
    steps = (grey[left] - grey[~left]).abs() * 255  # both rise by 4 a frame, the right one from 0.3 s on, twice as fast
    expected = torch.tensor([abs(4 * 10 * (t + 0.3) - 4 * 20 * t) for t in times[:6]])
    assert (steps - expected).abs().max() < 9


def test_faults_of_rigs_are_told_in_a_sentence(tmp_path):
    source = rig(tmp_path / "rig")

    def refusal() -> str:
        with pytest.raises(LumigraphError) as fault:
            capture_rig(source, tmp_path / "scene", MotionOptions(moving=True))
        return str(fault.value)

    (source / CLOCKS_FILE).write_text(json.dumps({"right.mp4": 9.0}))
    assert "no moment is in both" in refusal()
    (source / CLOCKS_FILE).write_text(json.dumps({"middle.mp4": 1.0}))
    assert "middle.mp4, which is no video there" in refusal()
    (source / CLOCKS_FILE).unlink()
    text = (source / "transforms.json").read_text()
    (source / "transforms.json").write_text(text.replace("right.mp4", "middle.mp4"))
    assert "no pose of right.mp4" in refusal()


def test_rigs_alike_say_nothing(tmp_path):
    source = rig(tmp_path / "rig")
    film(source / "right.mp4", 20, 10, 60)
    moments, said = common_moments(films_of(source), None)
    assert len(moments) == 20 and said == []
