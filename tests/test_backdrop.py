"""What a page has behind an open scene: the colours of its own sky and ground, and the height of its floor."""

from __future__ import annotations

import pytest
import torch
from solids import Seen, around, ball

from lumigraph.camera import Camera
from lumigraph.camera.rays import Rendering
from lumigraph.datasets.scene import Frame
from lumigraph.export.page import backdrop
from lumigraph.paths.opening import opening_of_scene

SKY, GROUND, FLOOR = (0.5, 0.7, 0.9), (0.3, 0.5, 0.1), -0.5


class Plain(Seen):
    """Ground as far as one sees, below a sky that stops light as clouds do."""

    def __init__(self, frame: Frame, opaque: float = 1.0):
        super().__init__(ball(), frame)
        self.opaque = opaque

    def render_rays(self, rays, background):
        down = rays.directions[:, 2] < 0
        depth = torch.where(down, (FLOOR - rays.origins[:, 2]) / rays.directions[:, 2], 50.0)
        rgb = torch.where(down[:, None], torch.tensor(GROUND), torch.tensor(SKY))
        return Rendering(rgb, depth, torch.full_like(depth, self.opaque))


def test_colours_and_floor_are_the_scenes_own():
    found = backdrop(Plain(Frame(reach=8.0)), around(lowest=-5.0))
    assert found is not None and found.floor == pytest.approx(FLOOR, abs=1e-3)
    assert found.overhead == pytest.approx(SKY) and found.underfoot == pytest.approx(GROUND)
    opening = opening_of_scene("plain", around(lowest=-5.0), Frame(reach=8.0), None, found)
    assert opening.background == found.horizon and opening.sky == (found.overhead, found.underfoot)
    assert opening.floor == found.floor
    own = opening_of_scene("plain", around(lowest=-5.0), Frame(reach=8.0), (0.0, 0.0, 1.0), found)
    assert own.background == (0.0, 0.0, 1.0) and own.sky is None and own.floor == found.floor


def test_from_above_the_horizon_is_a_haze_over_the_ground():
    poses = torch.tensor([[[1.0, 0, 0, x], [0, -1, 0, 0], [0, 0, -1, 3]] for x in (-1.0, 0.0, 1.0)])
    some = around()[torch.arange(3)]
    found = backdrop(Plain(Frame(reach=8.0)), Camera(poses, some.lens, some.size))
    assert found is not None and found.underfoot == pytest.approx(GROUND)
    assert all(a < b < c < 1 for a, b, c in zip(found.underfoot, found.horizon, found.overhead, strict=True))


@pytest.mark.parametrize(
    ("frame", "opaque"), [(Frame(), 1.0), (Frame(reach=8.0, has_alpha=True), 1.0), (Frame(reach=8.0), 0.2)]
)
def test_what_stands_before_its_own_background_keeps_it(frame, opaque):
    assert backdrop(Plain(frame, opaque), around(lowest=-5.0)) is None
