"""ImageStore: all photographs of a scene as bytes, in memory or, where they are too many, in a file."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from .errors import LumigraphError
from .loops import look_up

MEMORY_SHARE = 0.4  # of the machine's memory; the rest is for training and everything else that runs
PIECES = 64  # a batch from a file comes in about so many reads
SHORTEST_PIECE, LONGEST_PIECE = 64, 1024  # pixels; the longest fills a page
FORMAT = 1  # of the cache's files


@dataclass(frozen=True)
class Picture:
    """How to get one photograph.

    size:     (width, height) that `read` will give
    read:     makes the pixels, uint8 (height, width, 3 or 4), and which of them to trust (None: all)
    identity: says all that the pixels depend on (file, its date and size, scaling); None if nothing can
    """

    size: tuple[int, int]
    read: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    identity: str | None = None


def pair(image: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    return image, mask


@dataclass(frozen=True)
class Drawn:
    """Random pixels: which image, where (x, y), and their bytes (red, green, blue, alpha; 255 where there is none)."""

    image: Int[Tensor, " pixel"]
    xy: Float[Tensor, "pixel 2"]
    rgba: UInt8[Tensor, "pixel 4"]


class ImageStore:
    """Photographs of any sizes, end to end, four bytes to a pixel so that a pixel is one load.

    In a file, each image's pixels lie shuffled: pixel (a s) mod n at position s, with a the whole number beside
    n / golden ratio that shares no factor with n. Consecutive positions are then spread evenly over the picture, so
    a random batch is a few short reads rather than one disk access for every ray.

    rgba:     all pixels, four bytes seen as one int32
    sizes:    (width, height) of each image
    trusted:  per image the pixels to learn from, or None for all
    """

    def __init__(
        self,
        rgba: Int[Tensor, " pixel"],
        sizes: Int[Tensor, "image 2"],
        has_alpha: bool,
        trusted: Runs | None = None,
        shuffled: bool = False,
    ):
        self._rgba, self.sizes, self.has_alpha, self._trusted, self.shuffled = rgba, sizes, has_alpha, trusted, shuffled
        pixels = sizes.prod(-1)
        self._first = pixels.cumsum(0) - pixels
        self._width = sizes[:, 0].contiguous()
        self._count = pixels if trusted is None else trusted.count
        self._stride = torch.tensor([spread(n) if shuffled else 1 for n in self._count.tolist()])

    @classmethod
    def load(
        cls,
        pictures: Sequence[Picture],
        memory: int | None = None,
        cache: Path | None = None,
        progress: Callable[[int], object] = lambda done: None,
    ) -> ImageStore:
        """Read pictures in parallel.

        memory:   bytes that may stay in memory; None means a share of the machine's
        cache:    where larger captures go; None means the user's cache folder. It may be deleted at any time.
        progress: told how many are done
        Raises LumigraphError where the cache's disk is full, and whatever the pictures' `read` raises.
        """
        sizes = torch.tensor([p.size for p in pictures])
        total = int(sizes.prod(-1).sum())
        if 4 * total <= (default_memory() if memory is None else memory):
            rgba = np.empty(total, np.int32)
            has_alpha, trusted = fill(rgba, pictures, progress, shuffled=False)
            return cls(torch.from_numpy(rgba), sizes, has_alpha, trusted)
        folder = (cache or cache_folder() / "images") / key(pictures)
        if not (folder / "store.json").exists():
            write_store(folder, total, pictures, progress)
        about = json.loads((folder / "store.json").read_text())
        trusted = Runs(*map(torch.from_numpy, np.load(folder / "trusted.npz").values())) if about["trusted"] else None
        # Copy on write: PyTorch wants a writable array, and the file must stay as it is.
        rgba = np.memmap(folder / "pixels", np.int32, "c")
        if any(p.identity is None for p in pictures):
            shutil.rmtree(folder, ignore_errors=True)  # nobody can ask for it again; what is mapped stays
        return cls(torch.from_numpy(rgba), sizes, about["has_alpha"], trusted, shuffled=True)

    @classmethod
    def from_arrays(cls, images: Sequence[np.ndarray], masks: Sequence[np.ndarray | None] | None = None) -> ImageStore:
        """Pictures that are already here: uint8 (height, width, 3 or 4), and optionally which pixels to trust."""
        pairs = zip(images, masks or [None] * len(images), strict=True)
        return cls.load([Picture((i.shape[1], i.shape[0]), partial(pair, i, m)) for i, m in pairs], memory=sys.maxsize)

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
        """Which pixels of an image to trust; None if no image of the store has a mask."""
        if self._trusted is None:
            return None
        width, height = self.sizes[index].tolist()
        return self._trusted.mask(index, width * height).view(height, width)

    @property
    def trusted_pixels(self) -> Int[Tensor, " image"]:
        """How many pixels of each image may be learnt from."""
        return self._count

    def draw(self, count: int, images: Int[Tensor, " choice"], generator: torch.Generator) -> Drawn:
        """Random pixels: each of the given images as likely as the next, each trusted pixel of it as well."""
        piece = min(max(count // PIECES, SHORTEST_PIECE), LONGEST_PIECE) if self.shuffled else 1
        chance = torch.rand(-(-count // piece), dtype=torch.float64, generator=generator)
        image, xy = torch.empty(count, dtype=torch.int64), torch.empty(count, 2)
        rgba = torch.empty(count, 4, dtype=torch.uint8)
        nothing = torch.empty(0, dtype=torch.int64)
        runs = (nothing,) * 4 if self._trusted is None else self._trusted.columns()
        inputs = (chance, images, self._first, self._count, self._stride, self._width, *runs, self._rgba)
        look_up(piece, *(x.numpy() for x in (*inputs, image, xy, rgba.view(torch.int32)[:, 0])))
        return Drawn(image, xy, rgba)


@dataclass(frozen=True)
class Runs:
    """Masks as runs of trusted pixels, row by row: a run begins at pixel `start` and is preceded by `before` trusted
    pixels, counted from the first image on. Image i owns count[i] trusted pixels."""

    start: Int[Tensor, " run"]
    before: Int[Tensor, " run"]
    count: Int[Tensor, " image"]

    def columns(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """start, before, the trusted pixels ahead of each image, and each image's first run, one longer than images."""
        ahead = self.count.cumsum(0) - self.count
        first_run = torch.searchsorted(self.before, torch.cat([ahead, self.count.sum()[None]]))
        return self.start, self.before, ahead, first_run

    @staticmethod
    def of(masks: Sequence[np.ndarray]) -> Runs:
        starts, lengths = [], []
        for mask in masks:
            edges = np.flatnonzero(np.diff(mask.ravel().astype(np.int8), prepend=0, append=0))
            starts.append(edges[::2])
            lengths.append(edges[1::2] - edges[::2])
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


