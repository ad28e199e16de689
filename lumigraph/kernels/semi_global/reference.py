"""Reference implementation: one row after the other, of the picture turned so that each direction leads down."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from . import NO_RIVAL, PATHS


def run(volume, guide, penalties, slope_penalty, first):
    C, guide, penalties = volume.int(), guide.int(), penalties.int()
    total = torch.zeros_like(C)
    for dx, dy in PATHS:
        turned = dy == 0  # along a row: columns take the place of rows
        step, aside = (dx, 0) if turned else (dy, dx)
        costs, picture, sums = (x.transpose(0, 1) if turned else x for x in (C, guide, total))
        if step < 0:
            costs, picture = costs.flip(0), picture.flip(0)
        along(costs, picture, penalties, slope_penalty, aside, sums, step < 0)
    height, width, count = C.shape
    k = torch.arange(count, device=C.device)
    least, best = total.min(2)
    best = (total == least[..., None]).int().argmax(2)  # the first of equal ones
    beside = (best[..., None] + torch.tensor([-1, 1], device=C.device)).clamp(0, count - 1)
    a, b = total.gather(2, beside).unbind(-1)
    slope = 2 * (torch.maximum(a, b) - least)
    inner = (best > 0) & (best < count - 1) & (slope > 0)
    left = first + best + torch.where(inner, (a - b) / slope.clamp_min(1), 0)
    rivals = torch.where((k - best[..., None]).abs() > 1, total, NO_RIVAL)
    x = torch.arange(width, device=C.device)[:, None] + first + k  # of the left pixel that a right one meets
    inside = (x >= 0) & (x < width)
    met = total[:, x.clamp(0, max(width - 1, 0)), k] if width else total
    met = torch.where(inside, met, NO_RIVAL)
    right = torch.where(inside.any(1), first + (met == met.amin(2, keepdim=True)).int().argmax(2), first - 1)
    return left.float(), right.float(), (rivals.amin(2) - least).float()


def along(C: Tensor, guide: Tensor, penalties: Tensor, slope: int, aside: int, total: Tensor, back: bool) -> None:
    """Add L to the total, row after row; the pixel before (x, y) is (x - aside, y - 1)."""
    before = torch.empty(0)
    for y in range(len(C)):
        L = C[y].clone()
        if y > 0:
            x = torch.arange(len(L), device=C.device) - aside
            inside, x = (x >= 0) & (x < len(L)), x.clamp(0, max(len(L) - 1, 0))
            least = before[x].amin(1, keepdim=True)
            jump = penalties[(guide[y] - guide[y - 1][x]).abs()][:, None]
            sides = pad(before[x], (1, 1), value=1 << 20)
            options = [before[x], sides[:, :-2] + slope, sides[:, 2:] + slope, (least + jump).expand_as(L)]
            L = torch.where(inside[:, None], L - least + torch.stack(options).amin(0), L)
        total[len(C) - 1 - y if back else y] += L
        before = L
