"""Scores: measures of shapes against mathematics, each kind's protocol, and what shows the scores there are."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import tiny
import tiny_collection
import tiny_shapes
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.commands.cli import main
from lumigraph.datasets.collection import Collection
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.shapes import Shapes
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation.baseline import Baselines, below, in_hull
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.report import write_report
from lumigraph.evaluation.run import evaluate_collection, evaluate_on, evaluate_run, joined_shapes
from lumigraph.evaluation.shapes import ShapeScore, ShapesEvaluation, compare_shapes, evaluate_shapes
from lumigraph.evaluation.views import evaluate
from lumigraph.lab.benchmark.cell import Cell, CellSettings
from lumigraph.lab.benchmark.conduct import conduct
from lumigraph.lab.benchmark.table import markdown
from lumigraph.metrics import Score, chamfer_distance, intersection_over_union, named, normal_consistency, scores_of
from lumigraph.run import Run, build
from lumigraph.training import fit
from lumigraph.viewer.viewer import describe, measure_of

pytestmark = budget("runs", 10)

CPU = torch.device("cpu")


class Ball(methods.find("distance-grid")):  # type: ignore[misc]
    """Knows the distance of a ball instead of learning one; of whatever shape it is told of, its largest radius."""

    accepts = (Shapes,)
    radius = 0.9

    def distance(self, points):
        return points.norm(dim=-1) - self.radius

    def given(self, *evidence, **controls):
        told = super().given(**controls)
        told.radius = float(torch.from_numpy(evidence[0].members[0].mesh.vertices).norm(dim=-1).max())
        return told


def ball(radius: float) -> Ball:
    method = Ball(tiny_shapes.shapes().frame, Ball.Config())
    method.radius = radius
    return method


# Scores


def test_a_score_says_itself():
    assert (
        str(Score("PSNR", 31.417, "dB", "higher", 2)) == "31.42 dB" and str(Score("IoU", 0.5, "", "higher")) == "0.5000"
    )


def test_scores_are_read_by_key_and_by_name():
    view = {"psnr": 30.0, "ssim": 0.9, "lpips": None}
    assert [(x.name, str(x)) for x in scores_of(view)] == [("PSNR", "30.00 dB"), ("SSIM", "0.9000")]
    new = [Score("IoU", 0.7, "", "higher"), Score("chamfer-L1", 0.1, "", "lower")]
    assert scores_of({"scores": [json.loads(json.dumps(x.to_json())) for x in new]}) == new
    assert named(new, "IoU") is new[0] and named(new, "PSNR") is None and scores_of({}) == []


# Measures of shapes


def test_balls_in_each_other_have_known_scores(generator):
    points = 2 * torch.rand(20_000, 3, generator=generator) - 1
    radius = points.norm(dim=-1)
    assert intersection_over_union(radius < 0.6, radius < 0.8) == pytest.approx(0.75**3, abs=0.02)
    assert (
        intersection_over_union(radius < 0.5, radius < 0.5) == 1
        and intersection_over_union(radius > 9, radius > 9) == 1
    )
    assert intersection_over_union(radius < 0.5, radius > 0.5) == 0
    sphere = torch.nn.functional.normalize(torch.randn(5000, 3, generator=generator), dim=-1)
    mean, accuracy, completeness = chamfer_distance(0.6 * sphere, 0.8 * sphere, size=1.6)
    assert (mean, accuracy, completeness) == pytest.approx((0.2 / 0.16,) * 3, rel=1e-4)
    assert normal_consistency(0.6 * sphere, sphere, 0.8 * sphere, -sphere) == pytest.approx(
        1
    )  # the side does not count


def test_a_part_is_accurate_and_not_complete(generator):
    sphere = torch.nn.functional.normalize(torch.randn(5000, 3, generator=generator), dim=-1)
    upper = sphere[sphere[:, 2] > 0]
    mean, accuracy, completeness = chamfer_distance(upper, sphere, size=2.0)
    assert accuracy == 0 and completeness > 0.5 and mean == pytest.approx(completeness / 2)


# Protocols


def test_a_known_distance_has_the_scores_that_geometry_says():
    exact = evaluate_shapes(ball(0.9), tiny_shapes.shapes(), points=4000, cells=24, size=16)
    iou, chamfer, normals = exact.scores
    assert (iou.name, chamfer.name, normals.name) == ("IoU", "chamfer-L1", "normal consistency")
    assert iou.value > 0.97 and chamfer.value < 0.15 and normals.value > 0.98
    smaller = evaluate_shapes(ball(0.7), tiny_shapes.shapes(), points=4000, cells=24, size=16)
    assert smaller.scores[0].value == pytest.approx((0.7 / 0.9) ** 3, abs=0.03)
    assert smaller.scores[1].value == pytest.approx(0.2 / 0.18, abs=0.08)
    assert iou.value > smaller.scores[0].value and chamfer.value < smaller.scores[1].value
    assert exact.protocol["shapes"] == 1 and "4000 points" in exact.protocol["iou"]
    sheet = exact.contact_sheet("ball")
    assert sheet.width > 3 * 100 and [x.shape for x in exact.shown["ball"]] == [(16, 16, 3)] * 3


def test_of_several_shapes_each_is_told_first():
    data = dataclasses.replace(tiny_shapes.several(), splits={"train": torch.tensor([1]), "test": torch.arange(2)})
    found = evaluate_shapes(ball(0.2), data, points=2000, cells=16, size=8)
    assert [shape.name for shape in found.shapes] == ["ball", "box"] and found.compared == "2 shapes"
    assert found.shapes[0].iou > 0.95 and 0.65 < found.shapes[1].iou < 0.75  # a ball cut by the box of interest
    assert len(evaluate_shapes(ball(0.2), data, EvaluationOptions(views=1), points=500, cells=16, size=8).shapes) == 1


def test_shapes_that_are_not_there_are_refused():
    with pytest.raises(LumigraphError, match="no shapes in the split 'val'"):
        evaluate_shapes(ball(0.9), tiny_shapes.shapes(), EvaluationOptions("val"))
    with pytest.raises(LumigraphError, match="nowhere zero"):
        evaluate_shapes(ball(-1.0), tiny_shapes.shapes(), points=100, cells=16, size=8)


def test_a_member_of_a_collection_is_told_of_before_it_is_compared():
    data, kind = tiny_collection.collection(), methods.find("tinted-grid")
    method = build(kind, data.frame, kind.Config(), CPU, 0)
    fit(method, data, steps=60, show=False)
    names: list[str] = []
    told = evaluate_collection(method, data, keep=lambda name, seen: names.append(name))
    alone = evaluate(method, data["amber"])
    assert names == [f"amber/ball_{i}" for i in (0, 4, 8)] == [view.name for view in told.views]
    assert told.psnr > alone.psnr + 1 and told.protocol["members"] == 1
    assert evaluate_collection(method, data, EvaluationOptions("train", 1)).protocol["views"] == 3


def test_members_count_the_same_however_many_views_they_have():
    """A member of one view beside one of three: the mean is of members, by resolution as well."""
    method, ball = tiny.method(), tiny.scene()
    fewer = replace(ball, splits=ball.splits | {"test": ball.splits["test"][:1]})
    blank = replace(ball, images=ImageStore.from_arrays([np.zeros((tiny.SIZE, tiny.SIZE, 4), np.uint8)] * len(ball)))
    members = {"a": ball, "b": fewer, "c": blank}
    of_each = [evaluate(method, members[name]) for name in "bc"]
    data = replace(Collection.of(members, "balls"), splits={"test": torch.tensor([1, 2])})
    found = evaluate_collection(method, data)
    assert len(found.views) == 4 and abs(of_each[0].psnr - of_each[1].psnr) > 1
    for name in ("psnr", "ssim"):
        mean = (getattr(of_each[0], name) + getattr(of_each[1], name)) / 2
        assert getattr(found, name) == pytest.approx(mean)
        assert found.to_json()[name] == found.by_resolution["24x24"].means()[name] == pytest.approx(mean)
    assert found.protocol["psnr"] == "per view, averaged by member, then over all"
    some = [ShapeScore(str(i), 0.1, 0.1, 0.1, iou, None) for i, iou in enumerate((0.9, 0.7, 0.2))]
    parts = {
        name: ShapesEvaluation(x, {"shapes": len(x), "of": 4}, {}) for name, x in (("a", some[:2]), ("b", some[2:]))
    }
    assert named(joined_shapes(parts, {"members": 2}).scores, "IoU").value == pytest.approx((0.8 + 0.2) / 2)


@pytest.fixture(scope="module")
def shaped(tmp_path_factory) -> Run:
    """A run that learnt a shape, evaluated."""
    source = tiny_shapes.write(tmp_path_factory.mktemp("shapes")) / "ball.obj"
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        smaller(patch)
        assert main(["train", "distance-grid", str(source), "--steps", "40", "--output", str(folder)]) == 0
        assert main(["eval", str(folder)]) == 0
    return Run(folder)


def smaller(patch: pytest.MonkeyPatch) -> None:
    """Pictures and numbers of points that take no time."""
    patch.setattr("lumigraph.training.loop.PREVIEW_SIZE", 16)
    small = {"points": 4000, "cells": 24, "size": 16}
    patch.setattr("lumigraph.evaluation.run.evaluate_shapes", functools.partial(evaluate_shapes, **small))


def test_eval_picks_the_protocol(shaped, capsys):
    result = shaped.evaluation()
    iou = named(scores_of(result), "IoU")
    assert iou.value > 0.9 and result["steps"] == 40 and "psnr" not in result and (shaped.folder / "eval.png").exists()
    assert main(["info", str(shaped.folder)]) == 0 and str(iou) in capsys.readouterr().out
    page = write_report(shaped).read_text()
    assert f"{iou.value:.3f}" in page and "IoU, 1 shape" in page and "PSNR" not in page and "to render" not in page


def test_views_keep_their_keys_and_have_scores(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    fit(method := run.new_method(), tiny.scene(), run, steps=3, show=False)
    result = evaluate_run(run, method, tiny.scene())
    assert {"psnr", "ssim", "lpips", "protocol", "seconds_per_view", "views", "training_seconds"} <= result.keys()
    wanted = [("PSNR", "psnr"), ("SSIM", "ssim"), ("depth error", "depth_error")]  # the ball's depth is known
    assert [(x.name, x.value) for x in scores_of(result)] == [(name, result[key]) for name, key in wanted]
    assert evaluate_on(method, tiny.scene()).scores == scores_of(result)
    keyed = {name: value for name, value in result.items() if name != "scores"}
    assert scores_of(keyed) == scores_of(result)


def test_a_benchmark_of_shapes_has_their_columns(shaped, tmp_path, monkeypatch):
    smaller(monkeypatch)
    cell = Cell("distance-grid", "ball", shaped.settings.scene.source, Budget(20, None))

    def here(arguments, log):
        log.parent.mkdir(parents=True, exist_ok=True)
        return main(list(arguments))

    assert conduct([cell, dataclasses.replace(cell, seed=1)], CellSettings(device="cpu"), tmp_path, launch=here) == 0
    page = (tmp_path / "results.md").read_text()
    assert "| IoU | chamfer-L1 | normal consistency |" in page and "PSNR |" not in page and "s/view" not in page
    rows = json.loads((tmp_path / "results.json").read_text())["cells"]
    assert all(f"{named(scores_of(row), 'IoU').value:.4f}" in page for row in rows) and "shown" not in rows[0]
    assert conduct([cell], CellSettings(device="cpu"), tmp_path, launch=lambda *_: pytest.fail("it is done")) == 0
    assert "| – |" in markdown([*rows, rows[0] | {"scores": None, "failed": "rain", "run": "b"}])


def test_the_training_panel_shows_what_there_is():
    assert (
        measure_of([{"psnr": 20.0, "loss": 1.0}]) == measure_of([]) == "psnr" and measure_of([{"loss": 1.0}]) == "loss"
    )
    last = {"step": 3, "seconds": 61.0}
    assert describe([{"step": 2, "psnr": 10.0}, last | {"psnr": 20.0}]) == "step 3 · PSNR 20.00 dB · 1:01 trained"
    assert describe([last | {"psnr": 20.0}, last | {"psnr": 22.0}]) == "step 3 · PSNR 21.00 dB · 1:01 trained"
    assert describe([last | {"loss": 0.25}]) == "step 3 · loss 0.25 · 1:01 trained"
    assert describe([last]) == "step 3 · 1:01 trained"


def test_a_run_without_any_figure_has_a_report(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    for step in range(1, 6):
        run.log({"step": step, "seconds": 0.1 * step, "terms": {}, "statistics": {"rays": math.pi}})
    assert "<h2>Curves" not in write_report(run).read_text()


# Trivial baselines


def test_a_method_that_shows_less_than_the_nearest_photograph_says_so(tmp_path):
    scene = tiny.scene()
    run = tiny.new_run(tmp_path / "run")
    fit(fresh := run.new_method(CPU), scene, run, steps=1, show=False)
    with pytest.warns(LumigraphWarning, match="photograph alone, which needs no training"):
        result = evaluate_run(run, fresh.eval(), scene)
    fit(learnt := run.new_method(CPU), scene, run, steps=300, show=False)
    assert set(result["baselines"]) == {"mean photograph", "nearest photograph"}
    with warnings.catch_warnings():
        warnings.simplefilter("error", LumigraphWarning)
        evaluate_run(run, learnt.eval(), scene, EvaluationOptions())


def test_baselines_are_made_of_training_photographs_alone():
    scene = tiny.scene()
    stand_ins, held_out = Baselines(scene), int(scene.splits["test"][1])
    found = stand_ins.of(held_out, (tiny.SIZE, tiny.SIZE))
    pictures = [scene.photograph(i).before(scene.frame.background) for i in scene.splits["train"].tolist()]
    torch.testing.assert_close(found["mean photograph"], torch.stack(pictures).mean(0))
    distance = (scene.cameras.position[scene.splits["train"]] - scene.cameras.position[held_out]).norm(dim=-1)
    assert torch.equal(found["nearest photograph"], pictures[int(distance.argmin())])
    assert stand_ins.of(held_out, (12, 6))["nearest photograph"].shape == (12, 6, 3)


def test_a_hull_is_the_baseline_of_a_shape():
    points = torch.tensor([[0.0, 0, 0], [0.95, 0, 0], [0.6, 0.6, 0.6]])
    inside = in_hull(tiny_shapes.ball().mesh.vertices, points)
    assert inside is not None and inside.tolist() == [True, False, False]
    assert in_hull(np.zeros((5, 3)), points) is None
    score = compare_shapes(tiny_shapes.ball(), tiny_shapes.box(), object(), 500)
    assert score.baselines["convex hull"] > 0.95 > (score.iou or 0)
    assert below("run", "IoU", score.iou or 0, score.baselines) and not below("run", "IoU", 1.0, score.baselines)
