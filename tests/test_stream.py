"""Photographs that neither memory nor a file can hold: read again and again, each pixel as likely as the next."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from lumigraph.datasets.images import ImageSource, ImageStream, Layer, LayerSource, stream
from lumigraph.errors import LumigraphError
from lumigraph.opening import open_scene

WIDTH, HEIGHT = 8, 6


def picture(number: int, alpha: bool = False) -> np.ndarray:
    """Bytes that say of which photograph and from which place they are."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    channels = [np.full_like(x, number), x, y, *([np.full_like(x, 200)] if alpha else [])]
    return np.stack(channels, -1).astype(np.uint8)


def sources(count: int, mask: np.ndarray | None = None, opaque: tuple[int, ...] | None = None) -> list[ImageSource]:
    def read(number: int) -> tuple[np.ndarray, np.ndarray | None]:
        return picture(number, opaque is not None and number not in opaque), mask

    return [ImageSource((WIDTH, HEIGHT), partial(read, k), str(k)) for k in range(count)]


@pytest.fixture
def small(monkeypatch):
    """Few pixels stay, of few photographs."""
    for name, value in {"KEPT_PIXELS": 10, "RAYS_PER_READ": 8, "FIRST_VIEWS": 3, "READ_AHEAD": 2}.items():
        monkeypatch.setattr(stream, name, value)


def drawn(images: ImageStream, chosen: list[int], batches: int, seed: int = 0, rays: int = 16) -> torch.Tensor:
    """Rows of image, x, y, and what was there."""
    generator, rows = torch.Generator().manual_seed(seed), []
    for _ in range(batches):
        batch = images.draw(rays, torch.tensor(chosen), generator)
        rows.append(torch.cat([batch.image[:, None], batch.xy, batch.rgba], -1))
    return torch.cat(rows)


def test_every_trusted_pixel_of_every_photograph_is_as_likely_as_the_next(small):
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[2:4, 1:7] = False
    images = ImageStream(sources(7, mask), memory=0)
    chosen = [0, 2, 3, 6]
    rows = drawn(images, chosen, 2500)
    image, x, y = rows[:, 0], rows[:, 1] - 0.5, rows[:, 2] - 0.5
    assert torch.equal(rows[:, 3:], torch.stack([image, x, y, torch.full_like(x, 255)], -1))  # it lies where it says
    places = (image * HEIGHT * WIDTH + y * WIDTH + x).long()
    count = torch.bincount(places, minlength=7 * HEIGHT * WIDTH).view(7, HEIGHT, WIDTH).double()
    trusted = torch.from_numpy(mask).expand(7, -1, -1).clone()
    trusted[[1, 4, 5]] = False
    assert (count[~trusted] == 0).all()
    expected = count.sum() / trusted.sum()
    assert (count[trusted] / expected - 1).abs().max() < 0.4
    assert (count.sum((1, 2))[chosen] / count.sum() - 1 / len(chosen)).abs().max() < 0.02


def test_what_is_drawn_depends_on_the_seed_alone(small):
    """However long a reader takes."""

    def slow(read, number):
        torch.rand(3 * number)
        __import__("time").sleep(0.001 * (number % 3))
        return read()

    late = [ImageSource(s.size, partial(slow, s.read, k), s.identity) for k, s in enumerate(sources(9))]
    first, second = (drawn(ImageStream(s, memory=0), list(range(9)), 40) for s in (sources(9), late))
    assert torch.equal(first, second)
    assert not torch.equal(first, drawn(ImageStream(sources(9), memory=0), list(range(9)), 40, seed=1))


def test_a_photograph_is_read_once_for_many_rays(small):
    reads = []
    counted = [
        ImageSource(s.size, partial(lambda read, k: (reads.append(k), read())[1], s.read, k))
        for k, s in enumerate(sources(50))
    ]
    images = ImageStream(counted, memory=0)
    reads.clear()
    drawn(images, list(range(50)), 100, rays=4)
    assert len(reads) <= 3 + 400 // 8 + 3  # the first, one for every 8 rays, those ahead
    assert len(set(reads)) > 40


