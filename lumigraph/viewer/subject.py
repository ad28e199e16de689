"""Subject: what a viewer shows beside the method, from wherever it was opened."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ..camera import Camera
from ..camera.crop import Crop
from ..datasets.scene import Frame, Scene
from ..paths import Surroundings, best_centred, pivot

NAME = re.compile(r"\w[\w .-]{0,80}")  # of what somebody saves
NAME_RULE = "A name is made of letters, digits, spaces, dots and dashes"
Keep = Callable[[str, Crop | None, Mapping[str, float]], str]


@dataclass(frozen=True)
class Subject:
    """A scene as the viewer needs it.

    title:          shown above the controls
    cameras:        of the photographs, by split, in the scene's frame
    paths:          folder that camera paths are saved in
    render_command: command line that renders films of the scene, without `--path`
    open_scene:     opens the photographs, for thumbnails and sparse points; None if there are none
    rows:           of metrics.jsonl, as far as the method has been trained
    keep:           saves what a crop and cleaning leave of the cloud under a name, and says where; None where nothing
                    can be saved
    page:           makes a page (HTML) that draws the scene in the browser; None where only we can render it
    """

    title: str
    frame: Frame
    cameras: dict[str, Camera]
    paths: Path
    render_command: str
    open_scene: Callable[[], Scene] | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)
    keep: Keep | None = None
    page: Callable[[], bytes] | None = None

    @cached_property
    def around(self) -> Surroundings:
        """Positions and directions of all cameras."""
        return Surroundings(Camera.cat(list(self.cameras.values())).to("cpu"), self.frame)

    @cached_property
    def first(self) -> Camera:
        """The photograph's camera that every client begins with."""
        return self.around.cameras[best_centred(self.around)]

    def distance(self, camera: Camera) -> float:
        """Distance from a camera to the point that it turns about, in scene units."""
        position, forward = camera.position[0].double().cpu(), camera.forward[0].double().cpu()
        return float((pivot(self.around, position, forward) - position).norm())
