"""Scenes in blocks: where blocks are, tasks that may be called at any time, and the run of all of them as one scene."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from PIL import Image
from proofs import kept
from safetensors.torch import load_file
from streets import crossing_streets, write_street

from lumigraph import methods
from lumigraph.commands.cli import main
from lumigraph.components.training.pose_refinement import PoseRefinement
from lumigraph.composition import Placed
from lumigraph.datasets.images import ImageStore
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation import held_out_poses
from lumigraph.geometry import Similarity, rotated
from lumigraph.large import BlockRun, InBlocks, layout, monitor, open_any, planning, training, worker
from lumigraph.large.plan import Plan, Task
from lumigraph.large.training import Workers
from lumigraph.method import Method
from lumigraph.methods import find
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene, read_capture
from lumigraph.readers import Places, places_of
from lumigraph.run import Run
from lumigraph.run.files import SplatFile
from lumigraph.training import fit
from lumigraph.training.options import BlockOptions, TrainOptions

pytestmark = budget("runs", 25)

STEPS = 6  # of each block


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Path:
    return write_street(tmp_path_factory.mktemp("streets") / "street")


@pytest.fixture(scope="module")
def run(street, tmp_path_factory) -> Path:
    """Three blocks of the street, learnt in this process. Nobody may change it."""
    folder = tmp_path_factory.mktemp("runs") / "street"
    planned(street, folder)
    found = training.conduct(folder, Plan.read(folder / "blocks.json"), Workers(), show=False)
    assert sorted(found.done) == ["0", "1", "2"] and not found.failed and found.signal is None
    return folder


def planned(street: Path, folder: Path, wish: str = "3", method: str = "voxel-grid") -> Plan:
    places = places_of(read_capture(street))
    train, blocks = TrainOptions(steps=3 * STEPS), BlockOptions(wish)
    plan = planning.make_plan(str(street), places, method, find(method).smallest(), train, blocks)
    return planning.begin(folder, plan, places, threads=1)


def places(ground: np.ndarray, forward: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> Places:
    n = len(ground)
    positions = np.concatenate([ground, np.full((n, 1), 2.0)], -1)
    names = [f"{i:04d}.jpg" for i in range(n)]
    return Places(names, ["train"] * n, positions, np.tile(forward, (n, 1)), np.eye(3))


# Where blocks are


@pytest.mark.parametrize("rig", [1, 3])
def test_crossings_and_corners_of_streets_are_found(rig):
    found = layout.find_crossings(crossing_streets(3, 2, 40.0, 2.0, rig))
    expected = np.array([[x, y] for x in (0, 40, 80) for y in (0, 40)])
    away = np.linalg.norm(found[:, None] - expected, axis=-1)
    assert len(found) == 6 and away.min(0).max() < 2.0


def test_two_lanes_are_one_street():
    """A drive along every street once in each direction, as `procedural:city` has it, meets where streets do."""
    found = layout.find_crossings(places_of(read_capture("procedural:city,crossings=6,views=420,size=32")).ground)
    expected = np.array([[x, y] for x in (0, 36, 72) for y in (0, 36)])
    away = np.linalg.norm(found[:, None] - expected, axis=-1)
    assert len(found) == 6 and away.min(0).max() < 5.0


def test_a_survey_flight_and_a_road_have_no_crossings():
    grid = np.stack(np.meshgrid(np.arange(20) * 3.0, np.arange(20) * 3.0), -1).reshape(-1, 2)
    road = np.stack([np.arange(100.0), np.zeros(100)], -1)
    for ground in (grid + 0.2 * np.random.default_rng(0).standard_normal(grid.shape), road):
        assert not len(layout.find_crossings(ground))


@pytest.mark.parametrize("wish", ["auto", "6"])
def test_blocks_hold_every_photograph_and_overlap_by_half_a_radius(wish):
    there = places(crossing_streets(3, 2, 40.0, 2.0, 2))
    blocks = layout.lay_out(there, wish)
    assert len(blocks) == 6
    assert {name for block in blocks for name in block.photographs} == set(there.names)
    for block in blocks:
        flat = np.linalg.norm(there.ground - np.array(block.centre[:2]), axis=-1)
        within = {name for name, distance in zip(there.names, flat, strict=True) if distance <= block.radius}
        assert within <= set(block.photographs)
        looking = {there.names[i] for i in np.flatnonzero(there.ground[:, 0] < block.centre[0])}
        assert set(block.photographs) - within <= looking  # all look along +x
    if wish == "auto":
        a, b = (next(x for x in blocks if np.allclose(x.centre[:2], at, atol=2)) for at in ((0, 0), (0, 40)))
        assert a.radius + b.radius - 40 == pytest.approx(0.5 * a.radius, rel=0.25)


def test_block_files_say_where_blocks_are(tmp_path):
    there, file = places(crossing_streets(2, 2, 40.0, 2.0)), tmp_path / "blocks.json"
    discs = [((0, 0, 0), 15), ((500, 0, 0), 15), ((40, 40, 0), 15)]
    file.write_text(json.dumps({"blocks": [{"centre": c, "radius": r} for c, r in discs]}))
    with pytest.warns(LumigraphWarning) as told:
        blocks = layout.lay_out(there, str(file))
    assert [block.name for block in blocks] == ["0", "2"]
    assert "1 block has fewer than two photographs to learn from and will not be trained: 1" in str(told[0].message)
    assert "are in no block" in str(told[1].message)
    file.write_text(json.dumps({"blocks": [{"centre": [500, 0, 0], "radius": 15}]}))
    with pytest.raises(LumigraphError, match="its blocks are elsewhere"):
        layout.lay_out(there, str(file), "street")


@pytest.mark.parametrize(("wish", "told"), [("100", "too many"), ("nothing.json", "is no number and no file")])
def test_blocks_that_cannot_be(wish, told):
    with pytest.raises(LumigraphError, match=told):
        layout.lay_out(places(np.stack([np.arange(9.0), np.zeros(9)], -1)), wish)


# One block


def test_a_block_is_a_scene_of_its_own_in_the_frame_of_all(street, run):
    whole = open_scene(street)
    held_out = {whole.names[i] for i in whole.splits["test"].tolist()}
    at = whole.frame.to_source.points(whole.cameras.position.double())
    for name in "012":
        block = Run(run / "blocks" / name)
        names = block.view_names()
        assert set(names.get("test", [])) <= held_out and not set(names["train"]) & held_out
        mine = block.frame.to_source.points(block.cameras()["train"].position.double())
        expected = at[[whole.names.index(one) for one in names["train"]]]
        torch.testing.assert_close(mine, expected, atol=1e-4, rtol=0)
        reopened = block.scene()
        assert reopened.names == [shot for shot in whole.names if shot in set(sum(names.values(), []))]


def test_what_is_done_is_skipped_and_what_has_a_state_goes_on_to_the_bit(street, run, tmp_path, monkeypatch):
    planned(street, tmp_path / "again")
    block = tmp_path / "again" / "blocks" / "1"
    with monkeypatch.context() as patch:
        patch.setattr(worker, "fit", partial(fit, pause_at=2))
        assert worker.train_block(block).done is None and Run(block).state.step == 2
    done = worker.train_block(block).done
    assert done and done.steps == STEPS and done.key == Task.read(block).key
    assert weights(block) == weights(run / "blocks" / "1")
    before = listing(block)
    assert worker.train_block(block).done == done and listing(block) == before


def test_a_block_of_another_task_is_refused(run, tmp_path):
    block = shutil.copytree(run / "blocks" / "0", tmp_path / "0")
    said = json.loads((block / "task.json").read_text())
    (block / "task.json").write_text(json.dumps(said | {"seed": 5}))
    with pytest.raises(LumigraphError, match="trained for other settings"):
        worker.train_block(block)
    (block / "done.json").unlink()
    with pytest.raises(LumigraphError, match="holds a run of other settings"):
        worker.train_block(block)


def test_workers_say_where_they_do_not_see_the_folder(tmp_path):
    with pytest.raises(LumigraphError, match="does not see .*storage that all machines share"):
        worker.writable(tmp_path / "elsewhere")


def test_how_far_blocks_are_is_read_from_their_folders(run, tmp_path):
    assert monitor.stand_of(run / "blocks" / "0").state == "done"
    assert monitor.stand_of(tmp_path).state == "waiting"
    block = shutil.copytree(run / "blocks" / "0", tmp_path / "0")
    (block / "done.json").unlink()
    (block / "metrics.jsonl").write_text('{"step": 3, "seconds": 1.5, "psnr": 20.0}\n{"step": 4, "sec')
    assert monitor.stand_of(block) == monitor.Stand("learning", 0.5, 1.5, 20.0)
    watching = monitor.Watching(tmp_path, {"0": block, "1": tmp_path / "1"}, show=False)
    watching.look()
    assert watching.share == 0.25 and "0 of 2 blocks done" in watching.line() and "0 50 %" in watching.line()


# All of them


def test_a_run_in_blocks_opens_as_one_scene(street, run):
    opened = open_any(run)
    assert isinstance(opened, BlockRun) and opened.title == "street"
    whole = open_scene(street)
    cameras, names = opened.cameras(), opened.view_names()
    assert {split: sorted(some) for split, some in names.items()} == {
        split: [whole.names[i] for i in index.tolist()] for split, index in whole.splits.items()
    }
    at = opened.frame.to_source.points(cameras["train"].position.double())
    expected = whole.frame.to_source.points(whole.cameras.position.double())
    torch.testing.assert_close(at, expected[[whole.names.index(one) for one in names["train"]]], atol=1e-4, rtol=0)
    assert float(opened.centres.abs().max()) < 1 and len(opened.radii) == 3
    data = opened.dataset(split="test")
    torch.testing.assert_close(
        data.cameras[data.splits["test"]].position.sort(0).values, cameras["test"].position.sort(0).values,
        atol=1e-5, rtol=0,
    )  # fmt: skip
    seen = opened.method().render(cameras["test"][0])
    assert seen.rgb.shape == (16, 16, 3) and bool(seen.rgb.isfinite().all())


def test_a_run_in_blocks_is_not_converted_as_a_whole(run, tmp_path, capsys):
    assert main(["convert", str(run), "voxel-grid", "--output", str(tmp_path / "new")]) == 2
    assert f"is a run in blocks; convert each by itself: {run / 'blocks' / '0'}" in capsys.readouterr().err


def test_eval_and_render_take_a_run_in_blocks(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "copy")
    assert main(["eval", str(copy), "--views", "2"]) == 0
    assert json.loads((copy / "eval.json").read_text())["psnr"] > 5
    assert main(["render", str(copy), "--frames", "2", "--size", "16", "--path", "interpolate"]) == 0
    assert (copy / "renders" / "interpolate.mp4").exists(), capsys.readouterr().out


def test_blocks_that_have_learnt_nothing_are_left_out_and_named(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "copy")
    shutil.rmtree(copy / "blocks" / "1" / "checkpoints")
    with pytest.warns(LumigraphWarning, match="without 1 of its blocks, which have learnt nothing yet: 1"):
        assert len(open_any(copy).blocks) == 2
    for name in "02":
        shutil.rmtree(copy / "blocks" / name / "checkpoints")
    with pytest.raises(LumigraphError, match="no block that has learnt anything"):
        open_any(copy)


def learnt(street: Path, folder: Path, method: str) -> Path:
    """Two blocks of the street by another method."""
    plan = planned(street, folder, "2", method)
    found = training.conduct(folder, plan, Workers(), show=False)
    assert sorted(found.done) == ["0", "1"]
    return folder


def test_blocks_are_shown_in_one_light_and_known_ones_keep_theirs(street, tmp_path):
    folder = learnt(street, tmp_path / "run", "block-nerf")
    first = training.finish(folder).appearance
    assert sorted(first) == ["0", "1"] and all(len(code) == len(first["0"]) > 0 for code in first.values())
    before = (folder / "blocks.json").read_bytes()
    assert training.finish(folder).appearance == first and (folder / "blocks.json").read_bytes() == before
    assert training.finish(folder, again=["1"]).appearance["0"] == first["0"]
    opened = BlockRun(folder)
    shown = [part.method.shown_in.code.tolist() for part in opened.method().blocks]
    assert shown == [pytest.approx(Plan.read(folder / "blocks.json").appearance[name]) for name in "01"]


def test_clouds_of_blocks_become_one_file(street, tmp_path):
    folder = learnt(street, tmp_path / "run", "gaussian-splatting")
    training.finish(folder)
    opened = BlockRun(folder)
    cloud = opened.method().gaussians()
    every = [opened.placed(block).gaussians() for block in opened.blocks]
    assert 0 < len(cloud) < sum(map(len, every))
    assert len(SplatFile(folder / "cloud.ply").gaussians) == len(cloud)


def test_blocks_with_poses_of_their_own_are_aligned_and_evaluated_so(street, tmp_path, monkeypatch):
    """Cameras of one block have all moved by one similarity, as poses that are learnt with a scene may: its place takes
    them back. Held-out photographs are then found on their left halves."""
    folder, drift = learnt(street, tmp_path / "run", "instant-ngp"), torch.tensor([0.0, 0.0, 0.05])
    monkeypatch.setattr(held_out_poses, "STEPS", 3)  # for each photograph; 200 otherwise
    original = Run.method

    def drifted(run: Run, *told: object) -> Method:
        method = original(run, *told)
        if run.folder.name == "1":
            given = run.cameras()["train"]
            shift = rotated(given.position, drift.expand(len(given), 3)) - given.position + 0.1
            moves = torch.cat([drift.expand_as(shift), shift], -1)
            axes = method.poses.axes[given.image_index]
            method.poses.twist.data[given.image_index] = torch.linalg.solve(axes.mT, moves)
        return method

    monkeypatch.setattr(Run, "method", drifted)
    opened = BlockRun(folder)
    for block, by in zip(opened.blocks, (0.0, 0.1), strict=True):
        part, run = opened.placed(block), opened.runs[block.name]
        given = run.cameras()["train"]
        base = opened.frame.to_source.inverse @ run.frame.to_source
        refined = part.method.refined(given)
        assert float((refined.position - given.position).norm(dim=-1).mean()) >= by
        expected, found = base.points(given.position), part.place.points(refined.position)
        assert float((found - expected).norm(dim=-1).mean()) < (0.005 if by else 0.02) * base.scale
    method, data = opened.method(), opened.dataset(split="test")
    found = held_out_poses.held_out_poses(method, data)
    index = int(data.splits["test"][0])
    camera = found.camera(index)
    assert camera.pose.isfinite().all() and not torch.equal(camera.pose, data.cameras[index].pose)
    assert held_out_poses.pose_scores(method, data) == []


def test_the_pose_of_a_picture_of_blocks_has_a_gradient(ball_run):
    """Two blocks that show the same ball, side by side in a common frame: what they render is found from where it was
    rendered."""
    method, scene = ball_run.method(), tiny.scene()
    places = [Similarity.make(0.5, translation=torch.tensor([0.1, 0.0, 0.0])), Similarity.make(0.5)]
    centres, radii = torch.tensor([[0.3, 0.0, 0.0], [-0.3, 0.0, 0.0]]), torch.tensor([3.0, 3.0])
    both = InBlocks(scene.frame, [Placed(method, place) for place in places], centres, radii)
    both.poses = True
    cameras = scene.cameras.transformed(places[1].matrix)
    pictures = [both.render(cameras[i]).rgb for i in range(len(cameras))]
    images = ImageStore.from_arrays([np.uint8(255 * x.clamp(0, 1).numpy() + 0.5) for x in pictures])
    poses = PoseRefinement(len(scene))
    with torch.no_grad():
        poses.twist[4] = torch.tensor([0.03, -0.02, 0.01, 0.02, -0.01, 0.02])
    said = replace(scene, cameras=poses.refined(cameras), images=images, frame=replace(scene.frame, has_alpha=False))
    found = held_out_poses.held_out_poses(both, said).camera(4)
    said_error, error = (psnr(both.render(x).rgb[:, 12:], pictures[4][:, 12:]) for x in (said.cameras[4], found))
    assert error > said_error + 6, (error, said_error)


# The command


def train(*told: object) -> int:
    return main(["train", "block-nerf", *map(str, told)])


def test_the_command_goes_on_and_refuses_other_settings(street, run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = [street, "--field", "voxel-grid", "--blocks", 2, "--steps", 4, "--output", "big"]
    stop = partial(fit, pause_at=1)
    monkeypatch.setattr(worker, "fit", lambda *given, **more: replace(stop(*given, **more), signal=signal.SIGINT))
    assert train(*told) == 130
    assert "Stopped and saved, 0 of 2 blocks done; the same command goes on" in capsys.readouterr().err
    monkeypatch.setattr(worker, "fit", fit)
    assert train(*told) == 0
    assert all((tmp_path / f"big/blocks/{name}/done.json").exists() for name in "01")
    assert (tmp_path / "big/blocks.png").exists() and "2 blocks of" in capsys.readouterr().err
    told[told.index("--steps") + 1] = 8
    assert train(*told) == 2
    assert "another budget; choose another --output" in capsys.readouterr().err


def test_a_run_in_blocks_resumes_by_its_own_plan(street, run, tmp_path, capsys):
    planned(street, tmp_path / "big")
    assert main(["resume", str(tmp_path / "big"), "--steps", "9"]) == 2
    assert "goes on as it began, so --steps is not for it" in capsys.readouterr().err
    (tmp_path / "big/blocks/2/task.json").unlink()  # as after a kill while the plan was written
    assert main(["resume", str(tmp_path / "big")]) == 0
    assert all(Run(tmp_path / f"big/blocks/{name}").state.step == STEPS for name in "012")


def test_photographs_that_changed_are_noticed_in_blocks_too(street, run, tmp_path):
    moved = shutil.copytree(street, tmp_path / "street")
    picture = next(path for path in sorted(moved.rglob("*")) if path.suffix in (".png", ".jpg"))
    Image.fromarray(255 - np.array(Image.open(picture))).save(picture)
    with pytest.warns(LumigraphWarning, match=f"1 photograph of .* changed since .*{picture.name}"):
        BlockRun(run).dataset(str(moved))


def test_one_block_is_learnt_again_and_the_others_stay(street, run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "copy")
    new = write_street(tmp_path / "new", 24, phase=1.5, length=2.0)
    before = {name: listing(copy / "blocks" / name) for name in "012"}
    told = [new, "--field", "voxel-grid", "--into", copy, "--blocks", 1, "--steps", 5]
    assert train(*told) == 0, capsys.readouterr().err
    assert {name: listing(copy / "blocks" / name) == before[name] for name in "012"} == {
        "0": True,
        "1": False,
        "2": True,
    }
    assert Run(copy / "blocks" / "1").state.step == 5
    assert train(*told) == 0  # there is nothing left to do
    assert main(["eval", str(copy), "--scene", str(new)]) == 0
    assert json.loads((copy / "eval.json").read_text())["protocol"]["views"] == 3
    assert train(street, "--into", copy, "--blocks", 7) == 2
    assert "There is no block 7; there are 0, 1, 2" in capsys.readouterr().err
    assert train(street, "--into", tmp_path / "nothing", "--blocks", 1) == 2
    assert "nothing holds no run in blocks" in capsys.readouterr().err


def test_options_of_blocks_are_those_of_block_nerf_alone(capsys):
    for name, shown in (("block-nerf", True), ("instant-ngp", False)):
        with pytest.raises(SystemExit):
            main(["train", name, "--help"])
        assert ("--workers" in capsys.readouterr().out) == shown


def test_a_small_capture_is_one_ordinary_run(street, tmp_path):
    small = ["--field", "hash", "--steps", 1, "--levels", 2, "--log2-hashmap-size", 8, "--samples-per-step", 256]
    assert train(street, *small, "--output", tmp_path / "one") == 0
    assert Run(tmp_path / "one").method_name == "block-nerf"


# Ray


def test_without_ray_a_sentence_says_how_to_install_it(street, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    told = street, "--field", "voxel-grid", "--blocks", 2, "--steps", 2, "--output", tmp_path / "big", "--workers", 2
    assert train(*told) == 2
    assert "pip install 'lumigraph[ray]'" in capsys.readouterr().err


@pytest.mark.parametrize(("address", "told"), [("127.0.0.1:9", "Nothing answers"), ("somewhere", "is no HOST:PORT")])
def test_an_address_that_does_not_answer(run, address, told, tmp_path):
    pytest.importorskip("ray")
    plan = planned(Path(Plan.read(run / "blocks.json").scene.source), tmp_path / "big")
    with pytest.raises(LumigraphError, match=told):
        training.conduct(tmp_path / "big", plan, Workers(address=address), show=False)


def of_blocks() -> list[Path]:
    package = Path(worker.__file__).parent
    return [*package.glob("*.py"), package.parent / "training/loop.py", package.parent / "files/locks.py"]


@pytest.fixture(autouse=True)
def handlers():
    """Ray puts a handler of SIGTERM in place of ours and leaves it there."""
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


RUNS = "big", "undisturbed"


@kept(lambda: [*of_blocks(), Path(methods.__file__)])
def test_a_worker_that_is_killed_loses_nothing(street, tmp_path, monkeypatch):
    """Two workers that load the file of a method, one of which is killed while it learns: the same weights as
    undisturbed, to the bit.

    All of them load kernels that this process has compiled, for what is compiled and not loaded rounds differently.
    """
    pytest.importorskip("ray")
    monkeypatch.setattr(methods, "_registered", {})
    monkeypatch.setenv("LUMIGRAPH_CACHE", str(tmp_path / "cache"))
    file = tmp_path / "mine.py"
    file.write_text("from lumigraph.methods.instant_ngp import InstantNGP\n\n\nclass MyNGP(InstantNGP):\n    pass\n")
    (method,) = methods.load(file)
    (tmp_path / "cache" / methods.LOADED_FILE).unlink()  # by which other processes would find the file
    plan = planned(street, tmp_path / "big", method=method)
    for name in ("compiled", "undisturbed"):
        planned(street, tmp_path / name, method=method)
    worker.train_block(tmp_path / "compiled/blocks/0")
    blocks = [str(tmp_path / "undisturbed/blocks" / name) for name in "012"]
    program = "import sys; from pathlib import Path; from lumigraph.large.worker import train_block"
    program += "; from lumigraph.methods import load; load(sys.argv[1])"
    program += "; [train_block(Path(folder)) for folder in sys.argv[2:]]"
    subprocess.run([sys.executable, "-c", program, file, *blocks], check=True)
    killed = []

    def kill() -> None:
        until = time.monotonic() + 120
        while not killed and time.monotonic() < until:
            for lock in (tmp_path / "big/blocks").glob("*/lock.json"):
                try:
                    number = json.loads(lock.read_text())["process"]
                except (OSError, ValueError):
                    continue
                os.kill(number, signal.SIGKILL)
                killed.append(number)
                return
            time.sleep(0.01)

    killer = threading.Thread(target=kill)
    killer.start()
    found = training.conduct(tmp_path / "big", plan, Workers(count=2), show=False)
    killer.join()
    assert killed and sorted(found.done) == ["0", "1", "2"] and not found.failed
    for name in "012":
        one, other = (load_file(Run(tmp_path / run / "blocks" / name)._checkpoints.weights) for run in RUNS)
        assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def listing(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def weights(block: Path) -> bytes:
    return (Run(block)._checkpoints.weights).read_bytes()
