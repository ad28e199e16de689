"""Whatever a file says, it opens or is refused in one sentence: every value of every small file, changed in turn."""

from __future__ import annotations

import gzip
import importlib
import json
import math
import re
import shutil
import struct
import time
import types
import warnings
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from PIL import Image

from lumigraph import files
from lumigraph.camera.lens import Equirectangular, Fisheye, Lens, OpenCV, Pinhole, mix
from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation.report import header
from lumigraph.exchange import read_gaussians
from lumigraph.files.ranges import hints
from lumigraph.metrics import scores_of
from lumigraph.opening import open_scene
from lumigraph.paths.keyframes import CameraPath
from lumigraph.readers import blender
from lumigraph.readers import transforms as transforms_reader
from lumigraph.readers.assemble import checked_pose
from lumigraph.readers.capture import Capture, Shot
from lumigraph.readers.meshes import read_shape
from lumigraph.readers.oddities import oddities
from lumigraph.run import Run
from lumigraph.run.composition import read_composition
from lumigraph.sfm.folder import claim
from lumigraph.sfm.stages import Stages

pytestmark = budget("capture", 10)

NESTED: Any = None
for _ in range(200):
    NESTED = [NESTED]
WRONG = {
    "null": None,
    "text": "text",
    "minus": -1,
    "far": 1e300,
    "list": [],
    "object": {},
    "digits": 10**400,
    "nested": NESTED,
    "NUL": "a\0b",
}


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The way to every value inside a value of JSON; of lists the first and the last."""
    keys = list(value) if isinstance(value, dict) else sorted({0, len(value) - 1}) if isinstance(value, list) else []
    for key in keys if value else []:
        yield (*path, key)
        yield from places(value[key], (*path, key))


def changed(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """A copy with one value replaced."""
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = changed(value[path[0]], path[1:], new)
    return copy


def mutations(said: Any) -> Iterator[tuple[str, bytes]]:
    """Every value replaced by every wrong one, every key left out, and the text cut short; with what was done."""
    text = json.dumps(said).encode()
    for path in places(said):
        for name, new in WRONG.items():
            yield f"{path} {name}", json.dumps(changed(said, path, new)).encode()
        *outer, last = path
        if isinstance(last, str):
            inner = said
            for key in outer:
                inner = inner[key]
            yield (
                f"{path} left out",
                json.dumps(changed(said, tuple(outer), {k: v for k, v in inner.items() if k != last})).encode(),
            )
        yield f"{path} NaN", json.dumps(changed(said, path, math.nan)).encode()
    yield from ((f"cut at {at}", text[:at]) for at in range(0, len(text), max(len(text) // 5, 1)))
    yield "not text", b"\xff\xfe" + text


def try_all(file: Path, opened: Callable[[], object], every: int = 1) -> int:
    """Open with each mutation of a file in turn; how many were refused. Anything but a sentence fails."""
    whole, refused = file.read_bytes(), 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        opened()
        for number, (what, data) in enumerate(mutations(json.loads(whole))):
            if number % every:
                continue
            file.write_bytes(data)
            try:
                opened()
            except LumigraphError as error:
                assert "\n" not in str(error), f"{file.name}: {what}: {error}"
                refused += 1
            except Exception as error:
                raise AssertionError(f"{file.name}: {what}: {type(error).__name__}: {error}") from error
    file.write_bytes(whole)
    return refused


EVALUATION = {
    "psnr": 20.0,
    "ssim": 0.5,
    "lpips": None,
    "by_resolution": {"24x24": {"psnr": 20.0, "ssim": 0.5, "lpips": None, "views": 3}},
    "protocol": {"split": "test", "views": 3, "of": 3, "resolution": "24x24", "background": [1, 1, 1], "masked": False},
    "seconds_per_view": 0.1,
    "views": [{"name": "a", "resolution": "24x24", "psnr": 20.0, "ssim": 0.5, "seconds": 0.1, "lpips": None}] * 2,
    "scores": [{"name": "PSNR", "value": 20.0, "unit": "dB", "better": "higher", "digits": 2}],
    "steps": 60,
    "evaluated_on": "cpu",
}


@pytest.fixture
def run(ball_run, tmp_path) -> Run:
    return Run(shutil.copytree(ball_run.folder, tmp_path / "ball"))


def look_at(run: Run) -> None:
    """What commands ask of a run."""
    opened = Run(run.folder)
    opened.method()
    opened.cameras()["train"][0].resized(0.2).rays(torch.zeros(1, 2))
    opened.view_names()
    str(opened.frame.to_source.inverse.scale)
    opened.settings.to_json()


def test_config_json(run):
    assert try_all(run.folder / "config.json", lambda: look_at(run)) > 200


def test_cameras_json(run):
    assert try_all(run.folder / "cameras.json", lambda: (run.cameras(), run.view_names())) > 100


def resume(run: Run) -> None:
    method = run.method()
    optimizers = method.optimizers()
    run.restore_training(optimizers, torch.Generator())
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.zeros_like(parameter)
        optimizer.step()
    str(run.state)


def test_state_json(run):
    (file,) = run.folder.glob("checkpoints/*/state.json")
    assert try_all(file, lambda: resume(run), every=3) > 100


def test_eval_json(run):
    files.write_json(run.folder / "eval.json", EVALUATION, ours=True)

    def shown() -> None:
        said = run.evaluation()
        header(run, said)
        [[str(score) for score in scores_of(part)] for part in (said, *said.get("views", ()))]

    assert try_all(run.folder / "eval.json", shown) > 50


def test_damaged_metrics_are_passed_over(run):
    row = {"step": 5, "seconds": 1.0, "terms": {"a": 0.5}, "psnr": 10.0, "statistics": {"rays": 5.0}, "mean_loss": 0.1}
    lines = [data for _, data in mutations(row)]
    before = run.metrics()
    with open(run.folder / "metrics.jsonl", "ab") as file:
        file.write(b"\n".join([*lines, json.dumps(row).encode()]) + b"\n")
    rows = run.metrics()
    assert rows[: len(before)] == before and rows[-1] == row and len(rows) < len(before) + len(lines) / 2
    run.forget_after(4)


def test_camera_paths_and_compositions(tmp_path):
    pose = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    keys = [{"pose": pose, "fov": 50.0, "seconds": 0.0}, {"pose": pose, "fov": 50.0, "seconds": 1.0}]
    path = tmp_path / "path.json"
    files.write_json(
        path, {"format": "lumigraph camera path 1", "keyframes": keys, "loop": False, "fps": 30.0}, ours=True
    )
    fly = lambda: CameraPath.load(path).cameras(Frame(), (16, 16), 3)  # noqa: E731
    assert try_all(path, fly) > 50
    lens = Pinhole(torch.full((2, 2), 20.0), torch.full((2, 2), 8.0)).to_json()
    film = {"poses": [pose, pose], "lens": lens, "size": [16, 16], "fps": 30.0, "times": [0.0, 1.0]}
    files.write_json(path, {**film, "source_from_scene": [*pose, [0, 0, 0, 1]]}, ours=True)
    assert try_all(path, fly) > 50
    place = {"scale": 0.3, "rotation": [1, 0, 0, 0], "translation": [0.5, 0, -0.4]}
    parts = [
        {"source": "a.ply", "place": place, "box": [[-1, -1, 0], [1, 1, 1]]},
        {"source": "b", "place": [*pose, [0, 0, 0, 1]]},
    ]
    files.write_json(path, {"format": "lumigraph composition 1", "lead": 0, "parts": parts}, ours=True)
    assert try_all(path, lambda: read_composition(path)) > 50


def judged(capture: Capture) -> None:
    """All that is looked at before pictures are read."""
    if not capture.shots:
        raise LumigraphError("nothing is listed that exists")
    poses = np.stack([checked_pose(shot, capture.source) for shot in capture.shots])
    assert poses.shape[1:] == (3, 4) and all(shot.lens.fault() is None for shot in capture.shots)
    oddities(capture, capture.shots, poses)


def opaque(folder: Path) -> Path:
    """A folder whose photographs say nothing of opacity, for scenes without silhouettes open in no time."""
    for path in folder.glob("*.png"):
        Image.open(path).convert("RGB").save(path)
    return folder


def transforms(folder: Path, **more: Any) -> Path:
    """Three photographs as nerfstudio would list them."""
    said = json.loads((opaque(tiny.write_blender(folder)) / "transforms_train.json").read_text())
    said |= {"w": 24, "h": 24, "fl_x": 32.0, "fl_y": 32.0, "cx": 12.0, "cy": 12.0, "k1": 0.01, "camera_model": "OPENCV"}
    said |= {
        "up": [0, 0, 1],
        "aabb_scale": 4,
        "frames": [frame | {"time": 0.5} for frame in said["frames"][:3]],
        **more,
    }
    for name in ("train", "test"):
        (folder / f"transforms_{name}.json").unlink()
    files.write_json(folder / "transforms.json", said, ours=True)
    return folder


def test_transforms_json(tmp_path):
    folder = transforms(tmp_path / "scene")
    assert try_all(folder / "transforms.json", lambda: judged(transforms_reader.read(folder))) > 200
    assert try_all(folder / "transforms.json", lambda: open_scene(folder), every=60) > 3


def test_blender_transforms(ball_folder, tmp_path):
    folder = opaque(Path(shutil.copytree(ball_folder, tmp_path / "ball")))
    file = folder / "transforms_test.json"
    said = json.loads(file.read_text())
    files.write_json(file, said | {"frames": said["frames"][:1]}, ours=True)
    assert try_all(file, lambda: judged(blender.read(folder))) > 40


def test_files_of_captures(tmp_path):
    photos, work = tmp_path / "photos", tmp_path / "scene" / "work"
    photos.mkdir()
    claim(tmp_path / "scene", [photos])
    assert try_all(work / "sources.json", lambda: claim(tmp_path / "scene", [photos])) > 10
    Stages(work).mark("features", "key", True, 1.0)
    assert try_all(work / "stages.json", lambda: Stages(work).seconds()) > 20


@pytest.mark.parametrize("kind", ["pinhole", "opencv", "fisheye", "equirectangular", "mixed"])
def test_lenses(kind, tmp_path):
    two, eight = torch.full((2, 2), 20.0), torch.zeros(2, 8)
    lenses = {
        "pinhole": Pinhole(two, two),
        "opencv": OpenCV(two, two, eight),
        "fisheye": Fisheye(two, two, eight[:, :4]),
        "equirectangular": Equirectangular(two),
        "mixed": mix([Pinhole(two[:1], two[:1]), Equirectangular(two[:1])]),
    }
    files.write_json(tmp_path / "lens.json", lenses[kind].to_json(), ours=True)
    assert (
        try_all(
            tmp_path / "lens.json",
            lambda: Lens.from_json(files.read_json(tmp_path / "lens.json")).resized(torch.ones(1, 2)),
        )
        > 20
    )


def unions(kind: Any) -> Iterator[tuple[Any, ...]]:
    """The members of every union within an annotation."""
    if get_origin(kind) in (Union, types.UnionType):
        yield get_args(kind)
    for inner in get_args(kind):
        yield from unions(inner)


def test_no_layout_mixes_ranges_and_tuples():
    """On which msgspec 0.22 reads memory that is not its own."""
    rooms = "datasets.scene budget paths.keyframes readers.transforms run.settings run.composition run.records"
    found = 0
    for room in rooms.split():
        module = importlib.import_module(f"lumigraph.{room}")
        for layout in (x for x in vars(module).values() if isinstance(x, type) and is_dataclass(x)):
            for members in (one for kind in hints(layout).values() for one in unions(kind)):
                ranged = any(get_origin(x) is Annotated for x in members)
                fixed = any(get_origin(x) is tuple and Ellipsis not in get_args(x) for x in members)
                assert not (ranged and fixed), f"{layout}: {members}"
                found += 1
    assert found > 20


def test_options_of_a_run_are_those_that_are_known(run):
    said = json.loads((run.folder / "config.json").read_text())
    for options in (
        {"cache": "/tmp/elsewhere"},
        {"downscale": "2"},
        {"downscale": 0},
        {"scales": 10**9},
        {"views": 1.5},
    ):
        files.write_json(run.folder / "config.json", said | {"scene": said["scene"] | {"options": options}}, ours=True)
        with pytest.raises(LumigraphError, match=r"scene\.options"):
            Run(run.folder)


def test_an_optimizer_that_does_not_fit_is_refused(run):
    """Compiled loops would write beyond what it remembers."""
    from safetensors.torch import load_file, save

    from lumigraph.run.checkpoint import checksum

    (folder,) = run.folder.glob("checkpoints/*")
    tensors = load_file(folder / "optimizer.safetensors")
    name = next(name for name, tensor in tensors.items() if tensor.dim() > 1)
    data = save({**tensors, name: torch.zeros(3)})
    (folder / "optimizer.safetensors").write_bytes(data)
    said = json.loads((folder / "state.json").read_text())
    total = checksum(data)
    said["files"]["optimizer.safetensors"] = {"bytes": total.bytes, "crc32": total.crc32}
    files.write_json(folder / "state.json", said, ours=True)
    with pytest.raises(LumigraphError, match="has shape"):
        resume(run)


# Bombs


def test_a_small_file_of_a_hundred_million_gaussians_is_refused_at_once(tmp_path):
    count = 100_000_000
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0)
    path = tmp_path / "bomb.spz"
    path.write_bytes(gzip.compress(header + bytes(1 << 26)))
    begin = time.perf_counter()
    with pytest.raises(LumigraphError, match="Gaussians"):
        read_gaussians(path)
    assert time.perf_counter() - begin < 0.5
    packed = count * 20 // 1000  # as many bytes as zstd would need at the most
    streams = [(packed // 6, count * width) for width in (9, 1, 3, 3, 4)]
    table = b"".join(struct.pack("<QQ", *stream) for stream in streams)
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, len(streams), 32)
    path.write_bytes(head + table + bytes(packed))
    with pytest.raises(LumigraphError, match="no cloud can be packed into"):
        read_gaussians(path)


def test_clouds_that_do_not_fit_are_refused(tmp_path, monkeypatch):
    from lumigraph.exchange import checks

    monkeypatch.setattr(checks, "free_memory", lambda: 10_000)
    (tmp_path / "a.splat").write_bytes(bytes([200]) * 32 * 100)
    with pytest.raises(LumigraphError, match="take .* GB to read"):
        read_gaussians(tmp_path / "a.splat")


@pytest.mark.parametrize("size", [(0, 24), (2**31 - 1, 2**31 - 1), (60000, 60000)], ids=str)
def test_pictures_that_say_they_are_enormous(size, ball_folder, tmp_path):
    folder = Path(shutil.copytree(ball_folder, tmp_path / "ball"))
    path = folder / "train_1.png"
    whole = path.read_bytes()
    path.write_bytes(whole[:16] + struct.pack(">II", *size) + whole[24:])
    with pytest.raises(LumigraphError, match=r"train_1\.png cannot be read as an image"):
        open_scene(folder)


def test_arrays_of_odd_kinds(tmp_path):
    image = np.zeros((8, 8, 3), np.uint8)
    (tmp_path / "images").mkdir()
    for i in range(3):
        Image.fromarray(image).save(tmp_path / f"images/{i}.png")
    path = tmp_path / "poses_bounds.npy"
    head = "{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000, 17), }".ljust(117) + "\n"
    bomb = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode()
    tables = [
        np.zeros((3, 17), "O"),
        np.zeros((3, 17), "U3"),
        np.zeros((3, 17), complex),
        np.zeros(17),
        np.zeros((3, 17)),
    ]
    for table in tables:
        np.save(path, table, allow_pickle=True)
        with pytest.raises(LumigraphError, match="poses_bounds"):
            open_scene(tmp_path)
    path.write_bytes(bomb)
    with pytest.raises(LumigraphError, match="17 numbers"):
        open_scene(tmp_path)


# Absurd, but well-formed


def shots(poses: np.ndarray, focal: float = 32.0, names: list[str] | None = None) -> Capture:
    lens = Pinhole(torch.full((1, 2), focal), torch.full((1, 2), 12.0))
    image = np.zeros((24, 24, 3), np.uint8)
    return Capture(
        "x",
        [
            Shot((names or [f"{i:03d}" for i in range(len(poses))])[i], p, lens, (24, 24), image)
            for i, p in enumerate(poses)
        ],
    )


def around(count: int = 12, turned: bool = False) -> np.ndarray:
    poses = tiny.poses(count).double().numpy()
    if turned:
        poses[:, :, [0, 2]] *= -1
    return poses


ODD = {
    "one pose": (shots(around()[:1].repeat(5, 0)), "one and the same pose"),
    "one place": (shots(around() * [1, 1, 1, 0]), "poses in one place"),
    "a wide unit": (shots(around() * [1, 1, 1, 1e7]), "check the unit"),
    "a small unit": (shots(around() * [1, 1, 1, 1e-7]), "check the unit"),
    "backs": (shots(around(turned=True)), "look away"),
    "a long lens": (shots(around(), focal=1e6), "sees .* degrees"),
    "twice": (shots(around()[:4], names=["a", "a", "b", "c"]), "more than once, such as a"),
}


@pytest.mark.parametrize("what", ODD)
def test_what_cannot_be_meant_is_said(what):
    capture, words = ODD[what]
    (said,) = oddities(capture, capture.shots, np.stack([shot.pose for shot in capture.shots]))
    assert re.search(words, said) and "\n" not in said


def test_sound_captures_are_left_in_peace():
    for capture in (shots(around()), shots(around(40))):
        assert not oddities(capture, capture.shots, np.stack([shot.pose for shot in capture.shots]))


@pytest.mark.parametrize("scale", [1e-30, 1e-7, 1e30, 1e300])
def test_scenes_of_absurd_size_open_or_are_refused(scale, tmp_path):
    folder = transforms(tmp_path / "scene")
    said = json.loads((folder / "transforms.json").read_text())
    for frame in said["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= scale
    files.write_json(folder / "transforms.json", said, ours=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LumigraphWarning)
        try:
            scene = open_scene(folder)
        except LumigraphError as error:
            assert "transforms.json" in str(error) or "units" in str(error)
        else:
            assert scene.warnings and scene.cameras.pose.isfinite().all()


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("fault", ["no width", "no rotation", "far"])
def test_colmap_models_that_cannot_be(fault, text, tmp_path):
    import pycolmap

    place = tmp_path / "sparse" / "0"
    place.mkdir(parents=True)
    (tmp_path / "images").mkdir()
    turn, width, far = (
        "0 0 0 0" if fault == "no rotation" else "1 0 0 0",
        0 if fault == "no width" else 24,
        "1e300" if fault == "far" else "0",
    )
    lines = []
    for i in range(3):
        Image.fromarray(np.zeros((24, 24, 3), np.uint8)).save(tmp_path / f"images/{i}.png")
        lines += [f"{i + 1} {turn} {i} {far} 4 1 {i}.png", ""]
    (place / "cameras.txt").write_text(f"1 PINHOLE {width} 24 32 32 12 12\n")
    (place / "images.txt").write_text("\n".join(lines) + "\n")
    (place / "points3D.txt").write_text("")
    if not text:
        pycolmap.Reconstruction(place).write_binary(place)
        for file in place.glob("*.txt"):
            file.unlink()
        if fault == "no rotation":
            data = bytearray((place / "images.bin").read_bytes())
            data[12:44] = bytes(32)
            (place / "images.bin").write_bytes(data)
    with pytest.raises(LumigraphError, match={"no width": "0x24", "no rotation": "quaternion", "far": "units"}[fault]):
        open_scene(tmp_path)


def test_a_list_longer_than_its_file_takes_no_time(tmp_path):
    from lumigraph.readers.colmap import walk_frames

    assert walk_frames(struct.pack("<Q", 0), tmp_path) == 8
    with pytest.raises(struct.error):
        walk_frames(struct.pack("<Q", 2**40), tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n",
        "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 -2\n",
        "OFF\n3 1 0\n0 0 1e300\n1 0 0\n0 1 0\n3 0 1 2\n",
        "OFF\n1000000000 1 0\n0 0 0\n",
        "ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n0\n",
    ],
    ids=["no such corner", "a corner before the first", "far", "a billion corners", "a PLY of a million million"],
)
def test_meshes_that_cannot_be(text, tmp_path):
    path = tmp_path / f"mesh.{text[:3].lower()}"
    path.write_text(text)
    with pytest.raises(LumigraphError, match=r"mesh\."):
        read_shape(path, "mesh")
