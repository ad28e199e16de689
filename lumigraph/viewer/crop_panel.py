"""Tab `Crop` of a client: crop of the scene, floater removal, and saving the rest."""

import itertools
import math
import threading
import time
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from ..camera.crop import Crop, CropBox, Sphere
from ..composition.floaters import STRENGTH
from ..datasets.scene import Vector
from ..errors import LumigraphError
from .path_panel import code
from .shared import NAME, NAME_RULE, Locate, Shared

ALL, BOX, SPHERE = "Everything", "Inside a box", "Inside a sphere"
COLOUR = (240, 190, 80)
HANDLE = 0.25  # length of a handle's arrows, in radii of the subject
CIRCLE_SEGMENTS = 64  # pieces of a drawn circle
NUMBER_STEP, DIGITS = 0.001, 3  # scene units: step of the numbers, which have as many digits
STRENGTH_STEP = 0.02
DOUBLE_CLICK_SECONDS = 0.5  # seconds between two clicks that are a double click, at most
DOUBLE_CLICK_SHIFT = 0.02  # distance between them, as a share of the window
REMOVE, RESTORE = "Remove floaters", "Bring floaters back"


class CropPanel:
    """Contents of the tab.

    changed: called when the crop or the floaters change
    cleaned: whether floaters are hidden
    keep:    saves the rest under a name and returns its path; None if nothing can be saved
    notify:  notifies the client with a title and a text
    locate:  first surface point along a ray from an origin in a direction; None for empty space
    """

    def __init__(
        self,
        client: Any,
        shared: Shared,
        changed: Callable[[], None],
        keep: Callable[[str], str] | None,
        notify: Callable[[str, str], None],
        locate: Locate,
    ):
        self._client, self._shared, self._changed, self._keep, self._notify = client, shared, changed, keep, notify
        self._locate = locate
        self._listening, self._last_click = False, (-math.inf, (0.0, 0.0))  # its time and place
        self._nodes: dict[str, Any] = {}  # handles to drag, and the outline
        self._following = False  # while numbers are set from a handle
        self._updating = threading.RLock()  # messages of one client are answered by several threads
        gui, (middle, radius, lower, upper) = client.gui, self._around_subject()
        self._size, self.cleaned = radius, False
        with shared.tabs["Crop"]:
            self._shape = gui.add_dropdown("Show", (ALL, BOX, SPHERE))
            self._lower = gui.add_vector3("Lower", lower, step=NUMBER_STEP, visible=False)
            self._upper = gui.add_vector3("Upper", upper, step=NUMBER_STEP, visible=False)
            self._middle = gui.add_vector3("Middle", middle, step=NUMBER_STEP, visible=False)
            self._radius = gui.add_number("Radius", radius, min=NUMBER_STEP, step=NUMBER_STEP, visible=False)
            self._fit = gui.add_button("Fit to subject", hint="The sphere, or its box, around what the cameras look at")
            self._fit.on_click(lambda _: self.fit(SPHERE if self._shape.value == ALL else None))
            floats = shared.is_cloud and not shared.turns.training
            hint = f"Colours floaters; a larger strength finds more. {STRENGTH:g} is that of `lumigraph clean`"
            self._strength = gui.add_slider("Floaters", 0.0, 1.0, STRENGTH_STEP, 0.0, hint=hint, visible=floats)
            self._remove = gui.add_button(REMOVE, visible=False)
            self._remove.on_click(lambda _: self.remove(not self.cleaned))
            if keep is not None:
                name = f"{shared.subject.title}-part{shared.subject.part_ending}"
                hint = "Of a new run, or of a splat file: .ply or .spz"
                self._name = gui.add_text("Name", name, hint=hint)
                gui.add_button("Save").on_click(lambda _: self._save())
                self._about = gui.add_markdown("")
        numbers = self._lower, self._upper, self._middle, self._radius
        for handle in (self._shape, *numbers):
            handle.on_update(lambda _: self._update())
        self._strength.on_update(lambda _: self.remove(False))

    @property
    def crop(self) -> Crop | None:
        """The chosen crop in the scene's frame; `None` for the whole scene."""
        if self._shape.value == BOX:
            a, b = self._lower.value, self._upper.value
            return CropBox(vector(np.minimum(a, b)), vector(np.maximum(a, b)))
        if self._shape.value == SPHERE:
            return Sphere(vector(self._middle.value), max(float(self._radius.value), NUMBER_STEP))
        return None

    @property
    def strength(self) -> float:
        """Strength of floater removal or colouring; 0 for none."""
        return float(self._strength.value)

    def remove(self, cleaned: bool) -> None:
        """Hide the floaters, or colour them."""
        self.cleaned = cleaned
        self._remove.label = RESTORE if cleaned else REMOVE
        self._update()

    def fit(self, shape: str | None = None) -> None:
        """Fit sphere and box to the subject of the capture. shape: becomes visible; None keeps it"""
        middle, radius, lower, upper = self._around_subject()
        self._following = True
        try:
            if shape is not None:
                self._shape.value = shape
            self._middle.value, self._radius.value = middle, radius
            self._lower.value, self._upper.value = lower, upper
        finally:
            self._following = False
        self._update()

    def _around_subject(self) -> tuple[Vector, float, Vector, Vector]:
        """Middle and radius of the subject's sphere, and the corners of its box."""
        sphere, (lower, upper) = self._shared.subject_crops()
        return vector(sphere.middle), round(sphere.radius, DIGITS), vector(lower), vector(upper)

    @property
    def is_drawn(self) -> bool:
        """True if the handles or the outline of the crop are drawn."""
        return bool(self._nodes)

    def _update(self) -> None:
        if self._following:
            return
        with self._updating:
            shape = self._shape.value
            for handle, shown in (
                *((x, shape == BOX) for x in (self._lower, self._upper)),
                *((x, shape == SPHERE) for x in (self._middle, self._radius)),
                (self._remove, self.strength > 0),
            ):
                if handle.visible != shown:
                    handle.visible = shown
            self._place_handles()
            self._outline()
            self._listen(shape != ALL)
        self._changed()

    def _listen(self, wanted: bool) -> None:
        """Handle clicks in the scene while a crop is shown. viser reports single clicks, with a hand cursor."""
        if wanted and not self._listening:
            self._client.scene.on_click()(self._clicked)
        elif self._listening and not wanted:
            self._client.scene.remove_click_callback(self._clicked)
        self._listening = wanted

    def _clicked(self, event: Any) -> None:
        """Move the crop's centre to the surface under a double click."""
        now, place = time.monotonic(), event.screen_pos
        (before, at), self._last_click = self._last_click, (now, place)
        if now - before > DOUBLE_CLICK_SECONDS or math.dist(place, at) > DOUBLE_CLICK_SHIFT:
            return
        self._last_click = -math.inf, place
        if (middle := self._locate(event.ray_origin, event.ray_direction)) is None:
            return
        shift = np.array(middle) - (np.array(self._lower.value) + self._upper.value) / 2
        self._following = True
        try:
            self._middle.value = middle
            for corner in (self._lower, self._upper):
                corner.value = vector(corner.value + shift)
        finally:
            self._following = False
        self._update()

    def _place_handles(self) -> None:
        """Drag handles: at a box's two corners, or at a sphere's centre."""
        numbers = {BOX: {"lower": self._lower, "upper": self._upper}, SPHERE: {"middle": self._middle}}
        wanted = numbers.get(self._shape.value, {})
        for name in {"lower", "upper", "middle"} & self._nodes.keys() - wanted.keys():
            self._nodes.pop(name).remove()
        for name, number in wanted.items():
            if name not in self._nodes:
                self._nodes[name] = self._client.scene.add_transform_controls(
                    f"/crop/{name}",
                    HANDLE * self._size,
                    disable_rotations=True,
                    disable_sliders=True,
                    depth_test=False,
                    position=number.value,
                )
                self._nodes[name].on_update(self._follower(number))
            elif not np.allclose(self._nodes[name].position, number.value):
                self._nodes[name].position = np.array(number.value)

    def _follower(self, number: Any) -> Callable[[Any], Any]:
        """Callback that copies a handle's position to the panel's numbers, in the order of moves."""

        async def follow(event: Any) -> None:
            self._following = True
            try:
                number.value = vector(event.target.position)
            finally:
                self._following = False
            self._outline()
            self._changed()

        return follow

    def _outline(self) -> None:
        crop = self.crop
        if crop is None:
            if "outline" in self._nodes:
                self._nodes.pop("outline").remove()
            return
        lines = edges(crop) if isinstance(crop, CropBox) else circles(cast(Sphere, crop))
        if "outline" in self._nodes:
            self._nodes["outline"].points = lines
        else:
            self._nodes["outline"] = self._client.scene.add_line_segments(
                "/crop/outline", lines, COLOUR, thickness=2.0, thickness_units="screen"
            )

    def _save(self) -> None:
        assert self._keep is not None
        name = self._name.value.strip()
        if not NAME.fullmatch(name):
            self._notify("Not saved", NAME_RULE)
            return
        try:
            where = self._keep(name)
        except LumigraphError as error:
            self._notify("Not saved", str(error))
            return
        self._about.content = f"Saved as {code(where)}"


def vector(values: Any) -> Vector:
    """A vector as the panel's numbers show it."""
    x, y, z = (round(float(value), DIGITS) for value in values)
    return x, y, z


def edges(box: CropBox) -> Float[np.ndarray, "12 2 3"]:
    """The two ends of each of a box's twelve edges."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    ends = [(a, b) for a, b in itertools.combinations(corners, 2) if abs(a - b).sum() == 1]
    lower, upper = np.array(box.lower), np.array(box.upper)
    return lower + np.array(ends) * (upper - lower)


def circles(sphere: Sphere) -> Float[np.ndarray, "piece 2 3"]:
    """The ends of the pieces of three great circles, one across each axis."""
    angle = np.linspace(0, 2 * math.pi, CIRCLE_SEGMENTS + 1)
    across, along, none = np.cos(angle), np.sin(angle), np.zeros(CIRCLE_SEGMENTS + 1)
    rings = np.stack([np.roll(np.stack([across, along, none], -1), axis, -1) for axis in range(3)])
    pieces = np.stack([rings[:, :-1], rings[:, 1:]], 2).reshape(-1, 2, 3)
    return np.array(sphere.middle) + sphere.radius * pieces
