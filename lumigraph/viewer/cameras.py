"""Cameras of the house from the browser's, and how widely a camera looks."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Pinhole
from ..geometry import to_matrix

MAX_FIELD_OF_VIEW = math.radians(120)  # of a view, and of a photograph that is drawn as a frustum


def pose_of(wxyz, position) -> tuple[tuple[float, ...], ...]:
    """Camera-to-world matrix from a browser's quaternion and position; the axes are the same on both sides."""
    rotation = to_matrix(torch.tensor([list(map(float, wxyz))], dtype=torch.double))[0].tolist()
    return tuple((*row, float(x)) for row, x in zip(rotation, position, strict=True))


def rows(camera: Camera, first: int, last: int) -> Camera:
    """The camera of rows `first` to `last` of a picture behind a pinhole lens."""
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
    """Vertical angle of view, in radians, at which a window of an aspect (width / height) shows a whole photograph."""
    across, down = angles(camera)
    return min(MAX_FIELD_OF_VIEW, max(down, 2 * math.atan(math.tan(across / 2) / aspect)))
