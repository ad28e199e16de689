"""Structure from motion, on drawn photographs whose cameras are known."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from budgets import budget
from PIL import Image
from scipy.spatial import KDTree
from views import FOCAL, WIDTH, draw, look_at, panorama, pattern, pinhole, spoil, write_views

from lumigraph.commands import capture as command
from lumigraph.commands import cli
from lumigraph.errors import LumigraphError
from lumigraph.export.video import open_video
from lumigraph.opening import open_scene
from lumigraph.readers.colmap import read as read_colmap
from lumigraph.readers.oddities import jumps
from lumigraph.readers.transforms import read as read_transforms
from lumigraph.sfm import demand, diagnosis, reconstruction, sphere, worker
from lumigraph.sfm.agreement import Agreement, agreement, still_share
from lumigraph.sfm.coverage import use_of
from lumigraph.sfm.diagnosis import Matches, coverage, folds, read_matches, why_not
from lumigraph.sfm.georeference import georeference, upright
from lumigraph.sfm.lenses import MODEL, group_by_lens, prior, write_database
from lumigraph.sfm.options import MotionOptions
from lumigraph.sfm.pairs import (
    aggregated,
    alike,
    choose_matching,
    choose_pairs,
    exhaustive,
    overlapping,
    sequential,
)
from lumigraph.sfm.pairs import near as near_by
from lumigraph.sfm.photos import Intake, Photo
from lumigraph.sfm.reconstruction import Reconstruction, reconstruct
from lumigraph.sfm.stages import WORKER, Stages, key_of

pytestmark = budget("capture", 45)  # 43 s measured, with captures of two scenes, a sphere and turned photographs


TURNED = (("view01.jpg", 6, "ROTATE_90"), ("view05.jpg", 3, "ROTATE_180"), ("view08.jpg", 8, "ROTATE_270"))


class Told:
    """Progress that remembers what was told of, and stops at some point if asked."""

    def __init__(self, stop_in: str | None = None, after: int = 0):
        self.counts: dict[str, int] = {}
        self.stop_in, self.after = stop_in, after

    def __call__(self, items, description, total):
        for i, item in enumerate(items):
            if description == self.stop_in and i >= self.after:
                raise KeyboardInterrupt
            self.counts[description] = i + 1
            yield item


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """Twelve good photographs and six bad ones: sources, true poses, what is bad, the scene, its report, progress."""
    base = tmp_path_factory.mktemp("capture")
    photos = base / "photos"
    poses = write_views(photos)
    for name, orientation, undo in TURNED:
        with Image.open(photos / name) as image:
            stored, exif = image.transpose(Image.Transpose[undo]), image.getexif()
        exif[0x0112] = orientation
        stored.save(photos / name, quality=95, exif=exif)
    bad = spoil(photos)
    before = digests(photos)
    told = Told()
    (base / "temporary").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(base / "temporary"))
        result = reconstruct([photos], base / "scene", track=told)
    assert digests(photos) == before, "the user's files were changed"
    return photos, poses, bad, base / "scene", result, told


def digests(folder: Path) -> dict[str, str]:
    return {path.name: sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def aligned_error(scene: Path, poses: dict[str, np.ndarray]) -> np.ndarray:
    """Distances between found and true cameras after the best similarity, as a share of the true extent."""
    shots = {shot.name: shot.pose for shot in read_colmap(scene).shots if shot.name in poses}
    a = np.stack([shots[name][:, 3] for name in shots])
    b = np.stack([poses[name][:, 3] for name in shots])
    options = pycolmap.RANSACOptions()
    options.random_seed, extent = 0, np.linalg.norm(np.ptp(b, axis=0))
    similarity = pycolmap.estimate_sim3d_robust(a, b, options)["tgt_from_src"].matrix()
    return np.linalg.norm(a @ similarity[:, :3].T + similarity[:, 3] - b, axis=-1) / extent


def test_all_good_photographs_are_placed_where_they_were_taken(captured):
    _, poses, bad, scene, result, _ = captured
    assert set(poses) <= set(result["registered"]) <= set(poses) | set(bad["blurred"])
    assert np.median(aligned_error(scene, poses)) < 0.003
    assert result["error"] < 0.5
    focal = result["cameras"][0]["parameters"][0]
    assert focal == pytest.approx(300, rel=0.03)
    assert not any("one place" in sentence or "folded" in sentence for sentence in result["warnings"])


def test_photographs_with_several_orientations_share_a_lens(captured):
    _, _, _, scene, result, _ = captured
    assert {name for name, _, _ in TURNED} <= set(result["registered"]) and len(result["cameras"]) == 1
    for name, _, _ in TURNED:
        with Image.open(scene / "images" / name) as image:
            assert image.size == (320, 240) and 0x0112 not in image.getexif()


def test_exactly_the_bad_ones_are_named(captured):
    _, _, bad, _, result, _ = captured
    named = set(result["left_out"]) | set(result["blurred"]) | set(result["duplicates"])
    assert named == {name for names in bad.values() for name in names}
    assert result["duplicates"] == {"again.jpg": "view03.jpg"}
    assert "blurred.jpg" in result["blurred"]
    assert set(bad["left_out"]) <= set(result["left_out"])
    assert "too few details (0 found)" in result["left_out"]["blank.jpg"]
    assert result["left_out"]["stranger0.jpg"] == "shares too few details with any other photograph"


def test_progress_counts_what_there_is(captured):
    told = captured[-1].counts
    assert told["Looking at photographs"] == 18
    assert told["Finding details"] == 16 and told["Comparing pairs"] == 16 * 15 / 2 and told["Placing cameras"] == 16


def test_nothing_is_left_in_the_temporary_folder(captured):
    """COLMAP's logging library would leave files there that name all photographs."""
    assert not list((captured[0].parent / "temporary").iterdir())
    assert "Creating SIFT" in (captured[3] / "work" / "colmap.log").read_text()  # its messages are here


