"""One scene at several resolutions: the same photographs, smaller, drawn and compared as Mip-NeRF's protocol says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from captures import HEIGHT, WIDTH, Tiny, write_colmap, write_ngp

from lumigraph.commands.cli import main
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Scene
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.opening import open_scene
from lumigraph.readers import multiscale
from lumigraph.run import Run, State

pytestmark = budget("runs")


@pytest.fixture
def folder(ball_folder):
    return ball_folder


def test_every_photograph_is_there_at_every_scale(folder):
    scene, whole = open_scene(folder, scales=2), open_scene(folder)
    assert scene.frame == whole.frame and open_scene(folder, scales=1).names == whole.names
    assert scene.names == whole.names + [f"{name}@1/2" for name in whole.names]
    assert scene.images.sizes.tolist() == scene.cameras.size.tolist() == [[24, 24]] * 12 + [[12, 12]] * 12
    assert scene.cameras.image_index.tolist() == 2 * list(range(12))  # what a photograph learns, its copies learn too
    for split, index in whole.splits.items():
        held = {scene.names[i].partition("@")[0] for i in scene.splits[split]}
        assert held == {whole.names[i] for i in index} and len(scene.splits[split]) == 2 * len(index)
    for i in range(12):
        assert torch.equal(scene.images[i], whole.images[i])


def test_every_8th_photograph_is_held_out_not_every_8th_copy(tmp_path):
    scene = open_scene(write_ngp(tmp_path, Tiny(10)), scales=2)
    assert [scene.names[i] for i in scene.splits["test"]] == [
        f"images/view_{i:02d}.png{scale}" for scale in ("", "@1/2") for i in (0, 8)
    ]


def test_copies_are_means_of_what_covers_them(folder):
    """A square of four bytes (r, g, b, a) becomes sum(a r) / sum(a) and mean(a)."""
    scene = open_scene(folder, scales=2)
    for i in (1, 7):
        squares = scene.images[i].double().view(12, 2, 12, 2, 4)
        alpha = squares[..., 3:].sum((1, 3))
        colour = (squares[..., :3] * squares[..., 3:]).sum((1, 3)) / alpha.clamp_min(1)
        expected = torch.cat([colour, alpha / 4], -1)
        assert 0 < (expected[..., 3] % 255 != 0).sum()  # the ball has an edge
        assert (scene.images[12 + i] - expected).abs().max() <= 0.501


def test_a_camera_half_as_large_sees_the_same_through_pixels_twice_as_wide(folder):
    scene = open_scene(folder, scales=2)
    large, small = scene.cameras[3], scene.cameras[15]
    corners = torch.tensor([[0.0, 0.0], [24.0, 24.0], [12.0, 12.0], [5.0, 20.0]])
    a, b = large.rays(corners), small.rays(corners / 2)
    torch.testing.assert_close(a.directions, b.directions)
    torch.testing.assert_close(2 * a.radius, b.radius)
    assert torch.equal(a.origins, b.origins)


def test_pixels_are_drawn_in_proportion_to_their_footprint(folder, generator):
    """The paper's weights, in expectation: 4 for a pixel that covers four."""
    scene = open_scene(folder, scales=2)
    radius = scene.sample_rays(200_000, generator).rays.radius
    middle = scene.cameras[0].rays(torch.tensor([[12.0, 12.0]])).radius
    small = radius > 1.3 * middle  # pixels at a corner of the picture are 0.85 as large as in the middle
    per_pixel = torch.stack([(~small).sum() / 24**2, small.sum() / 12**2])
    assert float(per_pixel[1] / per_pixel[0]) == pytest.approx(4, rel=0.02)


def test_what_fills_no_square_is_left_out(tmp_path):
    scene = multiscale(replace_images(open_scene(write_ngp(tmp_path, Tiny(10))), 47, 35), 2)
    assert scene.cameras.size[10:].tolist() == scene.images.sizes[10:].tolist() == [[23, 17]] * 10
    corner = torch.tensor([[22.0, 17.0]])
    torch.testing.assert_close(scene.cameras[0].rays(2 * corner).directions, scene.cameras[10].rays(corner).directions)


