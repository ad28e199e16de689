"""The guided filter (He, Sun and Tang 2010): a rough outline takes the edges of the photograph that it lies on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter


def guided(
    guide: Float[np.ndarray, "height width"], rough: Float[np.ndarray, "height width"], radius: int, noise: float = 1e-3
) -> Float[np.ndarray, "height width"]:
    """a guide + b, whose a and b fit `rough` best in the windows around each pixel (eq. 5 to 8).

    noise: variance of the guide that counts as none
    """

    def mean(x: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
        return uniform_filter(x, 2 * radius + 1, mode="nearest")

    middle, level = mean(guide), mean(rough)
    a = (mean(guide * rough) - middle * level) / (mean(guide * guide) - middle**2 + noise)
    return mean(a) * guide + mean(level - a * middle)
