"""sRGB's encoding of light (IEC 61966-2-1)."""

import numpy as np


def linear_from_srgb(colour):
    """Encoded colours in [0, 1] to linear light."""
    colour = np.asarray(colour)
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(colour):
    """Linear light to encoded colours."""
    colour = np.asarray(colour)
    return np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * np.maximum(colour, 1e-9) ** (1 / 2.4) - 0.055)