def test_whole_photographs_and_their_layers_are_read_when_asked_for(small):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[1] = True
    images = ImageStream(sources(4, mask), memory=0)
    assert torch.equal(images[3], torch.from_numpy(picture(3))) and torch.equal(images.mask(3), torch.from_numpy(mask))
    asked = []

    def depth(number: int) -> np.ndarray:
        asked.append(number)
        return np.full((HEIGHT, WIDTH), number, np.float32)

    layer = Layer(images, [LayerSource(partial(depth, k)) for k in range(4)], np.dtype(np.float32), 1, "distance")
    assert (layer.stored(2) == 2).all() and asked == [2]
    with pytest.raises(LumigraphError, match="beside photographs cannot be learnt from while they stream"):
        images.draw(4, torch.arange(4), torch.Generator(), positions=True)


def test_alpha_is_known_from_the_first_and_a_stranger_is_named(small):
    assert ImageStream(sources(4, opaque=()), memory=0).has_alpha
    images = ImageStream(sources(40, opaque=tuple(k for k in range(40) if k != 5)), memory=0)
    assert not images.has_alpha
    with pytest.raises(LumigraphError, match="photograph 5 is see-through"):
        drawn(images, list(range(40)), 40)


def test_memory_holds_as_many_photographs_as_it_says():
    reading = stream.READER_THREADS * stream.READING_COPIES * 4 * WIDTH * HEIGHT
    room = 40
    images = ImageStream(sources(200), reading + (room + stream.READ_AHEAD) * 8 * stream.KEPT_PIXELS)
    drawn(images, list(range(200)), 1)
    assert images._rgba_of.nbytes + images._pixel.nbytes == room * 8 * stream.KEPT_PIXELS


def test_pictures_that_memory_does_not_hold_are_the_same_and_announced(tmp_path, monkeypatch, capsys):
    held = stream.load(sources(5), memory=10**6)
    assert capsys.readouterr().err == ""
    filed = stream.load(sources(5), memory=100, cache=tmp_path)
    assert (
        "Photographs take 0.0 GB decoded, and memory has 0.0 GB for them, so they go to a file in"
        in (said := capsys.readouterr().err)
        and said.count("\n") == 1
    )
    monkeypatch.setattr(stream, "address_limit", lambda: [(10**6, 10**6 - 100)])  # a mapped file takes addresses
    streamed = stream.load(sources(5), memory=100, cache=tmp_path)
    assert "read from their files again and again" in capsys.readouterr().err
    assert not filed.streams and filed.shuffled and isinstance(streamed, ImageStream)
    for k in range(5):
        assert torch.equal(held[k], filed[k]) and torch.equal(held[k], streamed[k])


def test_a_folder_larger_than_memory_and_disk_opens_and_gives_rays(tmp_path, monkeypatch, ball_folder):
    """A capture streams where the disk has no room, and is the same as in memory."""
    inside = open_scene(ball_folder)
    monkeypatch.setattr(stream, "free_space", lambda folder: 100)
    scene = open_scene(ball_folder, memory=0, cache=tmp_path / "cache")
    assert isinstance(scene.images, ImageStream) and not (tmp_path / "cache").exists()
    assert scene.frame == inside.frame and torch.equal(scene.cameras.pose, inside.cameras.pose)
    assert torch.equal(scene.photograph(1).rgb, inside.photograph(1).rgb)
    batch = scene.images.draw(64, scene.splits["train"], torch.Generator().manual_seed(0))
    there = [inside.images[i][y, x] for i, (x, y) in zip(batch.image.tolist(), batch.xy.long().tolist(), strict=True)]
    assert torch.equal(batch.rgba, torch.stack(there))
    assert len(scene.sample_rays(32, torch.Generator().manual_seed(0)).rgb) == 32