def replace_images(scene: Scene, width: int, height: int) -> Scene:
    """The upper left parts of all photographs."""
    parts = ImageStore.from_arrays([np.ascontiguousarray(scene.images[i][:height, :width]) for i in range(len(scene))])
    return replace(scene, images=parts, cameras=replace(scene.cameras, size=parts.sizes))


def test_masks_shrink_to_pixels_that_are_good_all_over(tmp_path):
    scene = open_scene(write_colmap(tmp_path, Tiny(10)))
    masks = [np.ones((HEIGHT, WIDTH), bool) for _ in range(10)]
    masks[1][5, 7] = False
    arrays = [scene.images[i].numpy() for i in range(10)]
    seen = multiscale(replace(scene, images=ImageStore.from_arrays(arrays, masks)), 2)
    bad = (~seen.images.mask(11)).nonzero().tolist()
    assert bad == [[2, 3]] and bool(seen.images.mask(10).all())
    masks[1][::2] = False
    with pytest.raises(LumigraphError, match="trusts no whole pixel of view_01.png@1/2"):
        multiscale(replace(scene, images=ImageStore.from_arrays(arrays, masks)), 2)


def test_copies_from_a_file_are_those_from_memory(folder, tmp_path):
    kept, mapped = open_scene(folder, scales=2), open_scene(folder, scales=2, memory=0, cache=tmp_path / "cache")
    assert mapped.images.shuffled and not kept.images.shuffled
    assert all(torch.equal(kept.images[i], mapped.images[i]) for i in range(24))


@pytest.mark.parametrize("scales", [0, 3])
def test_no_smaller_than_can_be_compared(folder, scales):
    with pytest.raises(LumigraphError, match="from 1 to 2"):
        open_scene(folder, scales=scales)


def test_scores_are_told_for_each_resolution(folder):
    scene, method = open_scene(folder, scales=2), tiny.method()
    found = evaluate(method, scene).to_json()
    parts = found["by_resolution"]
    assert list(parts) == ["24x24", "12x12"]
    for k, (size, part) in enumerate(parts.items()):
        alone = evaluate(method, replace(scene, splits={"test": scene.splits["test"][3 * k : 3 * k + 3]})).to_json()
        assert part == {"psnr": alone["psnr"], "ssim": alone["ssim"], "lpips": None, "views": 3}
        assert "by_resolution" not in alone and alone["protocol"]["resolution"] == size
    assert found["psnr"] == pytest.approx(sum(part["psnr"] for part in parts.values()) / 2)  # over views, as published
    assert parts["24x24"]["psnr"] != parts["12x12"]["psnr"]


def test_eval_prints_a_line_for_each_resolution(folder, tmp_path, capsys):
    scene = open_scene(folder, scales=2)
    method = tiny.method(scene.frame)
    run = Run.create(tmp_path / "run", method, scene, options={"scales": 2})
    run.save(State(), method, method.optimizers(), torch.Generator())
    assert main(["eval", str(run.folder), "--device", "cpu", "--save-images"]) == 0
    printed = capsys.readouterr().out
    assert "24x24" in printed and "12x12" in printed and "3 views" in printed
    assert len(list((run.folder / "eval").glob("*.png"))) == 6


def test_a_run_opens_the_same_scales_again(folder, tmp_path):
    scene = open_scene(folder, scales=2)
    run = Run.create(tmp_path / "run", tiny.method(scene.frame), scene, options={"scales": 2})
    assert Run(run.folder).scene().names == scene.names
    assert len(run.cameras()["train"]) == len(scene.splits["train"])


@pytest.mark.parametrize(("downscale", "halves"), [(2, True), (3, False)])
def test_photographs_smaller_than_a_window_of_ssim_are_refused(folder, downscale, halves):
    scene, larger = (open_scene(folder, downscale=x) for x in (downscale, downscale - 1))
    method = tiny.method(scene.frame)
    size, part = 24 // downscale, "the right half of " if halves else ""
    with pytest.raises(LumigraphError, match=rf"11 x 11 pixels, and {part}\S+, of {size}x{size} pixels, has fewer"):
        evaluate(method, scene, EvaluationOptions(right_halves=halves))
    assert len(evaluate(method, larger, EvaluationOptions(views=1, right_halves=halves)).views) == 1