def test_both_readers_see_the_same_cameras_and_points(captured):
    scene = captured[3]
    ours, colmap = read_transforms(scene), read_colmap(scene)
    assert [Path(shot.name).name for shot in ours.shots] == [shot.name for shot in colmap.shots]
    for a, b in zip(ours.shots, colmap.shots, strict=True):
        assert np.allclose(a.pose, b.pose, atol=1e-9) and a.size == b.size and a.image[1] == b.image[1]
        pixels = torch.tensor([[10.0, 20.0], [300.0, 200.0]])
        assert torch.allclose(a.lens.unproject(pixels), b.lens.unproject(pixels), atol=1e-6)
    assert len(ours.points) == len(colmap.points)
    assert KDTree(ours.points).query(colmap.points)[0].max() < 1e-4
    assert sorted(ours.sightings) == sorted(colmap.sightings) and max(ours.sightings) > 4


def test_the_scene_opens_with_points_and_held_out_views(captured):
    scene = open_scene(captured[3])
    assert len(scene) == len(captured[4]["registered"]) and len(scene.points) == captured[4]["points"]
    assert len(scene.splits["test"]) == 2 and not scene.warnings


def test_the_scene_stands_upright(captured):
    """+z of the drawn room is up, and the cameras were held level."""
    _, poses, _, scene, _, _ = captured
    for shot in read_colmap(scene).shots:
        if shot.name in poses:
            found_up, true_up = shot.pose[2, :3], poses[shot.name][2, :3]  # the world's up in the camera's axes
            assert found_up @ true_up > np.cos(np.radians(3))


def colours_of(image: Image.Image) -> set[tuple[int, ...]]:
    red, green, blue = np.asarray(image.convert("RGB")).astype(int).reshape(-1, 3).T
    numbers = np.unique(red << 16 | green << 8 | blue)
    return {(n >> 16, n >> 8 & 255, n & 255) for n in numbers.tolist()}


def test_pictures_are_drawn(captured):
    _, _, _, scene, _, _ = captured
    with Image.open(scene / "capture.png") as image:
        assert image.width > 1000 and len(colours_of(image)) > 500
    with Image.open(scene / "photographs.png") as image:
        colours = colours_of(image)
    for colour in ("c0392b", "3f6fb0"):  # frames of those left out and of duplicates
        assert tuple(bytes.fromhex(colour)) in colours


def test_a_second_call_does_nothing_again(captured, monkeypatch):
    photos, _, _, scene, result, _ = captured
    monkeypatch.setattr(Stages, "colmap", None)
    before = {
        path: path.stat().st_mtime_ns for path in scene.rglob("*") if path.is_file() and path.name != "sources.json"
    }
    assert reconstruct([photos], scene) == json.loads((scene / "capture.json").read_text()) == result
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_gps_turns_and_scales(captured, monkeypatch, tmp_path):
    """The same photographs with positions: no stage is done again, and the scene is in metres east, north and up."""
    photos, poses, _, scene, _, _ = captured
    metres, turn = 40.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    chance = np.random.default_rng(0)
    east_north_up = {name: metres * turn @ pose[:, 3] + chance.normal(0, 1.0, 3) for name, pose in poses.items()}
    there = pycolmap.GPSTransform().enu_to_ellipsoid(np.array(list(east_north_up.values())), 47.0, 8.0, 400.0)
    gps = {name: tuple(place.tolist()) for name, place in zip(east_north_up, there, strict=True)}
    plain = reconstruction.gather

    def with_gps(*arguments):
        intake = plain(*arguments)
        return replace(intake, photos=[replace(photo, gps=gps.get(photo.name)) for photo in intake.photos])

    copied = copy_of(scene, tmp_path)
    monkeypatch.setattr(reconstruction, "gather", with_gps)
    monkeypatch.setattr(Stages, "colmap", None)
    result = reconstruct([photos], copied)
    assert result["gps"]["used"] and result["gps"]["error"] < 3
    shots = {shot.name: shot.pose for shot in read_colmap(copied).shots}
    first, last = "view00.jpg", "view11.jpg"
    found = shots[last][:, 3] - shots[first][:, 3]
    true = metres * turn @ (poses[last] - poses[first])[:, 3]
    assert np.linalg.norm(found - true) < 0.05 * np.linalg.norm(true)
    axes = [shots[name][:, :3] for name in (first, last)]
    assert all(a[:, 2] @ (turn @ poses[n][:, 2]) > 0.995 for a, n in zip(axes, (first, last), strict=True))


def test_all_at_once_with_chosen_pairs(captured, tmp_path):
    """The other mapper, or the usual one should it give up for guessed focal lengths, and pairs by likeness."""
    photos, poses, _, scene, _, _ = captured
    copied, told = copy_of(scene, tmp_path), Told()
    result = reconstruct([photos], copied, MotionOptions(mapper="global", matching="retrieval"), told)
    assert "Finding details" not in told.counts and told.counts["Comparing pairs"] <= 120
    assert set(poses) <= set(result["registered"])
    assert np.median(aligned_error(copied, poses)) < 0.005


def test_a_folded_model_is_made_again_from_near_neighbours(captured, monkeypatch, tmp_path):
    photos, poses, _, scene, _, _ = captured
    copied = copy_of(scene, tmp_path)
    (copied / "capture.json").unlink()
    stages = Stages(copied / "work")
    stages.mark("unfolding", "other", False, 0)
    answers = iter([1, 0, 1])  # the first model leaps; the second, asked of before the first again, does not
    monkeypatch.setattr(Reconstruction, "leaps", lambda *_: next(answers))
    monkeypatch.setattr(reconstruction, "SEQUENTIAL_NEIGHBOURS", 4)
    told = Told()
    result = reconstruct([photos], copied, track=told)
    assert list(told.counts)[-1] == "Placing cameras" and "Comparing pairs" not in told.counts
    assert any("folded, so it was made again" in sentence for sentence in result["warnings"])
    assert len(result["registered"]) >= 0.8 * len(poses) and np.median(aligned_error(copied, poses)) < 0.01
    names = sorted(read_matches(copied / "work" / "database.db").features)
    far = {True: 0, False: 0}
    for near in far:
        for a, b in read_matches(copied / "work" / ("near.db" if near else "database.db")).shared:
            far[near] += abs(names.index(a) - names.index(b)) > 4
    assert far[True] == 0 < far[False]


