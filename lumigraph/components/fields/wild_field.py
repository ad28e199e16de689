"""A field that photographs see each in a light of their own, and with passers-by: its nouns, and what rays see of it.

Martin-Brualla et al. 2021 (NeRF in the Wild), sections 4.1 and 4.2.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...camera.rays import Rendering
from ...volume import composite
from .coded_field import CodedField, Places

LEAST = 1e-10  # opacity of a sample that is divided by at least


@dataclass(frozen=True)
class Passing:
    """What one photograph alone saw at places.

    density: per scene unit
    beta:    how little its colour is to be trusted, in units of colour
    """

    density: Float[Tensor, " sample"]
    rgb: Float[Tensor, "sample 3"]
    beta: Float[Tensor, " sample"]


class WildField(CodedField):
    """A field that also holds what each photograph alone saw."""

    @abstractmethod
    def passing(self, places: Places, codes: Float[Tensor, "sample code"]) -> Passing:
        """What the photographs of some transient codes saw (eq. 10)."""


def with_passing(
    places: Places, rgb: Float[Tensor, "sample 3"], passing: Passing, background: Float[Tensor, "#ray 3"]
) -> Rendering:
    """What rays see of both (eq. 9), and as the extra "beta" how uncertain its colours are (eq. 11), without beta_min.

        C = sum_i T_i (alpha(sigma_i) c_i + alpha(sigma'_i) c'_i)      T_i = exp(-sum_{j<i} (sigma_j + sigma'_j) d_j)
        beta = sum_i T'_i alpha(sigma'_i) beta_i                       T'_i = exp(-sum_{j<i} sigma'_j d_j)

    A sample's weight T_i alpha(sigma_i + sigma'_i) is shared out so that each part has the alpha of its own density.
    """
    samples, length = places.samples, places.samples.length
    whole = opaque((places.density + passing.density) * length).clamp_min(LEAST)
    stays, passes = (opaque(density * length) / whole for density in (places.density, passing.density))
    colours = stays[:, None] * rgb + passes[:, None] * passing.rgb
    seen = composite(samples, places.density + passing.density, colours, background)
    (beta, *_) = kernels.composite(passing.density * length, passing.beta[:, None], samples.ray_starts)
    return seen.with_extra(beta=beta[:, 0])


def opaque(thickness: Float[Tensor, " sample"]) -> Float[Tensor, " sample"]:
    """alpha = 1 - exp(-sigma d): the share of light that optical thickness stops."""
    return -torch.expm1(-thickness)
