"""Tab `Select` of a client: strokes on the view select a part of the scene, which is coloured and saved."""

import asyncio
import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ..errors import LumigraphError
from ..geometry import evenly
from ..selection import Selection, Strokes, describe, distil_features
from .cameras import ViewRequest
from .path_panel import code
from .shared import NAME, NAME_RULE, Shared

WANTED, UNWANTED = "Wanted", "Unwanted"
DRAW, STOP = "Draw strokes", "Stop drawing"
VIEW_PIXELS = 400  # along the longer side of the view that strokes are drawn on
BRUSH_PIXELS = 3  # half the width of a stroke there
MAX_VIEWS = 40  # photographs whose features are distilled, evenly chosen
COLOUR = (40, 255, 90)
POINT_SHARE = 0.004  # size of a shown point, in radii of the subject
ABOUT = "Click along the object. Clicks of one stroke are joined; another kind, or another view, begins a new one."


class StrokesPanel:
    """Contents of the tab.

    request: the client's current view
    drawn:   called when the selected part changes
    keep:    saves the cloud without some Gaussians under a name; None if nothing can be saved
    notify:  notifies the client with a title and a text
    """

    def __init__(
        self,
        client: Any,
        shared: Shared,
        request: Callable[[], ViewRequest],
        drawn: Callable[[], None],
        keep: Callable[[str, Any], str] | None,
        notify: Callable[[str, str], None],
    ):
        self._client, self._shared, self._request, self._drawn = client, shared, request, drawn
        self._keep, self._notify = keep, notify
        self._selection: Selection | None = None
        self._last: tuple[Any, tuple[float, float]] | None = None  # view and kind of the last click, and its place
        self._part: Bool[Tensor, " point"] | None = None
        self._node: Any = None
        self._working = threading.Lock()
        self._clicks = asyncio.Lock()
        gui = client.gui
        with shared.tabs["Select"]:
            self._kind = gui.add_dropdown("Stroke", (WANTED, UNWANTED))
            self._draw = gui.add_button(DRAW)
            self._undo = gui.add_button("Undo", visible=False)
            self._about = gui.add_markdown("")
            if keep is not None:
                self._name = gui.add_text("Name", f"{shared.subject.title}-object{shared.subject.part_ending}")
                gui.add_button("Save the part").on_click(lambda _: self._save(part=True))
                gui.add_button("Save the rest").on_click(lambda _: self._save(part=False))
        self._drawing = False
        self._draw.on_click(lambda _: self._toggle())
        self._undo.on_click(lambda _: self.undo())

    @property
    def is_drawn(self) -> bool:
        """True if a part is shown."""
        return self._node is not None

    def _toggle(self) -> None:
        self._drawing = not self._drawing
        self._draw.label = STOP if self._drawing else DRAW
        if self._drawing:
            self._about.content = ABOUT
            self._client.scene.on_click()(self._queue_click)
        else:
            self._client.scene.remove_click_callback(self._queue_click)
            self._last = None

    def _ready(self) -> Selection:
        """The selection; the first call distils the photographs' features."""
        if self._selection is None:
            self._notify("Looking at the photographs", "Their colours are put onto the scene, once; this takes seconds")
            assert self._shared.subject.open_scene is not None
            scene = self._shared.subject.open_scene()
            chosen = evenly(scene.splits["train"].tolist(), MAX_VIEWS)
            with self._shared.turns.turn():
                points = distil_features(self._shared.method, [scene.photograph(int(i)) for i in chosen], describe)
                self._selection = Selection(self._shared.method, points)
        return self._selection

    async def _queue_click(self, event: Any) -> None:
        """Process clicks in order; viser would handle each in a thread of its own, in any order."""
        async with self._clicks:
            await asyncio.to_thread(self.clicked, event)

    def clicked(self, event: Any) -> None:
        """Add a click to the strokes: a dot, or a line from the last click of the same kind on the same view."""
        request, kind = self._request(), self._kind.value
        with self._working:
            try:
                selection = self._ready()
                place, view = tuple(event.screen_pos), (request.pose, request.angle, kind)
                before = self._last[1] if self._last is not None and self._last[0] == view else place
                self._last = view, place
                selection.add(self._strokes(request, before, place, kind == WANTED))
            except LumigraphError as error:
                self._last = None
                self._notify("Nothing is selected", str(error))
                return
            self._update()

    def _strokes(self, request: ViewRequest, a: tuple[float, ...], b: tuple[float, ...], wanted: bool) -> Strokes:
        """A line on the client's view. a, b: its ends, as shares of the window"""
        scale = min(1.0, VIEW_PIXELS / max(request.full))
        width, height = size = tuple(max(1, round(scale * n)) for n in request.full)
        steps = max(2, math.ceil(2 * math.dist(a, b) * max(size) / BRUSH_PIXELS))
        line = np.linspace(np.array(a) * size, np.array(b) * size, steps)
        rows, columns = np.mgrid[:height, :width]
        pixels = np.zeros((height, width), bool)
        for x, y in line:
            pixels |= (columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2 <= BRUSH_PIXELS**2
        stroke, none = torch.from_numpy(pixels), torch.zeros(height, width, dtype=torch.bool)
        return Strokes(request.camera((width, height)), stroke if wanted else none, none if wanted else stroke)

    def undo(self) -> None:
        """Undo the last click."""
        with self._working:
            if self._selection is not None:
                self._selection.undo()
                self._last = None
                self._update()

    def _update(self) -> None:
        """Show the selected part as points."""
        assert self._selection is not None
        self._part = self._selection.chosen()
        self._undo.visible = len(self._selection) > 0
        if self._node is not None:
            self._node.remove()
            self._node = None
        points = self._selection.points.positions[self._part]
        if len(points):
            size = POINT_SHARE * self._shared.subject_crops()[0].radius
            self._node = self._client.scene.add_point_cloud(
                "/strokes/part", points.numpy(), COLOUR, point_size=size, point_shape="circle"
            )
        self._about.content = f"{len(points):,} of {len(self._part):,} selected"
        self._drawn()

    def _save(self, part: bool) -> None:
        assert self._keep is not None
        name = self._name.value.strip()
        if self._part is None or not self._part.any():
            self._notify("Not saved", "Nothing is selected; draw a stroke first")
        elif not NAME.fullmatch(name):
            self._notify("Not saved", NAME_RULE)
        else:
            try:
                where = self._keep(name, {"by strokes": ~self._part if part else self._part})
            except LumigraphError as error:
                self._notify("Not saved", str(error))
                return
            self._about.content = f"Saved as {code(where)}"
