"""Stored: a method's declaration of the storage format of one tensor, for compression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Layout = Literal["rows", "cells", "channels"]


@dataclass(frozen=True)
class Stored:
    """Storage format of a tensor, seen as a table of rows and columns.

    how:   "scaled", as whole numbers with a scale for each column; "coded", as rows of a codebook, the most important
           ones scaled; "half", as float16; "nothing", because rendering does not need it: it reads as `fill`.
           A tensor without a declaration is stored to the bit; a mask (bool) as one bit each
    bits:  of a whole number
    layout: meaning of a row: "rows", the first axis; "cells", of (..., channel); "channels", the cells of
           (grid, channel, x, y, z)
    plain: columns at the front that are scaled, also where the others are coded
    fill:  the value of all numbers in an empty row; such rows are not stored
    """

    how: Literal["scaled", "coded", "half", "nothing"]
    bits: int = 8
    layout: Layout = "rows"
    plain: int = 0
    fill: float = 0.0
