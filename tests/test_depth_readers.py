"""Readers of depth cameras: layouts written to a folder and read back."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.methods.tsdf_fusion import TSDFFusion
from lumigraph.opening import open_scene, read_capture
from lumigraph.readers import choose_reader

SIZE = (40, 30)
OPENGL = np.diag([1.0, -1, -1, 1])


def poses(count: int = 3) -> list[np.ndarray]:
    """Cameras side by side, OpenCV axes, one a little turned."""
    found = []
    for i in range(count):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(0.1 * i), -np.sin(0.1 * i)], [np.sin(0.1 * i), np.cos(0.1 * i)]]
        turn[:3, 3] = 0.2 * i, 0.1, -0.3
        found.append(turn)
    return found


def picture(path: Path, size: tuple[int, int] = SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((size[1], size[0], 3), 90, np.uint8)).save(path)


def depth(path: Path, per_metre: float, size: tuple[int, int] = SIZE) -> None:
    """A wall at 2 m, the first pixel not measured."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.full((size[1], size[0]), round(2 * per_metre), np.uint16)
    values[0, 0] = 0
    Image.fromarray(values).save(path)


def write_replica(folder: Path) -> None:
    lines = [" ".join(map(str, pose.ravel())) for pose in poses()]
    folder.mkdir()
    (folder / "traj.txt").write_text("\n".join(lines))
    camera = {"w": 40, "h": 30, "fx": 35.0, "fy": 35.0, "cx": 19.5, "cy": 14.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    for i in range(3):
        picture(folder / "results" / f"frame{i:06d}.jpg")
        depth(folder / "results" / f"depth{i:06d}.png", 6553.5)


def write_scannet(folder: Path) -> None:
    frames = folder / "frames"
    for i, pose in enumerate(poses()):
        picture(frames / "color" / f"{i}.jpg")
        depth(frames / "depth" / f"{i}.png", 1000, (20, 15))
        (frames / "pose").mkdir(exist_ok=True)
        np.savetxt(frames / "pose" / f"{i}.txt", pose)
    np.savetxt(frames / "pose" / "3.txt", np.full((4, 4), -np.inf))
    picture(frames / "color" / "3.jpg")
    (frames / "intrinsic").mkdir()
    camera = np.eye(4)
    camera[:2, :3] = [[35, 0, 19.5], [0, 35, 14.5]]
    np.savetxt(frames / "intrinsic" / "intrinsic_color.txt", camera)


def write_polycam(folder: Path) -> None:
    for i, pose in enumerate(poses()):
        name = f"100{i}"
        picture(folder / "keyframes" / "corrected_images" / f"{name}.jpg")
        depth(folder / "keyframes" / "depth" / f"{name}.png", 1000, (20, 15))
        rows = (pose @ OPENGL)[:3]
        said = {f"t_{r}{c}": rows[r, c] for r in range(3) for c in range(4)}
        said |= {"fx": 35.0, "fy": 35.0, "cx": 20.0, "cy": 15.0, "width": 40, "height": 30, "blur_score": 9.0}
        path = folder / "keyframes" / "corrected_cameras" / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(said))


def write_record3d(folder: Path) -> None:
    listed = []
    for i, pose in enumerate(poses()):
        picture(folder / "rgbd" / f"{i}.jpg")
        values = np.full((15, 20), 2.0, np.float32)
        values[0, 0] = np.nan
        (folder / "rgbd" / f"{i}.depth").write_bytes(values.tobytes())
        turn = (pose @ OPENGL)[:3, :3]
        half = 0.05 * i  # about z, after half a turn about x
        quaternion = [np.cos(half), np.sin(half), 0.0, 0.0]
        x, y, z, w = quaternion
        assert np.allclose(turn[:2, 0], [1 - 2 * (y * y + z * z), 2 * (x * y + z * w)])
        listed.append([*quaternion, *pose[:3, 3]])
    said = {"w": 40, "h": 30, "dw": 20, "dh": 15, "K": [35, 0, 0, 0, 35, 0, 20, 15, 1], "poses": listed, "fps": 60}
    (folder / "metadata.json").write_text(json.dumps(said))


