"""`bench shapes`: evidence of shapes, retrieval of the training shape that fits it, tables of both."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tiny_shapes
import torch
import trimesh
from budgets import budget

from lumigraph import methods
from lumigraph.commands.cli import main
from lumigraph.datasets.scene import Photograph
from lumigraph.datasets.shapes import Shapes
from lumigraph.evaluation.completion import CLOUD_POINTS, Retrieval, known_of
from lumigraph.lab.benchmark.shapes import measure
from lumigraph.opening import open_dataset
from lumigraph.run import Run, State, build

pytestmark = budget("runs", 10)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def shapes() -> Shapes:
    """A ball and a box to learn from."""
    index = torch.arange(2)
    return Shapes([tiny_shapes.ball(), tiny_shapes.box()], {"train": index, "test": index}, "in memory")


@pytest.mark.parametrize("kind", ["mesh", "half scan", "points", "picture"])
def test_retrieval_finds_the_shape_that_evidence_is_of(kind):
    retrieval = Retrieval(shapes())
    for shape in (tiny_shapes.ball(), tiny_shapes.box()):
        assert retrieval.nearest(known_of(shape, kind, generator())) is shape


def test_evidence_is_what_it_says():
    ball = tiny_shapes.ball()
    cloud, scan = (known_of(ball, kind, generator()).piece.members[0] for kind in ("points", "half scan"))
    assert len(cloud.mesh.vertices) == CLOUD_POINTS and cloud.normals is None and cloud.is_cloud
    radius, outward = torch.from_numpy(scan.mesh.vertices).norm(dim=-1), torch.from_numpy(scan.normals)
    assert float((radius - tiny_shapes.RADIUS).abs().max()) < 0.02
    middle = torch.from_numpy(scan.mesh.vertices.mean(0))
    assert float(middle.norm()) > 0.3, "one side alone"
    assert float((outward * torch.from_numpy(scan.mesh.vertices)).sum(-1).min()) > 0, "normals look outwards"
    assert isinstance(known_of(ball, "picture", generator()).piece, Photograph)


def run_of(name: str, source: Path, folder: Path) -> Path:
    kind, data = methods.find(name), open_dataset(source)
    method = build(kind, data.frame, kind.smallest(), torch.device("cpu"), 0)
    method.begin(data)
    method.loss(method.batch(data, generator()), 0)
    run = Run.create(folder, method, data)
    run.save(State(seconds=2.0), method, method.optimizers(), generator())
    return run.folder


def test_runs_are_measured(tmp_path):
    """Every level of a shape with its bytes; every evidence of held-out members beside retrieval."""
    many = tmp_path / "many"
    many.mkdir()
    trimesh.creation.icosphere(subdivisions=2, radius=0.25).export(many / "a.obj")
    trimesh.creation.box((2.0, 1.0, 0.5)).export(many / "b.obj")
    runs = [
        run_of("nglod", many / "a.obj", tmp_path / "one"),
        run_of("deepsdf", many, tmp_path / "sdf"),
        run_of("occupancy-network", many, tmp_path / "occupancy"),
    ]
    told: list[str] = []
    output = tmp_path / "output"
    output.mkdir()
    measure(runs, 4, 500, 16, output, told.append)
    found = json.loads((output / "shapes.json").read_text())
    held = found["held"]
    assert [x["level"] for x in held] == [1, 2] and held[0]["bytes"] < held[1]["bytes"] and held[0]["seconds"] == 2
    completed = found["completed"][str(many.resolve())]
    by = {(x["evidence"], x["by"]) for x in completed}
    assert by == {
        *((kind, "retrieval") for kind in ("mesh", "half scan", "points")),
        *((kind, "sdf") for kind in ("mesh", "half scan")),
        ("points", "occupancy"),
    }
    assert {x["score"]["name"] for x in completed} == {"a"}, "the first is held out"
    page = (output / "shapes.md").read_text()
    assert "half scan | sdf" in page and "| one | 2 |" in page


def test_the_command_trains_and_measures(tmp_path, monkeypatch):
    """Methods of one shape are not trained on a folder; training is another test's."""
    cells = []
    monkeypatch.setattr("lumigraph.lab.benchmark.conduct.conduct", lambda given, *_: cells.extend(given) or 0)
    measured = []
    monkeypatch.setattr("lumigraph.lab.benchmark.shapes.measure", lambda runs, *_: measured.extend(runs))
    folder = tiny_shapes.write(tmp_path / "meshes")
    shapes_of = [str(folder / "ball.obj"), str(folder)]
    words = ["bench", "shapes", "--methods", "deepsdf", "nglod", "--shapes", *shapes_of]
    assert main([*words, "--runs", str(tmp_path), "--steps", "3", "--output", str(tmp_path / "output")]) == 0
    assert [(cell.method, Path(cell.source).name) for cell in cells] == [
        ("deepsdf", "ball.obj"),
        ("nglod", "ball.obj"),
        ("deepsdf", "meshes"),
    ]
    assert measured == [tmp_path]
