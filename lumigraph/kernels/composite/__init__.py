"""Compositing: samples along rays become one value per ray."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from .._dispatch import implementation


def composite(
    tau: Float[Tensor, " sample"],
    values: Float[Tensor, "sample channel"],
    ray_starts: Int[Tensor, " ray_plus_one"],
    stop: float = 0.0,
) -> tuple[Float[Tensor, "ray channel"], Float[Tensor, " ray"], Float[Tensor, " sample"]]:
    """Accumulate values front to back (Max 1995, eq. 9).

        T_i = exp(-sum_{j<i} tau_j)      light that reaches sample i
        w_i = T_i (1 - exp(-tau_i))      its share of what the eye gets; 0 once T_i < stop

    tau:        optical thickness, density times length; never negative
    values:     colour, distance or anything else, per sample
    ray_starts: (R + 1,) int64; ray r owns samples ray_starts[r] to ray_starts[r + 1]
    stop:       early termination: samples behind this transmittance get weight 0 and no gradient

    Returns the accumulated values sum_i w_i v_i (R, C), opacity sum_i w_i (R,), and the weights (S,).
    All three are differentiable in tau and values.
    """
    return implementation("composite", tau)(tau, values, ray_starts, stop)