def copy_of(scene: Path, folder: Path) -> Path:
    """With dates, by which photographs are known again."""
    return Path(shutil.copytree(scene, folder / "scene"))


def test_stopped_and_gone_on(tmp_path):
    photos, scene = tmp_path / "a folder", tmp_path / "scene"
    poses = write_views(photos, 12)
    for i, name in enumerate(list(poses)):
        (photos / name).rename(photos / f"my {name}") if 3 <= i < 9 else (photos / name).unlink()
    with pytest.raises(KeyboardInterrupt):
        reconstruct([photos], scene, track=Told("Comparing pairs", after=3))
    marks = json.loads((scene / "work" / "stages.json").read_text())
    assert marks["features"]["done"] and not marks["matching"]["done"] and "mapping" not in marks
    assert not (scene / "capture.json").exists() and not (scene / "transforms.json").exists()
    told = Told()
    result = reconstruct([photos], scene, track=told)
    assert "Finding details" not in told.counts and told.counts["Placing cameras"] == 6
    assert result["registered"] == [f"my_view{i:02d}.jpg" for i in range(3, 9)]  # COLMAP's lists know no spaces
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(LumigraphError, match="made from other photographs"):
        reconstruct([other], scene)


@pytest.mark.parametrize(("since", "counts"), [("ever", "01"), ("begin", "00")])
def test_rows_are_counted_by_a_relative_path(tmp_path, since, counts):
    """People name folders from where they are. A second pass adds rows to those of the first."""
    for name, count in zip(("empty.db", "full.db"), counts, strict=True):
        with closing(pycolmap.Database.open(tmp_path / name)) as opened:
            if name == "full.db":
                opened.write_camera(pycolmap.Camera(model="PINHOLE", width=9, height=9, params=[9, 9, 4.5, 4.5]))
        command = [sys.executable, "-P", str(worker.COUNTER), name, "cameras", since]
        with subprocess.Popen(command, cwd=tmp_path, stdin=-1, stdout=-1, text=True) as counter:
            assert counter.stdout.readline() == f"{count}\n"
            counter.stdin.close()


@pytest.mark.parametrize(("share", "octave"), [(0.4, 0), (1.5, -1)])
def test_the_octave_of_twice_the_size_is_left_out_where_it_adds_nothing(tmp_path, share, octave):
    """Where a photograph has more features than asked for without it, a full search finds nearly the same ones."""
    names = list(write_views(tmp_path / "images", 2))
    with Image.open(tmp_path / "images" / names[0]) as image:
        photos = [photo(name, size=image.size) for name in names]
    job = {"images": str(tmp_path / "images"), "masks": None, "max_size": 1000, "threads": 1, "contrast": 1.0}
    job |= {"names": names, "features": 100_000}

    def found(name: str, run: Callable[[str], None]) -> list[set[tuple[int, int]]]:
        path = tmp_path / name
        write_database(path, [photos], "SIMPLE_RADIAL")
        run(str(path))
        with closing(pycolmap.Database.open(path)) as opened:
            features = [opened.read_keypoints(i.image_id) for i in opened.read_all_images()]
        return [set(map(tuple, each[:, :2].round().astype(int).tolist())) for each in features]

    own = found("own.db", lambda path: worker.extract(path, job, names, 0))
    job["features"] = round(share * min(map(len, own)))
    full, quick, chosen = (
        found("full.db", lambda path: worker.extract(path, job, names, -1)),
        found("quick.db", lambda path: worker.extract(path, job, names, octave)),
        found("chosen.db", lambda path: worker.find_features(job | {"database": path, "coarse": names})),
    )
    assert chosen == quick
    for one, other in zip(full, chosen, strict=True):
        assert abs(len(one) - len(other)) <= 0.05 * len(one) and len(one & other) > 0.7 * len(one)


