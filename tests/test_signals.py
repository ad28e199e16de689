"""Ctrl-C and SIGTERM, from whichever command: the exit code says which it was, and nothing half-done is called done."""

from __future__ import annotations

import ast
import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest
from budgets import budget
from shape_checks import PACKAGE

from lumigraph.commands.cli import main
from lumigraph.system.signals import REMINDER_SECONDS, Interrupt, Stopped, go_on_unless, listening, until_interrupted

pytestmark = budget("runs", 15)

BOTH = [signal.SIGINT, signal.SIGTERM]
# What each command is doing when the signal comes: RUN and PICTURE are put in.
COMMANDS = {
    "eval RUN": "lumigraph.run.Run.dataset",
    "info RUN": "lumigraph.run.Run.evaluation",
    "render RUN --frames 2": "lumigraph.export.film.film",
    "report RUN": "lumigraph.evaluation.report.write_report",
    "resume RUN --steps 100": "lumigraph.run.Run.dataset",
    "train voxel-grid SCENE": "lumigraph.opening.open_dataset",
    "demo --output OUT": "lumigraph.opening.open_dataset",
    "export mesh RUN OUT.ply": "lumigraph.export.mesh.render_depth_maps",
    "export points RUN OUT.ply": "lumigraph.export.points.render_depth_maps",
    "export panorama RUN OUT.png": "lumigraph.export.panorama.panorama",
    "export stereo RUN OUT.png": "lumigraph.export.panorama.stereo_pair",
    "export web RUN OUT.html": "lumigraph.export.page.views_page",
    "export splats RUN OUT.ply": "lumigraph.large.open_any",
    "compose RUN RUN --output OUT.json": "lumigraph.large.open_any",
    "explain ray RUN": "lumigraph.lab.explain.ray.along_ray",
    "capture SCENE --output OUT": "lumigraph.sfm.reconstruction.reconstruct",
    "bench kernels": "lumigraph.kernels.bench.bench_kernels",
    "bench step voxel-grid SCENE": "lumigraph.lab.benchmark.step.bench_step",
    "bench methods --methods voxel-grid --scenes SCENE --output OUT": "lumigraph.lab.benchmark.conduct.conduct",
    "view RUN": "lumigraph.large.open_any",
}


