"""Importance: how much of what is seen each number of a table has a share in (Li 2023, VQRF, eq. 4)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...method import Method
from ...method.capabilities import HasLooks, needs
from ...volume import weights_of

RAYS = 8192  # at once


@torch.no_grad()
def importance(
    method: Method,
    camera: Camera,
    lookup: Callable[[Float[Tensor, "sample 3"]], Float[Tensor, "sample value"]],
    tables: list[Tensor],
) -> list[Tensor]:
    """Sum over one picture's samples of their compositing weights, shared out to the numbers that each was looked up
    from: sum_s w_s d(lookup(x_s)) / d(table), in absolute value. Shaped like the tables.

    lookup: linear in each of the tables, of a stored grid for instance its trilinear interpolation: then a number's
            share in a sample is its interpolation weight, and the lookup's own gradient adds all of them up
    """
    rays = camera.rays(camera.pixels()).to(tables[0].device)
    totals = [torch.zeros_like(table) for table in tables]
    for i in range(0, len(rays), RAYS):
        some = rays[i : i + RAYS]
        look = needs(method, HasLooks).looks(some)[-1]
        points, _ = look.samples.along(some)
        weights = weights_of(look.samples, look.density)
        with torch.enable_grad():
            values = lookup(points)
        shares = torch.autograd.grad(values, tables, weights[:, None].expand_as(values).contiguous())
        for total, share in zip(totals, shares, strict=True):
            total += share.abs()
    return totals
