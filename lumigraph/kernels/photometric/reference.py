"""Reference implementation."""

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from . import C1, C2, WINDOW, weights


def run(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    x, y = (image.movedim(-1, 0)[:, None] for image in (a, b))
    mean_x, mean_y = _blur(x), _blur(y)
    variance_x, variance_y = _blur(x * x) - mean_x**2, _blur(y * y) - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    likeness = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    S = likeness / ((mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2))
    return S.mean(), (a - b).abs().mean()


def _blur(images: Tensor) -> Tensor:
    """Weighted sums over the windows around all pixels of (image, 1, height, width), zeros beyond the border."""
    w = torch.tensor(weights(), dtype=images.dtype, device=images.device)
    across = conv2d(images, w.view(1, 1, 1, -1), padding=(0, WINDOW // 2))
    return conv2d(across, w.view(1, 1, -1, 1), padding=(WINDOW // 2, 0))
