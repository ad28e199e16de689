"""Control points lead exports onto the frame of a survey."""

from __future__ import annotations

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph.errors import LumigraphError
from lumigraph.evaluation.control_points import ControlPoint, georeferenced, read_control_points
from lumigraph.geometry import Similarity, to_matrix
from lumigraph.run import Run

pytestmark = budget("runs", 5)

TURN = to_matrix(torch.tensor([[0.8, 0.1, -0.5, 0.3]], dtype=torch.float64))[0]
WORLD = Similarity.make(3.7, TURN, torch.tensor([512345.7, 4649776.2, 312.4], dtype=torch.float64))


def survey(count: int = 5, views: int = 3, error: float = 0.0) -> list[ControlPoint]:
    """Places of the tiny scene and their pixels in some photographs."""
    scene, random = tiny.scene(), torch.Generator().manual_seed(0)
    places = 0.5 * torch.rand(count, 3, generator=random, dtype=torch.float64) - 0.25
    points = []
    for place in places:
        pixels = []
        for i in range(views):
            camera = scene.cameras[i]
            pose = camera.pose[0].double()
            inward = (place - pose[:, 3]) @ pose[:, :3]
            pixel, _ = camera.lens.project(inward[None].float())
            u, v = (pixel[0] + error * torch.randn(2, generator=random)).tolist()
            pixels.append((scene.names[i], u, v))
        target = WORLD.points(scene.frame.to_source.points(place[None]))[0]
        points.append(ControlPoint(tuple(target.tolist()), pixels))
    return points


def table(points: list[ControlPoint], mark: str = ",") -> str:
    rows = [(image, u, v, *point.place) for point in points for image, u, v in point.seen]
    return (
        "\n".join([mark.join(("image", "u", "v", "x", "y", "z")), *(mark.join(map(str, row)) for row in rows)]) + "\n"
    )


def test_points_give_scale_turn_and_offset(ball_run, tmp_path):
    for mark in (",", ";", "\t"):
        (tmp_path / "points.csv").write_text("\ufeff" + table(survey(), mark))
        assert read_control_points(tmp_path / "points.csv") == survey()
    scene, method = tiny.scene(), ball_run.method("cpu")
    found = georeferenced(survey(), scene, method, tmp_path)
    assert found.rms < 1e-3 and found.by_depth == 0
    torch.testing.assert_close(found.world_from_source.matrix, WORLD.matrix, atol=2e-2, rtol=1e-6)
    rough = georeferenced(survey(8, error=0.5), scene, method, tmp_path)
    assert 1e-3 < rough.rms < 1


def test_a_run_remembers_the_frame_of_its_exports(ball_run, tmp_path, monkeypatch):
    import shutil

    shutil.copytree(ball_run.folder, tmp_path / "run")
    run = Run(tmp_path / "run")
    run.set_world(WORLD)
    again = Run(tmp_path / "run").frame
    torch.testing.assert_close(again.to_export.matrix, (WORLD @ again.to_source).matrix)
    assert again.scale == pytest.approx(3.7)
    scene = tiny.scene()
    monkeypatch.setattr("lumigraph.run.folder.open_dataset", lambda *_, **__: scene)
    assert Run(tmp_path / "run").scene() is scene, "its photographs are no others"
    run.set_scale(2.0)
    assert Run(tmp_path / "run").frame.to_export.scale == pytest.approx(2 * again.to_source.scale)


def test_too_little_is_told(ball_run, tmp_path):
    scene, method = tiny.scene(), ball_run.method("cpu")
    with pytest.raises(LumigraphError, match="3 are the least"):
        georeferenced(survey(2), scene, method, tmp_path)
    line = [ControlPoint((float(i), 0.0, 0.0), point.seen) for i, point in enumerate(survey())]
    with pytest.raises(LumigraphError, match="on a line"):
        georeferenced(line, scene, method, tmp_path)
    with pytest.raises(LumigraphError, match="no such photograph"):
        georeferenced([*survey(), ControlPoint((0.0, 0.0, 1.0), [("other.jpg", 1.0, 1.0)])], scene, method, tmp_path)
    (tmp_path / "bad.csv").write_text("a.jpg,1,2,three,4,5\n")
    with pytest.raises(LumigraphError, match="line 1 is not image, u, v"):
        read_control_points(tmp_path / "bad.csv")
    alone = georeferenced(survey(views=1), scene, method, tmp_path)
    assert alone.by_depth == 5 and np.isfinite(alone.residuals).all()
