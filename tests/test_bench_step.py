"""`bench step`: one training step taken apart into kernels, operations and the rest; its flame graph."""

from __future__ import annotations

import json
import time
from hashlib import sha256
from xml.etree import ElementTree

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import kernels
from lumigraph.commands.cli import main
from lumigraph.figures.charts import standalone
from lumigraph.figures.flame import WIDTH, Span, flame_graph
from lumigraph.kernels._operation import watched, watching
from lumigraph.kernels.tile import cpu as tile_engine
from lumigraph.lab.benchmark.step import KINDS, bench_step, take_apart
from lumigraph.methods.gaussian_splatting import GaussianSplatting
from lumigraph.run import build

pytestmark = budget("kernels", 10)

SVG = "{http://www.w3.org/2000/svg}"


def splatting():
    scene = tiny.scene()
    return build(GaussianSplatting, scene.frame, GaussianSplatting.smallest(), torch.device("cpu"), 0), scene


def by_name(found):
    return {row.name: row for row in found.rows}


def test_a_step_is_the_sum_of_its_rows(monkeypatch):
    seconds, run = 0.02, tile_engine.run
    monkeypatch.setattr(tile_engine, "run", lambda *inputs: time.sleep(seconds) or run(*inputs))
    found = bench_step(*splatting(), None, warmup=3, count=4, progress=0.6)
    rows = by_name(found)
    assert sum(row.ms for row in found.rows) == pytest.approx(found.profiled_ms, rel=1e-6)
    for name in ("project", "rasterize", "photometric"):
        assert rows[f"{name} forward"].calls == rows[f"{name} backward"].calls == 1
        assert rows[f"{name} forward"].bytes > 0 and rows[f"{name} backward"].kind == "kernel"
    assert rows["CloudAdam.step"].kind == "optimizer" and rows["photographs and rays"].kind == "data"
    assert {row.kind for row in found.rows} == set(KINDS)
    slow = rows["tile forward"]
    assert slow.ms >= 1e3 * seconds and slow.calls == 1
    assert found.memory_share(slow) == pytest.approx(slow.bytes / (slow.ms / 1e3) / found.memory_rate)
    assert rows["rasterize forward"].processor_ms > 0 and 0 < rows["CloudAdam.step"].processor_ms
    assert slow.processor_ms < slow.ms / 2, "a thread that sleeps does not run"
    parts = {part.name: part for part in found.tree.inside}
    assert found.tree.value == pytest.approx(found.profiled_ms)
    assert sum(part.value for part in parts.values()) <= found.tree.value
    assert "tile forward" in {part.name for part in parts["forward"].inside}
    assert {"data", "backward", "check", "optimizer", "after step"} <= set(parts)


def test_bytes_are_those_of_inputs_and_outputs():
    count = 1 << 18
    a, b = torch.rand(count, requires_grad=True), torch.rand(count)
    picture, photograph = torch.rand(64, 32, 3, requires_grad=True), torch.rand(64, 32, 3)
    optimizer = torch.optim.Adam([a], 1e-3)

    def step():
        optimizer.zero_grad()
        (a * b.view(2, -1).expand(3, -1, -1)[0].reshape(-1)).sum().backward()
        kernels.photometric(picture, photograph)[0].backward()
        optimizer.step()

    step()
    rows = by_name(take_apart(step, [optimizer], 2))
    assert rows["mul"].bytes == 5 * 4 * count + 4  # a, b, the product; back: one number, b, a gradient
    assert rows["photometric forward"].bytes == 2 * picture.numel() * 4 + 8
    assert "view" in rows and rows["view"].bytes == 0
    assert rows["Adam.step"].bytes == 7 * 4 * count + 8  # the number of steps is a moment too


def test_a_watch_ends_with_its_block():
    seen = []
    picture = torch.rand(8, 8, 3, requires_grad=True)
    with pytest.raises(KeyboardInterrupt), watching(lambda name, call, inputs: seen.append(name) or call()):
        kernels.photometric(picture, picture.detach())[0].backward()
        raise KeyboardInterrupt
    assert seen == ["photometric forward", "photometric backward"] and picture.grad is not None
    kernels.photometric(picture, picture.detach())[0].backward()
    assert watched("other", int, "3") == 3 and len(seen) == 2


def test_the_command_leaves_a_run_as_it_is(ball_folder, tmp_path, capsys):
    run = tmp_path / "run"
    assert main(["train", "voxel-grid", str(ball_folder), "--steps", "4", "--output", str(run)]) == 0

    def files():
        found = sorted(path for path in run.rglob("*") if path.is_file())
        return {path: sha256(path.read_bytes()).hexdigest() for path in found}

    capsys.readouterr()
    before = files()
    wanted = ["--warmup", "2", "--steps", "2", "--output", str(tmp_path / "step.json")]
    flame = ["--flame", str(tmp_path / "step.svg")]
    for words in (["voxel-grid", str(ball_folder), *flame], [str(run), "--overwrite"]):
        assert main(["bench", "step", *words, *wanted]) == 0
        told, figures = capsys.readouterr().out, json.loads((tmp_path / "step.json").read_text())
        assert figures["method"] == "voxel-grid" and "composite forward" in told
        assert sum(row["share"] for row in figures["rows"]) == pytest.approx(1)
    assert files() == before
    picture = ElementTree.parse(tmp_path / "step.svg").getroot()
    assert len(picture.findall(f"{SVG}g")) > 5


def test_bars_are_as_wide_as_their_share():
    root = Span("all", 8.0, 0, [Span("a<b", 1.0, 1), Span("half of it", 4.0, 2, [Span("inner", 2.0)]), Span("", 1e-4)])
    drawn = ElementTree.fromstring(standalone(flame_graph(root, "ms", ("one", "two"))))
    bars = {g.find(f"{SVG}title").text: g.find(f"{SVG}rect").attrib for g in drawn.findall(f"{SVG}g")}
    left = {title: (float(bar["x"]), float(bar["width"]) + 1, bar["y"]) for title, bar in bars.items()}
    assert left == {
        "all: 8 ms, 100.0 %": (0, WIDTH, "20"),
        "half of it: 4 ms, 50.0 %": (0, WIDTH / 2, "40"),
        "inner: 2 ms, 25.0 %": (0, WIDTH / 4, "60"),
        "a<b: 1 ms, 12.5 %": (WIDTH / 2, WIDTH / 8, "40"),
    }
