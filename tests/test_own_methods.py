"""Methods of one's own: registered from Python, loaded from a file, found by an entry point; their runs open again."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import tiny
from budgets import budget

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.lab.benchmark.cell import Cell, CellSettings, row_of
from lumigraph.lab.benchmark.conduct import launch
from lumigraph.run import Run
from lumigraph.system import plugins

pytestmark = budget("runs", 8)

SOURCE = (Path(__file__).parent / "methods" / "voxel_grid.py").read_text()


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Nothing is registered, and the cache is empty."""
    monkeypatch.setattr(methods, "_registered", {})
    monkeypatch.setenv("LUMIGRAPH_CACHE", str(tmp_path / "cache"))
    plugins.offered.cache_clear()
    yield
    plugins.offered.cache_clear()


@pytest.fixture
def own(tmp_path) -> Path:
    """A file with a method, outside of all packages."""
    file = tmp_path / "mine.py"
    file.write_text(SOURCE.replace("class VoxelGrid", "class MyGrid"))
    return file


def command(capsys, *words: object) -> tuple[int, str]:
    """A command as in a process of its own, which knows only what is installed; its exit code and what it prints."""
    methods._registered.clear()
    capsys.readouterr()
    code = main([str(word) for word in words])
    return code, "".join(capsys.readouterr())


def test_a_file_is_trained_by_the_command_and_its_run_opens_again(own, ball_folder, tmp_path, capsys):
    run = tmp_path / "run"
    told = ["--steps", 3, "--output", run, "--device", "cpu", "--cells", 6]
    assert command(capsys, "--method-file", own, "train", "my-grid", ball_folder, *told)[0] == 0
    assert json.loads((run / "config.json").read_text())["method_file"] == str(own)
    assert command(capsys, "eval", run, "--views", 1)[0] == 0  # the user has loaded this file before
    own.write_text(own.read_text() + "\nprint('it ran')\n")
    code, said = command(capsys, "eval", run, "--views", 1)
    assert code == 2 and f"give --method-file {own} if you trust it" in said and "it ran" not in said
    code, said = command(capsys, "eval", run, "--views", 1, f"--method-file={own}", "--overwrite")
    assert code == 0 and "it ran" in said


def test_a_run_from_elsewhere_runs_nothing(own, tmp_path):
    (name,) = methods.load(own)
    kind = methods.find(name)
    data = tiny.scene()
    Run.create(tmp_path / "run", kind(data.frame, kind.Config()), data)
    methods._registered.clear()
    (tmp_path / "cache" / methods.LOADED_FILE).unlink()
    with pytest.raises(LumigraphError, match=r"my-grid, a method that is not installed; it came from .*mine\.py"):
        Run(tmp_path / "run").new_method()
    assert name not in methods.available()


def test_a_class_from_python_leaves_a_run_that_opens(tmp_path):
    voxels = methods.find("voxel-grid")

    class OwnVoxels(voxels):
        pass

    data = tiny.scene()
    run = Run.create(tmp_path / "run", OwnVoxels(data.frame, voxels.Config()), data)
    assert run.method_name == "own-voxels" and isinstance(Run(run.folder).new_method(), OwnVoxels)
    assert "own-voxels" in methods.available()

    @methods.register
    class OtherVoxels(voxels):
        pass

    assert methods.find("other-voxels") is OtherVoxels and methods.name_of(OtherVoxels) == "other-voxels"
    assert methods.register(OwnVoxels, "second") is OwnVoxels and methods.find("second") is OwnVoxels
    with pytest.raises(LumigraphError, match="another method instant-ngp"):
        methods.register(OwnVoxels, "instant-ngp")
    with pytest.raises(LumigraphError, match="is no method"):
        methods.register(dict)


def test_packages_offer_methods_by_an_entry_point(monkeypatch, own):
    methods.load(own)
    methods._registered.clear()
    entry = EntryPoint("their-grid", "lumigraph_method_mine:MyGrid", "lumigraph.methods")
    broken = EntryPoint("broken", "nowhere_at_all:Thing", "lumigraph.methods")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry, broken] if group == "lumigraph.methods" else [])
    plugins.offered.cache_clear()
    kind = methods.find("their-grid")
    assert methods.name_of(kind) == "their-grid" and methods.file_of(kind) is None
    with pytest.raises(LumigraphError, match="broken cannot be loaded"):
        methods.find("broken")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1", "holds no method"),
        ("x = ", r"cannot be loaded \(SyntaxError"),
        ("raise ValueError('no')", r"cannot be loaded \(ValueError: no\)"),
    ],
)
def test_files_that_hold_no_method_are_refused_in_a_sentence(tmp_path, capsys, text, words):
    (tmp_path / "bad.py").write_text(text)
    with pytest.raises(LumigraphError, match=words):
        methods.load(tmp_path / "bad.py")
    assert main(["methods", "--method-file", str(tmp_path / "bad.py")]) == 2
    assert "bad.py" in capsys.readouterr().err
    assert main(["methods", "--method-file"]) == 2
    assert "names no file" in capsys.readouterr().err


def test_the_list_of_methods_has_those_of_a_file(own, capsys):
    assert main(["methods", "--method-file", str(own)]) == 0
    assert "my-grid" in capsys.readouterr().out


def test_processes_of_a_benchmark_load_the_file(own, tmp_path):
    """Also where the cache that remembers loaded files is empty; the row's command names the file."""
    methods.load(own)
    (tmp_path / "cache" / methods.LOADED_FILE).unlink()
    assert launch(["methods"], tmp_path / "log") == 0
    assert "my-grid" in (tmp_path / "log").read_text()
    cell = Cell("my-grid", "ball", "procedural:still-life", Budget(4, None))
    row = row_of(cell, tmp_path, CellSettings(), "not trained")
    assert row["command"] == "lumigraph train my-grid procedural:still-life --steps 4 --seed 0 --method-file mine.py"
