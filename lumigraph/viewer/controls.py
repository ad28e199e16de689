"""Tab `View` of one client: Controls for settings of the view, MethodControls for controls of the method."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from ..datasets.scene import Vector
from ..method.controls import Control, Value
from .cameras import STEP_SECONDS
from .modes import MODES
from .scenery import CAMERAS, POINTS
from .serving import PAGE
from .shared import Shared

DEFAULT_RESOLUTION = 1024  # pixels along the longer side, at first
CLIENT_SIDE_LINK = f'<a href="{PAGE}" target="_blank">Drawn by this browser, in a tab of its own</a>'
MIN_DEGREES, MAX_DEGREES = 10.0, 120.0  # degrees


class Controls:
    """Contents of the tab `View` of a viser client.

    changed: called when the picture changes
    home:    called to fly to the initial view
    """

    def __init__(self, client: Any, shared: Shared, changed: Callable[[], None], home: Callable[[], None]):
        self._client, self._own, self._changed = client, shared.subject.opening.background, changed
        self._modes = {mode.capitalize(): mode for mode in MODES}  # by how the dropdown names them
        gui = client.gui
        with shared.tabs["View"]:
            gui.add_button("Home", hint="Fly to where the view began").on_click(lambda _: home())
            self._mode = gui.add_dropdown("Show", list(self._modes))
            hint = "Drawn by our own renderer and sent, not by the browser"
            self._exact = gui.add_checkbox("Draw exactly", False, visible=shared.is_cloud, hint=hint)
            hint = "Degrees, from top to bottom"
            self._angle = gui.add_slider("Angle of view", MIN_DEGREES, MAX_DEGREES, 1.0, 50.0, hint=hint)
            hint = "Pixels along the longer side, once the camera rests"
            self._sharpest = gui.add_slider("Resolution", 240, 2048, 16, DEFAULT_RESOLUTION, hint=hint)
            self._background = gui.add_rgb("Background", to_bytes(self._own))
            self._cameras = gui.add_checkbox("Cameras", not shared.subject.embedded, hint="Click on one to fly there")
            self._points = gui.add_checkbox("Sparse points", False, visible=False)
            hint = "Fly back where the camera rests beyond the limits of the exported page"
            self._stays = gui.add_checkbox("Stay near the scene", True, hint=hint)
            if shared.subject.page is not None:
                gui.add_html(CLIENT_SIDE_LINK)
            self.status = gui.add_markdown("")
        for drawn in (self._mode, self._exact, self._sharpest, self._background, self._cameras, self._points):
            drawn.on_update(lambda _: self._update())
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
        """Background colour: exactly the scene's own until another is chosen."""
        chosen = tuple(self._background.value)
        own = self._own
        return own if chosen == to_bytes(own) else (chosen[0] / 255, chosen[1] / 255, chosen[2] / 255)

    @property
    def stays(self) -> bool:
        """True if the camera returns from beyond its limits."""
        return bool(self._stays.value)

    @property
    def surrounded(self) -> bool:
        """True if camera frusta or sparse points are drawn in the scene."""
        return bool(self._cameras.value or self._points.value)

    def offer_points(self) -> None:
        """Show the checkbox for sparse points."""
        self._points.visible = True

    def offer_modes(self, names: list[str]) -> None:
        """Add modes to the dropdown, without duplicates."""
        if not self._modes.keys() >= set(names):
            self._modes |= {name: name for name in names}
            self._mode.options = tuple(self._modes)

    def show_angle(self, radians: float) -> None:
        """Set the slider to the camera's angle of view."""
        degrees = float(min(max(round(math.degrees(radians)), MIN_DEGREES), MAX_DEGREES))
        if degrees != self._angle.value:
            self._angle.value = degrees

    def _set_angle(self) -> None:
        camera = self._client.camera
        if abs(math.degrees(camera.fov) - self._angle.value) > 0.51:  # not when it was only shown, rounded
            camera.fov = math.radians(self._angle.value)

    def _update(self) -> None:
        # What all clients share is hidden from one of them by a node of its own in the same place.
        for name, shown in ((CAMERAS, self._cameras.value), (POINTS, self._points.value)):
            if shown != self._shadows[name]:
                self._shadows[name] = shown  # first: another thread may follow
                self._client.scene.add_frame(name, show_axes=False, visible=shown)
        self._changed()


