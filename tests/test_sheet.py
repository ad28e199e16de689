"""Contact sheets of all shapes: they fit a screen, and every picture is where its label is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lumigraph.figures import SCREEN, Layout, Row, contact_sheet


def rows(count: int, height: int, width: int, columns: int = 4) -> list[Row]:
    """Pictures of one colour each: red says which row, green which column."""

    def picture(row: int, column: int) -> torch.Tensor:
        return torch.tensor([row / 16, column / 8, 1.0]).expand(height, width, 3)

    return [Row(f"IMG_{i:04d}.jpg · 24.33 dB", [picture(i, k) for k in range(columns)]) for i in range(count)]


@pytest.mark.parametrize(("height", "width"), [(192, 108), (108, 192), (320, 180)])
@pytest.mark.parametrize("count", [3, 8])
def test_a_sheet_fits_a_screen_and_is_no_tower(height, width, count):
    sheet = contact_sheet("title", ["photograph", "rendering", "error", "depth"], rows(count, height, width))
    assert sheet.width <= SCREEN[0] and sheet.height <= SCREEN[1] and sheet.width > 0.8 * sheet.height
    seen = np.asarray(sheet).reshape(-1, 3)
    colours, areas = np.unique(seen[seen[:, 2] == 255], axis=0, return_counts=True)
    wanted = {(round(255 * i / 16), round(255 * k / 8), 255) for i in range(count) for k in range(4)}
    assert {tuple(colour) for colour in colours.tolist()} == wanted and len(set(areas.tolist())) == 1


def test_upright_pictures_go_side_by_side_in_order():
    made = rows(6, 320, 180)
    sheet = np.asarray(contact_sheet("title", ["a", "b", "c", "d"], made))
    places = [np.argwhere((sheet == [round(255 * i / 16), 0, 255]).all(-1)).mean(0) for i in range(6)]
    lefts = [round(x) for _, x in places]
    assert lefts == sorted(lefts) and len(set(lefts)) > 1
    for (y, x), (below, beside) in zip(places, places[1:], strict=False):
        assert below > y if round(x) == round(beside) else below < y


def test_labels_do_not_reach_into_the_next_block():
    made = [
        Row("a name that is much longer than its pictures are wide, and then some", row.pictures)
        for row in rows(4, 90, 60, 1)
    ]
    layout = Layout(["photograph"], made, 256, 2)
    assert layout.block > 400 and layout.size[0] > layout.block
