"""A run's folder: whole after any end, clear about what is wrong with it."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import pytest
import tiny
import torch
from budgets import budget
from listing import names

from lumigraph import methods
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.files import replacing, write_json
from lumigraph.files.plain import alike, flatten, unflatten
from lumigraph.files.ranges import typed
from lumigraph.methods import articulated_splatting
from lumigraph.run import Run, State
from lumigraph.run.settings import of_this_version
from lumigraph.training import fit

pytestmark = budget("runs", 8)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of a few steps; tests that change it take a copy."""
    run = tiny.new_run(tmp_path_factory.mktemp("runs") / "ball")
    fit(run.new_method(), tiny.scene(), run, steps=10, show=False)
    return run


@pytest.fixture
def run(trained, tmp_path):
    import shutil

    return Run(shutil.copytree(trained.folder, tmp_path / "ball"))


def test_a_run_opens_without_photographs(run):
    method = run.method()
    assert not method.training and method.config == tiny.method().config and method.frame == tiny.scene().frame
    cameras = run.cameras()
    camera = tiny.scene().cameras[cameras["test"].image_index]
    for a, b in ((cameras["test"].pose, camera.pose), (cameras["test"].lens.focal, camera.lens.focal)):
        assert torch.equal(a, b)
    seen = method.render(cameras["test"][0])
    assert seen.rgb.shape == (24, 24, 3) and seen.rgb.isfinite().all()


def test_its_files_say_what_it_is(run):
    config = json.loads((run.folder / "config.json").read_text())
    assert config["method"] == "voxel-grid" and config["config"]["grids"] == {"cells": 12, "channels": [1, 3]}
    assert config["splits"] == {"train": 9, "test": 3} and config["versions"]["torch"]


def test_an_option_that_became_a_constant_opens(run):
    """At the top of a Config and in the numbers that it holds; a warning names one of another value."""
    settings, kind = run.settings, methods.find("gaussian-splatting")
    said = asdict(kind.smallest())
    for value, warns in (0.01, False), (0.02, True):
        older = replace(settings, config=said | {"mcmc": said["mcmc"] | {"opacity_regularization": value}})
        said_so = pytest.warns(LumigraphWarning, match="opacity_regularization was 0.02 .* is always 0.01 now")
        with said_so if warns else contextlib.nullcontext():
            assert older.method_config(kind, run.folder) == kind.smallest()
    kind = methods.find("deepsdf")
    older = replace(settings, config=asdict(kind.smallest()) | {"fit_weight": 1e-4})
    assert older.method_config(kind, run.folder) == kind.smallest()
    kind = methods.find("articulated-splatting")  # a whole part became one
    older = replace(
        settings, config=asdict(kind.smallest()) | {"tidying": {"prune_near": articulated_splatting.PRUNE_NEAR}}
    )
    assert older.method_config(kind, run.folder) == kind.smallest()


@dataclass(frozen=True)
class Layer:
    width: int = 1
    rate: float = 2.0


@dataclass(frozen=True)
class Stack:
    inner: Layer = Layer()
    steps: int = 3


@dataclass(frozen=True)
class Numbers:
    outer: Stack = Stack()
    size: int = 4


