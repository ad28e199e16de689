"""Shared: what all clients of a viewer have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..camera import Camera
from ..capabilities import HasGaussians, needs
from ..gaussians import Gaussians
from ..gaussians.cleaning import cleaned
from ..method import Method
from ..rays import Rendering
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
    view_tab, path_tab: where each client's own controls go
    step:               to which the method has been trained
    stopped:            whether the viewer has ended
    """

    method: Method
    is_cloud: bool
    subject: Subject
    turns: Turns
    server: Any
    view_tab: Any
    path_tab: Any
    scenery: Scenery
    step: int = 0
    stopped: bool = False

    def cloud(self, request: ViewRequest) -> Gaussians:
        """The Gaussians of the method as a client told it, those inside its crop. Raises LumigraphError if it has none.
        Call it inside `turns.turn`."""
        cloud = needs(self._given(request), HasGaussians).gaussians()
        return cleaned(cloud, request.crop)

    def render(self, camera: Camera, request: ViewRequest) -> Rendering:
        """What a camera sees of the method as a client told it, on the CPU. Call it inside `turns.turn`."""
        method = self._given(request)
        if request.crop is None:
            return method.render(camera).cpu()
        return render_inside(method, camera, request.crop, self.is_cloud).cpu()

    def _given(self, request: ViewRequest) -> Method:
        return self.method.given(**dict(request.told)) if request.told else self.method

    def knows(self, client: Any) -> bool:
        """Whether a client is still connected."""
        return not self.stopped and client.client_id in self.server.get_clients()
