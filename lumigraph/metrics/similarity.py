"""Similarity of a rendering to a photograph."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

MIN_ERROR = 1e-10  # mean squared error below which images count as equal: 100 dB


def psnr(a: Float[Tensor, "*shape"], b: Float[Tensor, "*shape"]) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10 of the mean squared error, for values in [0, 1]. At most 100."""
    error = (a.double() - b.double()).square().mean().clamp_min(MIN_ERROR)
    return float(-10 * error.log10())


def ssim_map(
    a: Float[Tensor, "height width channel"], b: Float[Tensor, "height width channel"]
) -> Float[Tensor, "inner_height inner_width channel"]:
    """Structural similarity around each pixel (Wang 2004, eq. 13), for values in [0, 1].

    Windows are Gaussians of 11 x 11 pixels with deviation 1.5; only those that lie inside the image count, so the map
    is 10 pixels smaller each way. K1 = 0.01, K2 = 0.03. Raises ValueError for images smaller than the window.
    """
    if min(a.shape[:2]) < WINDOW:
        raise ValueError(f"SSIM needs images of at least {WINDOW} x {WINDOW} pixels, not {tuple(a.shape[:2])}")
    x, y = (image.double().movedim(-1, 0)[:, None] for image in (a, b))
    mean_x, mean_y = blur(x), blur(y)
    variance_x = blur(x * x) - mean_x**2
    variance_y = blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    likeness = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    likeness = likeness / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))
    return likeness[:, 0].movedim(0, -1)


def ssim(a: Float[Tensor, "height width channel"], b: Float[Tensor, "height width channel"]) -> float:
    """Mean structural similarity over all windows and channels; see `ssim_map`."""
    return float(ssim_map(a, b).mean())


WINDOW, DEVIATION = 11, 1.5


def blur(images: Float[Tensor, "image 1 height width"]) -> Float[Tensor, "image 1 inner_height inner_width"]:
    """Weighted mean over each window, one axis after the other."""
    offsets = torch.arange(WINDOW, dtype=images.dtype, device=images.device) - WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / DEVIATION) ** 2)
    weights = weights / weights.sum()
    return conv2d(conv2d(images, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1))
