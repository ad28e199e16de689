"""Quality of a picture from its pixels: sharp or blurred, bright or dark, new or a duplicate.

All is computed on the luminance at 640 pixels along the longer side, where a phone's picture has little noise, and
slight blur is harmless.

Sharpness compares slopes over a short and over a long distance, in four directions θ:

    s = min over θ of  mean (Δ_θ,2 Y / 2)²  /  mean (Δ_θ,8 Y / 8)²

Δ_θ,d is the difference between two pixels that lie d apart. A picture that is smooth over 8 pixels has s = 1, perfect
edges have 4, fine texture up to 16. As numerator and denominator see the same edges, contrast and the amount of detail
cancel. Motion blurs along its own direction only, hence the minimum. Related to Crété-Roffet et al. 2007, "The Blur
Effect", which compares slopes before and after blurring.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import gaussian_filter

from ...color.srgb import linear_from_srgb
from ...readers.pictures import eight_bits, same_shape

JUDGED_SIDE = 640  # pixels, the longer side of the judged picture
SHORT_STEP, LONG_STEP = 2, 8  # pixels; along diagonals half as many steps, each √2 long
ROUNDING_SLOPE = 1 / 6 / LONG_STEP**2  # squared slope that rounding to whole numbers may cause

MIN_SHARPNESS = 1.4  # blurred in every context below this; clean edges blurred with σ = 1.2 have it
SOFT_SHARPNESS = 1.8  # below this a picture is blurred if others of the subject are sharp; σ = 0.9
CRISP_SHARPNESS = 3.5  # above this a picture counts as sharp
MIN_BLUR_RATIO = 1.6  # times less sharp than the others' median is noticeable, and
MIN_DEVIATIONS = 4.0  # standard deviations of the logarithm below it is unusual

MAX_EXPOSURE_STOPS = 1.5  # of exposure that a photograph may differ from others
EXPOSURE_WINDOW = 5  # neighbours on each side with which a frame's exposure is compared

SIGNATURE_SIDE = 96  # pixels to a side of a signature
DETAIL_SIGMA = 3.0  # pixels of the grid; larger structures are shared by all pictures of one subject
DUPLICATE_CORRELATION = 0.95  # of signatures; neighbours of a walk around a subject stay below 0.8


@dataclass(frozen=True)
class Judgement:
    """Quality of one picture, from its pixels.

    sharpness: see above, 1 to 16
    brightness: mean log2 of the linear luminance
    signature: normalised high-pass thumbnail, length 1, or 0 without detail
    """

    sharpness: float
    brightness: float
    signature: Float[np.ndarray, " cell"]


def judge(image: Image.Image) -> Judgement:
    """Judge one picture. An unread JPEG is decoded at a fraction of its size, which is fast.

    EXIF's orientation is ignored: only pictures of one orientation have comparable signatures.
    Raises Pillow's errors for damaged files.
    """
    image.draft("L", (JUDGED_SIDE, JUDGED_SIDE))
    grey = eight_bits(image).convert("L")
    times = max(grey.size) / JUDGED_SIDE
    if times > 1:
        size = max(round(grey.width / times), 1), max(round(grey.height / times), 1)
        grey = grey.resize(size, Image.Resampling.BOX)
    luminance = np.asarray(grey, np.float32)
    return Judgement(sharpness(luminance), brightness(luminance), signature(grey))


def sharpness(luminance: Float[np.ndarray, "height width"]) -> float:
    """Sharpness, from 1, smooth, to 16, pure fine texture. luminance: 0 to 255"""
    pairs = zip(slopes(luminance, SHORT_STEP), slopes(luminance, LONG_STEP), strict=True)
    return min((short + ROUNDING_SLOPE) / (long + ROUNDING_SLOPE) for short, long in pairs)


def slopes(y: Float[np.ndarray, "height width"], d: int) -> list[float]:
    """Mean squared slope over a distance d, across, down and along both diagonals."""
    h = d // 2
    ends = [
        (y[:, d:], y[:, :-d], d**2),
        (y[d:], y[:-d], d**2),
        (y[h:, h:], y[:-h, :-h], 2 * h**2),
        (y[h:, :-h], y[:-h, h:], 2 * h**2),
    ]
    return [float(np.square(a - b).mean()) / length if a.size else 0.0 for a, b, length in ends]


def brightness(luminance: Float[np.ndarray, "height width"]) -> float:
    """Mean log2 of the linear luminance, 0 for white, clamped below at 1/255 encoded."""
    encoded = np.maximum(luminance, 1) / 255
    return float(np.log2(linear_from_srgb(encoded)).mean())


def signature(grey: Image.Image) -> Float[np.ndarray, " cell"]:
    small = np.asarray(grey.resize((SIGNATURE_SIDE, SIGNATURE_SIDE), Image.Resampling.BOX), np.float32)
    detail = (small - gaussian_filter(small, DETAIL_SIGMA)).ravel()
    length = float(np.linalg.norm(detail))
    return detail / length if length > math.sqrt(ROUNDING_SLOPE) * SIGNATURE_SIDE else np.zeros_like(detail)


def blurred(sharpness: Mapping[str, float]) -> dict[str, str]:
    """Names of pictures that are too blurred to use, with the reason in a few words.

    Strongly blurred ones in any case. Otherwise clear outliers among the others that are also either soft or unusual,
    but not crisp. The spread is the median absolute deviation of log s, so that a minority of blurred ones does not
    widen it. Where all are equally sharp none is named; where all are strongly blurred all are.
    """
    if not sharpness:
        return {}
    logs = np.log(list(sharpness.values()))
    median = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - median)))
    usual, unusual = math.exp(median), math.exp(median - MIN_DEVIATIONS * spread)
    limit = min(usual / MIN_BLUR_RATIO, max(unusual, SOFT_SHARPNESS), CRISP_SHARPNESS)
    found = {}
    for name, value in sharpness.items():
        if value < limit:
            found[name] = f"far less sharp than the others: {value:.1f} where they have {usual:.1f}"
        elif value < MIN_SHARPNESS:
            found[name] = f"no fine detail: sharpness {value:.1f} where clean edges have 4"
    return found


def exposure_jumps(brightness: Sequence[float], in_order: bool) -> dict[int, float]:
    """Stops, by number, of photographs that differ by more than 1.5 from the median of their neighbours in order.

    brightness: mean log2 of the linear luminance
    in_order:   whether photographs follow each other in space; otherwise the median is that of all
    """
    found = {}
    for i, own in enumerate(brightness):
        others = brightness[max(0, i - EXPOSURE_WINDOW) : i + EXPOSURE_WINDOW + 1] if in_order else brightness
        if abs(stops := own - statistics.median(others)) > MAX_EXPOSURE_STOPS:
            found[i] = stops
    return found


def duplicates(
    signatures: Mapping[str, Float[np.ndarray, " cell"]], sizes: Mapping[str, tuple[int, int]]
) -> dict[str, str]:
    """Names of exact or near duplicates, with the name of the earlier picture.

    signatures: the one to keep comes first
    Two are the same if their signatures correlate by more than DUPLICATE_CORRELATION and they have one aspect ratio.
    """
    names = list(signatures)
    table = np.stack([signatures[name] for name in names]) if names else np.zeros((0, 1), np.float32)
    alike = np.triu(table @ table.T > DUPLICATE_CORRELATION, 1)
    found: dict[str, str] = {}
    for i, j in np.argwhere(alike).tolist():
        first, second = names[i], names[j]
        if first not in found and second not in found and same_shape(sizes[first], sizes[second]):
            found[second] = first
    return found
