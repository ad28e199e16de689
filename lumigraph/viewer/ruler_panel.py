"""Tab `Measure` of a client: distance of two clicked points, and the unit of exports by a known length."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ..datasets.scene import Vector
from ..errors import LumigraphError
from .path_panel import code
from .shared import Locate, Shared

COLOUR = (255, 90, 60)
MARK_SIZE = 0.01  # of a clicked point, in radii of the subject
LENGTH_STEP = 0.001
MEASURE, FIRST, SECOND = "Measure", "Click the first point in the scene", "Click the second point"


class RulerPanel:
    """Contents of the tab.

    locate: first surface point along a ray from an origin in a direction; None for empty space
    drawn:  called when points appear or disappear
    notify: notifies the client with a title and a text
    """

    def __init__(
        self, client: Any, shared: Shared, locate: Locate, drawn: Callable[[], None], notify: Callable[[str, str], None]
    ):
        self._client, self._shared, self._locate, self._drawn, self._notify = client, shared, locate, drawn, notify
        self._points: list[Vector] = []
        self._nodes: list[Any] = []
        self._scale = shared.subject.frame.scale
        gui = client.gui
        with shared.tabs["Measure"]:
            self._button = gui.add_button(MEASURE, hint="The distance between two points of the scene")
            self._about = gui.add_markdown("")
            hint = "Distance between the two points in the unit that exports shall have, such as metres"
            self._known = gui.add_number("True length", 1.0, min=1e-9, step=LENGTH_STEP, visible=False, hint=hint)
            self._set = gui.add_button("Set the scale of exports", visible=False)
        self._button.on_click(lambda _: self._begin())
        self._set.on_click(lambda _: self._keep())

    @property
    def is_drawn(self) -> bool:
        """True if points are drawn in the scene."""
        return bool(self._nodes)

    @property
    def length(self) -> float:
        """Distance between the two points in the frame of the photographs."""
        return self._shared.subject.frame.to_source.scale * math.dist(*self._points)

    def _begin(self) -> None:
        self._client.scene.remove_click_callback(self.clicked)
        self._points = []
        self._client.scene.on_click()(self.clicked)
        self._show()

    def clicked(self, event: Any) -> None:
        """Add the surface point under a click; the second one completes the measurement."""
        found = self._locate(event.ray_origin, event.ray_direction)
        if found is None:
            self._notify("Nothing is there", "Click something solid")
            return
        if len(self._points) < 2:
            self._points.append(found)
        if len(self._points) == 2:
            self._client.scene.remove_click_callback(self.clicked)
        self._show()

    def _show(self) -> None:
        both = len(self._points) == 2
        self._about.content = self._said if both else (FIRST, SECOND)[len(self._points)]
        self._known.visible = self._set.visible = both and self._shared.subject.set_scale is not None
        for node in self._nodes:
            node.remove()
        self._nodes = []
        if self._points:
            points, scene = np.array(self._points, np.float32), self._client.scene
            size = MARK_SIZE * self._shared.subject_crops()[0].radius
            mark = scene.add_point_cloud("/ruler/ends", points, COLOUR, point_size=size, point_shape="circle")
            self._nodes = [mark]
            if both:
                line = scene.add_line_segments(
                    "/ruler/line", points[None], COLOUR, thickness=2.0, thickness_units="screen"
                )
                self._nodes.append(line)
        self._drawn()

    @property
    def _said(self) -> str:
        frame = self._shared.subject.frame
        ends = frame.to_source.points(torch.tensor(self._points, dtype=torch.float64)).flatten().tolist()
        numbers = " ".join(f"{x:.6g}" for x in ends)
        return f"**{self._scale * self.length:.4g}** in the unit of exports\n\n{code(f'--scale-by {numbers} LENGTH')}"

    def _keep(self) -> None:
        assert self._shared.subject.set_scale is not None
        if not self.length:
            self._notify("Not set", "Both points are in one place; measure again")
            return
        scale = float(self._known.value) / self.length
        try:
            self._shared.subject.set_scale(scale)
        except LumigraphError as error:
            self._notify("Not set", str(error))
            return
        self._scale = scale
        self._about.content = self._said
