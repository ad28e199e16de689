"""ViewRequest: everything that decides what picture a client is shown at one moment."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ..camera import Camera
from ..camera.crop import Crop
from ..camera.lens import Pinhole
from ..datasets.scene import Vector
from ..method.controls import Value


@dataclass(frozen=True)
class ViewRequest:
    """A camera in the browser, and the settings of its client.

    pose:       camera-to-world, +x right, +y down, +z forward
    angle:      vertical angle of view, radians
    canvas:     the browser's (width, height) in pixels
    longest:    pixels along the longer side of the sharpest picture
    mode:       one of MODES, or the name of one of the method's extras
    background: colour behind everything
    exact:      whether Gaussians are rendered here rather than by the browser
    crop:       what is shown of the scene; None for all of it
    depth:      whether the browser needs depth, because it draws something beside the scene
    settings:       names and values of the method's controls that the client has turned
    floaters:   names and numbers of what `cleaned` is told of them; nothing if they stay
    """

    pose: tuple[tuple[float, ...], ...]
    angle: float
    canvas: tuple[int, int]
    longest: int
    mode: str
    background: Vector
    exact: bool = False
    crop: Crop | None = None
    depth: bool = False
    settings: tuple[tuple[str, Value], ...] = ()
    floaters: tuple[tuple[str, float], ...] = ()

    @property
    def part(self) -> bool:
        """True if a part of the scene is hidden by a crop or as floaters."""
        return self.crop is not None or bool(self.floaters)

    @property
    def full(self) -> tuple[int, int]:
        """(width, height) of the sharpest picture."""
        width, height = self.canvas
        share = min(1.0, self.longest / max(width, height))
        return max(1, round(width * share)), max(1, round(height * share))

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera of a picture of this (width, height), whose aspect is the canvas's."""
        width, height = size
        vertical = 0.5 / math.tan(0.5 * self.angle)  # focal length over height
        focal = torch.tensor([[vertical * width * self.canvas[1] / self.canvas[0], vertical * height]])
        lens = Pinhole(focal, torch.tensor([[0.5 * width, 0.5 * height]]))
        return Camera(torch.tensor([self.pose]), lens, torch.tensor([[width, height]]))
