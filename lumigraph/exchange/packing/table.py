"""Table: one tensor as rows and columns, without empty rows, its columns in one form or two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from .forms import Coded, Form, Half, Scaled
from .streams import Number, kind_of

Layout = Literal["rows", "cells", "channels"]


@dataclass(frozen=True)
class Stored:
    """Storage format of a tensor, seen as a table of rows and columns.

    how:   "scaled", as integers with a scale for each column; "coded", as rows of a codebook, the most important
           ones scaled; "half", as float16; "nothing", because rendering does not need it: it reads as `fill`.
           A tensor without a declaration is stored losslessly; a mask (bool) as one bit each
    bits:  of an integer
    layout: meaning of a row: "rows", the first axis; "cells", of (..., channel); "channels", the cells of
           (grid, channel, x, y, z)
    plain: leading columns that are scaled, also where the others are coded
    fill:  the value of all numbers in an empty row; such rows are not stored
    """

    how: Literal["scaled", "coded", "half", "nothing"]
    bits: int = 8
    layout: Layout = "rows"
    plain: int = 0
    fill: float = 0.0


MIN_ROWS_PER_CODE = 8  # rows for each code; with fewer a codebook would be no smaller than its rows
MIN_BITS = 2


@dataclass(frozen=True)
class Recipe:
    """Strength of the compression.

    codebook: largest number of its rows
    apart:    share of importance outside the codebook, see `forms.Coded`
    coarser:  bits to subtract from the method's own number of bits
    """

    codebook: int = 4096
    apart: float = 0.6
    coarser: int = 0


class Table:
    """A tensor of `shape`, whose rows that are not in `kept` are all `fill`.

    layout: meaning of a row, see `Stored`;  kept: None for all rows
    forms: side by side, left to right; empty if no row is kept
    dtype: of the tensor; float32 unless no row is kept
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        layout: Layout,
        fill: float,
        kept: Bool[Tensor, " row"] | None,
        forms: Sequence[Form] = (),
        dtype: Number = "float32",
    ):
        self.shape, self.layout, self.fill, self.kept, self.forms = shape, layout, fill, kept, list(forms)
        self.dtype = dtype

    def values(self) -> Float[Tensor, "row column"]:
        """The kept rows."""
        return torch.cat([form.values() for form in self.forms], -1)

    def tensor(self) -> Shaped[Tensor, "*shape"]:
        """The whole tensor."""
        found = torch.full(self.shape, self.fill, dtype=getattr(torch, self.dtype))
        if self.forms:
            self.put(found)
        return found

    @torch.no_grad()
    def put(self, tensor: Float[Tensor, "*shape"], values: Float[Tensor, "row column"] | None = None) -> None:
        """Write the kept rows into a tensor of the same shape. values: if known already"""
        values = (self.values() if values is None else values).to(tensor.device)
        rows = as_rows(tensor, self.layout)
        if self.kept is None:
            rows.copy_(values.view(rows.shape))
        else:
            rows[self.kept.view(rows.shape[:-1]).to(tensor.device)] = values

    def taken(self, tensor: Float[Tensor, "*shape"]) -> Float[Tensor, "row column"]:
        """Kept rows of a tensor of the same shape, such as a gradient."""
        rows = as_rows(tensor, self.layout)
        if self.kept is None:
            return rows.reshape(-1, rows.shape[-1]).cpu()
        return rows[self.kept.view(rows.shape[:-1]).to(tensor.device)].cpu()


def as_rows(tensor: Shaped[Tensor, "*shape"], layout: Layout) -> Shaped[Tensor, "*rows column"]:
    """A view of a tensor whose last axis are the columns; see `Stored`."""
    if layout == "rows":
        return tensor.view(len(tensor), math.prod(tensor.shape[1:]))
    return tensor if layout == "cells" else tensor.movedim(1, -1)


@torch.no_grad()
def packed(
    tensor: Shaped[Tensor, "*shape"],
    how: Stored,
    recipe: Recipe,
    weights: Float[Tensor, " row"] | None,
    generator: torch.Generator,
) -> Table:
    """A tensor in the form that its method declares. weights: importance of each of its rows; None if equal"""
    shape, bits = tuple(tensor.shape), max(how.bits - recipe.coarser, MIN_BITS)
    if how.how == "nothing":
        return Table(shape, how.layout, how.fill, None, dtype=kind_of(tensor.detach().cpu().numpy()))
    rows = as_rows(tensor.detach().cpu().float().contiguous(), how.layout)
    rows = rows.reshape(-1, rows.shape[-1])
    some = (rows != how.fill).any(-1)
    kept = None if some.all() else some
    rows = rows[some]
    if how.how == "half":
        return Table(shape, how.layout, how.fill, kept, [Half(rows)])
    if how.how == "scaled" or len(rows) < 2 * MIN_ROWS_PER_CODE:
        return Table(shape, how.layout, how.fill, kept, [Scaled(rows, bits)])
    weights = torch.ones(len(rows)) if weights is None else weights.cpu()[some]
    size = min(recipe.codebook, max(len(rows) // MIN_ROWS_PER_CODE, 1))
    front = [Scaled(rows[:, : how.plain], bits)] if how.plain else []
    coded = Coded(rows[:, how.plain :].contiguous(), weights, size, recipe.apart, bits, generator)
    return Table(shape, how.layout, how.fill, kept, [*front, coded])
