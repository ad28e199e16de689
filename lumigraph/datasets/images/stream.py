"""ImageStream: photographs that exceed memory and disk, re-read from their sources during training."""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from PIL import Image
from torch import Tensor

from ...errors import LumigraphError
from ...geometry import evenly
from ...system.memory import address_limit, gigabytes, memory_for_images
from ...system.progress import tell
from .cache import MARK_FILE, cache_folder, free_space, key
from .store import ImageSource, ImageStore, PixelBatch, name_of, see_through, whole

ADDRESS_SHARE = 0.5  # of the free addresses that a mapped file may take
DISK_SHARE = 0.5  # of the free space that a file of photographs may take
KEPT_PIXELS = 1 << 16  # random pixels kept per photograph
RAYS_PER_READ = 1 << 13  # rays that are drawn before another photograph is read
FIRST_VIEWS = 16  # photographs available for the first batch
READER_THREADS = 2  # threads that read ahead
READ_AHEAD = 4  # photographs that are read before their turn
READING_COPIES = 3  # of a photograph in memory, while it is read
ALPHA_PROBES = 4  # photographs that are tested for alpha

Some = tuple[UInt8[np.ndarray, "kept 4"], Int[np.ndarray, " kept"]]  # pixels of a photograph, and where they lie in it
PICTURES_FOLDER = "pictures"  # inside the cache


def load(
    pictures: Sequence[ImageSource],
    memory: int | None = None,
    cache: Path | None = None,
    progress: Callable[[int], object] = lambda done: None,
    keep: bool = False,
) -> ImageStore:
    """Photographs in memory, else in a file, else, if that exceeds half of the free disk space, as a stream. Arguments
    and errors as in `ImageStore.load`.

    keep: cache each picture in a file even if all fit into memory, so that it is made once
    """
    memory = memory_for_images() if memory is None else memory
    size = 4 * sum(width * height for width, height in (p.size for p in pictures))
    if keep:
        pictures = [kept(picture, cache or cache_folder()) for picture in pictures]
    if size > memory:
        folder = (cache or cache_folder() / "images") / name_of(pictures)
        held = f"Photographs take {gigabytes(size)} decoded, and memory has {gigabytes(memory)} for them, so they"
        more = "a larger --downscale, or more free memory, keeps them in memory"
        no_disk = not (folder / MARK_FILE).exists() and size > DISK_SHARE * free_space(folder)
        if no_disk or any(size > ADDRESS_SHARE * (limit - used) for limit, used in address_limit()):
            tell(f"{held} are read from their files again and again, which is slower; {more}")
            return ImageStream(pictures, memory, cache)
        tell(f"{held} go to a file in {folder.parent}; {more}")
    return ImageStore.load(pictures, memory, cache, progress)


