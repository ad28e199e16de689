"""Subject: what a viewer shows beside the method, from wherever it was opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ..camera import Camera
from ..paths import Surroundings
from ..scene import Frame, Scene
from .cameras import target


@dataclass(frozen=True)
class Subject:
    """A scene as the viewer needs it.

    title:          shown above the controls
    cameras:        of the photographs, by split, in the scene's frame
    paths:          folder that camera paths are saved in
    render_command: command line that renders films of the scene, without `--path`
    open_scene:     opens the photographs, for thumbnails and sparse points; None if there are none
    rows:           of metrics.jsonl, as far as the method has been trained
    """

    title: str
    frame: Frame
    cameras: dict[str, Camera]
    paths: Path
    render_command: str
    open_scene: Callable[[], Scene] | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)

    @cached_property
    def around(self) -> Surroundings:
        """Where all the cameras stand and look."""
        return Surroundings(Camera.cat(list(self.cameras.values())).to("cpu"), self.frame)

    def distance(self, camera: Camera) -> float:
        """Distance from a camera to the point that it turns about, in scene units."""
        return float((target(camera, self.frame, self.around) - camera.position[0]).norm())
