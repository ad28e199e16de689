"""Masks beside photographs: what is learnt from, what is an object, and the object found by itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from captures import HEIGHT, WIDTH, WRITERS, Tiny, write_ngp
from listing import names
from PIL import Image
from scipy import ndimage
from test_gaussian_splatting import new

from lumigraph.datasets.scene import Scene
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation.views import evaluate
from lumigraph.opening import open_scene
from lumigraph.readers.objects import doubts, mask_object
from lumigraph.readers.objects.segment import at_rest, outlined, segment
from lumigraph.readers.objects.view import ObjectView, find_table
from lumigraph.sfm.folder import copy_masks
from lumigraph.sfm.photos import gather
from lumigraph.sfm.photos.photo import untracked


def write_masks(folder: Path, names: list[str], times: int = 1) -> None:
    """Black on the left half, white on the right, each so many times larger than its photograph."""
    mask = np.zeros((HEIGHT * times, WIDTH * times), np.uint8)
    mask[:, WIDTH * times // 2 :] = 255
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(folder / name)


@pytest.mark.parametrize("layout", WRITERS)
def test_every_reader_learns_only_where_masks_allow(layout, tmp_path):
    folder, source = tmp_path / "scene", Tiny()
    WRITERS[layout](folder, source)
    named = open_scene(folder, downscale=1).names
    inside = [name.removeprefix("images/").removeprefix("./") for name in named]
    write_masks(folder / "masks", [f"{name}.png" for name in inside[:-1]], times=2)
    scene = open_scene(folder, downscale=1)
    for i in range(len(scene)):
        mask = scene.photograph(i).mask
        assert mask is not None
        assert mask[:, WIDTH // 2 :].all() and mask[:, : WIDTH // 2].all() == (i == len(scene) - 1)
    assert not scene.frame.has_alpha


def test_object_masks_are_alpha_and_photographs_without_one_are_left_out(tmp_path):
    source = Tiny()
    write_ngp(tmp_path / "scene", source)
    write_masks(tmp_path / "scene" / "object_masks", [name for name in source.names[1:]])
    with pytest.warns(LumigraphWarning, match="object_masks of images/view_00"):
        scene = open_scene(tmp_path / "scene", downscale=1)
    assert scene.frame.has_alpha and len(scene) == 9 and scene.frame.background == (1.0, 1.0, 1.0)
    photograph = scene.photograph(0)
    assert photograph.mask is None
    assert (photograph.alpha[:, : WIDTH // 2] == 0).all() and (photograph.alpha[:, WIDTH // 2 :] == 1).all()
    assert torch.equal(photograph.rgb, torch.from_numpy(source.pictures[1]) / 255)


def test_masks_that_belong_to_no_photograph_are_told(tmp_path):
    write_ngp(tmp_path / "scene", Tiny())
    write_masks(tmp_path / "scene" / "masks", ["other.png"])
    with pytest.warns(LumigraphWarning, match="None of the masks"):
        assert open_scene(tmp_path / "scene").photograph(0).mask is None


@pytest.mark.parametrize("place", ["images/masks", "masks"])
def test_capture_takes_masks_and_not_for_photographs(place, tmp_path):
    source = Tiny(count=4)
    source.write_images(tmp_path / "all" / "images")
    write_masks(tmp_path / "all" / place, ["view_01.png", "view_02.png.png"], times=3)
    intake = gather([tmp_path / "all" / "images"], tmp_path / "work")
    assert [photo.mask is not None for photo in intake.photos] == [False, True, True, False]
    masks = copy_masks(intake.photos, tmp_path / "masks", untracked)
    assert names(masks) == ["view_01.png.png", "view_02.png.png"]
    copied = np.asarray(Image.open(masks / "view_01.png.png"))
    assert copied.shape == (HEIGHT, WIDTH) and (copied[:, WIDTH // 2 :] > 0).all() and not copied[:, : WIDTH // 2].any()
    assert copy_masks(intake.photos[:1], tmp_path / "none", untracked) is None


def test_a_mask_of_another_shape_is_refused(tmp_path):
    write_ngp(tmp_path, Tiny())
    (tmp_path / "masks").mkdir()
    Image.new("L", (30, 30), 255).save(tmp_path / "masks" / "view_00.png")
    with pytest.raises(LumigraphError, match="is not the image's"):
        open_scene(tmp_path)


# The object, found


SIDE = 72


def photographed(pose: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """A striped ball of radius 0.5 before a cloudy wall that surrounds it, and where the ball is."""
    y, x = torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij")
    focal = tiny.FOCAL * SIDE / tiny.SIZE
    rays = torch.stack([(x - SIDE / 2) / focal, (y - SIDE / 2) / focal, torch.ones_like(x)], -1)
    rays = torch.nn.functional.normalize(rays, dim=-1) @ pose[:, :3].T
    origin = pose[:, 3]
    b = rays @ origin
    under = b * b - (origin @ origin - 0.25)
    hit = under > 0
    surface = origin + (-b - under.clamp_min(0).sqrt())[..., None] * rays
    stripes = (torch.sin(12 * surface[..., 2]) > 0)[..., None]
    own = torch.where(stripes, torch.tensor([0.8, 0.3, 0.1]), torch.tensor([0.9, 0.8, 0.3]))
    cloud = 0.1 * torch.sin(9 * rays[..., :1]) * torch.sin(7 * rays[..., 1:2] + 5 * rays[..., 2:])
    wall = torch.tensor([0.35, 0.45, 0.5]) + cloud
    return torch.where(hit[..., None], own, wall).numpy(), hit.numpy()


def write_ball(folder: Path) -> dict[str, np.ndarray]:
    """Twelve photographs of it with poses; where the ball is, by their names."""
    tiny.write_blender(folder)
    truth = {}
    for i, pose in enumerate(tiny.poses()):
        rgb, inside = photographed(pose)
        name = f"{'train' if i % 4 else 'test'}_{i}.png"
        Image.fromarray((rgb * 255).astype(np.uint8)).save(folder / name)
        truth[name] = inside
    return truth


def test_an_object_before_a_wall_is_found_and_learnt_alone(tmp_path):
    from lumigraph.readers import choose_reader

    folder = tmp_path / "scene"
    truth = write_ball(folder)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    masked = mask_object(folder, choose_reader(folder).read(folder))
    assert masked.photographs == 12 and masked.sheet.is_file()
    assert any("no table" in doubt for doubt in masked.doubts)
    for name, inside in truth.items():
        found = np.asarray(Image.open(folder / "object_masks" / f"{name.removesuffix('.png')}.png")) > 127
        assert (found & inside).sum() / (found | inside).sum() > 0.9, name
    assert all(path.read_bytes() == data for path, data in before.items())
    scene = open_scene(folder)
    assert scene.frame.has_alpha and scene.frame.reach == 1
    with pytest.raises(LumigraphError, match="is there already"):
        mask_object(folder, choose_reader(folder).read(folder))


def test_a_background_at_rest_is_told_from_a_subject_that_turns():
    """By pixels alone, where photographs agree. A background that moves with the camera says nothing."""
    cloud = photographed(tiny.poses()[0])[0]
    pairs = [photographed(pose) for pose in tiny.poses()]
    for still in (True, False):
        chance = np.random.default_rng(0)
        views = []
        for i, (rgb, inside) in enumerate(pairs):
            behind = cloud[::-1] if still else chance.random(rgb.shape)
            shown = torch.from_numpy(np.where(inside[..., None], rgb, behind)).float()
            views.append(ObjectView.of(f"{i}", tiny.scene().cameras[i].resized(SIDE / tiny.SIZE), shown))
        found = at_rest(views, [np.hypot(*np.indices((SIDE, SIDE)) - SIDE / 2) < 0.3 * SIDE] * len(views))
        evidence = np.concatenate([ratio[~inside] for ratio, (_, inside) in zip(found, pairs, strict=True)])
        assert np.median(evidence) > 2 if still else not evidence.any()
        if still:
            guesses = [
                view.mean(ndimage.binary_dilation(x, iterations=5).astype(float)) > 0.5
                for view, (_, x) in zip(views, pairs, strict=True)
            ]
            for mask, (_, inside) in zip(outlined(views, guesses), pairs, strict=True):
                assert (mask & inside).sum() / (mask | inside).sum() > 0.8  # the guesses: 0.65


def test_noise_holds_no_object():
    scene = tiny.scene()
    chance = torch.Generator().manual_seed(0)
    views = [
        ObjectView.of(scene.names[i], scene.cameras[i], 0.5 + 0.001 * torch.rand(24, 24, 3, generator=chance))
        for i in range(len(scene))
    ]
    with pytest.raises(LumigraphError, match="no object can be told from the rest"):
        segment(views, None)


def test_what_is_unsure_is_told():
    scene = tiny.scene()
    rgb = [torch.from_numpy(photographed(pose)[0]) for pose in tiny.poses()[::2]]
    cameras = [scene.cameras[i].resized(SIDE / tiny.SIZE) for i in range(0, 12, 2)]
    views = [ObjectView.of(f"{i}.jpg", camera, x) for i, (camera, x) in enumerate(zip(cameras, rgb, strict=True))]
    sure = replace(segment(views, None), overlaps=np.full(6, 0.9))
    assert sure.distinct > 0.95
    assert [doubt[:8] for doubt in doubts(sure)] == ["no table"]
    unsure = replace(sure, distinct=0.6, overlaps=np.where(np.arange(6) == 2, 0.3, 0.9), body=sure.region.cells)
    told = " ".join(doubts(unsure))
    assert "colours of what is around it" in told and "(2.jpg)" in told and "no object at all" in told


def test_the_table_is_the_plane_below(generator):
    table = torch.rand(300, 3, generator=generator) * torch.tensor([2.0, 2.0, 0.004]) - torch.tensor([1.0, 1.0, 0.3])
    thing = torch.rand(200, 3, generator=generator) - torch.tensor([0.5, 0.5, 0.28])
    found = find_table(torch.cat([table, thing]))
    assert found is not None and found.normal[2] > 0.999 and abs(found.height + 0.298) < 0.005
    assert find_table(thing) is None


def test_a_photograph_that_is_masked_altogether_is_not_compared(monkeypatch):
    scene, photograph = tiny.scene(), Scene.photograph

    def masked(self, index, *layers):
        shot = photograph(self, index, *layers)
        return replace(shot, mask=torch.full(shot.rgb.shape[:2], index != bad))

    monkeypatch.setattr(Scene, "photograph", masked)
    method = new()[0]
    bad = int(scene.splits["test"][1])
    found = evaluate(method, scene)
    assert len(found.views) == len(scene.splits["test"]) - 1 and np.isfinite(found.psnr)
    with pytest.raises(LumigraphError, match="nothing of the views"):
        evaluate(method, replace(scene, splits=scene.splits | {"test": scene.splits["test"][1:2]}))
