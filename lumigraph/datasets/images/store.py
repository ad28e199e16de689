"""ImageStore: all photographs of a scene as bytes, in memory or, if they are too large, in a file."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ...files import read_json
from ...system.memory import memory_for_images
from .cache import MARK_FILE, cache_folder, check_size, filled, in_parallel, key, new_file
from .pixel_sampling import sample_pixels

READS_PER_BATCH = 64  # about so many reads per batch from a file
MIN_PIECE, MAX_PIECE = 64, 1024  # pixels; the longest fills a page


@dataclass(frozen=True)
class Runs:
    """Run-length encoded masks, row by row: a run begins at pixel `start` and is preceded by `before` trusted pixels,
    counted from the first image on. Image i has count[i] trusted pixels."""

    start: Int[Tensor, " run"]
    before: Int[Tensor, " run"]
    count: Int[Tensor, " image"]

    def columns(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """start, before, the trusted pixels before each image, and each image's first run, one longer than images."""
        ahead = self.count.cumsum(0) - self.count
        first_run = torch.searchsorted(self.before, torch.cat([ahead, self.count.sum()[None]]))
        return self.start, self.before, ahead, first_run

    @staticmethod
    def of(found: Sequence[tuple[np.ndarray, np.ndarray]]) -> Runs:
        """Concatenate the runs of images, each from `runs_of`."""
        starts, lengths = zip(*found, strict=True)
        length = torch.from_numpy(np.concatenate(lengths))
        count = torch.tensor([int(x.sum()) for x in lengths])
        return Runs(torch.from_numpy(np.concatenate(starts)), length.cumsum(0) - length, count)

    def mask(self, image: int, pixels: int) -> Bool[Tensor, " pixel"]:
        ahead, own = int(self.count[:image].sum()), int(self.count[image])
        rank = torch.arange(ahead, ahead + own)
        run = torch.searchsorted(self.before, rank, right=True) - 1
        trusted = torch.zeros(pixels, dtype=torch.bool)
        trusted[self.start[run] + rank - self.before[run]] = True
        return trusted


def runs_of(mask: Bool[np.ndarray, "height width"]) -> tuple[np.ndarray, np.ndarray]:
    """Runs of trusted pixels, row by row: the pixel at which each begins, and its length in pixels."""
    edges = np.flatnonzero(np.diff(mask.ravel().astype(np.int8), prepend=0, append=0))
    return edges[::2], edges[1::2] - edges[::2]


def spread(count: int) -> int:
    """Factor a of the pixel shuffle of `count` pixels."""
    a = max(round(count * (math.sqrt(5) - 1) / 2), 1)
    while math.gcd(a, count) != 1:
        a += 1
    return a


def shuffled_order(pixels: int, mask: Tensor | np.ndarray | None) -> Int[np.ndarray, " pixel"]:
    """Pixel at each position of the file: trusted, shuffled so that random batches are short reads; then others."""
    trusted = np.arange(pixels) if mask is None else np.flatnonzero(np.asarray(mask))
    shuffled = trusted[np.arange(len(trusted)) * spread(len(trusted)) % max(len(trusted), 1)]
    return shuffled if mask is None else np.concatenate([shuffled, np.flatnonzero(~np.asarray(mask).ravel())])


@dataclass(frozen=True)
class StoreMark:
    """Contents of the mark file of a store."""

    has_alpha: bool
    trusted: bool


@dataclass(frozen=True)
class ImageSource:
    """Source of one photograph.

    size:     (width, height) of the result of `read`
    read:     returns the pixels, uint8 (height, width, 3 or 4), and a mask of trusted ones (None: all)
    identity: determines the pixels (file, its date and size, scaling); None if unknown
    decoding: peak bytes of `read`; limits the number of parallel calls
    """

    size: tuple[int, int]
    read: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    identity: str | None = None
    decoding: int = 0


@dataclass(frozen=True)
class PixelBatch:
    """Random pixels: image, coordinates (x, y), and bytes (red, green, blue, alpha; 255 without alpha).

    position: in the store and in every layer; None where not requested
    """

    image: Int[Tensor, " pixel"]
    xy: Float[Tensor, "pixel 2"]
    rgba: UInt8[Tensor, "pixel 4"]
    position: Int[Tensor, " pixel"] | None = None