def test_the_worker_ends_when_nobody_listens(tmp_path):
    """As after a kill of the process that started it."""
    write_views(tmp_path / "images", 3)
    job = {"stage": "matching", "database": str(tmp_path / "none.db"), "pairs": "/dev/stdin"}
    process = subprocess.Popen(
        [sys.executable, "-P", str(WORKER)],
        stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    process.stdin.write(json.dumps(job) + "\n")
    process.stdin.close()
    assert process.wait(timeout=20) == 1


def test_a_film_of_the_whole_sphere_becomes_flat_views(tmp_path):
    """A walk through a room, as a spherical camera films it; the views are where and what pinhole cameras see."""
    walls, width, count = [pattern(seed) for seed in range(6)], 512, 6
    poses = []
    for i, a in enumerate(np.linspace(0, 1.5, count)):
        eye = np.array([1 + i / 4, 1.2 + 0.5 * np.sin(2 * a), 1.6 + 0.2 * np.cos(3 * a)])
        poses.append(look_at(eye, eye + [np.cos(a), np.sin(a), 0]))
    film = tmp_path / "film.mp4"
    with open_video(film, 5) as video:
        for pose in poses:
            video.add(torch.from_numpy(np.array(draw(pose, walls, panorama(width)))))
    scene = tmp_path / "scene"
    result = reconstruct([film], scene, MotionOptions(camera="spherical"))
    assert len(result["registered"]) == count and result["error"] < 1
    assert [camera["model"] for camera in result["cameras"]] == ["EQUIRECTANGULAR"]
    fronts = {f"{i:06d}_front.jpg": pose for i, pose in enumerate(poses)}
    assert np.median(aligned_error(scene, fronts)) < 0.01
    flat = pycolmap.Reconstruction(scene / "sparse/0")
    flat.update_point_3d_errors()
    assert flat.compute_mean_reprojection_error() < 1 and flat.compute_mean_track_length() > 3
    opened = open_scene(scene)
    assert len(opened) == 5 * count and not opened.warnings
    side = round(width / np.pi)
    for view, turn in sphere.TURNS.items():
        seen = draw(np.concatenate([poses[3][:, :3] @ turn, poses[3][:, 3:]], 1), walls, pinhole(side, side, side / 2))
        with Image.open(scene / "images" / f"000003_{view}.jpg") as image:
            coarse = [np.asarray(one.resize((24, 24), Image.Resampling.BOX), int) for one in (image, seen)]
        assert np.abs(coarse[0] - coarse[1]).mean() < 8, view


def test_of_two_scenes_the_larger_is_used_and_the_other_named(tmp_path):
    photos = tmp_path / "photos"
    write_views(photos, 5)
    walls = [pattern(seed) for seed in range(60, 63)]
    for i in range(3):
        draw(look_at(np.array([3 - 0.3 * i, 1 + 0.4 * i, 1.2])), walls).save(photos / f"z{i}.jpg", quality=95)
    result = reconstruct([photos], tmp_path / "scene", MotionOptions(max_size=320))
    assert result["registered"] == [f"view{i:02d}.jpg" for i in range(5)]
    assert result["other_models"] == [[f"z{i}.jpg" for i in range(3)]]
    [said] = result["warnings"]
    assert "3 photographs fit together, but not with the rest: z0.jpg" in said and "capture them alone" in said


def test_a_camera_that_only_turned_shows_no_parallax(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    walls, eye = [pattern(seed) for seed in range(3)], np.array([2.0, 2.1, 1.2])
    for i in range(4):
        aim = eye + [-np.cos(0.3 + 0.2 * i), -np.sin(0.3 + 0.2 * i), -0.2]
        draw(look_at(eye, aim), walls).save(photos / f"{i}.jpg", quality=95)
    with pytest.raises(LumigraphError, match=r"nothing shows parallax.*; .*panorama.jpg is a panorama .* a step apart"):
        reconstruct([photos], tmp_path / "scene")
    made = np.asarray(Image.open(tmp_path / "scene/panorama.jpg"), float)
    level = look_at(eye, eye + [-np.cos(0.6), -np.sin(0.6), 0])
    truth, (height, width) = np.asarray(draw(level, walls, panorama(2 * round(np.pi * FOCAL))), float), made.shape[:2]
    assert width == pytest.approx((0.6 + 2 * np.arctan(WIDTH / 2 / FOCAL)) * FOCAL, rel=0.08)
    shown, left = made.sum(-1) > 0, (truth.shape[1] - width) // 2
    seen, shown = made[::3, ::3], shown[::3, ::3]  # which do for a mean of a hundred thousand
    errors = [
        np.abs(seen - truth[row : row + height : 3, column : column + width : 3])[shown].mean()
        for row in range(truth.shape[0] // 2 - height, truth.shape[0] // 2, 2)
        for column in range(left - 12, left + 12, 2)
    ]
    assert min(errors) < 25 and np.median(errors) > 50  # of 255: it is that place, and nothing is doubled


def test_turns_are_told_from_planes():
    """A camera of unknown focal length that turns, and one that moves before a wall, to the side or around it."""
    lens, noise = np.array([[900.0, 0, 400], [0, 900, 300], [0, 0, 1]]), np.random.default_rng(0)

    def seen(motion: np.ndarray) -> tuple:
        return lens @ motion @ np.linalg.inv(lens) * -3 + noise.normal(0, 1e-5, (3, 3)), (800, 600), (800, 600)

    turns = [look_at(np.zeros(3), np.array([1, a, b]))[:, :3] for a in (-0.3, -0.1, 0.2) for b in (0, 0.2)]
    between = [a.T @ b for i, a in enumerate(turns) for b in turns[:i]]
    wall = [np.eye(3) + np.outer([x, y, 0], [0, 0, 1.0]) for x in (0.05, 0.4) for y in (0, 0.3)]
    around = [r + np.outer([0.3, 0.1, 0.1], [0.1, 0, 1.0]) for r in between]
    counted = [diagnosis.count_turns([seen(m) for m in motions]) for motions in (between, wall, around, [])]
    assert counted == [len(between), 0, 0, 0]


def test_nothing_fits_together(tmp_path, capsys, monkeypatch):
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(3):
        Image.fromarray(pattern(50 + i, 160).astype(np.uint8)).save(photos / f"{i}.jpg", quality=95)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["capture", str(photos)]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("lumigraph: ")]
    assert len(said) == 1 and "no two of 3 show the same things" in said[0] and "overlap" in said[0]
    assert not list(tmp_path.rglob("transforms.json")) and not list(tmp_path.rglob("capture.json"))


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        (["nowhere"], "does not exist"),
        (["two"], "3 are the least"),
        (["two", "--output", "two"], "holds the photographs themselves"),
        (["two", "--output", "taken"], "is no capture"),
        (["two", "--max-size", "50"], "from 200 to"),
        (["two", "--frames", "1"], "at least 3"),
        (["black"], "4 photographs, and every one is black; open one to see"),
        (["same"], "1 photograph that can be used, and 3 are the least (3 more show what 0.jpg shows)"),
    ],
)
def test_bad_input_gets_one_sentence(tmp_path, capsys, monkeypatch, what, sentence):
    monkeypatch.chdir(tmp_path)
    walls = [pattern(seed) for seed in range(3)]
    for folder in ("two", "taken", "black", "same"):
        Path(folder).mkdir()
    for i in range(4):
        draw(look_at(np.array([3.0, 1.0, 1.0])), walls).save(f"same/{i}.jpg")
        Image.effect_noise((90, 60), 1).point(lambda value: max(value - 127, 0)).save(f"black/{i}.jpg")
    for i in range(2):
        draw(look_at(np.array([3.0, 1.0 + i, 1.0])), walls).save(f"two/{i}.jpg")
    Path("taken/notes.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(["capture", *what]) == 2
    assert sentence in capsys.readouterr().err
    assert [path for path in sorted(tmp_path.rglob("*")) if path.name != "scenes"] == before  # nothing half-written


def test_train_captures_what_has_no_poses(tmp_path, monkeypatch, captured, capsys):
    monkeypatch.chdir(tmp_path)
    calls = []

    def found(what, folder, options=None):
        calls.append((what, folder))
        return captured[4]

    monkeypatch.setattr(command, "find_cameras", found)
    assert command.posed("procedural:still-life") == "procedural:still-life"
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    shutil.copy(captured[0] / "view00.jpg", run / "preview.jpg")
    for known in (str(captured[3]), str(run)):
        assert command.posed(known) == known and not calls
    assert command.posed(str(captured[0])) == "scenes/" + captured[0].parent.name  # "photos" names nothing
    assert calls == [((captured[0],), Path("scenes") / captured[0].parent.name)]
    assert "left out" in capsys.readouterr().out


def test_bare_photographs_are_told_to_be_captured(captured):
    with pytest.raises(LumigraphError, match="lumigraph capture"):
        open_scene(captured[0])


# Parts by themselves


def test_stages_remember(tmp_path):
    stages = Stages(tmp_path)
    key = key_of({"b": 1, "a": [1, 2]})
    assert key == key_of({"a": [1, 2], "b": 1}) != key_of({"a": [2, 1], "b": 1})
    with pytest.raises(ValueError), stages.working("features", key):
        raise ValueError
    assert not Stages(tmp_path).is_done("features", key) and Stages(tmp_path).was_begun("features", key)
    with stages.working("features", key):
        pass
    assert Stages(tmp_path).is_done("features", key) and not Stages(tmp_path).is_done("features", key_of(1))


def photo(name: str, **facts) -> Photo:
    return Photo(name, Path(name), **{"size": (100, 80), **facts})


def test_a_capture_that_would_not_fit_gets_fewer_threads_smaller_photographs_and_fewer_features():
    photos = [photo(f"{i}", size=(4000, 3000)) for i in range(1000)]
    asked = replace(demand.demand_of(photos, "retrieval", 1600, 2048), threads=8)
    assert 20_000 < asked.pairs < 30_000 and 600 < asked.seconds < 36_000
    found, cuts = demand.fitted(asked, 16e9)
    assert found == asked and not cuts and "1,000 photographs of up to 4000x3000" in found.say()
    for free, (threads, side, features) in {4e9: (4, 1600, 2048), 1e9: (1, 1182, 571)}.items():
        found, cuts = demand.fitted(asked, free)
        assert (found.threads, found.max_size, found.features) == (threads, side, features)
        assert found.memory <= free and len(cuts) == (threads < 8) + (side < 1600) + (features < 2048)
    assert re.search(r"1 thread at a time .* with 7\.0 GB free", cuts[0])
    assert "features at 1,182 pixels instead of 1,600; with 2.3 GB free" in cuts[1] and "--max-size 1600" in cuts[1]
    with pytest.raises(LumigraphError, match="1,000 photographs of 4000x3000 pixels would need .* and 0.5 GB are free"):
        demand.fitted(asked, 5e8)


def test_who_shares_a_lens():
    phone = [photo(f"p{i}", device="phone", focal=90.0 + i) for i in range(3)]
    tourists = [photo("t0", size=(90, 60)), photo("t1", size=(91, 60)), photo("t2", size=(60, 90))]
    scan = [photo(f"s{i}") for i in range(4)]
    names = lambda groups: [[p.name for p in group] for group in groups]  # noqa: E731
    assert names(group_by_lens(phone + tourists, False)) == [["p0", "p1", "p2"], ["t0"], ["t1"], ["t2"]]
    assert names(group_by_lens(scan, False)) == [["s0", "s1", "s2", "s3"]]
    assert len(group_by_lens(scan, False, "per-image")) == 4
    assert len(group_by_lens(phone + scan, False, "single")) == 1
    with pytest.raises(LumigraphError, match="one size"):
        group_by_lens(tourists, False, "single")
    with pytest.raises(LumigraphError, match="100x80 pixels, and a panorama .* twice as wide"):
        group_by_lens(scan, False, "spherical")
    assert prior(phone) == (91.0, True) and prior(scan) == (120.0, False)


def test_which_pairs_are_compared():
    assert len(exhaustive(5)) == 10
    pairs = sequential(100, 10)
    assert (0, 10) in pairs and (0, 11) not in pairs and (0, 16) in pairs and (0, 64) in pairs
    assert [choose_matching(n, ordered) for n, ordered in ((20, False), (200, False), (20, True))] == [
        "exhaustive", "retrieval", "sequential",
    ]  # fmt: skip


def test_photographs_of_one_place_are_alike():
    """Three places, four photographs of each: with one neighbour less than there are, all are of the same place."""
    chance = np.random.default_rng(0)
    places = [chance.integers(0, 120, (300, 128)) for _ in range(3)]
    photos = [
        np.clip(places[i % 3][chance.permutation(300)[:200]] + chance.normal(0, 4, (200, 128)), 0, 255).astype(np.uint8)
        for i in range(12)
    ]
    similar = aggregated(photos.__getitem__, len(photos))
    assert all((i - j) % 3 == 0 for i, j in alike(similar, 3))
    assert all(abs(i - j) >= 6 for i, j in alike(similar, 3, apart=6))
    photos = [np.zeros((0, 128), np.uint8), *photos]
    assert np.isfinite(aggregated(photos.__getitem__, len(photos))).all()


def test_a_first_look_leaves_out_pairs_that_share_little():
    """Forty photographs around a thing share 60, 50, 40, 30, 20, 10 of their features with the six on each side: these
    alone are compared. One without features is compared with all."""
    chance = np.random.default_rng(0)
    ring = chance.normal(size=(400, 128)).astype(np.float32)
    seen = ring[(10 * np.arange(40)[:, None] + np.arange(70)) % 400]
    seen += chance.normal(0, 0.2, seen.shape)
    photos = seen / np.linalg.norm(seen, axis=2, keepdims=True)
    assert overlapping(photos) == {
        (min(i, j), max(i, j)) for i in range(40) for k in range(1, 7) for j in [(i + k) % 40]
    }
    photos[3, 5:] = 0
    photos[7] = 0
    found = overlapping(photos)
    assert len([pair for pair in found if 7 in pair]) == 39 and {(2, 3), (3, 4)} <= found
    counts = [demand.demand_of([photo("")] * 40, "exhaustive", 1600, 8192, preempt).pairs for preempt in (True, False)]
    assert len(found) + len(sequential(40, 2)) <= counts[0] < counts[1] == 780


@pytest.mark.parametrize("features", [2, 40])
def test_poor_photographs_are_compared_with_all(tmp_path, monkeypatch, features):
    """With few features, and where it is asked for, every pair is compared; with many those that share most."""
    monkeypatch.setattr("lumigraph.sfm.pairs.MIN_LOOK_FEATURES", 20)
    monkeypatch.setattr("lumigraph.sfm.pairs.MIN_SHARED", 0)
    chance, names = np.random.default_rng(0), [f"{i:02d}.png" for i in range(30)]
    write_database(tmp_path / "database.db", [[photo(name) for name in names]], MODEL)
    with closing(pycolmap.Database.open(tmp_path / "database.db")) as opened:
        for image in opened.read_all_images():
            opened.write_keypoints(image.image_id, chance.uniform(1, 60, (features, 6)).astype(np.float32))
            found = pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, chance.integers(0, 90, (features, 128)).astype(np.uint8)
            )
            opened.write_descriptors(image.image_id, found)
    nowhere = np.full((30, 3), np.nan)
    chosen, every = (
        choose_pairs("exhaustive", names, tmp_path / "database.db", nowhere, preempt=preempt)
        for preempt in (True, False)
    )
    assert len(every) == 435 and (set(chosen) == set(every)) == (features < 20) and set(chosen) <= set(every)