WRITERS = {"nice_slam": (write_replica, write_scannet), "phones": (write_polycam, write_record3d)}
EVERY = [(reader, write) for reader, writers in WRITERS.items() for write in writers]


@pytest.mark.parametrize(("reader", "write"), EVERY, ids=[write.__name__ for _, write in EVERY])
def test_a_layout_reads_back(reader, write, tmp_path, monkeypatch):
    """Poses to OpenCV's axes, one centre and focal length, depth along the axis in metres, unknown where it is."""
    unpacker = SimpleNamespace(decompress=lambda data: data, error=RuntimeError)
    monkeypatch.setitem(sys.modules, "liblzfse", unpacker)
    write(tmp_path / "scan")
    assert choose_reader(tmp_path / "scan").__name__.endswith(reader)
    capture = read_capture(tmp_path / "scan")
    assert len(capture.shots) == 3
    for shot, pose in zip(capture.shots, poses(), strict=True):
        np.testing.assert_allclose(shot.pose, pose[:3], atol=1e-6)
        torch.testing.assert_close(shot.lens.focal, torch.tensor([[35.0, 35.0]]), check_dtype=False)
        torch.testing.assert_close(shot.lens.centre, torch.tensor([[20.0, 15.0]]), check_dtype=False)
    scene = open_scene(tmp_path / "scan")
    photograph = scene.photograph(0, ("depth",))
    camera, measured = photograph.camera, photograph.extra["depth"]
    known = measured.isfinite()
    assert not known[0, 0] and float(known.float().mean()) > 0.99
    points = camera.rays(camera.pixels()).at(measured.nan_to_num().flatten())
    along = ((points - camera.position) * camera.forward).sum(-1)[known.flatten()] * scene.frame.to_source.scale
    torch.testing.assert_close(along, torch.full_like(along, 2.0), atol=2e-3, rtol=0)


def write_confidence(folder: Path, app: str) -> Path:
    """A capture of a phone whose confidence is low above, medium in the middle, high below."""
    levels = np.repeat(np.array([0, 1, 2], np.uint8), 5)[:, None].repeat(20, 1)
    if app == "record3d":
        write_record3d(folder)
        for i in range(3):
            (folder / "rgbd" / f"{i}.conf").write_bytes(levels.tobytes())
        return folder
    write_polycam(folder)
    (folder / "keyframes" / "confidence").mkdir()
    for i in range(3):
        grey = np.array([0, 54, 255], np.uint8)[levels] if app == "polycam" else levels
        Image.fromarray(grey).save(folder / "keyframes" / "confidence" / f"100{i}.png")
    return folder


@pytest.mark.parametrize("app", ["record3d", "polycam", "arkit"])
def test_confidence_of_phones_is_a_mask_and_a_deviation(app, tmp_path, monkeypatch):
    """The lowest is unknown; medium depth deviates three times as much as sure depth, and is fused with a ninth of its
    weight."""
    unpacker = SimpleNamespace(decompress=lambda data: data, error=RuntimeError)
    monkeypatch.setitem(sys.modules, "liblzfse", unpacker)
    scene = open_scene(write_confidence(tmp_path / "scan", app))
    photograph = scene.photograph(1, ("depth", "depth_deviation"))
    measured, deviation = photograph.extra["depth"], photograph.extra["depth_deviation"]
    assert not measured[:10].isfinite().any() and measured[10:].isfinite().float().mean() > 0.99
    share = deviation / measured
    torch.testing.assert_close(share[11:20, 1:], torch.full((9, 39), 0.03), atol=1e-3, rtol=0)
    torch.testing.assert_close(share[21:, 1:], torch.full((9, 39), 0.01), atol=1e-3, rtol=0)
    method = TSDFFusion(scene.frame, TSDFFusion.smallest())
    fused = []
    monkeypatch.setattr(method, "_fuse", lambda seen, sure: fused.append(sure))
    method.step(method.batch(scene, torch.Generator()), 0, lambda terms: None)
    torch.testing.assert_close(fused[0][15, 5] * 9, fused[0][25, 5], atol=1e-3, rtol=0)


