"""A field of frustums of cones: a coordinate network with an integrated encoding (Barron et al. 2021)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from .coordinate_field import CoordinateField
from .encodings import FrequencyEncoding, IntegratedEncoding

POINT_VARIANCE = (2 / 128) ** 2 / 12  # of points, a cell's of a grid of 128: photographs show nothing smaller
COLOUR_PADDING = 0.001  # by which colours may exceed 0 and 1, so that both are within reach of the sigmoid


def shifted_softplus(raw: Tensor) -> Tensor:
    """Density of the network's output (Barron 2021, section 3.3)."""
    return softplus(raw - 1)


class FrustumField(CoordinateField):
    """Density and colour of frustums; of points, as of a small volume around each.

    padding: by which colours may exceed 0 and 1
    """

    def __init__(self, *arguments: Any, padding: float = COLOUR_PADDING, **named: Any):
        super().__init__(*arguments, **named)
        self.activation, self.padding = shifted_softplus, padding

    def encodings(self, keep_input: bool) -> tuple[IntegratedEncoding, FrequencyEncoding]:
        n = self.numbers
        return IntegratedEncoding(3, n.position_frequencies), FrequencyEncoding(3, n.direction_frequencies, base=1.0)

    def encode(
        self, means: Float[Tensor, "place 3"], variances: Float[Tensor, "place 3"] | None = None
    ) -> Float[Tensor, "place width"]:
        variances = torch.full_like(means, POINT_VARIANCE) if variances is None else variances
        return self.encode_position(means, variances, self.octave_weights())

    def activated(self, raw: Float[Tensor, "place 3"]) -> Float[Tensor, "place 3"]:
        return raw.sigmoid() * (1 + 2 * self.padding) - self.padding if self.padding else raw.sigmoid()
