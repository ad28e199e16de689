"""Union: what several methods found along the same rays, as one look."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..camera.rays import Look, Samples
from ..volume import packed


def union(looks: Sequence[Look]) -> Look:
    """All that lies along rays: densities add up where samples of several looks overlap, and colours mix by density.

    Exact: every sample is cut where another look's sample begins or ends, so that density and colour stay constant over
    each piece, as they were over the samples. Light that one look emits passes through the other's haze.
    """
    if len(looks) == 1:
        return looks[0]
    rays = len(looks[0].samples.ray_starts) - 1
    counts = torch.stack([look.samples.ray_starts.diff() for look in looks])
    shared = (counts > 0).sum(0) > 1  # rays on which there is anything to cut
    alone = [kept(look, ~shared[look.samples.ray_index]) for look in looks]
    pieces = cut([kept(look, shared[look.samples.ray_index]) for look in looks])
    return joined([*alone, pieces], rays)


def kept(look: Look, mask: Tensor) -> Look:
    return Look(look.name, look.samples.keep(mask), look.density[mask], look.rgb[mask])


def cut(looks: Sequence[Look]) -> Look:
    """The pieces between all beginnings and ends of samples, where there is anything."""
    rays = len(looks[0].samples.ray_starts) - 1
    t, ray, begins = edges(looks)
    begin, end, on = t[:-1], t[1:], ray[:-1]
    piece = (end > begin) & (ray[1:] == on)
    density, colour = begin.new_zeros(len(begin)), begin.new_zeros(len(begin), 3)
    inside = torch.zeros_like(piece)
    for number, look in enumerate(looks):
        if not len(look.samples):
            continue
        latest = ((begins == number).cumsum(0) - 1)[:-1]  # the look's sample that began last, as edges are in order
        there = latest.clamp_min(0)
        holds = piece & (latest >= 0) & (look.samples.ray_index[there] == on) & (look.samples.t_end[there] > begin)
        mine = torch.where(holds, look.density[there], 0.0)
        density, colour, inside = density + mine, colour + mine[:, None] * look.rgb[there], inside | holds
    rgb = colour / density.clamp_min(torch.finfo(density.dtype).tiny)[:, None]
    starts = packed(torch.bincount(on[inside], minlength=rays))
    return Look("union", Samples(begin[inside], end[inside], starts), density[inside], rgb[inside])


def edges(looks: Sequence[Look]) -> tuple[Float[Tensor, " edge"], Int[Tensor, " edge"], Int[Tensor, " edge"]]:
    """Edges of samples: distance, ray, and the number of the look whose sample begins there, -1 for ends.

    By ray, then by distance.
    """
    parts = [(look.samples.t_start, look.samples.t_end, look.samples.ray_index) for look in looks]
    t = torch.cat([x for begin, end, _ in parts for x in (begin, end)])
    ray = torch.cat([index for _, _, index in parts for _ in range(2)])
    names = [torch.full_like(index, x) for number, (*_, index) in enumerate(parts) for x in (number, -1)]
    order = t.argsort(stable=True)
    order = order[ray[order].argsort(stable=True)]
    return t[order], ray[order], torch.cat(names)[order]


def joined(looks: Sequence[Look], rays: int) -> Look:
    """One look from several, of which no two have samples on the same ray."""
    ray = torch.cat([look.samples.ray_index for look in looks])
    order = ray.argsort(stable=True)
    begin, end, density, rgb = (
        torch.cat(columns)[order]
        for columns in zip(*((x.samples.t_start, x.samples.t_end, x.density, x.rgb) for x in looks), strict=True)
    )
    return Look("union", Samples(begin, end, packed(torch.bincount(ray, minlength=rays))), density, rgb)
