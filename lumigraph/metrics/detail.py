"""Fine detail of a rendering compared with its photograph. Sharp foliage shifted by a pixel has a low PSNR."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

FINE, COARSE = 3, 9  # pixels of two box filters, whose difference is fine detail without the sensor's noise
MAX_SHIFT = 2  # pixels
SHIFT_WINDOW = 15  # pixels of the square that is shifted as one
SHARP, BLURRED = 0.75, 0.5  # shares of the photograph's detail
SHIFTED_DB = 2.0  # dB from which on a shift explains the error; chance explains 0.9
MIN_ENERGY = 1e-6  # mean square of detail below which a photograph has none

Grey = Float[Tensor, "height width"]


@dataclass(frozen=True)
class FineDetail:
    """Fine detail of a rendering.

    sharpness: amplitude of a rendering's fine detail, as a share of its photograph's
    shift_gain: PSNR in dB gained by shifts of up to 2 pixels, separately for each square of 15 pixels
    """

    sharpness: float
    shift_gain: float

    def __str__(self) -> str:
        if self.sharpness < BLURRED:
            return f"blurred, with {100 * self.sharpness:.0f} % of the photographs' fine detail"
        if self.sharpness < SHARP:
            return f"softer than the photographs, with {100 * self.sharpness:.0f} % of their fine detail"
        if self.shift_gain < SHIFTED_DB:
            return "as sharp as the photographs"
        return (
            f"sharp, but shifted by a pixel or two, which lowers PSNR by {self.shift_gain:.1f} dB and is hardly visible"
        )


def detail(
    rendering: Float[Tensor, "height width 3"],
    photograph: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"] | None = None,
) -> FineDetail | None:
    """Detail of a rendering. None for pictures below 15 pixels, or without fine detail. mask: pixels that count"""
    one, other = (image.mean(-1).float() for image in (rendering, photograph))
    if min(one.shape) < SHIFT_WINDOW:
        return None
    counts = torch.ones_like(one, dtype=torch.bool) if mask is None else mask
    energies = [fine(image)[counts].square().mean() for image in (one, other)]
    if not counts.any() or energies[1] < MIN_ENERGY:
        return None
    padded = pad(one[None], [MAX_SHIFT] * 4, mode="replicate")[0]
    height, width = one.shape
    errors = [
        box((padded[y : y + height, x : x + width] - other).square(), SHIFT_WINDOW)
        for y in range(2 * MAX_SHIFT + 1)
        for x in range(2 * MAX_SHIFT + 1)
    ]
    still, moved = (
        error[counts].mean().clamp_min(1e-10) for error in (errors[len(errors) // 2], torch.stack(errors).amin(0))
    )
    return FineDetail(float((energies[0] / energies[1]).sqrt()), float(10 * (still / moved).log10()))


def fine(image: Grey) -> Grey:
    """Fine detail: the difference of two box filters."""
    return box(image, FINE) - box(image, COARSE)


def box(image: Grey, size: int) -> Grey:
    """Box filter: mean of a square around each pixel, within the image."""
    return avg_pool2d(image[None], size, 1, size // 2, count_include_pad=False)[0]
