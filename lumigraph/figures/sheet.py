"""Contact sheets: pictures in rows under named columns, of the shape and at most the size of a screen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from .pictures import fit_into, fitted, to_image

SCREEN = 1920, 1200  # pixels
CELL, MIN_CELL = 256, 144  # pixels, a picture's largest width
SHRINK_FACTOR = 0.85
MIN_COLUMN_WIDTH = 120  # pixels, room for its name
INK, FAINT_INK, PAPER = "#1b1d22", "#6d717a", "#fbfaf8"
GAP, MARGIN, LINE = 10, 28, 22
HEAD = MARGIN + 2 * LINE + 2  # the title and the columns' names
TITLE_SIZE, SMALL_SIZE = 17, 13  # sizes of letters


@dataclass(frozen=True)
class Row:
    """A line of a contact sheet: pictures of one size, and what to say of them all, or of each."""

    label: str | Sequence[str]
    pictures: Sequence[Float[Tensor, "height width 3"]]

    @property
    def labels(self) -> Sequence[str]:
        return [self.label] if isinstance(self.label, str) else self.label


def contact_sheet(title: str, columns: Sequence[str], rows: Sequence[Row], cell: int = CELL) -> Image.Image:
    """Pictures in rows under named columns, each at most `cell` pixels wide and 1.25 times that high.

    Where they would make a tower, as upright pictures do, rows go side by side in blocks, in order down each block, so
    that the sheet comes near to the shape of a screen. What is larger than a screen is made of smaller pictures.
    """
    layouts = [Layout(columns, rows, size, count) for size in sizes(cell) for count in range(1, max(len(rows), 1) + 1)]
    fitting = [layout for layout in layouts if layout.fits]
    largest = max((layout.cell for layout in fitting), default=min(layout.cell for layout in layouts))
    return min((x for x in fitting or layouts if x.cell == largest), key=lambda x: x.oddness).drawn(title)


def sizes(cell: int) -> list[int]:
    """Widths to try, the largest first."""
    found = [cell]
    while found[-1] * SHRINK_FACTOR > MIN_CELL:
        found.append(round(found[-1] * SHRINK_FACTOR))
    return found


@dataclass(frozen=True)
class Layout:
    """Rows in so many blocks side by side."""

    columns: Sequence[str]
    rows: Sequence[Row]
    cell: int
    count: int

    @cached_property
    def shapes(self) -> list[list[tuple[int, int]]]:
        """Width and height of each picture; nothing is made smaller before the layout is chosen."""
        most = self.cell, self.cell * 5 // 4
        return [[fitted(picture.shape[1], picture.shape[0], *most) for picture in row.pictures] for row in self.rows]

    @cached_property
    def heights(self) -> list[int]:
        """Height of each row, including its label."""
        return [max(height for _, height in shapes) + LINE + GAP for shapes in self.shapes]

    @cached_property
    def column(self) -> int:
        """From one column to the next."""
        return GAP + max(MIN_COLUMN_WIDTH, *(width for shapes in self.shapes for width, _ in shapes))

    @cached_property
    def block(self) -> int:
        """From one block to the next: no label reaches into it."""
        letters = ImageFont.load_default(SMALL_SIZE)
        longest = max((round(letters.getlength(row.labels[0])) for row in self.rows if len(row.labels) == 1), default=0)
        return max(self.across, longest) + 3 * GAP

    @property
    def across(self) -> int:
        return len(self.columns) * self.column - GAP

    @cached_property
    def blocks(self) -> list[range]:
        """Numbers of rows; equally many in each block, the last one maybe shorter."""
        each = -(-len(self.rows) // self.count)
        return [range(start, min(start + each, len(self.rows))) for start in range(0, len(self.rows), each)]

    @cached_property
    def size(self) -> tuple[int, int]:
        tallest = max(sum(self.heights[i] for i in block) for block in self.blocks)
        return 2 * MARGIN + (len(self.blocks) - 1) * self.block + self.across, HEAD + tallest - GAP + MARGIN

    @property
    def fits(self) -> bool:
        return self.size[0] <= SCREEN[0] and self.size[1] <= SCREEN[1]

    @property
    def oddness(self) -> float:
        """Distance of the aspect ratio from a screen's, as an absolute logarithm."""
        return abs(math.log(self.size[0] / self.size[1] * SCREEN[1] / SCREEN[0]))

    def drawn(self, title: str) -> Image.Image:
        sheet = Image.new("RGB", self.size, PAPER)
        draw, small = ImageDraw.Draw(sheet), ImageFont.load_default(SMALL_SIZE)
        draw.text((MARGIN, MARGIN - 10), title, INK, ImageFont.load_default(TITLE_SIZE))
        for number, block in enumerate(self.blocks):
            x, y = MARGIN + number * self.block, HEAD
            for i, name in enumerate(self.columns):
                draw.text((x + i * self.column, y - LINE), name, FAINT_INK, small)
            for row in block:
                for i, picture in enumerate(self.rows[row].pictures):
                    sheet.paste(fit_into(to_image(picture), *self.shapes[row][i]), (x + i * self.column, y))
                y += self.heights[row]
                for i, label in enumerate(self.rows[row].labels):
                    draw.text((x + i * self.column, y - LINE - GAP + 2), label, INK, small)
        return sheet
