"""ViewRequest: all settings of one picture for one client; conversions of browser cameras and their angles of view;
Flight: animation of a client's camera by the server."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.crop import Crop
from ..camera.lens import Pinhole
from ..datasets.scene import Vector
from ..geometry import to_matrix
from ..method.controls import Value

MAX_FIELD_OF_VIEW = math.radians(120)  # of a view, and of a photograph that is drawn as a frustum


def pose_of(wxyz, position) -> tuple[tuple[float, ...], ...]:
    """Camera-to-world matrix from a browser's quaternion and position; the axes are the same on both sides."""
    rotation = to_matrix(torch.tensor([list(map(float, wxyz))], dtype=torch.double))[0].tolist()
    return tuple((*row, float(x)) for row, x in zip(rotation, position, strict=True))


def rows(camera: Camera, first: int, last: int) -> Camera:
    """Camera of rows `first` to `last` of a pinhole picture."""
    lens = camera.lens
    assert isinstance(lens, Pinhole)
    shift = torch.tensor([[0.0, float(first)]])
    size = torch.tensor([[int(camera.size[0, 0]), last - first]])
    return replace(camera, size=size, lens=Pinhole(lens.focal, lens.centre - shift))


def angles(camera: Camera) -> tuple[float, float]:
    """Horizontal and vertical angle of view of one camera with any lens, in radians, at most MAX_FIELD_OF_VIEW."""
    width, height = camera.size[0].tolist()
    x, y = width / 2, height / 2
    edges = torch.tensor([[x, y], [0.0, y], [width, y], [x, 0.0], [x, height]])
    middle, left, right, top, bottom = camera.to("cpu").lens.unproject(edges)
    across, down = (angle(middle, a) + angle(middle, b) for a, b in ((left, right), (top, bottom)))
    return min(across, MAX_FIELD_OF_VIEW), min(down, MAX_FIELD_OF_VIEW)


def angle(a: Float[Tensor, " 3"], b: Float[Tensor, " 3"]) -> float:
    """Angle between two unit vectors, in radians."""
    return math.acos(max(-1.0, min(1.0, float(a @ b))))


def angle_for(camera: Camera, aspect: float) -> float:
    """Vertical angle of view, in radians, for a window of an aspect (width / height) to contain a whole photograph."""
    across, down = angles(camera)
    return min(MAX_FIELD_OF_VIEW, max(down, 2 * math.atan(math.tan(across / 2) / aspect)))


def angle_across(angle: float, aspect: float) -> float:
    """Vertical angle of view, in radians, for an angle across a window's smaller side, the convention of web pages.

    aspect: width / height
    """
    return min(MAX_FIELD_OF_VIEW, 2 * math.atan(math.tan(angle / 2) / min(aspect, 1.0)))


@dataclass(frozen=True)
class ViewRequest:
    """A camera in the browser, and the settings of its client.

    pose:       camera-to-world, +x right, +y down, +z forward
    angle:      vertical angle of view, radians
    canvas:     the browser's (width, height) in pixels
    longest:    pixels along the longer side of the sharpest picture
    mode:       one of MODES, or the name of one of the method's extras
    background: background colour
    exact:      whether Gaussians are rendered here rather than by the browser
    crop:       visible part of the scene; None for all of it
    depth:      whether the browser needs depth, to draw objects beside the scene
    settings:   names and values of the method's controls that the client has changed
    strength:   of `FloaterEvidence.floaters`; 0 for none
    cleaned:    whether floaters are hidden; otherwise they are coloured
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
    strength: float = 0.0
    cleaned: bool = False

    @property
    def part(self) -> bool:
        """True if a part of the scene is hidden by a crop, or hidden or coloured as floaters."""
        return self.crop is not None or self.strength > 0

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


STEP_SECONDS = 1 / 25  # seconds
FLIGHT_SECONDS = 0.6  # that a flight to a photograph takes
UP = np.array([0.0, 0.0, 1.0])


class Flight:
    """Animation of one client's camera. A new flight cancels the previous one."""

    def __init__(self, client: Any):
        self._client, self._number, self.flying = client, 0, False
        self.placed: tuple[np.ndarray, np.ndarray] | None = None  # position and target of the last `place`

    def stop(self) -> None:
        self._number, self.flying = self._number + 1, False

    def place(self, pose: Float[np.ndarray, "3 4"], distance: float, angle: float) -> None:
        """Set the camera: its pose, the distance to the point it turns about, its vertical angle of view in radians."""
        camera, target = self._client.camera, pose[:, 3] + distance * pose[:, 2]
        self.placed = pose[:, 3], target
        with self._client.atomic():
            camera.up_direction = upwards(pose)
            camera.position = pose[:, 3]
            camera.look_at = target
            camera.fov = angle

    def fly(self, pose: Float[np.ndarray, "3 4"], distance: float, angle: float) -> None:
        """Move the camera smoothly to the target of `place`. Returns on arrival, or when another flight begins."""
        self._number, self.flying = self._number + 1, True
        number, camera = self._number, self._client.camera
        begin = np.array(camera.position), np.array(camera.look_at), np.array(camera.up_direction), camera.fov
        goal = pose[:, 3], pose[:, 3] + distance * pose[:, 2], upwards(pose), angle
        count = round(FLIGHT_SECONDS / STEP_SECONDS)
        for i in range(1, count):
            if number != self._number:
                return
            t = i / count
            t = t * t * (3 - 2 * t)
            position, ahead, up, fov = (a + t * (b - a) for a, b in zip(begin, goal, strict=True))
            with self._client.atomic():
                camera.up_direction = up
                camera.position = position
                camera.look_at = ahead
                camera.fov = fov
            time.sleep(STEP_SECONDS)
        self.place(pose, distance, angle)
        self.flying = False

    def play(
        self,
        poses: Float[np.ndarray, "frame 3 4"],
        distance: float,
        angles: list[float],
        seconds: float,
        shown: Callable[[int], None] = lambda frame: None,
    ) -> bool:
        """Move the camera along a path in real time, skipping frames if necessary; returns whether it reached the end.

        shown: called with the number of each frame that is not skipped
        """
        self._number, self.flying = self._number + 1, True
        number, begin = self._number, time.perf_counter()
        while (now := time.perf_counter() - begin) < seconds:
            if number != self._number:
                return False
            i = min(int(now / seconds * len(poses)), len(poses) - 1)
            self.place(poses[i], distance, angles[i])
            shown(i)
            time.sleep(STEP_SECONDS)
        self.place(poses[-1], distance, angles[-1])
        self.flying = False
        shown(len(poses) - 1)
        return True


def upwards(pose: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, " 3"]:
    """Up direction for the browser that reproduces a pose's roll, closest to the scene's up."""
    right = pose[:, 0]
    up = UP - (UP @ right) * right
    if up @ -pose[:, 1] < 0.05:  # upside down, or nearly level with the axis
        up = -pose[:, 1]
    return up / np.linalg.norm(up)
