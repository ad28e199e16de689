"""Part of a method: what lies inside a crop, or Gaussians that were picked from its cloud."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, NoReturn

import torch

from ..camera import Camera
from ..camera.crop import Crop
from ..camera.rays import Rendering
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..gaussians import Gaussians, splatting
from ..geometry import Similarity
from ..method import Method
from .composed import NEAR_PLANE_SCALE, compose
from .placed import Placed


def cropped(method: Method, crop: Crop) -> Method:
    """Method restricted to a crop in its frame, for rendering only.

    Along rays its samples end where the crop does; Gaussians are picked by their centres; of methods with neither,
    pixels are by their depth.
    """
    return compose(method.frame, [Placed(method, Similarity.make(1.0), crop, leads=True)]).to(method.device)


class PickedCloud(Method):
    """A cloud as it is: it renders, and does not learn."""

    def __init__(self, frame: Frame, gaussians: Gaussians):
        super().__init__(frame, None)
        self._antialiased = gaussians.antialiased
        self._names = [field.name for field in fields(gaussians) if field.name != "antialiased"]
        for name in self._names:
            self.register_buffer(name, getattr(gaussians, name).detach())
        self.to(gaussians.means.device).eval()

    def gaussians(self) -> Gaussians:
        """The cloud, in the scene's frame."""
        return Gaussians(**{name: getattr(self, name) for name in self._names}, antialiased=self._antialiased)

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        near = NEAR_PLANE_SCALE * self.frame.near
        return splatting.render(self.gaussians(), camera.to(self.device), self.frame.background, near)

    def batch(self, data: Any, generator: torch.Generator) -> NoReturn:
        raise LumigraphError("Gaussians that were picked from a cloud do not learn; resume the run they came from")
