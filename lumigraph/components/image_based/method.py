"""ImageBasedMethod: a method whose state is its photographs, with a depth map of each; nothing is learnt."""

from __future__ import annotations

from typing import Any, ClassVar

from torch import Tensor

from ...datasets.scene import Frame, Photograph, Scene
from ...method import Descend, Method
from .depth import Geometry
from .kept_views import KeptViews

STEREO_SHARE = 0.8  # of a budget in seconds, for depth


class ImageBasedMethod(Method):
    """Photographs are kept in `begin`, by `keep`; a picture is made of them.

    views: what is kept; config has `depth_size`
    """

    any_lens: ClassVar[bool] = True

    def __init__(self, frame: Frame, config: Any):
        super().__init__(frame, config)
        self.views = KeptViews(config.depth_size)

    def keep(self, data: Scene, geometry: Geometry, seconds: float, mesh_file: str = "") -> None:
        """Take over the training photographs, and find their depth. seconds: the whole budget"""
        self.views.keep(data, geometry, mesh_file, self.frame.background, STEREO_SHARE * seconds)

    @property
    def complete(self) -> bool:
        """True once the photographs are kept."""
        return bool(self.views)

    def steps_for(self, quality: Any, data: Any) -> int:
        """One, in which nothing happens."""
        return 1

    def batch(self, data: Scene, generator: Any) -> Photograph:
        """The first photograph, for the trainer to count."""
        return data.photograph(int(data.splits["train"][0]))

    def step(self, batch: Photograph, step: int, descend: Descend) -> dict[str, Tensor]:
        """Nothing is left to learn once `begin` has kept the photographs."""
        return {}
