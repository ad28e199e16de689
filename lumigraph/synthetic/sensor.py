"""Sensor simulation: light becomes raw numbers of a mosaic, with shot noise and read noise; and its development.

Its numbers are those of a Nikon D3200's raw file of a still life at base sensitivity. In flat regions the variance of
its green pixels, by second differences over squares of 8 pixels, is 8 + 0.29 times the mean above black (DN², photon
transfer): the gain is 0.29 DN per photon, and the read noise 2.8 DN.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..readers.raw import RawPhoto
from ..readers.raw.photo import repeated, srgb_from_camera

COLOUR_MATRIX = ((0.9020, -0.2890, -0.0715), (-0.4535, 1.2436, 0.2348), (-0.0934, 0.1919, 0.7086))  # XYZ to camera
WHITE_BALANCE = (1.949, 1.0, 1.344)  # gains of red, green and blue
PATTERN = ((0, 1), (1, 2))
BLACK_LEVEL, WHITE_LEVEL, MAX_LEVEL = 600, 15520, (1 << 14) - 1  # DN
READ_NOISE = 2.8  # DN, standard deviation
DN_PER_PHOTON = 0.29  # DN of one that is counted


@dataclass(frozen=True)
class Sensor:
    """Sensor of the camera: exposures and sensitivity.

    exposures:   relative to the longest exposure; photographs alternate
    sensitivity: sensor value of white at the longest exposure, as a share of saturation
    """

    exposures: tuple[float, ...] = (1.0, 1 / 4, 1 / 16)
    sensitivity: float = 1.0

    def exposure(self, image: int) -> float:
        return self.exposures[image % len(self.exposures)]

    def brightness(self, image: int) -> float:
        """Brightness factor of one photograph that maps white to white."""
        return 1 / (self.sensitivity * self.exposure(image))

    def photograph(self, radiance: Callable[[], np.ndarray], size: tuple[int, int], image: int) -> RawPhoto:
        """A raw photograph, with noise seeded by its number.

        radiance: returns linear sRGB (height, width, 3), 1 for white
        """

        def read() -> np.ndarray:
            return (self.numbers(radiance(), image).astype(np.float32) - BLACK_LEVEL) / np.float32(
                WHITE_LEVEL - BLACK_LEVEL
            )

        return RawPhoto(
            Path(f"{image:04d}"),
            size,
            PATTERN,
            WHITE_BALANCE,
            srgb_from_camera(np.array(COLOUR_MATRIX)),
            self.exposure(image),
            read,
        )

    def numbers(self, radiance: Float[np.ndarray, "height width 3"], image: int) -> np.ndarray:
        """Sensor readout: integers of 14 bits, (height, width)."""
        random = np.random.default_rng(image)
        camera = radiance @ np.linalg.inv(srgb_from_camera(np.array(COLOUR_MATRIX))).T / WHITE_BALANCE
        filters = repeated(PATTERN, (radiance.shape[1], radiance.shape[0])).astype(np.int64)
        light = np.take_along_axis(camera, filters[..., None], -1)[..., 0].clip(0, None)
        mean = light * self.sensitivity * self.exposure(image) * (WHITE_LEVEL - BLACK_LEVEL)
        counted = random.poisson(mean / DN_PER_PHOTON) * DN_PER_PHOTON
        read = BLACK_LEVEL + counted + READ_NOISE * random.standard_normal(mean.shape)
        return np.rint(read).clip(0, MAX_LEVEL).astype(np.uint16)
