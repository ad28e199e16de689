"""Look: what a client wants to see at one moment; and the house's cameras from the browser's, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..kernels.project.reference import to_matrix
from ..lens import Pinhole
from ..paths import UP, Surroundings, look_at
from ..scene import Frame, Vector
from .crop import Box
from .modes import Mode

WIDEST = math.radians(120)  # of a view, and of a photograph that is drawn as a frustum


@dataclass(frozen=True)
class Look:
    """pose: camera-to-world, +x right, +y down, +z forward
    angle:   of view, vertical, radians
    canvas:  the browser's (width, height) in pixels
    longest: pixels along the longer side of the sharpest picture that is wanted
    here:    whether this machine draws, even what the browser could
    depth:   whether anything is drawn beside the scene that it should hide
    """

    pose: tuple[tuple[float, ...], ...]
    angle: float
    canvas: tuple[int, int]
    longest: int
    mode: Mode
    background: Vector
    here: bool = False
    box: Box | None = None
    depth: bool = False

    @property
    def full(self) -> tuple[int, int]:
        """(width, height) of the sharpest picture."""
        width, height = self.canvas
        share = min(1.0, self.longest / max(width, height))
        return max(1, round(width * share)), max(1, round(height * share))

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera behind a picture of this (width, height), which has the canvas's shape."""
        width, height = size
        vertical = 0.5 / math.tan(0.5 * self.angle)  # focal length over height
        focal = torch.tensor([[vertical * width * self.canvas[1] / self.canvas[0], vertical * height]])
        lens = Pinhole(focal, torch.tensor([[0.5 * width, 0.5 * height]]))
        return Camera(torch.tensor([self.pose]), lens, torch.tensor([[width, height]]))


def pose_of(wxyz, position) -> tuple[tuple[float, ...], ...]:
    """Camera-to-world from a browser's quaternion and place; it has the house's axes."""
    rotation = to_matrix(torch.tensor([list(map(float, wxyz))], dtype=torch.double))[0].tolist()
    return tuple((*row, float(x)) for row, x in zip(rotation, position, strict=True))


def rows(camera: Camera, first: int, last: int) -> Camera:
    """The camera of some rows of a picture behind a pinhole lens."""
    lens = camera.lens
    assert isinstance(lens, Pinhole)
    shift = torch.tensor([[0.0, float(first)]])
    size = torch.tensor([[int(camera.size[0, 0]), last - first]])
    return replace(camera, size=size, lens=Pinhole(lens.focal, lens.centre - shift))


def angles(camera: Camera) -> tuple[float, float]:
    """Radians across and down the picture of one camera, whatever its lens; not more than a flat picture can show."""
    width, height = camera.size[0].tolist()
    x, y = width / 2, height / 2
    edges = torch.tensor([[x, y], [0.0, y], [width, y], [x, 0.0], [x, height]])
    middle, left, right, top, bottom = camera.to("cpu").lens.unproject(edges)
    across, down = (angle(middle, a) + angle(middle, b) for a, b in ((left, right), (top, bottom)))
    return min(across, WIDEST), min(down, WIDEST)


def angle(a: Float[Tensor, " 3"], b: Float[Tensor, " 3"]) -> float:
    """Radians between unit vectors."""
    return math.acos(max(-1.0, min(1.0, float(a @ b))))


def angle_for(camera: Camera, aspect: float) -> float:
    """The vertical angle at which a window of this width over height shows all of a photograph."""
    across, down = angles(camera)
    return min(WIDEST, max(down, 2 * math.atan(math.tan(across / 2) / aspect)))


def target(camera: Camera, frame: Frame, around: Surroundings) -> Float[Tensor, " 3"]:
    """What a camera looks at: the point on its axis beside what all look at, or one nearby if they look outward."""
    position, forward = camera.position[0].double(), camera.forward[0].double()
    towards = float((around.focus - position) @ forward) if around.inward else 0.0
    return position + max(towards, 10 * frame.near) * forward


def upright(position: Tensor, goal: Tensor) -> Float[Tensor, "3 4"]:
    """A pose at a position that looks at a goal, without roll."""
    return look_at(position[None], (goal - position)[None], UP)[0]
