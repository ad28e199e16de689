"""PlayedCloud: a moving cloud from a file; FilteredCloud: some of the Gaussians of a dynamic method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NoReturn

import torch
from jaxtyping import Bool
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..gaussians import Gaussians, splatting
from ..gaussians.moving import MovingGaussians
from ..method import Method
from ..method.controls import Control, moment
from .composed import NEAR_PLANE_SCALE, at_moment_of


class PlayedCloud(Method):
    """A fixed moving cloud for rendering only, at any time. frame: with the times 0 to its duration"""

    def __init__(self, frame: Frame, moving: MovingGaussians):
        super().__init__(replace(frame, times=(0.0, moving.duration)), None)
        self._moving = moving
        self.eval()

    @property
    def controls(self) -> tuple[Control, ...]:
        assert self.frame.times is not None
        return (moment(self.frame.times),)

    def moving(self, duration: float) -> MovingGaussians:
        """The moving cloud, in the scene's frame, stretched to a duration in seconds."""
        return self._moving.lasting(duration)

    def gaussians(self) -> Gaussians:
        return self._moving.at(float(self.settings.get("time", 0.0))).to(self.device)

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        return splatting.render(
            at_moment_of(self, camera).gaussians(), camera, self.frame.background, NEAR_PLANE_SCALE * self.frame.near
        )

    def batch(self, data: Any, generator: torch.Generator) -> NoReturn:
        raise LumigraphError("A file of a moving cloud does not learn; resume the run it came from")


class FilteredCloud(Method):
    """Some Gaussians of a dynamic method, at any time. kept: mask over all of them"""

    def __init__(self, method: Any, kept: Bool[Tensor, " gaussian"]):
        super().__init__(method.frame, None)
        self.method, self.kept, self.settings = method, kept, method.settings
        self.eval()

    @property
    def controls(self) -> tuple[Control, ...]:
        return self.method.controls

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Any]) -> None:
        self.method = self.method.given(**controls)

    def gaussians(self) -> Gaussians:
        return self.method.gaussians()[self.kept]

    def refined(self, cameras: Camera) -> Camera:
        return self.method.refined(cameras)

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        cloud = at_moment_of(self, camera).gaussians()
        return splatting.render(cloud, camera, self.frame.background, NEAR_PLANE_SCALE * self.frame.near)

    def batch(self, data: Any, generator: torch.Generator) -> NoReturn:
        raise LumigraphError("Gaussians that were picked from a cloud do not learn; resume the run they came from")
