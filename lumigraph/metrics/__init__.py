"""Metrics: PSNR, SSIM, LPIPS, IoU, chamfer distance; scores."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import conv2d

from ..files.ranges import between

# Of one view, and of views' means: key, name, unit, better, digits.
KEYS = (
    ("psnr", "PSNR", "dB", "higher", 2),
    ("ssim", "SSIM", "", "higher", 4),
    ("lpips", "LPIPS", "", "lower", 4),
    ("clean_psnr", "clean PSNR", "dB", "higher", 2),
    ("depth_error", "depth error", "% of the distance", "lower", 2),
    ("moving_psnr", "moving PSNR", "dB", "higher", 2),
    ("moving_ssim", "moving SSIM", "", "higher", 4),
)
MIN_ERROR = 1e-10  # mean squared error below which images count as equal: 100 dB
WINDOW, DEVIATION = 11, 1.5  # pixels of SSIM's Gaussian window


@dataclass(frozen=True)
class Score:
    """A score of an evaluation.

    unit:   as a user reads it; empty for a plain number
    digits: decimals to show
    """

    name: str
    value: float
    unit: str
    better: Literal["higher", "lower"]
    digits: Annotated[int, between(0, 16)] = 4

    def __str__(self) -> str:
        return f"{self.value:.{self.digits}f} {self.unit}".rstrip()

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def scores_of(result: dict[str, Any]) -> list[Score]:
    """The scores in eval.json, in its entry of one view, or in a benchmark's row; the headline first."""
    if "scores" in result:
        return [Score(**score) for score in result["scores"]]
    return [
        Score(name, result[key], unit, better, digits)  # type: ignore[arg-type]
        for key, name, unit, better, digits in KEYS
        if result.get(key) is not None
    ]


def named(scores: Sequence[Score], name: str) -> Score | None:
    """Score by name, or None."""
    return next((score for score in scores if score.name == name), None)


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


def blur(images: Float[Tensor, "image 1 height width"]) -> Float[Tensor, "image 1 inner_height inner_width"]:
    """Weighted mean over each window, one axis after the other."""
    offsets = torch.arange(WINDOW, dtype=images.dtype, device=images.device) - WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / DEVIATION) ** 2)
    weights = weights / weights.sum()
    return conv2d(conv2d(images, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1))


def intersection_over_union(a: Bool[Tensor, " point"], b: Bool[Tensor, " point"]) -> float:
    """Intersection over union of two volumes, by the points inside of each. In [0, 1]; 1 if both are empty.

    The points should be uniform in a box around both.
    """
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 1.0


def chamfer_distance(
    learnt: Float[Tensor, "learnt 3"], true: Float[Tensor, "true 3"], size: float
) -> tuple[float, float, float]:
    """Chamfer-L1 between points of two surfaces, in tenths of a size: the mean of accuracy (from learnt points to the
    nearest true ones) and completeness (the other way), and these two."""
    accuracy, completeness = nearest(learnt, true)[0].mean(), nearest(true, learnt)[0].mean()
    unit = size / 10
    return float(accuracy + completeness) / 2 / unit, float(accuracy) / unit, float(completeness) / unit


def normal_consistency(
    learnt: Float[Tensor, "learnt 3"],
    learnt_normals: Float[Tensor, "learnt 3"],
    true: Float[Tensor, "true 3"],
    true_normals: Float[Tensor, "true 3"],
) -> float:
    """The mean |cosine| between the normals of each point and of the nearest one on the other surface, both ways. In
    [0, 1]."""
    there, back = nearest(learnt, true)[1], nearest(true, learnt)[1]
    a = (learnt_normals * true_normals[there]).sum(-1).abs().mean()
    b = (true_normals * learnt_normals[back]).sum(-1).abs().mean()
    return float(a + b) / 2


def nearest(
    points: Float[Tensor, "point 3"], others: Float[Tensor, "other 3"]
) -> tuple[Float[np.ndarray, " point"], Tensor]:
    """The distance of each point to the nearest of the others, and its number."""
    distance, number = cKDTree(others.double().numpy()).query(points.double().numpy())
    return distance, torch.from_numpy(number)
