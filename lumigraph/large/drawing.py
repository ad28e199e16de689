"""The plan of a large scene seen from above: photographs, where they look, and the blocks around them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..capture import Places
from .plan import Block

DRAWING_SIDE, SUPERSAMPLING = 1000, 3  # pixels of the longer side; supersampling factor
MARGIN, HEADER_HEIGHT = 40, 60
PAPER_COLOUR, INK_COLOUR, FAINT_COLOUR, HELD_OUT_COLOUR = "#fbfaf8", "#1b1d22", "#6d717a", "#d97706"
BLOCK_COLOURS = ("#2563eb", "#059669", "#7c3aed", "#db2777", "#0891b2", "#65a30d")
DIRECTION_LENGTH = 14  # pixels of the line along a photograph's viewing direction
MAX_SHOWN = 20_000  # photographs


def draw_plan(places: Places, blocks: Sequence[Block]) -> Image.Image:
    """North is where the second axis of the levelled source points; photographs that are held out are orange."""
    turn = places.upright.T
    centres = np.array([block.centre for block in blocks]) @ turn
    radii = np.array([block.radius for block in blocks])
    ground, gaze = places.ground, (places.forwards @ turn)[:, :2]
    low = np.minimum(ground.min(0), (centres[:, :2] - radii[:, None]).min(0))
    high = np.maximum(ground.max(0), (centres[:, :2] + radii[:, None]).max(0))
    scale = SUPERSAMPLING * DRAWING_SIDE / max(float((high - low).max()), 1e-9)
    width, height = (np.ceil((high - low) * scale) + 2 * SUPERSAMPLING * MARGIN).astype(int)
    image = Image.new("RGB", (int(width), int(height) + SUPERSAMPLING * HEADER_HEIGHT), PAPER_COLOUR)
    draw = ImageDraw.Draw(image, "RGBA")

    def at(point: np.ndarray) -> tuple[float, float]:
        x, y = (point - low) * scale + SUPERSAMPLING * MARGIN
        return float(x), float(height - y) + SUPERSAMPLING * HEADER_HEIGHT

    letters = ImageFont.load_default(18 * SUPERSAMPLING)
    for i, (centre, radius) in enumerate(zip(centres[:, :2], radii, strict=True)):
        colour, (x, y), r = BLOCK_COLOURS[i % len(BLOCK_COLOURS)], at(centre), radius * scale
        draw.ellipse([x - r, y - r, x + r, y + r], f"{colour}18", colour, 2 * SUPERSAMPLING)
    for i in range(0, len(ground), max(1, len(ground) // MAX_SHOWN)):
        held_out = places.splits[i] != "train"
        (x, y), colour, dot = at(ground[i]), HELD_OUT_COLOUR if held_out else FAINT_COLOUR, 2.2 * SUPERSAMPLING
        draw.line(
            [
                x,
                y,
                x + SUPERSAMPLING * DIRECTION_LENGTH * gaze[i, 0],
                y - SUPERSAMPLING * DIRECTION_LENGTH * gaze[i, 1],
            ],
            colour,
            SUPERSAMPLING,
        )
        draw.ellipse([x - dot, y - dot, x + dot, y + dot], colour)
    for i, (block, centre) in enumerate(zip(blocks, centres[:, :2], strict=True)):
        (x, y), text = at(centre), f"{block.name}: {len(block.photographs)}"
        box = draw.textbbox((x, y), text, letters, anchor="mm")
        draw.rounded_rectangle([box[0] - 12, box[1] - 9, box[2] + 12, box[3] + 9], 12, f"{PAPER_COLOUR}e0")
        draw.text((x, y), text, BLOCK_COLOURS[i % len(BLOCK_COLOURS)], letters, anchor="mm")
    head = (
        f"{len(blocks)} blocks, {len(places)} photographs; beside each name how many are of it, overlap counted twice"
    )
    draw.text(
        (SUPERSAMPLING * MARGIN, SUPERSAMPLING * 22), head, INK_COLOUR, ImageFont.load_default(17 * SUPERSAMPLING)
    )
    return image.resize((image.width // SUPERSAMPLING, image.height // SUPERSAMPLING), Image.Resampling.LANCZOS)
