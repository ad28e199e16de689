"""Figures: colour maps, contact sheets, charts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ..color.blending import before
from ..color.tags import save_srgb, srgb_bytes
from ..files import Kind, replacing

# Bright and warm to dark and cool, evenly falling in lightness.
RAMP = ("fff6dc", "fbcf7f", "f39a5b", "db5f60", "a93b77", "6c2e80", "352a6e", "131a3e")
EMPTY_COLOUR = "0a0c12"  # where a ray meets nothing
ERROR_GAIN = 5

Range = tuple[float, float]


def to_bytes(rgb: Float[Tensor, "height width 3"]) -> UInt8[Tensor, "height width 3"]:
    """Colours in [0, 1] as bytes; values outside are clipped."""
    return rgb.detach().cpu().clamp(0, 1).mul_(255).round_().to(torch.uint8)


def to_image(rgb: Float[Tensor, "height width 3"]) -> Image.Image:
    return Image.fromarray(to_bytes(rgb).numpy())


def png(rgb: Float[Tensor, "height width 3"]) -> bytes:
    return srgb_bytes(to_image(rgb))


def save_picture(
    path: Path, rgb: Float[Tensor, "height width 3"] | Image.Image, kind: Kind = "file", ours: bool = False
) -> None:
    """Write a PNG, whole or not at all. kind, ours: as for `files.replacing`."""
    image = rgb if isinstance(rgb, Image.Image) else to_image(rgb)
    with replacing(path, kind, ours) as partial:
        save_srgb(image, partial)


def depth_range(depth: Float[Tensor, "*pixels"], opacity: Float[Tensor, "*pixels"]) -> Range:
    """Near and far limits of the depth colour map: 2 % and 98 % quantiles of solid pixels."""
    solid = depth[(opacity > 0.5) & depth.isfinite() & (depth > 0)].flatten()
    if not len(solid):
        return 1.0, 2.0
    solid = solid[:: max(1, len(solid) // 100_000)]  # quantile() takes no more than 16 million
    near, far = torch.quantile(solid, torch.tensor([0.02, 0.98], device=solid.device)).tolist()
    return near, max(far, near * 1.05)


def colour_depth(
    depth: Float[Tensor, "height width"], opacity: Float[Tensor, "height width"], within: Range
) -> Float[Tensor, "height width 3"]:
    """Depth as colours on a logarithmic scale: near is bright and warm, far dark and cool; faint where transparent."""
    near, far = (torch.tensor(x).log() for x in within)
    share = (depth.clamp_min(1e-9).log() - near) / (far - near)
    colours = ramp(torch.where(share.isfinite(), share, 1.0))
    return before(colours, opacity.clamp(0, 1), hex_colour(EMPTY_COLOUR).to(colours))


def colour_error(
    a: Float[Tensor, "height width 3"], b: Float[Tensor, "height width 3"], gain: float = ERROR_GAIN
) -> Float[Tensor, "height width 3"]:
    """Mean absolute difference times a gain as colours: dark is none, bright is 1 / gain and more."""
    return ramp(1 - gain * (a - b).abs().mean(-1))


def ramp(share: Float[Tensor, "*pixels"]) -> Float[Tensor, "*pixels 3"]:
    """The colour map at positions in [0, 1]."""
    colours = torch.stack([hex_colour(c) for c in RAMP]).to(share)
    position = share.clamp(0, 1) * (len(RAMP) - 1)
    below = position.long().clamp(max=len(RAMP) - 2)
    return torch.lerp(colours[below], colours[below + 1], (position - below)[..., None])


def hex_colour(text: str) -> Float[Tensor, " 3"]:
    return torch.tensor(list(bytes.fromhex(text))) / 255


def fit_into(image: Image.Image, width: int, height: int) -> Image.Image:
    """Shrunk to fit, never enlarged."""
    size = fitted(*image.size, width, height)
    return image if size == image.size else image.resize(size, Image.Resampling.LANCZOS)


def fitted(width: int, height: int, most_width: int, most_height: int) -> tuple[int, int]:
    """Size of a picture shrunk to fit, never enlarged."""
    scale = min(most_width / width, most_height / height, 1.0)
    return max(1, round(width * scale)), max(1, round(height * scale))


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
    """A line of a contact sheet: pictures of one size, and a label for all, or for each."""

    label: str | Sequence[str]
    pictures: Sequence[Float[Tensor, "height width 3"]]

    @property
    def labels(self) -> Sequence[str]:
        return [self.label] if isinstance(self.label, str) else self.label


def contact_sheet(title: str, columns: Sequence[str], rows: Sequence[Row], cell: int = CELL) -> Image.Image:
    """Pictures in rows under named columns, each at most `cell` pixels wide and 1.25 times that high.

    Tall sheets, as of upright pictures, are split into blocks side by side, in order down each block, to approach the
    shape of a screen. Sheets larger than a screen have smaller pictures.
    """
    layouts = [Layout(columns, rows, size, count) for size in sizes(cell) for count in range(1, max(len(rows), 1) + 1)]
    fitting = [layout for layout in layouts if layout.fits]
    largest = max((layout.cell for layout in fitting), default=min(layout.cell for layout in layouts))
    return min((x for x in fitting or layouts if x.cell == largest), key=lambda x: x.oddness).draw_sheet(title)


def sizes(cell: int) -> list[int]:
    """Widths to try, the largest first."""
    found = [cell]
    while found[-1] * SHRINK_FACTOR > MIN_CELL:
        found.append(round(found[-1] * SHRINK_FACTOR))
    return found


@dataclass(frozen=True)
class Layout:
    """Layout of rows in a number of blocks side by side."""

    columns: Sequence[str]
    rows: Sequence[Row]
    cell: int
    count: int

    @cached_property
    def shapes(self) -> list[list[tuple[int, int]]]:
        """Width and height of each picture, before shrinking."""
        most = self.cell, self.cell * 5 // 4
        return [[fitted(picture.shape[1], picture.shape[0], *most) for picture in row.pictures] for row in self.rows]

    @cached_property
    def heights(self) -> list[int]:
        """Height of each row, including its label."""
        return [max(height for _, height in shapes) + LINE + GAP for shapes in self.shapes]

    @cached_property
    def column(self) -> int:
        """Horizontal distance between columns."""
        return GAP + max(MIN_COLUMN_WIDTH, *(width for shapes in self.shapes for width, _ in shapes))

    @cached_property
    def block(self) -> int:
        """Horizontal distance between blocks, wide enough for labels."""
        letters = ImageFont.load_default(SMALL_SIZE)
        longest = max((round(letters.getlength(row.labels[0])) for row in self.rows if len(row.labels) == 1), default=0)
        return max(self.across, longest) + 3 * GAP

    @property
    def across(self) -> int:
        return len(self.columns) * self.column - GAP

    @cached_property
    def blocks(self) -> list[range]:
        """Numbers of rows in each block; equally many, but for the last."""
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

    def draw_sheet(self, title: str) -> Image.Image:
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