def test_pairs_of_many_photographs_are_found_a_block_at_a_time(monkeypatch):
    """The same as all of them at once; and by place, those whose place is known."""
    random = np.random.default_rng(0)
    vectors, places = random.normal(size=(50, 6)).astype(np.float32), random.normal(size=(50, 3))
    whole = alike(vectors, 4, apart=3)
    monkeypatch.setattr("lumigraph.sfm.pairs.BLOCK_VIEWS", 7)
    assert alike(vectors, 4, apart=3) == whole and all(j - i >= 3 for i, j in whole)
    places[[3, 20]] = np.nan
    away = np.linalg.norm(places[:, None] - places, axis=-1)
    np.fill_diagonal(away, np.nan)
    expected = {(min(i, j), max(i, j)) for i in range(50) if i not in (3, 20) for j in np.argsort(away[i])[:5].tolist()}
    assert near_by(places, 5) == expected
    assert near_by(np.full((4, 3), np.nan)) == set()


def test_a_fold_is_a_jump():
    """Neighbours far apart that look the same way or share details; a camera carried elsewhere does neither."""
    walk = np.stack([look_at(np.array([x, 0, 0.0]), np.array([x, 5, 0])) for x in np.linspace(0, 5, 50)])
    assert jumps(walk) == []
    folded = walk.copy()
    folded[30:, 1, 3] += 4
    assert [i for i, _ in jumps(folded)] == [29] and jumps(folded)[0][1] > 30
    carried = folded.copy()
    carried[30:, :, :3] = look_at(np.zeros(3), np.array([1.0, -1, 0]))[:, :3]
    assert jumps(carried) == [] and [i for i, _ in jumps(carried, [29])] == [29]
    names = [f"{i}" for i in range(50)]
    shared = Matches(dict.fromkeys(names, 500), {("30", "29"): 80}, 0)
    assert folds(names, carried, shared, True) and not folds(names, carried, replace(shared, shared={}), True)


