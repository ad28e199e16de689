"""Viewer: a server that shows a scene to any number of browsers. TrainingPanel: its training tab."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from html import escape
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..camera import Camera
from ..method import Method
from ..method.capabilities import HasGaussians, can
from ..metrics.rows import last_psnr
from ..system.progress import clock, short
from .address import Address
from .scenery import Scenery
from .serving import quiet, start_server
from .shared import Shared, Subject
from .turns import Turns
from .visitor import Visitor

UPDATE_SECONDS = 1.0  # seconds between updates
WAKE_SECONDS = 0.5  # seconds of sleep: a signal just before it begins does not end it
FORGET_SECONDS = 2.0  # seconds after the last client has left, at which memory is given back
CURVE_POINTS = 200  # of the curve
INK = "#5686d6"
Measure = Literal["psnr", "loss"]
TITLES: dict[Measure, str] = {"psnr": "PSNR of training photographs", "loss": "Loss of training batches"}


class TrainingPanel:
    """Training panel, made inside its tab. rows: of metrics.jsonl, from earlier sessions"""

    def __init__(self, server: Any, turns: Turns, rows: list[dict[str, Any]]):
        self._gui, self._turns = server.gui, turns
        self._measure = measure_of(rows)
        self._rows, self._next = list(rows), 0.0
        begins = turns.training or not rows
        self._status = self._gui.add_markdown("About to begin" if begins else describe(rows))
        self._plot = self._gui.add_uplot(
            curve(self._points),
            series(self._measure),
            title=TITLES[self._measure],
            scales={"x": {"time": False}},
            aspect=1.6,
            visible=len(self._points) > 1,
        )
        self._button = self._gui.add_button("Pause", visible=turns.training)
        self._button.on_click(lambda _: self._toggle())

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        """Record a completed step. row: its line of metrics.jsonl, empty if it has none"""
        if not row:
            return
        if not self._rows and self._measure != (measure := measure_of([row])):
            self._measure = measure
            self._plot.title, self._plot.series = TITLES[measure], series(measure)
        self._rows.append({"step": step} | row)
        if (now := time.perf_counter()) >= self._next:
            self._next = now + UPDATE_SECONDS
            self._status.content = f"{100 * progress:.0f} % · {describe(self._rows)}"
            self._draw()

    def end(self) -> None:
        """Show the end of training."""
        self._button.visible = False
        self._status.content = f"Done · {describe(self._rows)}" if self._rows else "Done"
        self._draw()

    @property
    def _points(self) -> list[tuple[float, float]]:
        return [(row["seconds"], row[self._measure]) for row in self._rows if self._measure in row]

    def _draw(self) -> None:
        self._plot.data = curve(self._points)
        self._plot.visible = len(self._points) > 1

    def _toggle(self) -> None:
        self._turns.paused = self._turns.training and not self._turns.paused
        self._button.label = "Resume" if self._turns.paused else "Pause"


def measure_of(rows: list[dict[str, Any]]) -> Measure:
    """Name of the plotted measure: the PSNR, or the loss for methods without one."""
    return "psnr" if not rows or any("psnr" in row for row in rows) else "loss"


def series(measure: Measure) -> tuple[dict[str, Any], dict[str, Any]]:
    """Axes of the plot for uPlot."""
    return {"label": "seconds"}, {"label": "dB" if measure == "psnr" else "loss", "stroke": INK, "width": 2}


def describe(rows: list[dict[str, Any]]) -> str:
    """Step, PSNR of training photographs or loss, and time. rows: of metrics.jsonl up to this step"""
    row, psnr = rows[-1], last_psnr(rows)
    quality = f"PSNR {psnr:.2f} dB" if psnr is not None else f"loss {short(row['loss'])}" if "loss" in row else ""
    return " · ".join(part for part in (f"step {row['step']}", quality, f"{clock(row['seconds'])} trained") if part)


def curve(rows: list[tuple[float, float]]) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
    """Seconds and PSNR or loss of the curve: means over intervals of steps, at most CURVE_POINTS of them."""
    if not rows:
        return np.zeros(1), np.zeros(1)
    table = np.array(rows)
    seconds, psnr = np.array([part.mean(0) for part in np.array_split(table, min(len(table), CURVE_POINTS))]).T
    return seconds, psnr


NARROW_WINDOW_PIXELS = 576  # pixels: viser's panel is a sheet at the bottom of windows up to this width

# A click on the sheet's handle folds it; what is clicked is the text of the title, inside the handle. The mark keeps it
# from folding again when a user opens it, which makes the picture anew. viser's sheet is 20em wide on any window.
SCRIPT = """
document.title = {title};
const sheet = this.closest(".mantine-Paper-root");
if (innerWidth <= {narrow} && sheet && !window.sheetFolded) {{
  window.sheetFolded = true;
  const fixed = [sheet, ...sheet.querySelectorAll("div")].filter((part) => part.style.width === "20em");
  fixed.forEach((part) => (part.style.width = "100%"));
  const texts = [...sheet.querySelectorAll("*")].filter((part) => part.childElementCount === 0);
  texts.find((part) => part.textContent === {title})?.click();
}}
"""


def prepare_window(gui: Any, title: str) -> None:
    """Set the title of the browser tab; collapse the panel in small windows once, and make it as wide as they are.

    gui: viser's, of the server

    viser has no option for this. A hidden picture that fails to load runs a line of JavaScript instead.
    """
    script = SCRIPT.format(title=json.dumps(title), narrow=NARROW_WINDOW_PIXELS)
    gui.add_html(f'<img hidden alt="" src="data:," onerror="{escape(script)}">', order=1e9)


class Viewer:
    """Server that runs from construction until `stop`, in threads of its own.

    training: whether `fit(..., watch=viewer)` will train the method, taking turns with the clients

    fit() calls `asked` and `give_way` between steps and `note` after each; when it returns, call `end_training`.
    """

    def __init__(self, method: Method, subject: Subject, address: Address, training: bool = False):
        self.method, self.subject, self.address = method, subject, address
        self.turns = Turns(training, method.idle_render_share)
        self._visitors: dict[int, Visitor] = {}
        self._lock = threading.Lock()  # around the visitors
        self._welcoming = threading.Lock()  # one at a time fills the tabs
        self._server = start_server(address, subject.label, subject.page)
        self._aim(folded=subject.embedded and (training or not can(method, HasGaussians)))
        tabs = self._server.gui.add_tab_group()
        selects = subject.open_scene is not None and not training
        more = [*(["Select"] if selects else []), "Measure", "Path", *(["Export"] if subject.exporter else [])]
        names = ["View", "Crop", *more]
        own_tabs = {name: tabs.add_tab(name) for name in names}
        self._panel: TrainingPanel | None = None
        if subject.rows or training:
            with tabs.add_tab("Training"):
                self._panel = TrainingPanel(self._server, self.turns, subject.rows)
        self._scenery = Scenery(self._server, subject.cameras, self._clicked)
        self._shared = Shared(
            method, can(method, HasGaussians), subject, self.turns, self._server, own_tabs, self._scenery
        )
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._farewell)
        if subject.open_scene is not None:
            self._scenery.fill(subject.open_scene, self._filled)

    def _aim(self, folded: bool) -> None:
        """Set the appearance of the page, and the initial camera of every client. folded: show the panel's bar alone"""
        server, subject = self._server, self.subject
        width, dark = ("small", True) if subject.embedded else ("medium", False)
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width=width, dark_mode=dark)
        if folded:
            server.gui.main_panel.minimize()
        prepare_window(server.gui, subject.label)
        # No environment map: nothing here is lit, and viser fades the canvas in over frames once it has loaded
        server.scene.configure_environment_map(None)
        opening = subject.opening
        server.initial_camera.position = np.array(opening.position)
        server.initial_camera.look_at = np.array(opening.target)
        server.initial_camera.fov = math.radians(opening.angle)

    # What fit() calls

    @property
    def asked(self) -> bool:
        """True if training must yield to a rendering."""
        return self.turns.asked

    def give_way(self, stopping: Callable[[], object]) -> None:
        """Let clients render. Called between two steps, with the method in evaluation mode."""
        self.turns.give_way(stopping)

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        """Record a completed step. row: its line of metrics.jsonl, empty if it has none"""
        self._shared.step = step
        if self._panel is not None:
            self._panel.note(step, progress, row)

    def end_training(self) -> None:
        """End training; the method does not change any more."""
        self.turns.end_training()
        if self._panel is not None:
            self._panel.end()
        for visitor in self._everyone():
            visitor.painter.request()

    # Coming and going

    def serve(self) -> None:
        """Wait for Ctrl-C, which raises KeyboardInterrupt."""
        while True:
            time.sleep(WAKE_SECONDS)

    def stop(self) -> None:
        """End the server and disconnect every client."""
        self._shared.stopped = True
        for visitor in self._everyone():
            visitor.stop()
        self._scenery.stop()
        with quiet():
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *fault: object) -> None:
        self.stop()

    def _everyone(self) -> list[Visitor]:
        with self._lock:
            return list(self._visitors.values())

    def _welcome(self, client: Any) -> None:
        with self._welcoming:
            visitor = Visitor(self._shared, client)
        with self._lock:
            self._visitors[client.client_id] = visitor
        if not self._shared.connected(client):  # it left while its panel was being made
            self._farewell(client)

    def _farewell(self, client: Any) -> None:
        with self._lock:
            visitor = self._visitors.pop(client.client_id, None)
            if not self._visitors:  # once their threads have ended too
                clearing = threading.Timer(FORGET_SECONDS, self._forget)
                clearing.daemon = True
                clearing.start()
        if visitor is not None:
            visitor.stop()

    def _forget(self) -> None:
        """Free the data cached for clients, if none is connected."""
        if not self._everyone():
            self._shared.forget()

    def _clicked(self, client: Any, camera: Camera) -> None:
        with self._lock:
            visitor = self._visitors.get(client.client_id)
        if visitor is not None:
            visitor.fly_to(camera, self.subject.distance(camera))

    def _filled(self, fault: str | None) -> None:
        for visitor in self._everyone():
            if fault is not None:
                visitor.notify("Without photographs", fault)
            else:
                visitor.offer_points()
