"""Weighted k-means: the rows of a codebook, and which of them each row of a table is nearest to."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

MAX_TRAINING_ROWS = 1 << 17  # rows at most; each then counts as much as its weight says
PASSES = 8  # over them; the error falls by less than 1 % in any further one
CHUNK_ROWS = 1 << 13  # rows whose distances to the whole codebook are held at once, fewer if it is long
MAX_DISTANCES = 1 << 26  # distances that are held at once


@torch.no_grad()
def clustered(
    rows: Float[Tensor, "row column"], weights: Float[Tensor, " row"], size: int, generator: torch.Generator
) -> tuple[Float[Tensor, "code column"], Int[Tensor, " row"]]:
    """A codebook of `size` rows and the code of each row: sum_i w_i |x_i - b_{c(i)}|^2 is made small (Lloyd 1982).

    Rows that the codebook begins with are drawn by their weights. A code that nothing is nearest to begins anew at one
    of the rows that are worst off.
    """
    weights = weights.double().clamp_min(0) + 1e-9 * (float(weights.max()) if len(weights) else 1.0) + 1e-30
    if len(rows) > MAX_TRAINING_ROWS:
        some = torch.multinomial(weights, MAX_TRAINING_ROWS, replacement=True, generator=generator)
        learnt, counts = rows[some], torch.ones(MAX_TRAINING_ROWS)
    else:
        learnt, counts = rows, (weights / weights.mean()).float()
    book = learnt[_drawn(counts, size, generator)].clone()
    for _ in range(PASSES):
        codes, errors = nearest(learnt, book)
        total = torch.zeros(size).index_add_(0, codes, counts)
        sums = torch.zeros_like(book).index_add_(0, codes, counts[:, None] * learnt)
        used = total > 0
        book[used] = sums[used] / total[used, None]
        if (idle := int((~used).sum())) and (worst := errors * counts).any():
            book[~used] = learnt[worst.topk(min(idle, len(worst))).indices.repeat(idle)[:idle]]
    codes = nearest(rows, book)[0]
    order = torch.bincount(codes, minlength=size).argsort(descending=True, stable=True)  # small codes are the frequent
    return book[order], order.argsort()[codes]


def nearest(
    rows: Float[Tensor, "row column"], book: Float[Tensor, "code column"]
) -> tuple[Int[Tensor, " row"], Float[Tensor, " row"]]:
    """The code of each row, and its squared distance."""
    half = 0.5 * book.square().sum(-1)
    codes, errors = torch.empty(len(rows), dtype=torch.int64), torch.empty(len(rows))
    chunk = min(CHUNK_ROWS, max(1, MAX_DISTANCES // max(1, len(book))))
    for i in range(0, len(rows), chunk):
        some = rows[i : i + chunk]
        least, codes[i : i + chunk] = torch.addmm(half, some, book.t(), alpha=-1).min(-1)
        errors[i : i + chunk] = (2 * least + some.square().sum(-1)).clamp_min(0)
    return codes, errors


def _drawn(weights: Float[Tensor, " row"], count: int, generator: torch.Generator) -> Int[Tensor, " some"]:
    """So many different rows, heavy ones more likely (Efraimidis and Spirakis 2006)."""
    keys = torch.rand(len(weights), generator=generator).clamp_min(1e-12).log() / weights.clamp_min(1e-12)
    return keys.topk(count).indices