class ImageStore:
    """Photographs of any sizes, concatenated, four bytes per pixel so that a pixel is one load.

    In a file, each image's pixels are shuffled: pixel (a s) mod n at position s, with a an integer near
    n / golden ratio that is coprime to n. Consecutive positions are then spread evenly over the picture, so
    a random batch is a few short reads rather than one disk access for every ray.

    rgba:     all pixels, four bytes seen as one int32
    sizes:    (width, height) of each image
    trusted:  mask of training pixels per image, or None for all
    name:     hash of the decoded pictures; None if unknown
    memory:   bytes left for layers; None means a share of the machine's
    cache:    folder for data that exceeds memory; None means the user's cache folder
    """

    streams = False  # whether photographs are read again and again, so that they have no place

    def __init__(
        self,
        rgba: Int[Tensor, " pixel"],
        sizes: Int[Tensor, "image 2"],
        has_alpha: bool,
        trusted: Runs | None = None,
        shuffled: bool = False,
        name: str | None = None,
        memory: int | None = None,
        cache: Path | None = None,
    ):
        self._rgba, self.sizes, self.has_alpha, self._trusted, self.shuffled = rgba, sizes, has_alpha, trusted, shuffled
        self.name, self.cache = name, cache
        self._memory = memory_for_images() if memory is None else memory
        pixels = sizes.prod(-1)
        self._first = pixels.cumsum(0) - pixels
        self._width = sizes[:, 0].contiguous()
        self._count = pixels if trusted is None else trusted.count
        self._stride = torch.tensor([spread(n) if shuffled else 1 for n in self._count.tolist()])

    @classmethod
    def load(
        cls,
        pictures: Sequence[ImageSource],
        memory: int | None = None,
        cache: Path | None = None,
        progress: Callable[[int], object] = lambda done: None,
    ) -> ImageStore:
        """Read pictures in parallel.

        memory:   bytes that may stay in memory; None means a share of the machine's
        cache:    folder for larger captures; None means the user's cache folder. It may be deleted at any time.
        progress: called with the number of finished ones
        Raises LumigraphError for a full disk, and all errors of the pictures' `read`.
        """
        sizes = torch.tensor([p.size for p in pictures])
        total, memory = int(sizes.prod(-1).sum()), memory_for_images() if memory is None else memory
        nameless = any(p.identity is None for p in pictures)
        called = name_of(pictures)
        if 4 * total <= memory:
            rgba = np.empty(total, np.int32)
            has_alpha, trusted = fill(rgba, pictures, progress, shuffled=False)
            left, name = memory - 4 * total, None if nameless else f"{called} in order"
            return cls(torch.from_numpy(rgba), sizes, has_alpha, trusted, False, name, left, cache)
        folder = (cache or cache_folder() / "images") / called
        if not (folder / MARK_FILE).exists():
            write_store(folder, total, pictures, progress)
        about = read_json(folder / MARK_FILE, StoreMark)
        check_size(folder / "pixels", 4 * total)
        trusted = None
        if about.trusted:
            trusted = Runs(*map(torch.from_numpy, np.load(folder / "trusted.npz", allow_pickle=False).values()))
        # Copy on write: PyTorch requires a writable array, and the file must stay as it is.
        rgba = np.memmap(folder / "pixels", np.int32, "c")
        if nameless:
            shutil.rmtree(folder, ignore_errors=True)  # it has no name to be found by; what is mapped stays
        name = None if nameless else f"{called} shuffled"
        return cls(torch.from_numpy(rgba), sizes, about.has_alpha, trusted, True, name, memory, cache)

    @classmethod
    def from_arrays(cls, images: Sequence[np.ndarray], masks: Sequence[np.ndarray | None] | None = None) -> ImageStore:
        """Store of arrays: uint8 (height, width, 3 or 4), and optionally masks of trusted pixels."""

        def source(image: np.ndarray, mask: np.ndarray | None) -> ImageSource:
            return ImageSource((image.shape[1], image.shape[0]), lambda: (image, mask))

        pairs = zip(images, masks or [None] * len(images), strict=True)
        return cls.load([source(*pair) for pair in pairs], memory=sys.maxsize)

    def __len__(self) -> int:
        return len(self.sizes)

    def __getitem__(self, index: int) -> UInt8[Tensor, "height width channel"]:
        """One image's bytes, with alpha where the store has it."""
        width, height = self.sizes[index].tolist()
        first = int(self._first[index])
        rgba = self._rgba[first : first + width * height]
        if self.shuffled:
            natural = torch.empty_like(rgba)
            natural[torch.from_numpy(shuffled_order(width * height, self.mask(index)))] = rgba
            rgba = natural
        return rgba.view(torch.uint8).view(height, width, 4)[..., : 4 if self.has_alpha else 3]

    def mask(self, index: int) -> Bool[Tensor, "height width"] | None:
        """Mask of an image's pixels to use; None if no image of the store has a mask."""
        if self._trusted is None:
            return None
        width, height = self.sizes[index].tolist()
        return self._trusted.mask(index, width * height).view(height, width)

    @property
    def may_have_masks(self) -> bool:
        """False if all pixels of all images are to be used."""
        return self._trusted is not None

    @property
    def trusted_pixels(self) -> Int[Tensor, " image"]:
        """Number of trainable pixels of each image."""
        return self._count

    def order(self, index: int) -> Int[np.ndarray, " pixel"] | None:
        """Pixel of an image, as a row-major index, at each of its positions; None if they are row by row."""
        return shuffled_order(int(self.sizes[index].prod()), self.mask(index)) if self.shuffled else None

    def span(self, index: int) -> slice:
        """The positions of an image."""
        first = int(self._first[index])
        return slice(first, first + int(self.sizes[index].prod()))

    def grant(self, size: int) -> bool:
        """Reserve bytes of the memory budget; False if they exceed it."""
        granted = size <= self._memory
        self._memory -= size if granted else 0
        return granted

    def draw(
        self, count: int, images: Int[Tensor, " choice"], generator: torch.Generator, positions: bool = False
    ) -> PixelBatch:
        """Random pixels: images uniformly, then their trusted pixels uniformly.

        positions: also return their positions, for layers
        """
        piece = min(max(count // READS_PER_BATCH, MIN_PIECE), MAX_PIECE) if self.shuffled else 1
        chance = torch.rand(-(-count // piece), dtype=torch.float64, generator=generator)
        image, xy = torch.empty(count, dtype=torch.int64), torch.empty(count, 2)
        rgba = torch.empty(count, 4, dtype=torch.uint8)
        nothing = torch.empty(0, dtype=torch.int64)
        position = torch.empty(count, dtype=torch.int64) if positions else nothing
        runs = (nothing,) * 4 if self._trusted is None else self._trusted.columns()
        inputs = (chance, images, self._first, self._count, self._stride, self._width, *runs, self._rgba)
        sample_pixels(piece, *(x.numpy() for x in (*inputs, image, xy, rgba.view(torch.int32)[:, 0], position)))
        return PixelBatch(image, xy, rgba, position if positions else None)


def name_of(pictures: Sequence[ImageSource]) -> str:
    """File name for these pictures."""
    return key(p.identity and f"{p.size} {p.identity}" for p in pictures)


def whole(picture: ImageSource) -> tuple[UInt8[np.ndarray, "height width 4"], Bool[np.ndarray, "height width"] | None]:
    """A photograph's pixels, four bytes each, and which of them to trust; None for all."""
    image, mask = picture.read()
    assert image.shape[1::-1] == picture.size, f"promised {picture.size}, read {image.shape}"
    four = np.full((*image.shape[:2], 4), 255, np.uint8)
    four[..., : image.shape[2]] = image
    return four, None if mask is None or mask.all() else mask.astype(bool)


def see_through(pixels: UInt8[np.ndarray, "height width 4"]) -> bool:
    return bool((pixels[..., 3] < 255).any())


def fill(
    rgba: np.ndarray, pictures: Sequence[ImageSource], progress: Callable[[int], object], shuffled: bool
) -> tuple[bool, Runs | None]:
    """Read all pictures into their places. Returns whether any has transparency, and the runs of trusted pixels."""
    ends = np.cumsum([p.size[0] * p.size[1] for p in pictures])

    def read(index: int) -> tuple[bool, tuple[np.ndarray, np.ndarray] | None]:
        pixels, mask = whole(pictures[index])
        one = pixels.view(np.int32).ravel()
        rgba[ends[index] - len(one) : ends[index]] = one[shuffled_order(len(one), mask)] if shuffled else one
        return see_through(pixels), None if mask is None else runs_of(mask)

    most = max(max(p.decoding, 8 * p.size[0] * p.size[1]) for p in pictures)
    found = in_parallel(read, range(len(pictures)), progress, most)
    trusted = None
    if any(runs is not None for _, runs in found):
        pairs = zip(found, pictures, strict=True)
        trusted = Runs.of([runs or (np.array([0]), np.array([p.size[0] * p.size[1]])) for (_, runs), p in pairs])
    return any(alpha for alpha, _ in found), trusted


def write_store(folder: Path, total: int, pictures: Sequence[ImageSource], progress: Callable[[int], object]) -> None:
    with filled(folder, 4 * total) as part:
        rgba = new_file(part / "pixels", np.int32, (total,))
        has_alpha, trusted = fill(rgba, pictures, progress, shuffled=True)
        rgba.flush()
        if trusted is not None:
            start, before, count = (x.numpy() for x in (trusted.start, trusted.before, trusted.count))
            np.savez(part / "trusted.npz", start=start, before=before, count=count)
        (part / MARK_FILE).write_text(json.dumps({"has_alpha": has_alpha, "trusted": trusted is not None}))