def test_gaps_around_a_subject():
    def ring(degrees):
        eyes = [np.array([np.cos(a), np.sin(a), 0.4]) * 3 for a in np.radians(degrees)]
        return np.stack([look_at(eye, np.zeros(3)) for eye in eyes])

    names = [f"{i}" for i in range(24)]
    assert coverage(names, ring(np.arange(0, 360, 15))).degrees == pytest.approx(360)
    some = coverage(names[:18], ring(np.arange(0, 270, 15)))
    assert some.degrees == pytest.approx(255, abs=1)
    assert [round(gap.degrees) for gap in some.gaps] == [105] and set(some.gaps[0].between) == {"17", "0"}
    ahead = np.stack([look_at(np.array([x, 0, 0.0]), np.array([x, 5, 0])) for x in range(3)])
    assert coverage(names[:3], ahead) is None
    side = coverage(names[:7], ring(np.arange(0, 105, 15)))
    assert side.ends == (names[0], names[6])
    told = use_of(side.degrees, side.ends)
    assert told.startswith(f"enough for views of one side of an object, from between {names[0]} and {names[6]}")
    assert "take 13 photographs more" in told and "front" in use_of(40.0, side.ends)
    assert use_of(360.0, None) == "enough for views from all sides"
    sparse = coverage(names[:9], ring(np.arange(0, 360, 40)))  # all around, too far apart
    assert sparse.ends is None and len(sparse.gaps) == 9 and "more from" in sparse.advice[0]


