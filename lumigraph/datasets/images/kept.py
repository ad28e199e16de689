"""Pictures that took long to make are made once: a file of the user's cache for each, whichever scene asks for it."""

from __future__ import annotations

import contextlib
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from .cache import key
from .store import ImageSource

PICTURES_FOLDER = "pictures"  # inside the cache


def kept(picture: ImageSource, cache: Path) -> ImageSource:
    """The same picture, which reads its file in `cache` where there is one and leaves one otherwise; as it is if
    nothing says what it depends on."""
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
    """Write a picture, whole or not at all. A disk that is full or may not be written keeps nothing."""
    part = path.with_name(f"{path.stem}.{os.getpid()}.part")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            Image.fromarray(pixels).save(part, "png", compress_level=1)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
