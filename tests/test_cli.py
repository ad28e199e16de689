"""The commands, as a person would use and misuse them."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import tiny
from budgets import budget

from lumigraph.commands.cli import COMMANDS, main
from lumigraph.commands.common import next_free, scene_name
from lumigraph.files.names import discard
from lumigraph.run import Run

pytestmark = budget("runs", 18)

HERE = Path(__file__).parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{HERE.parent}{os.pathsep}{HERE}"}
# A process that knows the method of the tests.
LUMIGRAPH = [sys.executable, "-c", "import sys, tiny; from lumigraph.commands.cli import main; sys.exit(main())"]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("photographs") / "ball")


@pytest.fixture(scope="module")
def trained(photographs, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "ball"
    arguments = ["--output", str(folder), "--steps", "80", "--cells", "10", "--seed", "7", "--device", "cpu"]
    assert main(["train", "voxel-grid", str(photographs), *arguments]) == 0
    return folder


def test_train_writes_a_run_that_knows_its_options(trained, photographs, capsys):
    said = Run(trained).settings
    assert said.config["grids"]["cells"] == 10 and said.seed == 7 and said.budget == {"steps": 80}
    assert said.scene.source == str(photographs) and said.splits == {"train": 9, "test": 3}
    assert Run(trained).state.step == 80


def test_eval_writes_what_programs_read(trained, capsys):
    assert main(["eval", str(trained), "--save-images", "--device", "cpu"]) == 0
    result = json.loads((trained / "eval.json").read_text())
    assert {"psnr", "ssim", "protocol", "seconds_per_view", "training_seconds", "compile_seconds"} <= result.keys()
    assert {"split", "resolution", "background", "views"} <= result["protocol"].keys()
    assert len(result["views"]) == 3 and result["steps"] == 80 and 10 < result["psnr"] < 40
    assert f"{result['psnr']:.2f} dB" in capsys.readouterr().out
    assert (trained / "eval.png").exists() and len(list((trained / "eval").glob("*.png"))) == 3
    assert main(["eval", str(trained), "--split", "train"]) == 0
    assert json.loads((trained / "eval-train.json").read_text())["protocol"]["views"] == 9


@pytest.mark.parametrize("path", ["orbit", "sweep", "spiral", "interpolate", "still", "held-out"])
def test_render_needs_no_photographs(trained, tmp_path, monkeypatch, path):
    monkeypatch.setattr(Run, "scene", lambda self, source=None: pytest.fail("asked for photographs"))
    output = tmp_path / f"{path}.mp4"
    more = ["--depth", "--pictures", "png"] if path == "orbit" else []
    assert main(["render", str(trained), "--path", path, "--frames", "3", "--output", str(output), *more]) == 0
    about = json.loads(output.with_suffix(".json").read_text())
    assert about["frames"] == 3 and about["size"] == [24, 24] and len(about["poses"]) == 3
    made = {entry.name for entry in tmp_path.iterdir()} - {".lumigraph"}
    assert made == {output.name, f"{path}.json", *[f"{path}-depth.mp4", path] * (path == "orbit")}


def test_report_and_info_and_methods(trained, photographs, capsys):
    assert main(["report", str(trained)]) == 0
    assert (trained / "report.html").read_text().startswith("<!doctype html>")
    assert main(["info", str(trained)]) == 0 and "a run of voxel-grid" in capsys.readouterr().out
    assert main(["info", str(photographs)]) == 0
    told = capsys.readouterr().out
    assert "12 photographs" in told and "12 of 24x24" in told and "Pinhole" in told
    assert main(["methods"]) == 0 and "voxel-grid" in capsys.readouterr().out


def test_info_is_not_cut_where_the_terminal_ends(photographs, tmp_path, capsys):
    folder = shutil.copytree(photographs, tmp_path / ("far" * 30))
    assert main(["info", str(folder)]) == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first.endswith("a scene of 12 photographs") and not any("far" * 30 in line for line in others)


def test_pausing_and_resuming(photographs, tmp_path, capsys):
    run = tmp_path / "run"
    arguments = ["train", "voxel-grid", str(photographs), "--output", str(run), "--steps", "30", "--pause-at", "10"]
    assert main(arguments) == 0
    assert f"go on with: lumigraph resume {run}" in capsys.readouterr().err
    assert Run(run).state.step == 10
    assert main(["resume", str(run)]) == 0 and Run(run).state.step == 30
    assert main(["resume", str(run)]) == 2 and "has spent its budget" in capsys.readouterr().err
    assert main(["resume", str(run), "--steps", "35"]) == 0 and Run(run).state.step == 35
    assert Run(run).settings.budget == {"steps": 35}


def test_photographs_may_move_but_not_change(trained, photographs, tmp_path, capsys):
    moved = tmp_path / "moved"
    photographs.rename(moved)
    try:
        assert main(["eval", str(trained)]) == 2
        assert str(photographs) in capsys.readouterr().err
        assert main(["eval", str(trained), "--scene", str(moved)]) == 0
    finally:
        moved.rename(photographs)
    other = tiny.write_blender(tmp_path / "other", count=16)
    capsys.readouterr()
    assert main(["eval", str(trained), "--scene", str(other)]) == 2
    assert "is not what" in capsys.readouterr().err


def test_names_of_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as pool:  # each process has a name of its own
        found = list(pool.map(lambda _: next_free("runs/fox-nerf"), range(16)))
    assert sorted(map(str, found)) == sorted(f"runs/fox-nerf-{n}" for n in range(1, 17))
    (found[0] / "config.json").write_text("{}")
    for folder in found[:2]:
        discard(folder)
    assert [folder.exists() for folder in found[:3]] == [True, False, True]
    assert [scene_name(x) for x in ("a/my fox/", "procedural:still-life")] == ["my-fox", "still-life"]


# {photographs}, {trained} and {new} stand for folders.
BAD = {
    "no scene": ["train", "voxel-grid", "{new}/nowhere"],
    "unknown layout": ["train", "voxel-grid", "{trained}"],
    "unknown method": ["train", "voxel-grit", "{photographs}"],
    "no steps": ["train", "voxel-grid", "{photographs}", "--steps", "0"],
    "negative seconds": ["train", "voxel-grid", "{photographs}", "--seconds", "-1"],
    "two budgets": ["train", "voxel-grid", "{photographs}", "--steps", "3", "--seconds", "3"],
    "steps and a quality": ["train", "voxel-grid", "{photographs}", "--steps", "3", "--quality", "good"],
    "a run in the way": ["train", "voxel-grid", "{photographs}", "--steps", "3", "--output", "{trained}"],
    "photographs in the way": ["train", "voxel-grid", "{photographs}", "--steps", "3", "--output", "{photographs}"],
    "no such device": ["train", "voxel-grid", "{photographs}", "--steps", "3", "--device", "abacus"],
    "no such preset": ["train", "voxel-grid", "{photographs}", "--steps", "3", "--device", "cuda:99"],
    "a device without numbers": ["eval", "{trained}", "--device", "meta"],
    "no name of a host": ["view", "{trained}", "--host", "9" * 200],
    "evaluate nothing": ["eval", "{new}/nowhere"],
    "evaluate photographs": ["eval", "{photographs}"],
    "evaluate no views": ["eval", "{trained}", "--split", "val"],
    "render nothing": ["render", "{new}/nowhere"],
    "render no frames": ["render", "{trained}", "--frames", "0"],
    "render no pixels": ["render", "{trained}", "--size", "3"],
    "render held-out, no frames": ["render", "{trained}", "--path", "held-out", "--frames", "0"],
    "another kind of film": ["render", "{trained}", "--output", "{new}/film.avi"],
    "no frames per second": ["render", "{trained}", "--fps", "0"],
    "report on nothing": ["report", "{new}/nowhere"],
    "resume nothing": ["resume", "{photographs}"],
    "info on nothing": ["info", "{new}/nowhere"],
    "demo into photographs": ["demo", "--output", "{photographs}"],
    "demo without frames": ["demo", "--frames", "0"],
    "a misspelt command": ["trian", "nerf"],
    "a word for seconds": ["train", "gaussian-splatting", "{photographs}", "--seconds", "ten"],
    "a share of a view": ["eval", "{trained}", "--views", "1.5"],
}


@pytest.mark.parametrize("arguments", BAD.values(), ids=BAD.keys())
def test_bad_input_gets_one_sentence(photographs, trained, tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    folders = (photographs, trained)
    before = [sorted(folder.rglob("*")) for folder in folders]
    words = [x.format(photographs=photographs, trained=trained, new=tmp_path) for x in arguments]
    assert main(words) == 2
    told = capsys.readouterr()
    lines = [line for line in told.err.splitlines() if not line.startswith("Looking for what the cameras look at")]
    assert told.out == "" and len(lines) == 1 and lines[0].startswith("lumigraph: "), told.err
    assert "Traceback" not in told.err and len(told.err) > 40
    assert [sorted(folder.rglob("*")) for folder in folders] == before and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "answer"),
    [
        (["trian"], "did you mean train?"),
        (["train", "splat", "x"], "did you mean gaussian-splatting?"),
        (["train", "nerf", "x", "--seconds", "ten"], "--seconds cannot be 'ten'; give it a number"),
        (["eval", "x", "--views", "1.5"], "--views cannot be '1.5'; give it a whole number"),
        (["train", "nerf", "x", "--learning-rate", "many"], "--learning-rate cannot be 'many'; give it a number"),
        (["train", "nerf", "x", "--quality", "fine"], "--quality cannot be 'fine'; choose one of best, draft, good"),
        (["train"], "`lumigraph train` needs METHOD and SCENE; `lumigraph train --help` lists"),
        (["train", "voxel-grid"], "`lumigraph train` needs SCENE;"),
        (["train", str(Path(__file__).parent)], "as in `lumigraph train gaussian-splatting "),
        (["train", "nerf", "x", "y"], "`lumigraph train` does not know y; `lumigraph train --help` lists"),
        (["export"], "`lumigraph export` needs one of collision, "),
        (["export", "web", "x"], "`lumigraph export web` needs FILE.html;"),
        (["export", "mesch", "x"], "`lumigraph export` does not know mesch; did you mean mesh?"),
        (["eval", "x", "--sav-images"], "does not know --sav-images; did you mean --save-images?"),
        (["compress", "x", "--output", "y", "--secnds", "4"], "--secnds; did you mean --seconds?"),
        (["methods", "--nonsense"], "`lumigraph methods` does not know --nonsense; `lumigraph methods --help`"),
    ],
)
def test_a_wrong_word_is_answered_by_a_sentence(arguments, answer, capsys):
    assert main(arguments) == 2
    told = capsys.readouterr()
    assert answer in told.err and told.err.count("\n") == 1 and told.out == ""


def test_a_traceback_on_request(tmp_path, monkeypatch):
    monkeypatch.setenv("LUMIGRAPH_DEBUG", "1")
    with pytest.raises(Exception, match="is not a run"):
        main(["eval", str(tmp_path)])


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as done:
        main([command, "--help"])
    told = capsys.readouterr().out
    assert done.value.code == 0 and f"usage: lumigraph {command}" in told
    for line in told.splitlines():
        assert "{None}" not in line and "STR" not in line, line


def test_help_on_a_method_names_its_numbers(capsys):
    with pytest.raises(SystemExit):
        main(["train", "voxel-grid", "--help"])
    told = capsys.readouterr().out
    assert "--learning-rate" in told and "decays to a tenth" in told and "voxel-grid options" in told.lower()


def test_a_group_of_numbers_hides_no_option_of_train(capsys):
    """Instant-NGP's Config holds `steps`, of rays."""
    with pytest.raises(SystemExit):
        main(["train", "instant-ngp", "--help"])
    assert "--steps N" in capsys.readouterr().out