def test_an_option_that_moved_opens():
    """Down into a part or up out of one, alone or with its whole part; what is unknown is refused."""
    for said, found in (
        ({"steps": 5, "outer": {"inner": {"width": 6}}}, {"outer": {"steps": 5, "inner": {"width": 6}}}),
        ({"inner": {"width": 6, "size": 7}}, {"outer": {"inner": {"width": 6}}, "size": 7}),
        ({"outer": {"inner": 1}, "width": 2}, None),
        ({"width": {"width": {"width": "wide"}}}, None),
        ({"late": {"other": 3}}, None),
    ):
        with contextlib.nullcontext() if found else pytest.raises(LumigraphError):
            numbers = typed(Numbers, of_this_version(said, Numbers, "a run"), "a run", closed=True)
            assert alike(asdict(numbers), asdict(typed(Numbers, found, "a run")))
    kind = methods.find("nerf-w")
    said = asdict(kind.smallest())
    said |= said.pop("backbone")
    said["table"]["density_layers"] = 1
    older = of_this_version(said, kind.Config, "a run")
    assert typed(kind.Config, older, "a run", closed=True) == kind.smallest()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_kills_while_saving_lose_nothing(tmp_path):
    here = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": f"{here.parent}{os.pathsep}{here}"}
    command = [sys.executable, str(here / "kill_while_saving.py"), str(tmp_path / "run")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("20 kills")


def test_half_written_and_half_deleted_states_are_passed_over(run):
    folder = run.folder / "checkpoints"
    for name in (".lumigraph-0123456789abcdef.partial", ".lumigraph-fedcba9876543210.partial"):
        (folder / name).mkdir()
        (folder / name / "weights.safetensors").write_bytes(b"half")
    assert run.state.step == 10
    method = run.method()
    run.save(State(11, 1.0), method, method.optimizers(), torch.Generator())
    assert [x.name for x in folder.iterdir()] == ["000011"]


def test_a_full_disk_keeps_the_state_before(run, monkeypatch):
    method, write = run.method(), Path.write_bytes

    def full(self, data):
        if self.name == "optimizer.safetensors":
            write(self, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self))
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(LumigraphError, match=r"000011 could not be written because the disk is full; free some space"):
        run.save(State(11, 1.0), method, method.optimizers(), torch.Generator())
    assert [x.name for x in (run.folder / "checkpoints").iterdir()] == ["000010"]
    assert run.state.step == 10 and run.method()


def damage(run: Run, name: str, change) -> None:
    path = run.folder / name
    path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("checkpoints/000010/weights.safetensors", lambda data: data[:-40], "weights.safetensors is damaged"),
        ("checkpoints/000010/weights.safetensors", lambda data: b"", "weights.safetensors is damaged"),
        ("checkpoints/000010/weights.safetensors", lambda data: data[:-9] + b"\x55" + data[-8:], "is damaged"),
        ("checkpoints/000010/state.json", lambda data: data[:-30], "state.json cannot be read as JSON"),
        ("checkpoints/000010/state.json", lambda data: b'{"step": 10}', "not a checkpoint that Lumigraph wrote"),
        ("checkpoints/000010/state.json", lambda data: data.replace(b"voxel-grid", b"nerf"), "run of nerf"),
        ("checkpoints/000010/state.json", lambda data: data.replace(b'"step"', b'"stop"'), "does not hold what it sh"),
        ("config.json", lambda data: b"\x00\xff\x80", "cannot be read as JSON"),
        ("config.json", lambda data: b"[1, 2]", "was not written by this version"),
        ("config.json", lambda data: b'{"model": "nerfacto"}', "was not written by this version"),
        (
            "config.json",
            lambda data: data.replace(b"voxel-grid", b"gauss"),
            "a run of gauss, a method that is not installed; there are",
        ),
        ("config.json", lambda data: data.replace(b'"rays"', b'"beams"'), "config.json does not hold what it should"),
        ("config.json", lambda data: data.replace(b'"reach"', b'"grasp"'), "nothing is known of 'grasp'"),
        (
            "config.json",
            lambda data: data.replace(b'"cells": 12', b'"cells": 13'),
            "does not fit the method voxel-grid",
        ),
    ],
)
def test_damage_is_named_in_one_sentence(run, name, change, words):
    damage(run, name, change)
    with pytest.raises(LumigraphError, match=words) as fault:
        opened = Run(run.folder)
        assert opened.method() and opened.state
    assert "\n" not in str(fault.value) and str(run.folder) in str(fault.value)


def test_a_missing_file_is_named(run):
    (run.folder / "checkpoints/000010/weights.safetensors").unlink()
    with pytest.raises(LumigraphError, match=r"weights\.safetensors does not exist"):
        run.method()


def test_a_damaged_optimizer_stops_a_resume(run):
    damage(run, "checkpoints/000010/optimizer.safetensors", lambda data: data[:-1])
    with pytest.raises(LumigraphError, match=r"optimizer\.safetensors is damaged"):
        fit(run.new_method(), tiny.scene(), run, steps=20, show=False)


