"""A folder of SNeRG's viewer, opened as if it were a run: something to render, with cameras around it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from .. import methods
from ..baked import Atlas
from ..camera import Camera, ring
from ..errors import LumigraphError
from ..exchange import snerg
from ..geometry import Similarity
from ..method import Method
from ..scene import Frame
from .opened import Opened

WHITE = (1.0, 1.0, 1.0)  # is behind everything in that viewer


class SnergFolder(Opened):
    """An atlas in a folder, with a ring of cameras around it. Raises LumigraphError for a folder that holds none."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.atlas, to_source = within_reach(snerg.read(self.path))
        if not len(self.atlas.values):
            raise LumigraphError(f"{self.path} holds no voxels, so there is nothing to show")
        if (network := self.atlas.network) and len(network.biases[0]) != len(network.biases[1]):
            raise LumigraphError(f"{self.path} has a network of two widths, of which one is read; export it anew")
        low = self.atlas.low
        high = low + self.atlas.voxel * self.atlas.block * torch.tensor(self.atlas.index.shape)
        bounds = tuple(tuple(corner.clamp(-1, 1).tolist()) for corner in (low, high))
        self.frame = Frame(bounds, near=0.01, background=WHITE, source_from_scene=to_source.rows)  # type: ignore[arg-type]

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The atlas, ready to render."""
        kind = methods.find("snerg")
        network = self.atlas.network
        width = {} if network is None else {"view_width": len(network.biases[0])}
        method = kind(self.frame, replace(kind.smallest(), block_size=self.atlas.block + 2, **width))
        method.take(self.atlas)
        return method.to(device).eval()

    def cameras(self) -> dict[str, Camera]:
        """A ring of cameras around the middle, looking at it."""
        return {"train": ring(self.frame.bounds)}


def within_reach(atlas: Atlas) -> tuple[Atlas, Similarity]:
    """An atlas moved and shrunk into [-1, 1]^3 where it is not there already, and the way back."""
    size = atlas.voxel * atlas.block * torch.tensor(atlas.index.shape)
    if bool((atlas.low >= -1.01).all() and (atlas.low + size <= 1.01).all()):
        return atlas, Similarity.make(1.0)
    scale, middle = 2 / float(size.max()), atlas.low + size / 2
    moved = replace(atlas, low=(atlas.low - middle) * scale, voxel=atlas.voxel * scale)
    return moved, Similarity.make(1 / scale, torch.eye(3, dtype=torch.float64), middle.double())
