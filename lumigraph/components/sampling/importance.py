"""Importance of a table's numbers: their share in rendered pictures (Li 2023, VQRF, eq. 4)."""

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
    """Importance of a table's numbers in one picture: compositing weights, distributed over looked-up numbers,
    sum_s w_s d(lookup(x_s)) / d(table), in absolute value. Shaped like the tables.

    lookup: linear in each of the tables, e.g. trilinear interpolation of a grid: then a number's share in a sample is
            its interpolation weight, and the lookup's own gradient sums all of them
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
