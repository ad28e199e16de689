"""Shared: what all clients of a viewer have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..camera import Camera
from ..camera.rays import Rendering
from ..gaussians import Gaussians, splatting
from ..gaussians.cloud import cleaned
from ..method import Method
from ..method.capabilities import HasGaussians, needs
from .crop import render_inside
from .scenery import Scenery
from .subject import Subject
from .turns import Turns
from .view_request import ViewRequest


@dataclass
class Shared:
    """The method, the server, and what every client sees alike. The viewer makes it; each visitor reads it.

    is_cloud:           whether the method has Gaussians
    server:             viser's
    tabs:               View, Crop and Path, where each client's own controls go
    step:               to which the method has been trained
    stopped:            whether the viewer has ended
    """

    method: Method
    is_cloud: bool
    subject: Subject
    turns: Turns
    server: Any
    tabs: tuple[Any, Any, Any]
    scenery: Scenery
    step: int = 0
    stopped: bool = False
    _picked: tuple[Any, Gaussians] | None = None  # what was wanted last of part of the cloud, and that part

    def cloud(self, request: ViewRequest) -> Gaussians:
        """The Gaussians of the method as a client told it, of which its crop and cleaning leave these. Raises
        LumigraphError if it has none. Call it inside `turns.turn`."""
        if not request.part:
            return needs(self._given(request), HasGaussians).gaussians()
        wanted = self.step, request.settings, request.crop, request.floaters
        if self._picked is None or self._picked[0] != wanted:
            cloud = needs(self._given(request), HasGaussians).gaussians()
            self._picked = wanted, cleaned(cloud, request.crop, **dict(request.floaters))
        return self._picked[1]

    def render(self, camera: Camera, request: ViewRequest) -> Rendering:
        """Rendering of the method with a client's controls and crop, on the CPU. Call it inside `turns.turn`."""
        method = self._given(request)
        if not request.part:
            return method.render(camera).cpu()
        if request.crop is not None and not self.is_cloud:
            return render_inside(method, camera, request.crop).cpu()
        cloud, frame = self.cloud(request), method.frame
        return splatting.render(cloud, camera.to(method.device), frame.background, frame.near).cpu()

    def _given(self, request: ViewRequest) -> Method:
        return self.method.given(**dict(request.settings)) if request.settings else self.method

    def knows(self, client: Any) -> bool:
        """True if a client is still connected."""
        return not self.stopped and client.client_id in self.server.get_clients()
