"""Controls: the settings of one client's own view."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ..datasets.scene import Frame, Vector
from .modes import MODES
from .scenery import CAMERAS, POINTS
from .serving import PAGE

DEFAULT_RESOLUTION = 1024  # pixels along the longer side, unless the client wants another
CLIENT_SIDE_LINK = f'<a href="{PAGE}" target="_blank">Drawn by this browser, in a tab of its own</a>'
MIN_DEGREES, MAX_DEGREES = 10.0, 120.0  # degrees


class Controls:
    """The contents of a client's tab `View`.

    client:  viser's
    tab:     viser's, which holds them
    changed: called when anything that is drawn changes
    cloud:   whether the method is a cloud of Gaussians, which the browser can draw
    page:    whether there is a page on which the browser draws the scene itself
    """

    def __init__(
        self, client: Any, tab: Any, frame: Frame, cloud: bool, changed: Callable[[], None], page: bool = False
    ):
        self._client, self._frame, self._changed = client, frame, changed
        self._modes = {mode.capitalize(): mode for mode in MODES}  # by how the dropdown names them
        gui = client.gui
        with tab:
            self._mode = gui.add_dropdown("Show", list(self._modes))
            self._exact = gui.add_checkbox(
                "Draw exactly", False, visible=cloud, hint="Drawn by our own renderer and sent, not by the browser"
            )
            self._angle = gui.add_slider(
                "Angle of view", MIN_DEGREES, MAX_DEGREES, 1.0, 50.0, hint="Degrees, from top to bottom"
            )
            self._sharpest = gui.add_slider(
                "Resolution",
                240,
                2048,
                16,
                DEFAULT_RESOLUTION,
                hint="Pixels along the longer side, once the camera rests",
            )
            self._background = gui.add_rgb("Background", to_bytes(frame.background))
            self._cameras = gui.add_checkbox("Cameras", True, hint="Click on one to fly there")
            self._points = gui.add_checkbox("Sparse points", False, visible=False)
            if page:
                gui.add_html(CLIENT_SIDE_LINK)
            self.status = gui.add_markdown("")
        for drawn in (self._mode, self._exact, self._sharpest, self._background):
            drawn.on_update(lambda _: self._update())
        self._cameras.on_update(lambda _: self._update())
        self._points.on_update(lambda _: self._update())
        self._angle.on_update(lambda _: self._set_angle())
        self._shadows = {CAMERAS: True, POINTS: True}
        self._update()

    @property
    def mode(self) -> str:
        return self._modes[self._mode.value]

    @property
    def exact(self) -> bool:
        """True if this process renders Gaussians, False if the browser does."""
        return self._exact.value

    @property
    def longest(self) -> int:
        """Pixels along the longer side of the sharpest picture."""
        return int(self._sharpest.value)

    @property
    def background(self) -> Vector:
        """The background colour: the scene's own, to the last bit, until another is chosen."""
        chosen = tuple(self._background.value)
        own = self._frame.background
        return own if chosen == to_bytes(own) else (chosen[0] / 255, chosen[1] / 255, chosen[2] / 255)

    @property
    def surrounded(self) -> bool:
        """True if camera frusta or sparse points are drawn in the scene."""
        return bool(self._cameras.value or self._points.value)

    def offer_points(self) -> None:
        """Show the checkbox for sparse points."""
        self._points.visible = True

    def offer_modes(self, names: list[str]) -> None:
        """Add modes to the dropdown, those that are not there yet."""
        if not self._modes.keys() >= set(names):
            self._modes |= {name: name for name in names}
            self._mode.options = tuple(self._modes)

    def tell_angle(self, radians: float) -> None:
        """Show the camera's angle of view at the slider."""
        degrees = float(min(max(round(math.degrees(radians)), MIN_DEGREES), MAX_DEGREES))
        if degrees != self._angle.value:
            self._angle.value = degrees

    def _set_angle(self) -> None:
        camera = self._client.camera
        if abs(math.degrees(camera.fov) - self._angle.value) > 0.51:  # not when it was only told, and rounded
            camera.fov = math.radians(self._angle.value)

    def _update(self) -> None:
        # What all clients share is hidden from one of them by a node of its own in the same place.
        for name, shown in ((CAMERAS, self._cameras.value), (POINTS, self._points.value)):
            if shown != self._shadows[name]:
                self._client.scene.add_frame(name, show_axes=False, visible=shown)
                self._shadows[name] = shown
        self._changed()


def to_bytes(colour: Vector) -> tuple[int, int, int]:
    red, green, blue = (round(255 * x) for x in colour)
    return red, green, blue