class ImageStream(ImageStore):
    """Photographs of any sizes, of which some random pixels are in memory at a time.

    Reader threads go through all photographs in a random order, again and again, and store KEPT random pixels of each.
    A batch is sampled from the stored photographs, of which the oldest is evicted for the next. So in the long run
    photographs are sampled uniformly, and their trusted pixels too, and no batch waits for a photograph. Samples depend
    on the generator of the first batch and on all batches since; a resumed run begins anew.

    pictures: sources of each photograph
    memory:   byte limit, photographs that are being read included
    """

    streams = True

    def __init__(self, pictures: Sequence[ImageSource], memory: int, cache: Path | None = None):
        sizes = torch.tensor([p.size for p in pictures])
        self._pictures = list(pictures)
        has_alpha = any(see_through(whole(self._pictures[i])[0]) for i in evenly(range(len(pictures)), ALPHA_PROBES))
        super().__init__(torch.empty(0, dtype=torch.int32), sizes, has_alpha, memory=0, cache=cache)
        reading = READER_THREADS * READING_COPIES * 4 * int(sizes.prod(-1).max())
        self._room = int(
            np.clip((memory - reading) // (8 * KEPT_PIXELS) - READ_AHEAD, FIRST_VIEWS, max(len(pictures), FIRST_VIEWS))
        )
        self._readers = ThreadPoolExecutor(READER_THREADS, "reading ahead")
        self._images: Tensor | None = None  # those that are drawn from

    def __getitem__(self, index: int) -> UInt8[Tensor, "height width channel"]:
        """One image's bytes, read from its source."""
        pixels, _ = whole(self._pictures[index])
        return torch.from_numpy(pixels)[..., : 4 if self.has_alpha else 3]

    @property
    def may_have_masks(self) -> bool:
        """True, for masks are read with their images."""
        return True

    def mask(self, index: int) -> Bool[Tensor, "height width"] | None:
        """Mask of an image's pixels to use, read from its source; None if all."""
        _, trusted = whole(self._pictures[index])
        return None if trusted is None else torch.from_numpy(trusted)

    def draw(
        self, count: int, images: Int[Tensor, " choice"], generator: torch.Generator, positions: bool = False
    ) -> PixelBatch:
        """Random pixels; see `ImageStore.draw`. Raises LumigraphError where layers ask for positions."""
        if positions:
            raise LumigraphError(
                "what is known beside photographs cannot be learnt from while they stream from their files, which they "
                "do where neither memory nor the cache's disk holds them; use a larger --downscale or free some space"
            )
        if self._images is None or not torch.equal(self._images, images):
            self._begin(images, generator)
        self._due += count
        while self._due >= RAYS_PER_READ:
            self._take()
            self._due -= RAYS_PER_READ
        which, share = torch.rand(2, count, dtype=torch.float64, generator=generator).numpy()
        place = (which * self._filled).astype(np.int64)
        rank = (share * self._held[place]).astype(np.int64)
        image, pixel = self._number[place], self._pixel[place, rank]
        width = self.sizes[:, 0].numpy()[image]
        xy = torch.from_numpy(np.stack([pixel % width, pixel // width], -1)).float() + 0.5
        return PixelBatch(torch.from_numpy(image), xy, torch.from_numpy(self._rgba_of[place, rank]))

    def _begin(self, images: Tensor, generator: torch.Generator) -> None:
        """Start sampling from these photographs."""
        self._images, self._due = images.clone(), 0
        self._random = np.random.default_rng(int(torch.randint(1 << 62, (1,), generator=generator)))
        self._left: list[int] = []
        self._coming: deque[tuple[int, Future[Some]]] = deque()
        self._filled, self._next = 0, 0
        self._rgba_of = np.empty((self._room, KEPT_PIXELS, 4), np.uint8)
        self._pixel = np.empty((self._room, KEPT_PIXELS), np.int32)
        self._held, self._number = np.zeros((2, self._room), np.int64)
        for _ in range(min(FIRST_VIEWS, len(images))):
            self._take()

    def _take(self) -> None:
        """Wait for the next photograph, and start reading further ones."""
        assert self._images is not None
        while len(self._coming) <= READ_AHEAD:
            if not self._left:
                self._left = self._random.permutation(self._images.numpy()).tolist()
            number = self._left.pop()
            seed = int(self._random.integers(1 << 62))
            self._coming.append((number, self._readers.submit(self._some, number, seed)))
        number, coming = self._coming.popleft()
        rgba, pixel = coming.result()
        place, count = self._next, len(pixel)
        self._rgba_of[place, :count], self._pixel[place, :count] = rgba, pixel
        self._held[place], self._number[place] = count, number
        self._filled, self._next = max(self._filled, place + 1), (place + 1) % self._room

    def _some(self, number: int, seed: int) -> Some:
        """Random trusted pixels of a photograph, or all if they are few."""
        pixels, trusted = whole(self._pictures[number])
        if not self.has_alpha and see_through(pixels):
            raise LumigraphError(
                f"photograph {number} is see-through, and those that were looked at first are not; store all alike"
            )
        rgba = pixels.reshape(-1, 4)
        known = None if trusted is None else np.flatnonzero(trusted)
        count = len(rgba) if known is None else len(known)
        if not count:
            raise LumigraphError(
                f"the mask of photograph {number} trusts no pixel; correct it or remove the photograph"
            )
        if count <= KEPT_PIXELS:
            chosen = np.arange(count)
        else:
            chosen = np.sort(np.random.default_rng(seed).integers(count, size=KEPT_PIXELS))  # in the order of memory
        chosen = chosen if known is None else known[chosen]
        return rgba[chosen], chosen.astype(np.int32)


def kept(picture: ImageSource, cache: Path) -> ImageSource:
    """A picture with a cache file, for pictures that take long to make: read from `cache` if there, else made and
    written. Unchanged if it has no identity."""
    if picture.identity is None:
        return picture
    return replace(picture, read=partial(read_or_make, picture, cache / PICTURES_FOLDER))


def read_or_make(picture: ImageSource, folder: Path) -> tuple[np.ndarray, np.ndarray | None]:
    path = folder / f"{key([f'{picture.size} {picture.identity}'])}.png"
    with contextlib.suppress(OSError, SyntaxError, ValueError), Image.open(path) as file:
        pixels = np.asarray(file)
        if pixels.shape[1::-1] == picture.size:
            return pixels, None
    pixels, mask = picture.read()
    if mask is None:
        leave(path, pixels)
    return pixels, mask


def leave(path: Path, pixels: np.ndarray) -> None:
    """Write a picture atomically. A full or read-only disk is ignored."""
    part = path.with_name(f"{path.stem}.{os.getpid()}.part")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            Image.fromarray(pixels).save(part, "png", compress_level=1)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