def test_exposure_rotation_and_reasons():
    usual = [photo(f"{i}", brightness=-3 + 0.1 * i) for i in range(9)]
    assert diagnosis.about_exposure(usual, False) == []
    dark = [*usual, photo("dark", brightness=-5.0)]
    assert "dark;" in diagnosis.about_exposure(dark, False)[0]
    dusk = [photo(f"{i}", brightness=-0.3 * i) for i in range(30)]  # slowly, so that neighbours agree
    assert diagnosis.about_exposure(dusk, True) == [] and diagnosis.about_exposure(dusk, False)
    matches = Matches(
        {name: 500 for name in "abcdef"} | {"g": 3},
        {("a", "b"): 90, ("b", "c"): 60, ("e", "d"): 30, ("a", "f"): 20},
        3,
    )
    assert "one place" in diagnosis.about_rotation(10.0, matches)[0]
    assert diagnosis.about_rotation(10.0, replace(matches, turned=1)) == []
    assert "one place" in diagnosis.about_rotation(0.5, replace(matches, turned=0))[0]
    placed = ["a", "b", "c"]
    assert why_not("d", placed, [], matches, False).startswith("in another group of 2, which shares too little")
    assert why_not("f", placed, [], matches, False).startswith("matches a (20 details)")
    assert "too few details (3 found): blurred" == why_not("g", placed, [], matches, True)
    assert "another group of 3" in why_not("f", placed, [["f", "x", "y"]], matches, False)


def located(places: np.ndarray) -> list[Photo]:
    there = pycolmap.GPSTransform().enu_to_ellipsoid(places, 47.0, 8.0, 400.0)
    return [photo(f"{i}", gps=tuple(place.tolist())) for i, place in enumerate(there)]


def test_when_gps_is_trusted():
    chance = np.random.default_rng(1)
    centres = chance.normal(0, 1, (20, 3))
    places = 30 * centres + chance.normal(0, 1, (20, 3))
    places[4] += [300, 0, 0]  # a receiver that was lost
    found = georeference(centres, located(places))
    assert found.new_from_old.scale == pytest.approx(30, rel=0.03) and found.error < 3
    assert found.origin[0] == pytest.approx(47.0, abs=1e-3)
    line = centres * [1, 0, 0]
    assert "GPS is not used" in georeference(line, located(30 * line + chance.normal(0, 1, (20, 3)))).say
    table = georeference(centres, located(0.5 * centres + chance.normal(0, 4, (20, 3))))
    assert table.new_from_old is None and "too large" in table.say
    assert georeference(centres[:2], located(places[:2])).new_from_old is None
    assert georeference(centres, [photo(f"{i}") for i in range(20)]) is None


def test_level_cameras_tell_up():
    tilt = pycolmap.Rotation3d(np.array([0.2, -0.1, 0.05, 0.97])).matrix()
    eyes = [np.array([2 * np.cos(a), 2 * np.sin(a), 1.0]) for a in np.linspace(0, 2, 9)]
    poses = np.stack([tilt @ look_at(eye, np.zeros(3)) for eye in eyes])
    assert upright(poses).rotation.matrix() @ tilt @ [0, 0, 1] == pytest.approx([0, 0, 1], abs=1e-3)


def test_one_photograph_is_an_intake_too():
    """Names that COLMAP cannot hold are changed, and stay unique."""
    intake = Intake("x", [photo("a b.jpg"), photo("a_b.jpg")], duplicates={"a b.jpg": "a_b.jpg"})
    safe = reconstruction.with_safe_names(intake)
    assert [p.name for p in safe.photos] == ["a_b.jpg", "_a_b.jpg"] and safe.duplicates == {"a_b.jpg": "_a_b.jpg"}


@pytest.mark.parametrize(("asked", "other"), [("incremental", "global"), ("global", "incremental")])
@pytest.mark.parametrize("first", [0, 50])
@pytest.mark.parametrize("count", [8, reconstruction.MAX_THOROUGH + 1])
def test_where_matches_contradict_a_model_other_ways_are_tried(tmp_path, monkeypatch, asked, other, first, count):
    """A walk straight ahead has no pair to begin with; missing focal lengths leave nothing to place all at once; and a
    wrong model has a small error too. Many photographs are not placed a third time."""
    tried: list[tuple[str, int]] = []
    shares = {(asked, 0): first, (other, 0): 40, ("incremental", 1): 90}

    def mapped(database: Path, models: Path, mapper: str, seed: int) -> None:
        tried.append((mapper, seed))
        (models / "0").mkdir(parents=True)
        (models / "0" / f"{mapper}{seed}").touch()

    monkeypatch.setattr(reconstruction, "largest", lambda models: 8)
    monkeypatch.setattr(reconstruction, "read_matches", lambda database: Matches({}, {}, 0))
    work = object.__new__(Reconstruction)
    work.stages, work.models, work.unfolded = Stages(tmp_path), tmp_path / "models", tmp_path / "unfolded"
    work.database, work.options = tmp_path / "database.db", MotionOptions(mapper=asked)
    work.map, work.agreement = mapped, lambda *_: Agreement(100, shares[tried[-1]])
    work.photos = [photo("a.jpg")] * count
    few = count <= reconstruction.MAX_THOROUGH
    for _ in range(2):  # once it is there it stays
        work.place("key")
        assert tried == [(asked, 0), (other, 0), ("incremental", 1)][: 3 if few else 2]
        if not few:
            assert (work.models / "0" / f"{other if first < 40 else asked}0").exists()
            continue
        assert {place.name for place in work.models.iterdir()} == {"0", reconstruction.NOTE_FILE}
        assert (work.models / "0" / "incremental1").exists()
        note = (work.models / reconstruction.NOTE_FILE).read_text()
        assert ("contradicted 50%" in note) == bool(first) and "contradicts 10%" in note


