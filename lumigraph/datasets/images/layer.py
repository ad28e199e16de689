"""Layer: one named plane of per-pixel values beside colour, read on request."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .cache import MARK_FILE, cache_folder, check_size, filled, in_parallel, key, new_file
from .resize import resized
from .store import ImageStore

ENCODINGS = {
    "sRGB": "colours as photographed; a fourth channel is alpha, by which they are not multiplied",
    "linear": "light; a fourth channel is alpha, by which it is not multiplied",
    "linear premultiplied": "light multiplied by the alpha in a fourth channel",
    "distance": "lengths along the pixel's ray",
    "z-depth": "lengths along the optical axis",
    "mosaic": "light behind a filter of one colour each, in squares of two by two pixels that repeat",
    "index": "whole numbers that name something",
    "filter": "whole numbers that name the filter over each pixel of a mosaic",
    "direction": "unit vectors in the scene's frame",
    "pixels": "offsets (x, y) in pixels of the picture",
    "plain": "numbers of any other kind",
}
INTEGER_ENCODINGS = ("index", "filter")  # whole numbers
UNKNOWN_INDEX = -1  # an index that is not known


@dataclass(frozen=True)
class LayerSource:
    """Source of one photograph's values of a layer.

    read:     returns the stored numbers, (height, width) or (height, width, channels), at the photograph's size
    identity: determines the numbers, as in `ImageSource`
    """

    read: Callable[[], np.ndarray]
    identity: str | None = None


@dataclass(eq=False, repr=False)
class Layer:
    """Values of one kind for every pixel of the photographs, in storage encoding.

    They are in the order of the store, so that a pixel has the same position in both, within the same memory budget,
    else in a file. A photograph's values are read on first use.

    planes:   sources of each photograph; None for one without values
    dtype:    of stored numbers
    channels: numbers per pixel; a single one has no axis of its own
    encoding: meaning of the numbers, a key of ENCODINGS
    scale:    value of a stored 1, in scene units for lengths
    unknown:  stored numbers that mean unknown, as NaN always does. Photographs without a plane have the first
    empty:    stored lengths that mean empty space
    names:    of an index's values, if any
    """

    images: ImageStore
    planes: Sequence[LayerSource | None]
    dtype: np.dtype
    channels: int
    encoding: str
    scale: float = 1.0
    unknown: tuple[float, ...] = ()
    empty: tuple[float, ...] = ()
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        assert len(self.planes) == len(self.images) and self.encoding in ENCODINGS
        self._values: np.ndarray | None = None
        self._read = np.zeros(len(self.planes), bool)

    def __len__(self) -> int:
        """Number of photographs with values of their own."""
        return sum(plane is not None for plane in self.planes)

    def stored(self, image: int) -> np.ndarray:
        """One photograph's numbers as the source stores them, (height, width) or (height, width, channels)."""
        if self.images.streams:
            return self._alone(image)
        values, order = self._hold([image])[self.images.span(image)], self.images.order(image)
        if order is not None:
            natural = np.empty_like(values)
            natural[order] = values
            values = natural
        width, height = self.images.sizes[image].tolist()
        return values.reshape(height, width, *values.shape[1:])

    def gathered(self, position: Int[Tensor, " pixel"], images: Int[Tensor, " choice"]) -> np.ndarray:
        """Stored numbers at positions of the store within some of the photographs."""
        return self._hold(images.numpy())[position.numpy()]

    def decoded(self, stored: np.ndarray, cosine: Callable[[], Tensor]) -> Tensor:
        """Decode stored numbers: float32 with NaN for unknown and infinity for empty; integers for an index, -1 for
                               unknown.

        cosine: of the angle between each pixel's ray and the optical axis; needed for lengths along the axis
        """
        sure = self.known(stored)
        if self.encoding in INTEGER_ENCODINGS:
            return torch.from_numpy(np.where(sure, stored, UNKNOWN_INDEX).astype(np.int64))
        values = torch.from_numpy(stored.astype(np.float64) * self.scale)
        if self.empty:
            values[torch.from_numpy(np.isin(stored, self.empty))] = torch.inf
        values.numpy()[~sure] = np.nan
        if self.encoding == "z-depth":
            values = values / cosine().double()
        elif self.encoding == "linear premultiplied" and self.channels == 4:
            values[..., :3] /= torch.where(values[..., 3:] > 0, values[..., 3:], 1)
        return values.float()

    def known(self, stored: np.ndarray) -> Bool[np.ndarray, "*pixels"]:
        """Mask of the pixels with a known value."""
        return known(stored, self.unknown, self.channels)

    def reduced(self, image: int, factor: int) -> np.ndarray:
        """A photograph's stored numbers at 1 / factor of its size; see `resized`. Incomplete squares are cropped."""
        stored = self.stored(image)
        height, width = (n // factor * factor for n in stored.shape[:2])
        stored = stored[:height, :width]
        return resized(stored, (width // factor, height // factor), self.encoding, self.known(stored))

    def like(self, images: ImageStore, planes: Sequence[LayerSource | None]) -> Layer:
        """A layer of the same kind for other photographs."""
        return replace(self, images=images, planes=planes)

    def _hold(self, wanted: Sequence[int] | np.ndarray) -> np.ndarray:
        """All stored numbers in the order of the store, after reading those of the wanted photographs."""
        if self._values is None:
            shape = (int(self.images.sizes.prod(-1).sum()), *((self.channels,) if self.channels > 1 else ()))
            if self.images.grant(int(np.prod(shape)) * self.dtype.itemsize):
                self._values = np.empty(shape, self.dtype)
            else:
                self._values = self._mapped(shape)
                self._read[:] = True
        values = self._values
        if not self._read[wanted].all():
            in_parallel(lambda image: self._fill(values, image), [int(i) for i in wanted if not self._read[i]])
        return values

    def _alone(self, image: int) -> np.ndarray:
        """One photograph's numbers, row by row, read from its source."""
        width, height = self.images.sizes[image].tolist()
        values = np.empty((width * height, *((self.channels,) if self.channels > 1 else ())), self.dtype)
        self._put(values, image, None)
        return values.reshape(height, width, *values.shape[1:])

    def _fill(self, values: np.ndarray, image: int) -> None:
        """Read one photograph's numbers into their place."""
        self._put(values[self.images.span(image)], image, self.images.order(image))
        self._read[image] = True

    def _put(self, place: np.ndarray, image: int, order: np.ndarray | None) -> None:
        """Read one photograph's numbers in a pixel order; None for row by row."""
        plane = self.planes[image]
        if plane is None:
            place[:] = self.unknown[0] if self.unknown else UNKNOWN_INDEX if self.encoding == "index" else np.nan
            return
        found = plane.read()
        width, height = self.images.sizes[image].tolist()
        assert found.shape[:2] == (height, width), f"promised {width}x{height}, read {found.shape}"
        flat = found.reshape(place.shape)
        place[:] = flat if order is None else flat[order]

    def _mapped(self, shape: tuple[int, ...]) -> np.ndarray:
        """All numbers in a mapped cache file, shared by equal layers."""
        nameless = self.images.name is None or any(p is not None and p.identity is None for p in self.planes)
        parts = [p.identity if p else "nothing" for p in self.planes]
        called = key([None if nameless else f"{self.images.name} {self.dtype.str} {self.channels}", *parts])
        folder = (self.images.cache or cache_folder() / "images") / called
        if not (folder / MARK_FILE).exists():
            with filled(folder, int(np.prod(shape)) * self.dtype.itemsize) as part:
                values = new_file(part / "values", self.dtype, shape)
                in_parallel(lambda image: self._fill(values, image), range(len(self.planes)))
                values.flush()
                (part / MARK_FILE).write_text(json.dumps({"dtype": self.dtype.str, "channels": self.channels}))
        check_size(folder / "values", int(np.prod(shape)) * self.dtype.itemsize)
        found = np.memmap(folder / "values", self.dtype, "c", shape=shape)
        if nameless:
            shutil.rmtree(folder, ignore_errors=True)
        return found


def cosines(directions: Float[Tensor, "*pixels 3"], forward: Float[Tensor, "*#pixels 3"]) -> Float[Tensor, "*pixels"]:
    """Cosine of the angle between rays and the optical axes of their cameras."""
    return (directions.double() * forward.double()).sum(-1)


def known(stored: np.ndarray, unknown: tuple[float, ...], channels: int) -> Bool[np.ndarray, "*pixels"]:
    """Mask of the pixels with a known value; see `Layer`."""
    numbers = stored if channels > 1 else stored[..., None]
    sure = np.ones(numbers.shape[:-1], bool)
    for number in unknown:
        sure &= (numbers != number).any(-1)
    return np.asarray(sure & ~np.isnan(numbers).any(-1) if stored.dtype.kind == "f" else sure)
