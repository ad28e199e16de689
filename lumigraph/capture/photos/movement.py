"""Displacement of a moving camera's picture."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.fft import irfft2, rfft2

TILE_SIDE = 32  # pixels
REFERENCE_STRIDE = 3  # pixels of movement after which a new reference is taken
MIN_VARIANCE = 9.0  # of values 0 to 255, of a tile that can be tracked
WINDOW_MEAN_SQUARE = (3 / 8) ** 2  # mean square of the window that fades out a tile's border


class Odometer:
    """Adds up how far the picture moves, in pixels of small grey pictures that are shown to it one by one.

    Each is compared with a reference, which is exchanged only once the picture has moved by STRIDE, so that noise does
    not add up while the camera rests.
    """

    def __init__(self) -> None:
        self.travelled = 0.0  # up to the reference
        self._reference: np.ndarray | None = None

    def show(self, picture: Float[np.ndarray, "height width"]) -> float:
        """The distance so far."""
        tiles = cut(picture)
        if self._reference is None:
            self._reference = tiles
        distance = moved(self._reference, tiles)
        if distance >= REFERENCE_STRIDE:
            self.travelled, self._reference, distance = self.travelled + distance, tiles, 0.0
        return self.travelled + distance


def cut(picture: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "tile row column"]:
    """Square tiles, faded out towards their borders; what does not fill a tile is left out."""
    rows, columns = max(picture.shape[0] // TILE_SIDE, 1), max(picture.shape[1] // TILE_SIDE, 1)
    whole = np.zeros((rows * TILE_SIDE, columns * TILE_SIDE), np.float32)
    part = picture[: rows * TILE_SIDE, : columns * TILE_SIDE]
    whole[: part.shape[0], : part.shape[1]] = part
    tiles = whole.reshape(rows, TILE_SIDE, columns, TILE_SIDE).swapaxes(1, 2).reshape(-1, TILE_SIDE, TILE_SIDE)
    window = np.hanning(TILE_SIDE).astype(np.float32)
    return (tiles - tiles.mean((1, 2), keepdims=True)) * window[:, None] * window


def moved(a: Float[np.ndarray, "tile row column"], b: Float[np.ndarray, "tile row column"]) -> float:
    """Mean length of the tiles' displacements, each where its cross-correlation peaks; 0 where nothing has texture.

    Tiles are followed one by one, so that walking forward or turning about the line of sight counts as well.
    """
    textured = np.minimum(np.square(a).mean((1, 2)), np.square(b).mean((1, 2))) > MIN_VARIANCE * WINDOW_MEAN_SQUARE
    if not textured.any():
        return 0.0
    correlation = irfft2(np.conj(rfft2(a[textured])) * rfft2(b[textured]), s=(TILE_SIDE, TILE_SIDE))
    y, x = np.unravel_index(correlation.reshape(len(correlation), -1).argmax(1), (TILE_SIDE, TILE_SIDE))
    wrapped = [(axis + TILE_SIDE // 2) % TILE_SIDE - TILE_SIDE // 2 for axis in (x, y)]
    return float(np.hypot(*wrapped).mean())