def spread(count: int) -> int:
    """The factor a of the shuffle of `count` pixels."""
    a = max(round(count * (math.sqrt(5) - 1) / 2), 1)
    while math.gcd(a, count) != 1:
        a += 1
    return a


def shuffled_order(pixels: int, mask: Tensor | np.ndarray | None) -> Int[np.ndarray, " pixel"]:
    """Which pixel lies at each position of the file: trusted ones shuffled, then the others."""
    trusted = np.arange(pixels) if mask is None else np.flatnonzero(np.asarray(mask))
    shuffled = trusted[np.arange(len(trusted)) * spread(len(trusted)) % max(len(trusted), 1)]
    return shuffled if mask is None else np.concatenate([shuffled, np.flatnonzero(~np.asarray(mask).ravel())])


def fill(
    rgba: np.ndarray, pictures: Sequence[Picture], progress: Callable[[int], object], shuffled: bool
) -> tuple[bool, Runs | None]:
    """Read all pictures into their places. Returns whether any is see-through, and what to trust."""
    ends = np.cumsum([p.size[0] * p.size[1] for p in pictures])

    def read(index: int) -> tuple[bool, np.ndarray | None]:
        picture = pictures[index]
        image, mask = picture.read()
        assert image.shape[1::-1] == picture.size, f"promised {picture.size}, read {image.shape}"
        pixels = image.shape[0] * image.shape[1]
        four = np.full((pixels, 4), 255, np.uint8)
        four[:, : image.shape[2]] = image.reshape(pixels, -1)
        one = four.view(np.int32)[:, 0]
        mask = None if mask is None or mask.all() else mask.astype(bool)
        rgba[ends[index] - pixels : ends[index]] = one[shuffled_order(pixels, mask)] if shuffled else one
        return bool((four[:, 3] < 255).any()), mask

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 16)) as pool:
        tasks = [pool.submit(read, i) for i in range(len(pictures))]
        found = []
        try:
            for task in tasks:
                found.append(task.result())
                progress(len(found))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    masks = [mask for _, mask in found]
    trusted = None
    if any(mask is not None for mask in masks):
        whole = (np.ones(p.size[::-1], bool) for p in pictures)
        trusted = Runs.of([w if m is None else m for m, w in zip(masks, whole, strict=True)])
    return any(alpha for alpha, _ in found), trusted