def test_options_need_no_pytorch():
    """In a process of their own: dataclasses of options, which commands, apps and scripts declare nothing of again."""
    rooms = "derive", "evaluation", "export", "sfm", "training"
    asked = "; ".join(f"import lumigraph.{room}.options" for room in rooms)
    script = f"import sys; {asked}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


def test_help_does_not_wait_for_pytorch():
    script = "import sys; from lumigraph.commands.cli import main; main(['methods']); sys.exit('torch' in sys.modules)"
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", script], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and "instant-ngp" in done.stdout, done.stderr
    assert time.perf_counter() - begin < 10


@contextlib.contextmanager
def learning(photographs: Path, run: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """A process that trains, from when it has logged a few steps on; it does not outlive the block."""
    command = [*LUMIGRAPH, "train", "voxel-grid", str(photographs), *options, "--output", str(run)]
    with subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        try:
            deadline = time.monotonic() + 120
            while not (run / "metrics.jsonl").exists() or not (run / "metrics.jsonl").stat().st_size:
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.05)
            yield process
        finally:
            process.kill()


def test_control_c_saves_and_says_how_to_go_on(photographs, tmp_path):
    run = tmp_path / "run"
    with learning(photographs, run, "--seconds", "200") as process:
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
    assert process.returncode == 130, told
    assert f"go on with: lumigraph resume {run}" in told and "Traceback" not in told
    assert Run(run).state.step >= 10 and Run(run).method()


def test_a_killed_run_goes_on(photographs, tmp_path):
    run = tmp_path / "run"
    with learning(photographs, run, "--steps", "100000") as process:
        process.kill()
    assert main(["resume", str(run), "--steps", "20"]) == 0
    assert Run(run).state.step == 20 and [row["step"] for row in Run(run).metrics()] == [10, 20]
