"""Faulty photographs are named with their fault, and no others: by pixels, by tracks, by what a run renders."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import tiny
import torch
from budgets import budget
from PIL import Image, ImageFilter, ImageOps
from views import FOCAL, HEIGHT, WALL, WIDTH, between, look_at, pattern, write_views

from lumigraph import methods
from lumigraph.commands.cli import main
from lumigraph.datasets.images import ImageStore
from lumigraph.evaluation.photographs import RESULT_FILE, compare_all, examine, examined, rendered
from lumigraph.evaluation.report import write_report
from lumigraph.methods.lumigraph import Lumigraph
from lumigraph.metrics import psnr
from lumigraph.opening import read_capture
from lumigraph.sfm.coverage import coverage
from lumigraph.sfm.doctor import LACKING, Finding, Residual, deviations, findings, grouped, of_residuals
from lumigraph.training import fit

pytestmark = budget("capture", 8)

TURN = np.radians(5)
TURNED = np.array([[np.cos(TURN), 0, np.sin(TURN)], [0, 1, 0], [-np.sin(TURN), 0, np.cos(TURN)]])


def drawn_capture(folder: Path) -> Path:
    """Twelve photographs of a corner with transforms.json and a COLMAP model, all of which agree."""
    poses = write_views(folder / "images")
    random = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2])
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    points, colours = [], []
    for axis in range(3):
        uv = random.uniform(0.02 * WALL, 0.7 * WALL, (150, 2))
        points.append(np.insert(uv, axis, 0.0, axis=1))
        colours.append(between(pattern(axis), *(uv / WALL * (len(pattern(axis)) - 1)).T))
    tracks = defaultdict(list)
    for number, (name, pose) in enumerate(poses.items(), 1):
        inward = (np.concatenate(points) - pose[:, 3]) @ pose[:, :3]
        xy = FOCAL * inward[:, :2] / inward[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        shown = np.flatnonzero((inward[:, 2] > 0) & (xy >= 0).all(-1) & (xy < (WIDTH, HEIGHT)).all(-1))
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy[k]) for k in shown])
        whole = np.concatenate([pose, [[0, 0, 0, 1]]])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(whole)[:3]))
        for i, k in enumerate(shown.tolist()):
            tracks[k].append((number, i))
    for k, elements in tracks.items():
        track = pycolmap.Track()
        for element in elements:
            track.add_element(*element)
        model.add_point3D(np.concatenate(points)[k], track, np.concatenate(colours)[k].round().astype(np.uint8))
    (folder / "sparse/0").mkdir(parents=True)
    model.write_binary(folder / "sparse/0")
    write_transforms(folder, poses)
    return folder


def write_transforms(folder: Path, poses: dict[str, np.ndarray]) -> None:
    frames = []
    for name, pose in poses.items():
        matrix = np.concatenate([pose * [1, -1, -1, 1], [[0, 0, 0, 1]]])
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Path:
    """A capture without faults, until the first test spoils it."""
    return drawn_capture(tmp_path_factory.mktemp("doctor") / "corner")


def spoiled(folder: Path) -> dict[str, str]:
    """Spoil four photographs of a drawn capture; gives name and fault of each."""
    images = folder / "images"
    for name, change in (
        ("view02.jpg", lambda image: image.filter(ImageFilter.GaussianBlur(6))),
        ("view05.jpg", ImageOps.mirror),
        ("view07.jpg", lambda image: Image.fromarray(pattern(20, 512).astype(np.uint8)).resize(image.size)),
    ):
        with Image.open(images / name) as image:
            changed = change(image.convert("RGB"))
        changed.save(images / name, quality=95)
    poses = {Path(shot.name).name: shot.pose.copy() for shot in read_capture(folder).shots}
    poses["view09.jpg"][:, :3] @= TURNED
    write_transforms(folder, poses)
    return {
        "view02.jpg": "blurred",
        "view05.jpg": "mirrored",
        "view07.jpg": "shows something else",
        "view09.jpg": "placed badly",
    }


def test_spoiled_photographs_are_named_and_no_others(clean, capsys):
    assert findings(read_capture(clean)) == []
    expected = spoiled(clean)
    found = findings(read_capture(clean))
    assert {finding.photograph: finding.fault for finding in found} == expected and len(found) == 4
    turned = next(finding for finding in found if finding.photograph == "view09.jpg")
    assert "100 % of its tracks disagree" in turned.evidence and "lumigraph capture" in turned.advice
    assert f"mv {clean / 'images/view05.jpg'}" in str(found)
    assert main(["info", str(clean)]) == 0
    out = capsys.readouterr().out
    assert all(f"{name}: " in out for name in expected) and "shows something else" in out


def test_photographs_without_a_pose_come_from_the_report_of_the_capture(clean):
    path = clean / "capture.json"
    path.write_text(json.dumps({"left_out": {"a.jpg": "shares too few details"}}))
    first = findings(read_capture(clean))[0]
    path.unlink()
    assert (first.photograph, first.fault, first.evidence) == ("a.jpg", "left out", "shares too few details")


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    """A run that has learnt the ball, and its scene with three training photographs spoiled afterwards."""
    scene = tiny.scene()
    run = tiny.new_run(tmp_path_factory.mktemp("doctor") / "ball")
    fit(run.new_method(), scene, run, steps=60, show=False, rehearsal=False)
    pictures = [scene.images[i].byte().numpy() for i in range(len(scene))]
    pictures[1] = pictures[1][:, ::-1].copy()
    pictures[6] = np.full_like(pictures[6], 255)
    pictures[6][::2, :, :3] = 0
    pose = scene.cameras.pose.clone()
    pose[10, :, :3] = pose[10, :, :3] @ torch.from_numpy(TURNED).float()
    cameras = replace(scene.cameras, pose=pose)
    return run, scene, replace(scene, images=ImageStore.from_arrays(pictures), cameras=cameras)


def test_a_run_names_photographs_that_it_cannot_render(learnt):
    run, scene, wrong = learnt
    method = run.method()
    assert of_residuals([one.residual for one in compare_all(method, scene)], (), set()) == []
    faults = defaultdict(set)
    for finding in of_residuals([one.residual for one in compare_all(method, wrong)], (), set()):
        faults[finding.photograph].add(finding.fault)
    assert faults == {"ball_1": {"mirrored"}, "ball_6": {"rendered badly"}, "ball_10": {"rendered badly"}}


def test_clouds_are_compared_at_the_size_of_the_photographs():
    """Small pictures of Gaussians are means of whole ones; drawn small, Gaussians would be wider."""
    scene = tiny.scene()
    method = methods.find("gaussian-splatting")(scene.frame)
    shot, camera, seen = rendered(method, scene, 3, int(scene.cameras.size.max()) / 4)
    whole = method.render(scene.cameras[3])
    height, width = (n // 4 for n in whole.depth.shape)
    means = whole.rgb[: 4 * height, : 4 * width].view(height, 4, width, 4, 3).mean((1, 3))
    assert shot.rgb.shape == seen.rgb.shape == (height, width, 3) and camera.size.tolist() == [[width, height]]
    torch.testing.assert_close(seen.rgb, means)
    assert not torch.allclose(seen.rgb, method.render(camera).rgb, atol=1e-3)


def test_photographs_that_a_method_shows_themselves_are_compared_without_aliasing():
    """A lumigraph shows each photograph at its camera: reduced, it is the reduced photograph."""
    scene = tiny.scene()
    method = Lumigraph(scene.frame, replace(Lumigraph.smallest(), geometry="plane")).eval()
    method.begin(scene)
    shot, _, seen = rendered(method, scene, 3, int(scene.cameras.size.max()) / 4)
    assert psnr(seen.rgb, shot.before(scene.frame.background)) > 45


def test_the_worst_photographs_stand_in_the_report(learnt):
    run, _, wrong = learnt
    found = examine(run, run.method(), wrong).findings
    checked = examined(run)
    assert checked is not None and checked.findings == found and len(checked.residuals) == len(wrong)
    page = write_report(run).read_text()
    assert "Photographs to look at" in page and "ball_10" in page and "mirrored" in page
    asked = [
        "numbers to learn",
        "model",
        "of a photograph",
        "of training",
        "PSNR of training",
        "Photographs to",
        "Settings",
    ]
    places = [page.index(f">{words}") for words in asked]
    assert places == sorted(places)
    assert (run.folder / RESULT_FILE).exists()


def test_depth_that_floats_is_a_fault():
    """Depth is a photograph's fault only if its rendering is worse than the others; otherwise it is the run's."""
    psnr = {"b": 21.5} | dict.fromkeys("acdefgh", 25.0)
    rows = [Residual(name, "train", x, 10.0, 0.6 if name in "ab" else 0.0) for name, x in psnr.items()]
    [finding] = of_residuals(rows, (), set())
    assert (finding.photograph, finding.fault) == ("b", "contradicts depth") and "60 %" in finding.evidence


def test_deviations_are_robust():
    values = np.array([20.0, 20.1, 19.9, 20.2, 19.8, 5.0])
    assert deviations(values, 1.0)[-1] == pytest.approx(14.95) and deviations(values, 1.0)[:-1].max() < 0.2


def ring(degrees: np.ndarray, height: float | np.ndarray) -> np.ndarray:
    turns = np.radians(degrees)
    eyes = np.stack([3 * np.cos(turns), 3 * np.sin(turns), np.broadcast_to(height, turns.shape)], -1)
    return np.stack([look_at(eye, np.zeros(3)) for eye in eyes])


def test_lacking_directions_are_advised():
    degrees = np.arange(-130, 135, 20.0)  # the first photograph is the middle of what lies opposite the gap
    names = [f"{i}.jpg" for i in range(len(degrees))]
    around = coverage(["front.jpg", *names], ring(np.array([0.0, *degrees]), np.array([1.5] + [0.0, 1.5] * 7)))
    assert around.degrees == pytest.approx(260) and around.elevations == pytest.approx((0.0, 26.6), abs=0.1)
    assert around.advice == ["4 more from behind, a step lower: between 13.jpg and 0.jpg"] and len(around.places) == 4
    assert all(x < 0 and np.hypot(x, y) > 2 for x, y, _ in around.places)
    flat = coverage(names, ring(np.arange(0, 360, 360 / len(names)), 0.5))
    assert len(flat.advice) == 1 and "a second round of 12 photographs, a step higher" in flat.advice[0]
    assert all(z > 1 for _, _, z in flat.places)


def test_lacking_directions_are_findings(clean):
    capture = read_capture(clean)
    poses = ring(np.linspace(0, 260, len(capture.shots)), 0.5)
    shots = [replace(shot, pose=pose) for shot, pose in zip(capture.shots, poses, strict=True)]
    found = [f for f in findings(replace(capture, shots=shots), {}) if f.fault == LACKING]
    assert len(found) == 2 and all(f.photograph == "" and isinstance(f, Finding) for f in found)
    assert "260 of 360 degrees" in found[0].evidence and "between view11.jpg and view00.jpg" in found[0].advice


def test_photographs_with_the_same_fault_stand_in_one_line():
    found = [Finding(name, "left out", "in another group of 2", "retake it") for name in ("a.jpg", "b.jpg")]
    found += [Finding("c.jpg", "left out", "black", "retake it"), Finding("", "floaters", "3 of 9", "")]
    assert grouped(found) == {
        "left out": ["a.jpg, b.jpg: in another group of 2; retake it", "c.jpg: black; retake it"],
        "floaters": ["3 of 9"],
    }
    around = [Finding("", LACKING, "half is covered", f"{side} more") for side in ("one", "two")]
    assert grouped(around) == {LACKING: ["half is covered; one more", "two more"]}