def write_store(folder: Path, total: int, pictures: Sequence[Picture], progress: Callable[[int], object]) -> None:
    """Fill a folder of the cache; it appears complete or not at all."""
    part = folder.with_name(f"{folder.name}.{os.getpid()}.part")
    with full_disk_told(part, 4 * total):
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        try:
            with open(part / "pixels", "wb") as file:
                reserve(file, 4 * total)
            rgba = np.memmap(part / "pixels", np.int32, "r+")
            has_alpha, trusted = fill(rgba, pictures, progress, shuffled=True)
            rgba.flush()
            if trusted is not None:
                start, before, count = (x.numpy() for x in (trusted.start, trusted.before, trusted.count))
                np.savez(part / "trusted.npz", start=start, before=before, count=count)
            about = {"has_alpha": has_alpha, "trusted": trusted is not None}
            (part / "store.json").write_text(json.dumps(about))
            if not (folder / "store.json").exists():  # else another process was quicker
                os.replace(part, folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def reserve(file, size: int) -> None:
    """Claim the disk now: writing to a mapped file on a full disk would kill the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
        return
    block = bytes(1 << 20)
    for begin in range(0, size, len(block)):
        file.write(block[: size - begin])


@contextmanager
def full_disk_told(path: Path, size: int) -> Iterator[None]:
    try:
        yield
    except OSError as fault:
        raise LumigraphError(
            f"{path.parent}: cannot keep {size / 1e9:.1f} GB of decoded images here ({fault.strerror or fault}); "
            f"free some space, set LUMIGRAPH_CACHE to a folder on another disk, or use a larger --downscale"
        ) from fault


def key(pictures: Sequence[Picture]) -> str:
    """A name for what these pictures decode to; nameless ones get a name nobody else will ask for."""
    digest = hashlib.sha256(f"{FORMAT} {sys.byteorder}".encode())
    for picture in pictures:
        identity = picture.identity or f"{os.getpid()} {time.time_ns()} {id(picture)}"
        digest.update(f"\n{picture.size} {identity}".encode())
    return digest.hexdigest()[:32]


def cache_folder() -> Path:
    """Where this user's programs keep what can be made again."""
    if chosen := os.environ.get("LUMIGRAPH_CACHE"):
        return Path(chosen)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "lumigraph"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "lumigraph" / "cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lumigraph"


def default_memory() -> int:
    """Bytes of images to keep in memory: a share of the machine's, or of what a container allows."""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        total = 8 << 30
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):  # no container, or no limit
            total = min(total, int(Path(limit).read_text()))
    return int(MEMORY_SHARE * total)
