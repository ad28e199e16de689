"""A file of Gaussians, opened as if it were a run: something to render, with cameras around it."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from . import methods
from .camera import Camera
from .errors import LumigraphError
from .exchange import read_gaussians
from .gaussians import Gaussians
from .lens import Pinhole
from .method import Method
from .scene import Frame

SIZE, ANGLE = 800, 50.0  # pixels and degrees of the cameras around it
DISTANCE, ELEVATION, CAMERAS = 2.6, 15.0, 24  # scene units, degrees
SHARE = 0.96  # of what is visible that the box of interest holds, along each axis
# Splat files have y pointing down by custom, as the cameras they were learnt from; scenes stand upright.
UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)


class SplatFile:
    """What `Run` offers to films: a method, a frame, cameras. Raises LumigraphError for a file that is no cloud."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.gaussians: Gaussians = read_gaussians(self.path)
        if not len(self.gaussians):
            raise LumigraphError(f"{self.path} holds no Gaussians, so there is nothing to show")
        scene_from_file = upright_similarity(self.gaussians)
        back = torch.linalg.inv(scene_from_file)
        self.frame = Frame(reach=64.0, near=0.01, source_from_scene=tuple((a, b, c, d) for a, b, c, d in back.tolist()))
        self._in_scene = self.gaussians.transformed(scene_from_file)

    @property
    def renders(self) -> Path:
        """Where films of it go: not beside the file, which may lie where nobody may write."""
        return Path("renders") / self.path.name.partition(".")[0]

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The cloud, ready to render."""
        kind = methods.find("gaussian-splatting")
        method = kind(self.frame, kind.Config(degree=self.gaussians.degree, antialiased=self.gaussians.antialiased))
        method.cloud.replace(self._in_scene)
        return method.to(device).eval()

    def cameras(self) -> dict[str, Camera]:
        """A ring of cameras around the middle, looking at it."""
        angle = torch.arange(CAMERAS) * (2 * math.pi / CAMERAS)
        height = torch.full_like(angle, math.radians(ELEVATION))
        outward = torch.stack([height.cos() * angle.cos(), height.cos() * angle.sin(), height.sin()], -1)
        right = torch.stack([-angle.sin(), angle.cos(), torch.zeros_like(angle)], -1)
        pose = torch.stack([right, torch.linalg.cross(-outward, right), -outward, DISTANCE * outward], -1)
        focal = 0.5 * SIZE / math.tan(0.5 * math.radians(ANGLE))
        lens = Pinhole(torch.full((CAMERAS, 2), focal), torch.full((CAMERAS, 2), SIZE / 2))
        return {"train": Camera(pose, lens, torch.full((CAMERAS, 2), SIZE))}


def upright_similarity(gaussians: Gaussians) -> Float[Tensor, "4 4"]:
    """What brings most of the visible cloud into [-1, 1]^3, standing upright."""
    means = gaussians.means.double().cpu()
    solid = means[gaussians.opacities.sigmoid().cpu() > 0.1]
    means = (solid if len(solid) > 10 else means) @ UPRIGHT.T
    some = means[:: max(1, len(means) // 100_000)]
    shares = torch.tensor([(1 - SHARE) / 2, (1 + SHARE) / 2], dtype=torch.float64)
    low, high = torch.quantile(some, shares, dim=0)
    scale = 2 / max(float((high - low).max()), 1e-9)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = scale * UPRIGHT
    matrix[:3, 3] = -scale * (low + high) / 2
    return matrix
