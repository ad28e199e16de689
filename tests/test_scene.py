"""Scenes and their images: random pixels are the right pixels, evenly drawn, from memory as from a file."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.datasets.images import ImageSource, ImageStore, Runs, runs_of, shuffled_order, spread
from lumigraph.datasets.scene import Frame, Scene
from lumigraph.errors import LumigraphError

SIZES = [(7, 5), (40, 30), (1, 1), (13, 64)]


@pytest.fixture
def images():
    random = np.random.default_rng(0)
    return [random.integers(0, 256, (h, w, 3), dtype=np.uint8) for w, h in SIZES]


@pytest.fixture
def masks():
    random = np.random.default_rng(1)
    masks = [random.random((h, w)) < 0.4 for w, h in SIZES]
    masks[2] = None
    return masks


def pictures(images, masks=None, reads=None):
    """Pictures with identities, which count how often they are read."""

    def read(i):
        if reads is not None:
            reads.append(i)
        return images[i], None if masks is None else masks[i]

    return [ImageSource(im.shape[1::-1], lambda i=i: read(i), f"picture {i}") for i, im in enumerate(images)]


def store(kind, images, masks, folder: Path) -> ImageStore:
    if kind == "memory":
        return ImageStore.from_arrays(images, masks)
    return ImageStore.load(pictures(images, masks), memory=0, cache=folder)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("kind", ["memory", "file"])
class TestStore:
    def test_gives_every_image_back(self, kind, masked, images, masks, tmp_path):
        held = store(kind, images, masks if masked else None, tmp_path)
        assert len(held) == len(images) and held.shuffled == (kind == "file")
        for i, image in enumerate(images):
            assert np.array_equal(held[i], image)
            if masked:
                expected = np.ones(image.shape[:2], bool) if masks[i] is None else masks[i]
                assert np.array_equal(held.mask(i), expected)
            else:
                assert held.mask(i) is None

    def test_draws_the_pixels_it_says(self, kind, masked, images, masks, tmp_path, generator):
        held = store(kind, images, masks if masked else None, tmp_path)
        drawn = held.draw(5000, torch.tensor([0, 1, 3]), generator)
        for image, xy, rgba in zip(drawn.image.tolist(), drawn.xy.tolist(), drawn.rgba.tolist(), strict=True):
            column, row = int(xy[0]), int(xy[1])
            assert xy == [column + 0.5, row + 0.5]
            assert rgba == [*images[image][row, column], 255]
            assert not masked or masks[image][row, column]

    def test_draws_images_evenly_and_all_of_their_pixels(self, kind, masked, images, masks, tmp_path, generator):
        held = store(kind, images, masks if masked else None, tmp_path)
        draws = [held.draw(4096, torch.tensor([0, 1, 3]), generator) for _ in range(20)]
        image, xy = torch.cat([d.image for d in draws]), torch.cat([d.xy for d in draws]).long()
        assert set(image.tolist()) == {0, 1, 3}
        shares = torch.bincount(image) / len(image)
        pieces = len(image) if kind == "memory" else len(image) / 64
        assert (shares[[0, 1, 3]] - 1 / 3).abs().max() < 4 * (2 / 9 / pieces) ** 0.5
        for i in (0, 1, 3):
            seen = np.zeros(images[i].shape[:2], int)
            np.add.at(seen, tuple(xy[image == i].T.flip(0).numpy()), 1)
            wanted = masks[i] if masked else np.ones_like(seen, bool)
            assert (seen[~wanted] == 0).all()
            mean = seen[wanted].mean()
            assert abs(seen[wanted] - mean).max() < 6.5 * mean**0.5 + 2

    def test_is_decided_by_the_generator_alone(self, kind, masked, images, masks, tmp_path):
        held = store(kind, images, masks if masked else None, tmp_path)
        choice = torch.arange(4)
        first, second, other = (held.draw(999, choice, torch.Generator().manual_seed(s)) for s in (5, 5, 6))
        assert torch.equal(first.xy, second.xy) and torch.equal(first.rgba, second.rgba)
        assert not torch.equal(first.xy, other.xy)


def test_alpha_is_kept_where_any_image_has_it(images):
    opaque = np.concatenate([images[0], np.full((5, 7, 1), 255, np.uint8)], -1)
    assert not ImageStore.from_arrays([opaque]).has_alpha
    clear = opaque.copy()
    clear[2, 3, 3] = 17
    held = ImageStore.from_arrays([images[1], clear])
    assert held.has_alpha
    assert np.array_equal(held[1], clear)
    assert np.array_equal(held[0][..., 3], np.full((30, 40), 255))


def test_runs_of_a_mask_are_its_pixels():
    masks = [np.array([[1, 0, 1], [1, 1, 0]], bool), np.ones((1, 2), bool), np.array([[0, 1]], bool)]
    runs = Runs.of([runs_of(mask) for mask in masks])
    assert runs.start.tolist() == [0, 2, 0, 1] and runs.count.tolist() == [4, 2, 1]
    for i, mask in enumerate(masks):
        assert np.array_equal(runs.mask(i, mask.size), mask.ravel())


@pytest.mark.parametrize("count", [1, 2, 3, 10, 64, 997, 4096])
def test_the_shuffle_is_a_permutation(count):
    assert sorted(np.arange(count) * spread(count) % count) == list(range(count))
    mask = np.random.default_rng(count).random(count) < 0.5
    order = shuffled_order(count, mask)
    assert sorted(order) == list(range(count)) and mask[order[: mask.sum()]].all()


def test_a_piece_of_the_shuffle_is_spread_over_the_picture():
    order = shuffled_order(540 * 960, None)
    for begin in (0, 1000, 77777):
        piece = order[begin : begin + 512]
        cells = (piece // 540 // 60) * 9 + piece % 540 // 60  # 16 x 9 cells, 3.6 pixels each
        assert (np.bincount(cells, minlength=144) > 0).mean() > 0.95


def test_a_file_is_used_again_until_a_picture_changes(images, tmp_path):
    reads: list[int] = []
    for _ in range(2):
        ImageStore.load(pictures(images, reads=reads), memory=0, cache=tmp_path)
    assert sorted(reads) == [0, 1, 2, 3]
    changed = pictures(images, reads=reads)
    changed[1] = ImageSource(changed[1].size, changed[1].read, "picture 1, edited")
    ImageStore.load(changed, memory=0, cache=tmp_path)
    assert len(reads) == 8
    nameless = [ImageSource(p.size, p.read) for p in changed]
    for _ in range(2):
        ImageStore.load(nameless, memory=0, cache=tmp_path)
    assert len(reads) == 16
    assert len(list(tmp_path.iterdir())) == 2  # nobody can ask for the nameless again


def test_training_never_writes_to_the_file(images, tmp_path):
    held = ImageStore.load(pictures(images), memory=0, cache=tmp_path)
    (file,) = tmp_path.glob("*/pixels")
    before = file.read_bytes()
    held._rgba.zero_()
    assert file.read_bytes() == before


def test_a_full_disk_is_told_and_nothing_left(images, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(LumigraphError, match="No space left.*LUMIGRAPH_CACHE"):
        ImageStore.load(pictures(images), memory=0, cache=tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_picture_that_cannot_be_read_leaves_nothing(images, tmp_path):
    def broken():
        raise LumigraphError("b.png is damaged")

    with pytest.raises(LumigraphError, match=r"b\.png is damaged"):
        ImageStore.load([*pictures(images), ImageSource((3, 3), broken, "b")], memory=0, cache=tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_budget_decides(images, tmp_path):
    bytes_needed = 4 * sum(w * h for w, h in SIZES)
    assert not ImageStore.load(pictures(images), memory=bytes_needed, cache=tmp_path).shuffled
    assert ImageStore.load(pictures(images), memory=bytes_needed - 1, cache=tmp_path).shuffled


@pytest.fixture
def scene(images, generator):
    count = len(images)
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator)).Q
    rotation = rotation * torch.linalg.det(rotation)[:, None, None]
    pose = torch.cat([rotation, torch.randn(count, 3, 1, generator=generator)], -1)
    size = torch.tensor(SIZES)
    lens = Pinhole(50 + 10 * torch.rand(count, 2, generator=generator), size / 2.0)
    cameras = Camera(pose, lens, size, None, torch.arange(count))
    splits = {"train": torch.tensor([1, 3]), "test": torch.tensor([0])}
    return Scene(cameras, ImageStore.from_arrays(images), Frame(), splits, [str(i) for i in range(count)])


def test_sampled_rays_pass_through_their_pixels(scene, images, generator):
    batch = scene.sample_rays(2000, generator)
    assert len(batch) == 2000 and batch.alpha is None
    assert set(batch.rays.image_index.tolist()) == {1, 3}
    pixels, valid = scene.cameras.project(batch.rays.at(torch.full((2000,), 2.0)), batch.rays.image_index)
    assert valid.all()
    torch.testing.assert_close(pixels, pixels.floor() + 0.5, rtol=0, atol=1e-3)
    for image, (x, y), rgb in zip(batch.rays.image_index.tolist(), pixels.long().tolist(), batch.rgb, strict=True):
        torch.testing.assert_close(rgb, torch.from_numpy(images[image][y, x]) / 255.0)


def test_held_out_images_are_never_sampled(scene, generator):
    assert set(scene.sample_rays(500, generator, split="test").rays.image_index.tolist()) == {0}


def test_a_photograph_is_a_camera_and_its_picture(scene, images):
    photograph = scene.photograph(3)
    assert len(photograph.camera) == 1 and photograph.camera.size.tolist() == [[13, 64]]
    assert photograph.alpha is None and photograph.extra == {}
    torch.testing.assert_close(photograph.rgb, torch.from_numpy(images[3]) / 255.0)


def test_alpha_comes_with_the_rays(scene, images, generator):
    clear = [np.concatenate([im, np.full((*im.shape[:2], 1), 51, np.uint8)], -1) for im in images]
    batch = Scene(scene.cameras, ImageStore.from_arrays(clear), Frame(), scene.splits, scene.names).sample_rays(
        10, generator
    )
    assert batch.alpha is not None
    torch.testing.assert_close(batch.alpha, torch.full((10,), 0.2))


def test_a_frame_survives_json():
    matrix = ((0.5, 0.0, 0.0, 1.0), (0.0, 0.5, 0.0, 2.0), (0.0, 0.0, 0.5, 0.1), (0.0, 0.0, 0.0, 1.0))
    frame = Frame(((-1, -0.3, 0.1), (1.0, 1 / 3, 0.7)), 16.0, 0.01, (1.0, 1.0, 1.0), True, 12, matrix)
    assert Frame.from_json(json.loads(json.dumps(frame.to_json()))) == frame
