"""Two thirds of a mosaic's colours were never measured: what they were, going by the pixels around."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import convolve

RED, GREEN, BLUE = range(3)
Pattern = tuple[tuple[int, int], tuple[int, int]]  # the filters over each square of four pixels, row by row

# Malvar 2004, figure 2: bilinear means, corrected by how the colour that was measured here curves.
CROSS_FILTER = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]) / 8
BESIDE_FILTER = (
    np.array([[0, 0, 1, 0, 0], [0, -2, 0, -2, 0], [-2, 8, 10, 8, -2], [0, -2, 0, -2, 0], [0, 0, 1, 0, 0]]) / 16
)
CORNERS_FILTER = (
    np.array([[0, 0, -3, 0, 0], [0, 4, 0, 4, 0], [-3, 0, 12, 0, -3], [0, 4, 0, 4, 0], [0, 0, -3, 0, 0]]) / 16
)


def demosaiced(light: Float[np.ndarray, "height width"], pattern: Pattern) -> Float[np.ndarray, "height width 3"]:
    """Red, green and blue of every pixel (Malvar, He and Cutler 2004); what was measured stays as it is.

    light: white-balanced, so that grey has the same value behind each filter
    """
    green, along, across, corners = (
        convolve(light, kernel.astype(light.dtype), mode="mirror")
        for kernel in (CROSS_FILTER, BESIDE_FILTER, BESIDE_FILTER.T, CORNERS_FILTER)
    )
    rgb = np.stack([light, green, light], -1)
    for colour in (RED, BLUE):
        (y, x), *_ = np.argwhere(np.array(pattern) == colour)
        own_rows, own_columns = slice(y, None, 2), slice(x, None, 2)
        rows, columns = slice(1 - y, None, 2), slice(1 - x, None, 2)
        plane = rgb[..., colour]
        plane[own_rows, columns] = along[own_rows, columns]
        plane[rows, own_columns] = across[rows, own_columns]
        plane[rows, columns] = corners[rows, columns]
        rgb[own_rows, columns, GREEN] = light[own_rows, columns]
    return rgb


def repeated(pattern: Pattern, size: tuple[int, int]) -> np.ndarray:
    """Filter over every pixel of a picture of a size (width, height): int8 (height, width)."""
    width, height = size
    return np.tile(np.array(pattern, np.int8), (-(-height // 2), -(-width // 2)))[:height, :width]