def test_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(LumigraphError, match="is not a run"):
        Run(tmp_path)
    with pytest.raises(LumigraphError, match="nowhere does not exist"):
        Run(tmp_path / "nowhere")


def test_a_run_without_a_state(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    with pytest.raises(LumigraphError, match="no saved state yet"):
        run.method()


def test_runs_begin_in_new_or_empty_folders(run, tmp_path):
    (tmp_path / "empty").mkdir()
    tiny.new_run(tmp_path / "empty")
    with pytest.raises(LumigraphError, match=r"already holds a run; go on with it by `lumigraph resume"):
        tiny.new_run(run.folder)
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("Madam")
    with pytest.raises(LumigraphError, match="is not an empty folder"):
        tiny.new_run(tmp_path / "letters")
    with pytest.raises(LumigraphError, match="is not an empty folder"):
        tiny.new_run(tmp_path / "letters" / "dear.txt")
    assert os.listdir(tmp_path / "letters") == ["dear.txt"]


def test_a_line_cut_short_is_passed_over(run):
    rows = run.metrics()
    with open(run.folder / "metrics.jsonl", "a") as file:
        file.write('{"step": 11, "sec')
    assert run.metrics() == rows and [row["step"] for row in rows] == [10]


def test_nested_values_survive_without_pickle():
    state = {0: {"step": torch.tensor(3.0), "m": torch.rand(2, 3)}, "groups": [{"betas": (0.9, 0.99), "lr": 1e-3}]}
    tensors: dict[str, torch.Tensor] = {}
    plain = json.loads(json.dumps(flatten(state, tensors)))
    back = unflatten(plain, tensors)
    assert back[0]["m"] is state[0]["m"] and back["groups"] == state["groups"] and list(back) == [0, "groups"]
    with pytest.raises(TypeError, match="set"):
        flatten({"x": {1, 2}}, {})


@dataclass(frozen=True)
class Inner:
    sizes: tuple[int, ...] = (1, 2)


@dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    maybe: Inner | None = None
    pair: tuple[float, str] | None = None


@pytest.mark.parametrize("value", [Outer(), Outer(Inner((3,)), Inner(()), (0.5, "x"))])
def test_a_config_survives_json(value):
    assert typed(Outer, json.loads(json.dumps(asdict(value))), "a config") == value


def test_numbers_are_alike_up_to_a_tolerance():
    assert alike({"a": [1, 2.00001], "b": None}, {"a": (1.0, 2.0), "b": None})
    assert not alike({"a": [1, 2.1]}, {"a": [1, 2.0]})
    assert not alike({"a": 1}, {"a": 1, "b": 2})


def test_files_are_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "value.json"
    write_json(path, {"x": [1.5, 2.0], "names": ["a [1, 2]"]})
    assert json.loads(path.read_text()) == {"x": [1.5, 2.0], "names": ["a [1, 2]"]} and "[1.5, 2.0]" in path.read_text()
    with pytest.raises(RuntimeError), replacing(path) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert json.loads(path.read_text())["x"] == [1.5, 2.0] and names(tmp_path) == ["value.json"]
    with pytest.raises(ValueError):
        write_json(path, {"x": float("nan")})
    assert json.loads(path.read_text())["x"] == [1.5, 2.0]


def test_methods_are_found_by_file_name():
    assert "voxel-grid" in methods.available()
    assert methods.summary("voxel-grid").startswith("Voxel grid:")
    assert methods.find("voxel_grid") is methods.find("voxel-grid")
    assert methods.name_of(tiny.method()) == "voxel-grid"
    with pytest.raises(LumigraphError, match="did you mean voxel-grid"):
        methods.find("voxel-grit")


def test_a_run_begins_where_one_was_killed_before_it_had_begun(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    (run.folder / "config.json").unlink()
    (run.folder / ".lumigraph-0123456789abcdef.partial").write_bytes(b"{")
    assert tiny.new_run(tmp_path / "run").folder == run.folder


def test_no_run_begins_beside_somebodys_cameras(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "cameras.json").write_text("{}")
    with pytest.raises(LumigraphError, match="not an empty folder"):
        tiny.new_run(tmp_path / "run")
