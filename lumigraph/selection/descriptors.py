"""Untrained descriptors: features of each pixel from colours and contrast around it at several scales.

They separate surfaces by colour and texture, not objects: two chairs of one fabric are alike, and a figure's face is
unlike its coat. Strokes on each material, and growth in space, compensate; a network's features (`networks.py`) need
fewer strokes.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, gaussian_gradient_magnitude
from skimage.color import rgb2lab
from torch import Tensor

COLOUR_SCALES = {0.0: 1.0, 2.0: 0.5, 5.0: 0.25}  # deviation in pixels of the blur of CIELAB colours, and their weight
CONTRAST_SCALES = {2.0: 0.5, 5.0: 0.5}  # deviation in pixels around which contrast is measured, and its weight
EDGE_SCALE, EDGE_WEIGHT = 1.0, 0.5  # pixels; of the gradient of lightness
LAB_UNITS = (40.0, 20.0, 20.0)  # CIELAB units that count as 1; more for lightness, which changes with the shade


def describe(rgb: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width feature"]:
    """Descriptors of a picture: CIELAB colours, their contrast and the gradient of lightness, at several scales.

    rgb: sRGB-encoded, in [0, 1]
    """
    lab = rgb2lab(rgb.cpu().clamp(0, 1).numpy().astype(np.float64)) / LAB_UNITS
    lightness = lab[..., 0]
    found = [weight * blurred(lab, scale) for scale, weight in COLOUR_SCALES.items()]
    for scale, weight in CONTRAST_SCALES.items():
        variance = blurred(lab**2, scale) - blurred(lab, scale) ** 2
        found.append(weight * np.sqrt(variance.sum(-1, keepdims=True).clip(0)))
    found.append(EDGE_WEIGHT * gaussian_gradient_magnitude(lightness, EDGE_SCALE)[..., None])
    return torch.from_numpy(np.concatenate(found, -1).astype(np.float32))


def blurred(
    picture: Float[np.ndarray, "height width channel"], scale: float
) -> Float[np.ndarray, "height width channel"]:
    """A picture convolved with a Gaussian. scale: its deviation in pixels, 0 for the picture itself"""
    return gaussian_filter(picture, (scale, scale, 0)) if scale else picture
