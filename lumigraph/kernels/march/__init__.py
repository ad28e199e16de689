"""Ray marching: which stretches of each ray are worth asking the network about."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from ...rays import Samples
from .._dispatch import implementation


def march(
    origins: Float[Tensor, "ray 3"],
    directions: Float[Tensor, "ray 3"],
    t_near: Float[Tensor, " ray"],
    t_far: Float[Tensor, " ray"],
    occupied: Bool[Tensor, "cascade x y z"],
    density: Float[Tensor, "cascade x y z"],
    step: float,
    growth: float = 0.0,
    stop: float = 0.0,
) -> Samples:
    """Keep the intervals of a fixed lattice whose midpoints lie in occupied cells.

    The lattice starts at t_near (jitter belongs there). With growth 0, t_k = t_near + k step. Otherwise steps are
    constant up to the first lattice point at or beyond t_c = step / growth and geometric from there,
    t_{k+1} = (1 + growth) t_k, so that a step covers a constant angle (Müller 2022, appendix E.1).
    Intervals whose midpoint is at or beyond t_far are dropped.

    Cascade c is a grid of n^3 cells over the cube [-2^c, 2^c]^3; a point belongs to the finest cascade that
    holds it (max |x| < 2^c), and to none outside the last. A grid's index is [cascade, x, y, z].

    occupied: cells worth visiting
    density:  what is known of each cell, per scene unit; sums of density times length along kept samples tell when
              a ray is spent: samples behind exp(-sum) < stop are dropped. 0 keeps all.
    t_near:   >= 0; a ray whose t_far <= t_near has no samples
    Not differentiable.
    """
    run = implementation("march", origins)
    return Samples(*run(origins, directions, t_near, t_far, occupied, density, step, growth, stop))
