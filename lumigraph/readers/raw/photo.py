"""One raw photograph, and its development: white balance, demosaicing, sRGB."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import convolve

from ...color.srgb import srgb_from_linear

XYZ_FROM_SRGB = np.array(
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
)
WHITE_PERCENTILE = 97  # of the light, which becomes white in a developed picture (Mildenhall 2022, supplement)
RED, GREEN, BLUE = range(3)
Pattern = tuple[tuple[int, int], tuple[int, int]]  # the filters over each square of four pixels, row by row

# Malvar 2004, figure 2: bilinear means, corrected by how the colour that was measured here curves.
CROSS_FILTER = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]])
BESIDE_FILTER = np.array([[0, 0, 1, 0, 0], [0, -2, 0, -2, 0], [-2, 8, 10, 8, -2], [0, -2, 0, -2, 0], [0, 0, 1, 0, 0]])
CORNERS_FILTER = np.array([[0, 0, -3, 0, 0], [0, 4, 0, 4, 0], [-3, 0, 12, 0, -3], [0, 4, 0, 4, 0], [0, 0, -3, 0, 0]])


def demosaiced(light: Float[np.ndarray, "height width"], pattern: Pattern) -> Float[np.ndarray, "height width 3"]:
    """Demosaic to red, green and blue of every pixel (Malvar, He and Cutler 2004); measured values stay unchanged.

    light: white-balanced, so that grey has the same value behind each filter
    """
    green, along, across, corners = (
        convolve(light, kernel.astype(light.dtype), mode="mirror")
        for kernel in (CROSS_FILTER / 8, BESIDE_FILTER / 16, BESIDE_FILTER.T / 16, CORNERS_FILTER / 16)
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


@dataclass(frozen=True)
class RawPhoto:
    """A raw photograph, upright.

    size:     (width, height) in pixels
    pattern:  colour filter of each of 2 x 2 pixels: 0 red, 1 green, 2 blue
    gains:    white balance of red, green and blue by the camera
    srgb_from_camera: from white-balanced colours of this camera to linear sRGB
    exposure: up to one factor, seconds · ISO / 100 / f-number²; None if unknown
    read:     returns the light of every pixel, float32 (height, width): 0 at black level, 1 at saturation. Noise around
              black is not clipped at 0, so that its mean is 0
    """

    path: Path
    size: tuple[int, int]
    pattern: Pattern
    gains: tuple[float, float, float]
    srgb_from_camera: Float[np.ndarray, "3 3"]
    exposure: float | None
    read: Callable[[], Float[np.ndarray, "height width"]]

    @property
    def filters(self) -> np.ndarray:
        """Filter over every pixel, int8 (height, width)."""
        return repeated(self.pattern, self.size)

    def linear(self) -> Float[np.ndarray, "height width 3"]:
        """Linear sRGB of every pixel, 1 at saturation; it may lie beyond [0, 1]."""
        gains = np.array(self.gains, np.float32)
        balanced = np.minimum(self.read(), 1) * gains[self.filters]
        # Beyond what the least amplified colour can tell, highlights would turn that of the others: they are white.
        rgb = np.minimum(demosaiced(balanced, self.pattern), gains.min())
        return rgb @ self.srgb_from_camera.T.astype(np.float32)

    def developed(self, brightness: float) -> UInt8[np.ndarray, "height width 3"]:
        """An ordinary picture: black level, white balance, demosaicing, the camera's colours, sRGB's curve.

        brightness: factor on the light before it is clipped and encoded
        """
        return (srgb_from_linear((self.linear() * brightness).clip(0, 1)) * 255 + 0.5).astype(np.uint8)

    def highlight(self) -> float:
        """Green light at which the developed picture saturates to white."""
        green = self.read()[self.filters == GREEN] * self.gains[GREEN]
        return max(float(np.percentile(green, WHITE_PERCENTILE)), 1e-6)


def srgb_from_camera(camera_from_xyz: Float[np.ndarray, "3 3"] | None) -> Float[np.ndarray, "3 3"]:
    """From white-balanced camera colours to linear sRGB, as in DNG's specification and dcraw: rows of the inverse sum
    to 1, so that white stays white.

    camera_from_xyz: the file's colour matrix; None leaves colours unchanged
    """
    if camera_from_xyz is None:
        return np.eye(3)
    camera_from_srgb = np.asarray(camera_from_xyz, np.float64) @ XYZ_FROM_SRGB
    return np.linalg.inv(camera_from_srgb / camera_from_srgb.sum(-1, keepdims=True))