def synthetic_model(place, frames, model="SIMPLE_RADIAL", params=(1280.0, 512.0, 384.0, 0.05)):
    """A model of random points with its database, both as COLMAP makes them."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, frames, 300
    options.camera_model_id, options.camera_params = getattr(pycolmap.CameraModelId, model), list(params)
    with closing(pycolmap.Database.open(place / "database.db")) as database:
        return pycolmap.synthesize_dataset(options, database)


def test_matches_contradict_wrong_cameras(tmp_path):
    model, database = synthetic_model(tmp_path, 8), tmp_path / "database.db"
    matches = read_matches(database)
    whole = agreement(model, database, matches)
    assert whole.share > 0.99 and whole.matches > 1000
    frames = sorted(model.reg_frame_ids())
    part = pycolmap.Reconstruction(model)
    part.deregister_frame(frames[0])  # a match of a photograph without a place is not confirmed
    assert agreement(part, database, matches).share == pytest.approx(6 / 8, abs=0.05)
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, np.sin(0.1), 0, np.cos(0.1)])), np.zeros(3))
    frame = model.frame(frames[0])
    frame.rig_from_world = turn * frame.rig_from_world
    assert agreement(model, database, matches).share == pytest.approx(6 / 8, abs=0.1)


def test_a_background_at_rest_behind_a_subject_that_turns_is_noticed(tmp_path):
    """Forty places that stay where they are in all pictures: matches that verification left out."""
    model, place = synthetic_model(tmp_path, 8), tmp_path / "database.db"
    assert still_share(model, place) < 0.05
    fixed = np.random.default_rng(0).uniform((0, 0), (1024, 768), (40, 2)).astype(np.float32)
    with closing(pycolmap.Database.open(place)) as database:
        counts = {}
        for image in database.read_all_images():
            own = database.read_keypoints(image.image_id)
            counts[image.image_id] = len(own)
            more = np.pad(fixed, ((0, 0), (0, own.shape[1] - 2)))
            database.update_keypoints(image.image_id, np.concatenate([own, more]))
        for number in database.read_two_view_geometries()[0]:
            a, b = pycolmap.pair_id_to_image_pair(number)
            found = database.read_matches(a, b)
            at_rest = np.stack([counts[a] + np.arange(40), counts[b] + np.arange(40)], 1)
            database.delete_matches(a, b)
            database.write_matches(a, b, np.concatenate([found, at_rest]).astype(np.uint32))
    assert still_share(model, place) > 0.9 and agreement(model, place, read_matches(place)).share > 0.99


@pytest.mark.parametrize("masked", [True, False])
def test_a_subject_that_turned_is_masked_unasked(masked, tmp_path, monkeypatch, capsys):
    """And where no object can be told from the rest, the capture stands, with a warning."""
    finding = {"photograph": "", "fault": "turning subject", "evidence": "it turns", "advice": "mask it"}
    monkeypatch.setattr(command, "show_result", lambda folder, result, onward: None)
    made = []

    def show_masks(folder, onward):
        if not masked:
            raise LumigraphError("No object")
        made.append(onward)

    monkeypatch.setattr(command, "show_masks", show_masks)
    command.show_all(tmp_path, {"findings": []}, "train it")
    command.show_all(tmp_path, {"findings": [finding]}, "train it")
    said = capsys.readouterr()
    assert made == ["train it"] * masked and ("warning: No object" in said.err) is not masked
    assert ("train it" in said.out) is not masked
    if not masked:
        with pytest.raises(LumigraphError, match="No object"):
            command.show_all(tmp_path, {"findings": [finding]}, "train it", masked=True)


@pytest.mark.parametrize("shared", [0, 3])
def test_models_that_stand_apart_are_joined(tmp_path, shared):
    whole = synthetic_model(tmp_path, 16)
    frames = sorted(whole.reg_frame_ids())
    turn = pycolmap.Rotation3d(np.array([1, 2, 3, 9]) / 95**0.5)
    for name, kept in (("a", frames[:10]), ("b", frames[10 - shared :])):
        part = pycolmap.Reconstruction(whole)
        for frame in set(frames) - set(kept):
            part.deregister_frame(frame)
        if name == "b":
            part.transform(pycolmap.Sim3d(2.5, turn, np.array([1.0, 2.0, 3.0])))
        (tmp_path / name).mkdir()
        part.write(tmp_path / name)
    apart = [str(tmp_path / name) for name in "ab"]
    job = {"apart": apart, "database": tmp_path / "database.db", "images": tmp_path, "models": tmp_path / "joined"}
    worker.join(job | {"threads": 1, "seed": 0})
    joined = pycolmap.Reconstruction(tmp_path / "joined")
    similarity = pycolmap.align_reconstructions_via_proj_centers(joined, whole, 0.01)
    joined.transform(similarity)
    assert joined.num_reg_images() == 16
    for number in frames:
        ours, true = joined.frame(number).rig_from_world, whole.frame(number).rig_from_world
        assert np.allclose(ours.matrix(), true.matrix(), atol=1e-3)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", (1280.0, 512.0, 384.0, 0.05)),
        ("OPENCV", (1280.0, 1240.0, 512.0, 384.0, 0.05, 0.1, 0.01, 0.01)),
    ],
)
def test_a_lens_gets_the_parameters_that_held_out_tracks_confirm(tmp_path, model, params):
    made = synthetic_model(tmp_path, 30, model, params)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, made)
    for camera in made.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [1270.0, 512.0, 384.0, 0.04]
    (tmp_path / "model").mkdir()
    made.write(tmp_path / "model")
    worker.refine_lenses({"model": tmp_path / "model", "models": tmp_path / "refined", "views": 30})
    [camera] = pycolmap.Reconstruction(tmp_path / "refined").cameras.values()
    assert camera.model.name == model
    if model == "OPENCV":
        assert camera.params[:2] == pytest.approx(params[:2], rel=2e-3)
