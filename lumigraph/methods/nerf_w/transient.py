"""Transient: what one photograph alone saw, such as passers-by (Martin-Brualla et al. 2021, sections 4.1 and 4.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from ... import kernels
from ...camera.rays import Look, Rendering
from ...components.fields.activations import truncated_exp
from ...components.fields.dense import Dense, in_chunks
from ...components.fields.hash_field import HashField, side_by_side
from ...components.fields.mlp import MLP
from ...volume import composite

MIN_OPACITY = 1e-10  # opacity of a sample that is divided by at least
THIN = 3.0  # transient density is exp(-THIN) per scene unit at first, beside a hash table: it is only where needed


@dataclass(frozen=True)
class Transient:
    """Density per scene unit and colour of what one photograph alone saw, and the deviation of its colour."""

    density: Float[Tensor, " sample"]
    rgb: Float[Tensor, "sample 3"]
    beta: Float[Tensor, " sample"]


class TransientHead(nn.Module):
    """Density, colour and deviation from features of the static field and a transient code (eq. 10).

    widths: of the features with the code, and of the hidden layers
    """

    def __init__(self, *widths: int, exact: bool = False):
        super().__init__()
        hidden = [Dense(a, b, True, exact) for a, b in zip(widths, widths[1:], strict=False)]
        self.layers = nn.Sequential(*hidden, Dense(widths[-1], 5, False, exact))

    def forward(
        self, features: Tensor, code: Float[Tensor, "sample code"], stretch: Float[Tensor, " sample"]
    ) -> Transient:
        """stretch: coordinates in a scene unit"""

        def answer(feature: Tensor, code: Tensor) -> tuple[Tensor]:
            return (self.layers(torch.cat([feature, code.to(feature.dtype)], -1)).float(),)

        (raw,) = in_chunks(answer, features, code)
        return Transient(softplus(raw[:, 0]) * stretch, raw[:, 1:4].sigmoid(), softplus(raw[:, 4]))


class HashTransientHead(nn.Module):
    """The same from the encoding of an `EncodedHashField`. One photograph alone sees a passer-by and cannot tell how
    far away they stood, so transient density is learnt where its rays are sampled anyway: at the surfaces behind."""

    def __init__(self, *widths: int):
        super().__init__()
        self.layers = MLP(*widths, 5)

    def forward(
        self, features: tuple[Tensor, ...], code: Float[Tensor, "sample code"], stretch: Float[Tensor, " sample"]
    ) -> Transient:
        raw = self.layers(side_by_side(features[1], code))
        return Transient(truncated_exp(raw[:, 0] - THIN), raw[:, 1:4].sigmoid(), softplus(raw[:, 4]))


class EncodedHashField(HashField):
    """A hash table whose features include the encoding, without gradients: the table holds the static scene, and a
    transient head does not change what it learns."""

    def geometry(
        self, points: Float[Tensor, "point 3"], code: Tensor | None = None
    ) -> tuple[Float[Tensor, " point"], Any]:
        encoded = self.encode(points)
        density, geometry = self.decode(points, encoded)
        return density, (geometry, encoded.detach())

    def colour(self, features: Any, directions: Float[Tensor, "point 3"], code: Tensor | None = None) -> Tensor:
        return super().colour(features[0], directions, code)


def with_transient(look: Look, transient: Transient, background: Float[Tensor, "#ray 3"]) -> Rendering:
    """A rendering of the static scene and the transient (eq. 9), and as the extra "beta" the deviation of its colours
    (eq. 11), without beta_min.

        C = sum_i T_i (alpha(sigma_i) c_i + alpha(sigma'_i) c'_i)      T_i = exp(-sum_{j<i} (sigma_j + sigma'_j) d_j)
        beta = sum_i T'_i alpha(sigma'_i) beta_i                       T'_i = exp(-sum_{j<i} sigma'_j d_j)

    A sample's weight T_i alpha(sigma_i + sigma'_i) is shared out so that each part has the alpha of its own density.
    """
    samples, length = look.samples, look.samples.length
    density = look.density + transient.density
    whole = opaque(density * length).clamp_min(MIN_OPACITY)
    static, passing = (opaque(x * length) / whole for x in (look.density, transient.density))
    colours = static[:, None] * look.rgb + passing[:, None] * transient.rgb
    seen = composite(samples, density, colours, background)
    (beta, *_) = kernels.composite(transient.density * length, transient.beta[:, None], samples.ray_starts)
    return seen.with_extra(beta=beta[:, 0])


def opaque(thickness: Float[Tensor, " sample"]) -> Float[Tensor, " sample"]:
    """alpha = 1 - exp(-sigma d), the share of light that optical thickness stops."""
    return -torch.expm1(-thickness)