def to_bytes(colour: Vector) -> tuple[int, int, int]:
    red, green, blue = (round(255 * x) for x in colour)
    return red, green, blue


STEPS = 200  # of a slider
TIME = "time"  # name of the control that plays
PASS_SECONDS = 4.0  # through all moments, at first


class MethodControls:
    """Folder `Controls` in the tab `View` of a client, if the method has any. changed: called when one is moved"""

    def __init__(self, client: Any, shared: Shared, changed: Callable[[], None]):
        controls: Sequence[Control] = shared.method.controls
        self._controls, self._begun = controls, {x.name: shared.method.control(x.name) for x in controls}
        self._handles: dict[str, Any] = {}
        self._playback: Playback | None = None
        if not controls:
            return
        with shared.tabs["View"], client.gui.add_folder("Controls"):
            for control in controls:
                handle = self._handles[control.name] = add(client.gui, control, self._begun[control.name])
                handle.on_update(lambda _: changed())
                if control.name == TIME and control.range is not None:
                    self._playback = Playback(client.gui, handle, control.range)

    def stop(self) -> None:
        """Stop playback."""
        if self._playback is not None:
            self._playback.stop()

    @property
    def values(self) -> tuple[tuple[str, Value], ...]:
        """Names and values of the controls that differ from their initial values."""
        return tuple((name, value) for name, value in self._now().items() if value != self._begun[name])

    @property
    def time(self) -> float | None:
        """Current time of a dynamic scene."""
        moment = self._now().get(TIME)
        return None if moment is None else float(moment)

    def show_time(self, moment: float) -> None:
        """Set the control `time`, if there is one."""
        if TIME in self._handles:
            self._handles[TIME].value = moment

    def _now(self) -> dict[str, Value]:
        found: dict[str, Value] = {}
        for control in self._controls:
            shown = self._handles[control.name].value
            # sliders round, also beyond the ends of their range
            found[control.name] = shown if control.range is None else float(np.clip(shown, *control.range))
        return found


class Playback:
    """Play and pause button of a time slider, in a loop."""

    def __init__(self, gui: Any, slider: Any, span: tuple[float, float]):
        self._slider, self._span, self._number = slider, span, 0
        buttons = gui.add_button_group("Moments", ("Play", "Pause"))
        buttons.on_click(lambda _: self.play() if buttons.value == "Play" else self.stop())
        self._seconds = gui.add_slider("Seconds", 0.5, 30.0, 0.5, PASS_SECONDS, hint="Of a pass through all moments")

    def stop(self) -> None:
        self._number += 1

    def play(self) -> None:
        """Move the slider until `stop` or the next call; dragging it continues from there."""
        self._number += 1
        number, (first, last), before = self._number, self._span, time.perf_counter()
        with suppress(RuntimeError):  # of a slider that is removed meanwhile, with its client
            while number == self._number:
                time.sleep(STEP_SECONDS)
                now = time.perf_counter()
                share = (self._slider.value - first) / (last - first) + (now - before) / self._seconds.value
                self._slider.value, before = first + share % 1.0 * (last - first), now


def add(gui: Any, control: Control, value: Value) -> Any:
    """A slider or a list, set to a value."""
    label = f"{control.name.replace('_', ' ').capitalize()}{f' ({control.unit})' if control.unit else ''}"
    if control.range is None:
        choices = tuple(dict.fromkeys((*control.choices, str(value))))  # a blend of two is none of them
        return gui.add_dropdown(label, choices, initial_value=value, hint=control.about or None)
    least, most = control.range
    step = max((most - least) / STEPS, 1e-9)
    return gui.add_slider(label, least, most, step, float(value), hint=control.about or None)