def test_confidence_of_another_size_is_named(tmp_path):
    folder = write_confidence(tmp_path / "scan", "polycam")
    Image.fromarray(np.zeros((5, 5), np.uint8)).save(folder / "keyframes" / "confidence" / "1001.png")
    with pytest.raises(LumigraphError, match="confidence"):
        open_scene(folder).photograph(1, ("depth",))


def test_what_is_wrong_with_a_layout_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    write_record3d(tmp_path / "phone")
    with pytest.raises(LumigraphError, match="pip install 'lumigraph\\[record3d\\]'"):
        open_scene(tmp_path / "phone").photograph(0, ("depth",))
    write_replica(tmp_path / "replica")
    (tmp_path / "replica" / "results" / "frame000001.jpg").unlink()
    assert read_capture(tmp_path / "replica").missing == ["results/frame000001"]
    (tmp_path / "replica" / "traj.txt").write_text("1 2 3\n")
    with pytest.raises(LumigraphError, match="line 1, is no 4x4 matrix"):
        read_capture(tmp_path / "replica")
    (tmp_path / "replica" / "cam_params.json").unlink()
    with pytest.raises(LumigraphError, match=r"has no cam_params\.json"):
        read_capture(tmp_path / "replica")


def test_depth_of_another_shape_is_named(tmp_path):
    write_scannet(tmp_path / "scan")
    depth(tmp_path / "scan" / "frames" / "depth" / "1.png", 1000, (20, 20))
    with pytest.raises(LumigraphError, match="its shape 20x20 is not the photograph's"):
        open_scene(tmp_path / "scan").photograph(1, ("depth",))


def write_tum(folder: Path, moments: list[float]) -> None:
    """Lists of files and poses, whose moments a user gives in any order."""
    folder.mkdir()
    for i in range(3):
        picture(folder / "rgb" / f"{i}.png")
        depth(folder / "depth" / f"{i}.png", 5000)
    for kind in ("rgb", "depth"):
        lines = [f"{moment} {kind}/{i}.png" for i, moment in enumerate(moments)]
        (folder / f"{kind}.txt").write_text("# timestamp filename\n" + "\n".join(lines))
    rows = [f"{i}.0 {0.1 * i} 0 0 0 0 0 1" for i in range(3)]
    (folder / "groundtruth.txt").write_text("\n".join(rows))


def test_moments_that_go_back_are_said_and_paired(tmp_path):
    write_tum(tmp_path / "scan", [0.0, 2.0, 1.0])
    capture = read_capture(tmp_path / "scan")
    assert [shot.pose[0, 3] for shot in capture.shots] == pytest.approx([0.0, 0.2, 0.1])
    (note,) = capture.notes
    assert "moments go back 1 times" in note and "paired by the nearest moment" in note


def test_missing_frames_are_said_and_the_others_used(tmp_path):
    write_tum(tmp_path / "scan", [0.0, 1.0, 2.0])
    (tmp_path / "scan" / "rgb" / "1.png").unlink()
    (tmp_path / "scan" / "depth" / "2.png").unlink()
    with pytest.warns(LumigraphWarning, match="lists 2 files that do not exist; using the other 2 photographs"):
        scene = open_scene(tmp_path / "scan")
    assert len(scene) == 2 and len(scene.layers["depth"]) == 1
    with pytest.raises(LumigraphError, match="no depth for rgb/2.png; tracking needs"):
        open_scene(tmp_path / "scan", unposed={})
