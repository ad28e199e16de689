"""Forms: encodings of tables as scaled integers, as codebook rows, or as float16; all trainable.

`values()` are the decoded numbers, with a straight-through gradient to the unrounded ones (Bengio 2013), so that a
table can be fine-tuned as it will be read.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MAX_TRAINING_ROWS = 1 << 17  # rows at most; each then counts by its weight
PASSES = 8  # over them; the error falls by less than 1 % in any further one
MAX_DISTANCES = 1 << 20  # distances of rows to a codebook that are held at once: they stay in the processor's cache


@torch.no_grad()
def clustered(
    rows: Float[Tensor, "row column"], weights: Float[Tensor, " row"], size: int, generator: torch.Generator
) -> tuple[Float[Tensor, "code column"], Int[Tensor, " row"]]:
    """Weighted k-means (Lloyd 1982): a codebook of `size` rows and the code of each row, minimising
    sum_i w_i |x_i - b_{c(i)}|^2.

    Initial rows are sampled by their weights. An empty cluster restarts at one of the rows with the largest error.
    """
    weights = weights.double().clamp_min(0) + 1e-9 * (float(weights.max()) if len(weights) else 1.0) + 1e-30
    if len(rows) > MAX_TRAINING_ROWS:
        some = torch.multinomial(weights, MAX_TRAINING_ROWS, replacement=True, generator=generator)
        learnt, counts = rows[some], torch.ones(MAX_TRAINING_ROWS)
    else:
        learnt, counts = rows, (weights / weights.mean()).float()
    # different rows, heavy ones more likely (Efraimidis and Spirakis 2006)
    keys = torch.rand(len(counts), generator=generator).clamp_min(1e-12).log() / counts.clamp_min(1e-12)
    book = learnt[keys.topk(size).indices].clone()
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
    """Nearest code of each row, and its squared distance."""
    half = 0.5 * book.square().sum(-1)
    codes, errors = torch.empty(len(rows), dtype=torch.int64), torch.empty(len(rows))
    chunk = max(1, MAX_DISTANCES // max(1, len(book)))
    for i in range(0, len(rows), chunk):
        some = rows[i : i + chunk]
        distances = torch.addmm(half, some, book.t(), alpha=-1)
        codes[i : i + chunk] = torch.from_numpy(distances.numpy().argmin(-1))  # NumPy's takes half as long as PyTorch's
        least = distances.gather(1, codes[i : i + chunk, None])[:, 0]
        errors[i : i + chunk] = (2 * least + some.square().sum(-1)).clamp_min(0)
    return codes, errors


MAX_DEVIATIONS = 8.0  # standard deviations that the levels of a whole number span; what lies beyond has more levels
MAX_WHOLE_NUMBER = (1 << 16) - 1  # the largest whole number
TUNING_UNIT = 0.02  # of a float16's typical size: what tuning takes for its unit


class Form(ABC):
    """An encoded table.

    name:  of the form, in files
    width: columns
    """

    name: str
    width: int

    @abstractmethod
    def values(self) -> Float[Tensor, "row column"]:
        """The decoded numbers; differentiable in the trainable tensors."""

    @abstractmethod
    def learning(self) -> list[tuple[Tensor, float]]:
        """Trainable tensors, each with its storage error: the natural unit of its steps."""

    @abstractmethod
    def streams(self) -> list[np.ndarray]:
        """Arrays to store in a file."""


class Half(Form):
    """Table of float16 numbers."""

    name = "half"

    def __init__(self, values: Float[Tensor, "row column"]):
        self.exact, self.width = values.clone(), values.shape[1]

    def values(self) -> Float[Tensor, "row column"]:
        return straight(self.exact, self.exact.half().float())

    def learning(self) -> list[tuple[Tensor, float]]:
        return [(self.exact, TUNING_UNIT * rms(self.exact))]

    def streams(self) -> list[np.ndarray]:
        return [self.exact.detach().half().numpy()]

    @staticmethod
    def read(streams: Sequence[np.ndarray]) -> Half:
        (halves,) = streams
        return Half(torch.from_numpy(halves.astype(np.float32)))


class Scaled(Form):
    """Table of scaled integers: low + step · n, n of 8 or 16 bits, with a scale for each column."""

    name = "scaled"

    def __init__(self, values: Float[Tensor, "row column"], bits: int):
        self.exact, self.width = values.clone(), values.shape[1]
        filled = values if len(values) else values.new_zeros(1, self.width)
        self.low, high = filled.amin(0), filled.amax(0)
        span = torch.minimum(high - self.low, MAX_DEVIATIONS * filled.std(0, correction=0))
        self.step = torch.maximum(span / ((1 << bits) - 1), (high - self.low) / MAX_WHOLE_NUMBER).clamp_min(1e-12)

    def values(self) -> Float[Tensor, "row column"]:
        return straight(self.exact, self.low + self.step * self._codes())

    def learning(self) -> list[tuple[Tensor, float]]:
        return [(self.exact, float(self.step.mean()))]

    def streams(self) -> list[np.ndarray]:
        codes = self._codes()
        kind = np.uint8 if not len(codes) or codes.max() < 256 else np.uint16
        return [torch.stack([self.low, self.step]).numpy(), codes.numpy().astype(kind)]

    def _codes(self) -> Float[Tensor, "row column"]:
        return ((self.exact.detach() - self.low) / self.step).round_().clamp_(0, MAX_WHOLE_NUMBER)

    @staticmethod
    def read(streams: Sequence[np.ndarray]) -> Scaled:
        scales, codes = streams
        found = Scaled.__new__(Scaled)
        found.low, found.step = torch.from_numpy(scales.astype(np.float32))
        if codes.dtype.kind != "u" or not (found.low.isfinite() & found.step.isfinite() & (found.step > 0)).all():
            raise ValueError("a scale is not sound")
        found.exact = found.low + found.step * torch.from_numpy(codes.astype(np.float32))
        found.width = found.exact.shape[1]
        return found


class Coded(Form):
    """Vector-quantised table b_c: rows of a codebook; the most important rows are stored scaled (Li 2023, VQRF).

    weights: importance of the rows
    size:    rows of the codebook
    apart:   share of all importance whose rows, the most important ones first, are kept out of the codebook
    """

    name = "coded"

    def __init__(
        self,
        values: Float[Tensor, "row column"],
        weights: Float[Tensor, " row"],
        size: int,
        apart: float,
        bits: int,
        generator: torch.Generator,
    ):
        self.width = values.shape[1]
        self.apart = most_important(weights, apart)
        common = values[~self.apart]
        book, self.codes = clustered(common, weights[~self.apart], min(size, len(common)), generator)
        self.error = rms(common - book[self.codes])
        self.book, self.own = Scaled(book, bits), Scaled(values[self.apart], bits)

    def values(self) -> Float[Tensor, "row column"]:
        found = self.own.exact.new_empty(len(self.apart), self.width)
        found = found.index_put((self.apart,), self.own.values())
        return found.index_put((~self.apart,), self.book.values()[self.codes])

    def learning(self) -> list[tuple[Tensor, float]]:
        return [(self.book.exact, self.error), *self.own.learning()]

    def streams(self) -> list[np.ndarray]:
        codes = self.codes.numpy().astype(np.uint16)[:, None]
        return [*self.book.streams(), codes, self.apart.numpy(), *self.own.streams()]

    @staticmethod
    def read(streams: Sequence[np.ndarray]) -> Coded:
        *book, codes, apart, scales, own = streams
        found = Coded.__new__(Coded)
        found.book, found.own, found.error = Scaled.read(book), Scaled.read([scales, own]), 0.0
        found.apart, found.width = torch.from_numpy(apart), found.book.width
        found.codes = torch.from_numpy(codes[:, 0].astype(np.int64))
        if apart.dtype != bool or apart.ndim != 1 or found.own.width != found.width:
            raise ValueError("a codebook does not fit its rows")
        if int(apart.sum()) != len(own) or int((~apart).sum()) != len(codes):
            raise ValueError("rows of a codebook are missing")
        if len(codes) and codes.max() >= len(found.book.exact):
            raise ValueError(f"code {codes.max()} is not in a codebook of {len(found.book.exact)}")
        return found


FORMS: dict[str, tuple[type[Half] | type[Scaled] | type[Coded], int]] = {  # and of how many streams
    "half": (Half, 1),
    "scaled": (Scaled, 2),
    "coded": (Coded, 6),
}


def straight(exact: Float[Tensor, "*shape"], rounded: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The rounded tensor with the gradient of the exact one (straight-through)."""
    return exact + (rounded - exact).detach() if exact.requires_grad else rounded


def most_important(weights: Float[Tensor, " row"], share: float) -> Bool[Tensor, " row"]:
    """Mask of the fewest rows that add up to a share of the total weight."""
    order = weights.double().argsort(descending=True, stable=True)
    before = weights.double()[order].cumsum(0) - weights.double()[order]
    chosen = torch.zeros(len(weights), dtype=torch.bool)
    chosen[order[before < share * float(weights.double().sum())]] = True
    return chosen


def rms(values: Float[Tensor, "*shape"]) -> float:
    return float(values.detach().square().mean().sqrt()) if values.numel() else 0.0
