"""ImageBasedMethod: a method of stored photographs, with a depth map of each, without training."""

from __future__ import annotations

from typing import Any, ClassVar

from torch import Tensor

from ...datasets.scene import Frame, Photograph, Scene
from ...method import Descend, Method
from .depth import Geometry
from .kept_views import KeptViews

STEREO_SHARE = 0.8  # of a budget in seconds, for depth


class ImageBasedMethod(Method):
    """Image-based method: `begin` stores photographs, by `keep`; pictures are rendered from them.

    views: stored photographs; config has `depth_size`
    """

    any_lens: ClassVar[bool] = True

    def __init__(self, frame: Frame, config: Any):
        super().__init__(frame, config)
        self.views = KeptViews(config.depth_size)

    def keep(self, data: Scene, geometry: Geometry, seconds: float, mesh_file: str = "") -> None:
        """Store the training photographs, and compute their depth. seconds: the whole budget"""
        self.views.keep(data, geometry, mesh_file, self.frame.background, STEREO_SHARE * seconds)

    @property
    def complete(self) -> bool:
        """True after the photographs are stored."""
        return bool(self.views)

    def steps_for(self, quality: Any, data: Any) -> int:
        """One step, which does nothing."""
        return 1

    def batch(self, data: Scene, generator: Any) -> Photograph:
        """The first photograph, since the trainer needs a batch."""
        return data.photograph(int(data.splits["train"][0]))

    def step(self, batch: Photograph, step: int, descend: Descend) -> dict[str, Tensor]:
        """Do nothing: `begin` has stored the photographs."""
        return {}
