"""Stored: what a method says of one of its tensors, so that it can be stored in fewer bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Layout = Literal["rows", "cells", "channels"]


@dataclass(frozen=True)
class Stored:
    """How a tensor may be stored. It is a table of rows and columns.

    how:   "scaled", as whole numbers with a scale for each column; "coded", as rows of a codebook, the most important
           ones scaled; "half", as float16; "nothing", because pictures do not need it: `fill` comes back.
           A tensor that nothing is said of is stored to the bit; of marks (bool) that is one bit each
    bits:  of a whole number
    layout: what is a row: "rows", whatever the first axis counts; "cells", of (..., channel); "channels", the cells of
           (grid, channel, x, y, z)
    plain: columns at the front that are scaled, also where the others are coded
    fill:  what every number of a row is where there is nothing; such rows are not stored
    """

    how: Literal["scaled", "coded", "half", "nothing"]
    bits: int = 8
    layout: Layout = "rows"
    plain: int = 0
    fill: float = 0.0
