"""Marching: what methods share that sample occupied cells, look at what light reaches, and learn from that alone."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...camera.rays import Rays, Samples
from ...kernels import composite
from ...volume import visible

FIRST_RAYS = 256  # of a step, before anybody knows how many samples a ray needs
FEWEST_RAYS = 64
GROWTH = 1.5  # rays per step at most, from one step to the next


@torch.no_grad()
def reached(
    rays: Rays, found: Samples, density_at: Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]], stop: float
) -> tuple[Samples, int]:
    """The samples that light reaches, and how many were asked about: a first pass, without gradients, along each ray
    from the front until it is spent. Most samples lie behind what their ray sees (see `volume.visible`).

    density_at: per scene unit
    stop:       transmittance below which a ray is spent
    """
    (points, _), length = found.along(rays), found.length
    asked_in_all = 0

    def thickness_of(asked: Int[Tensor, " asked"]) -> Float[Tensor, " asked"]:
        nonlocal asked_in_all
        asked_in_all += len(asked)
        return density_at(points.index_select(0, asked)) * length.index_select(0, asked)

    seen = visible(found, thickness_of, stop)
    return found.keep(seen), asked_in_all


@torch.no_grad()
def weighty(
    rays: Rays,
    found: Samples,
    density_at: Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]],
    stop: float,
    least: float,
) -> Samples:
    """The samples with more than the least weight in their ray's colour, asking about all of them at once.

    Where density costs no more than a lookup, this is quicker than `reached`, and free space that is nearly but not
    quite empty is left out too (as the published code of Sun 2022 does before it asks for colours).
    """
    tau = density_at(found.along(rays)[0]) * found.length
    return found.keep(composite(tau, tau[:, None], found.ray_starts, stop)[2] > least)


def rays_for(wanted: int, rays: int, samples: float) -> int:
    """Rays of the next step, so that it asks about `wanted` samples, from a step whose rays asked about `samples`.

    Steps then take the same time and memory, whether a ray meets much or little (Müller 2022, section 5.4).
    """
    return int(min(max(rays * wanted / max(samples, 1), FEWEST_RAYS), GROWTH * rays, wanted))
