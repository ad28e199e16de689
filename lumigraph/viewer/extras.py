"""Pictures of a rendering's extras: whatever else a method renders by name, such as labels or uncertainty."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from ..camera.rays import Rendering
from ..figures import EMPTY_COLOUR, hex_colour, ramp

# Twenty colours that are told apart easily; labels beyond begin again at the first.
PALETTE = (
    *("e6194b", "3cb44b", "ffe119", "4363d8", "f58231", "911eb4", "46f0f0", "f032e6", "bcf60c", "fabebe"),
    *("008080", "e6beff", "9a6324", "fffac8", "800000", "aaffc3", "808000", "ffd8b1", "000075", "a9a9a9"),
)
MAX_QUANTILE_VALUES = 1_000_000  # values that a range is found from; quantile() takes no more than 16 million


def drawable(rendering: Rendering) -> list[str]:
    """Names of the extras that can be drawn: one number or label per pixel, or three channels of numbers."""
    return [
        name
        for name, values in rendering.extra.items()
        if not values.is_complex() and (is_plane(values) or (values.is_floating_point() and values.shape[2:] == (3,)))
    ]


def is_plane(values: Shaped[Tensor, "height width *channel"]) -> bool:
    return values.shape[2:] in ((), (1,))


def draw_extra(
    values: Shaped[Tensor, "height width *channel"], opacity: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 3"]:
    """A picture of one drawable extra.

    Three channels are colours, clipped to [0, 1]. Numbers are bright where high and dark where low, labels have the
    palette's colours; both are drawn where the scene is, and labels where they are not negative.
    """
    if not is_plane(values):
        return values.float().nan_to_num(0.0).clamp(0, 1)
    plane = values.reshape(opacity.shape)
    if plane.is_floating_point():
        drawn = plane.isfinite() & (opacity > 0)
        colours = heat(plane.float(), drawn)
    else:
        drawn = (plane >= 0) & (opacity > 0)
        colours = label_colours(plane.long())
    return torch.where(drawn[..., None], colours, hex_colour(EMPTY_COLOUR))


def heat(values: Float[Tensor, "height width"], among: Bool[Tensor, "height width"]) -> Float[Tensor, "height width 3"]:
    """Colours of numbers along the ramp, whose ends are the 2nd and 98th percentile of those in a mask."""
    low, high = percentiles(values[among])
    return ramp(1 - ((values - low) / max(high - low, 1e-12)).nan_to_num(0.0))


def percentiles(values: Float[Tensor, " value"]) -> tuple[float, float]:
    """The 2nd and the 98th percentile; 0 and 1 of no values."""
    if not len(values):
        return 0.0, 1.0
    some = values[:: -(-len(values) // MAX_QUANTILE_VALUES)]
    low, high = torch.quantile(some, torch.tensor([0.02, 0.98])).tolist()
    return low, high


def label_colours(labels: Int[Tensor, "height width"]) -> Float[Tensor, "height width 3"]:
    """The palette's colour of each label."""
    palette = torch.stack([hex_colour(text) for text in PALETTE])
    return palette[labels % len(PALETTE)]
