"""A file of Gaussians, opened as if it were a run: something to render, with cameras around it."""

from __future__ import annotations

from pathlib import Path

import torch

from .. import methods
from ..camera import Camera, ring
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..exchange import read_gaussians
from ..files.ranges import changed
from ..gaussians import Gaussians
from ..geometry import Similarity
from ..method import Method
from .opened import Opened

BOX_SHARE = 0.96  # of visible Gaussians inside the box of interest, along each axis
# Splat files have y pointing down by custom, as the cameras they were learnt from; scenes stand upright.
UPRIGHT_ROTATION = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)


class SplatFile(Opened):
    """A cloud in a file, with a ring of cameras around it. Raises LumigraphError for a file that is no cloud."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.gaussians: Gaussians = read_gaussians(self.path)
        if not len(self.gaussians):
            raise LumigraphError(f"{self.path} holds no Gaussians, so there is nothing to show")
        self.frame = frame_of(self.gaussians)
        self._in_scene = self.gaussians.transformed(self.frame.to_source.inverse.matrix)

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The cloud, ready to render."""
        kind = methods.find("gaussian-splatting")
        cloud = self.gaussians
        method = kind(self.frame, changed(kind.Config(), sh_degree=cloud.degree, antialiased=cloud.antialiased))
        method.cloud.replace(self._in_scene)
        return method.to(device).eval()

    def source_gaussians(self) -> Gaussians:
        return self.gaussians

    def cameras(self) -> dict[str, Camera]:
        """A ring of cameras around the middle, looking at it."""
        return {"train": ring(self.frame.bounds)}


def frame_of(gaussians: Gaussians) -> Frame:
    """The frame of a scene whose source are the axes of a file."""
    return Frame(reach=64.0, near=0.01, source_from_scene=upright_similarity(gaussians).inverse.rows)


def upright_similarity(gaussians: Gaussians) -> Similarity:
    """Similarity that moves most of the visible cloud into [-1, 1]^3, upright."""
    means = gaussians.means.double().cpu()
    solid = means[gaussians.opacities.sigmoid().cpu() > 0.1]
    means = (solid if len(solid) > 10 else means) @ UPRIGHT_ROTATION.T
    some = means[:: max(1, len(means) // 100_000)]
    shares = torch.tensor([(1 - BOX_SHARE) / 2, (1 + BOX_SHARE) / 2], dtype=torch.float64)
    low, high = torch.quantile(some, shares, dim=0)
    scale = 2 / max(float((high - low).max()), 1e-9)
    return Similarity.make(scale, UPRIGHT_ROTATION, -scale * (low + high) / 2)