@pytest.mark.parametrize("number", BOTH)
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_ends(command, number, ball_run, ball_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(COMMANDS[command], lambda *_, **__: signal.raise_signal(number))
    names = {"RUN": str(ball_run.folder), "SCENE": str(ball_folder), "OUT": str(tmp_path / "out")}
    for name, path in names.items():
        command = command.replace(name, path)
    assert main(command.split()) == 128 + number
    said = capsys.readouterr()
    assert not said.out and "Traceback" not in said.err
    assert ("lumigraph: Stopped" in said.err) == (number == signal.SIGINT)
    assert not list(tmp_path.glob("out*")) and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.parametrize("number", BOTH)
def test_networks_that_a_signal_left_unfinished_are_not_explained(number, tmp_path, monkeypatch):
    from PIL import Image

    from lumigraph.methods.fourier_features import FourierFeatures

    Image.new("RGB", (16, 16), "teal").save(tmp_path / "picture.png")
    begun = []
    monkeypatch.setattr(FourierFeatures, "after_step", lambda self, step: step == 2 and signal.raise_signal(number))
    monkeypatch.setattr(FourierFeatures, "begin", lambda self, data, seconds: begun.append(self))
    page = tmp_path / "page"
    command = ["explain", "encodings", str(tmp_path / "picture.png"), "--steps", "9", "--output", str(page)]
    assert main(command) == 128 + number
    assert len(begun) <= 1 and not page.exists()


def test_whoever_trains_looks_at_how_it_ended():
    """A call of fit() whose outcome nobody takes would go on after Ctrl-C with what is half learnt."""
    careless = []
    for path in [*PACKAGE.rglob("*.py"), *PACKAGE.parent.joinpath("benchmarks").rglob("*.py")]:
        text = path.read_text("utf-8")
        for node in ast.walk(ast.parse(text)) if "    fit(" in text else ():
            call = node.value if isinstance(node, ast.Expr) else None
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "fit":
                careless.append(f"{path.name}:{node.lineno}")
    assert not careless


def test_the_second_signal_breaks_off_and_both_act_as_before_afterwards():
    before = [signal.getsignal(number) for number in BOTH]
    with pytest.raises(Stopped) as stopped, listening(), Interrupt() as interrupt:
        signal.raise_signal(signal.SIGTERM)
        assert interrupt.signal == signal.SIGTERM
        signal.raise_signal(signal.SIGTERM)
    assert stopped.value.number == signal.SIGTERM
    assert [signal.getsignal(number) for number in BOTH] == before
    go_on_unless(None)


def test_a_signal_that_comes_while_something_is_loaded_is_heard_afterwards(tmp_path, monkeypatch):
    """Here a module takes any exception for something else, as libraries do."""
    lines = ["import signal", "try: signal.raise_signal(signal.SIGTERM)", "except BaseException: raise ImportError"]
    (tmp_path / "touchy.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(Stopped), listening():
        import touchy  # noqa: F401

        time.sleep(20)


def test_a_signal_that_somebody_has_lost_comes_again():
    begin = time.monotonic()
    with pytest.raises(Stopped), listening():
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        time.sleep(20)
    assert time.monotonic() - begin < 15
    with listening(), until_interrupted():
        signal.raise_signal(signal.SIGINT)
    time.sleep(2 * REMINDER_SECONDS)  # one that was heeded does not


def test_cleaning_up_is_not_disturbed_by_reminders_but_by_a_second_signal():
    cleaned = []
    with pytest.raises(Stopped), listening():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            time.sleep(3 * REMINDER_SECONDS)
            cleaned.append("up")
    assert cleaned
    with pytest.raises(Stopped), listening():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGTERM)
            cleaned.append("again")
    assert cleaned == ["up"]


def test_what_control_c_is_meant_to_end_still_heeds_sigterm():
    with until_interrupted():
        raise KeyboardInterrupt
    with pytest.raises(Stopped), until_interrupted():
        raise Stopped(signal.SIGTERM)


SCRIPT = """
import os, signal, sys
from lumigraph.system.signals import listening, untouched
with listening():
    with untouched():
        import pycolmap
    os.kill(os.getpid(), signal.SIGTERM)
"""


def test_colmap_does_not_take_sigterm_away():
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode != -signal.SIGTERM and done.stderr.splitlines()[-1].startswith(
        "lumigraph.system.signals.Stopped"
    )


PNG = """
import io
from lumigraph.system.library import pycolmap
from PIL import Image
pycolmap.logging.warning("a word")
Image.new("RGB", (300, 200)).save(io.BytesIO(), "PNG")
"""


def test_pillow_saves_png_after_colmap_is_loaded(tmp_path):
    """In the order that ended the process by a double free; and the logging library leaves no files."""
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent), "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", PNG], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "a word" in done.stderr, done.stderr
    assert not list(tmp_path.iterdir())


def test_pycolmap_is_loaded_at_one_place():
    loading = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if any(line.strip() == "import pycolmap" for line in path.read_text("utf-8").splitlines())
    }
    assert loading == {"system/library.py", "sfm/worker.py"}


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells children that their parent has died")
def test_children_die_with_their_parent(tmp_path):
    """A parent that is killed outright, and its child, which writes its number and sleeps."""
    child = "import os, sys, time; print(os.getpid(), flush=True); time.sleep(60)"
    parent = f"import sys; from lumigraph.system.children import start_python; start_python(['-c', {child!r}]).wait()"
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    with subprocess.Popen(
        [sys.executable, "-c", parent], env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        assert int(process.stdout.readline()) > 0
        process.kill()
        process.wait()
        assert process.stdout.read() == ""  # ends when the child, which holds the other end, has ended
