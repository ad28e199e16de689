"""A folder of SNeRG's viewer, opened as if it were a run: something to render, with cameras around it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import methods
from ..camera import Camera, ring
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..exchange import snerg
from ..exchange.baked import Atlas
from ..geometry import Similarity
from ..method import Method
from .opened import Opened

VOXEL_MARGIN = 0.02  # beyond [-1, 1]^3, that a voxel may reach
WHITE_BACKGROUND = (1.0, 1.0, 1.0)  # the background of that viewer


class SnergFolder(Opened):
    """An atlas in a folder, with a ring of cameras around it. Raises LumigraphError for a folder that holds none."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        atlas = snerg.read(self.path)
        places, _ = atlas.voxels()
        if not len(places):
            raise LumigraphError(f"{self.path} holds no voxels, so there is nothing to show")
        corners = atlas.low + atlas.voxel * torch.stack([places.amin(0), places.amax(0) + 1])
        to_source = Similarity.make(1.0) if atlas.contracted else within_reach(corners)
        scale, shift = to_source.inverse.scale, to_source.inverse.matrix[:3, 3].float()
        self.atlas = replace(atlas, low=scale * atlas.low + shift, voxel=scale * atlas.voxel)
        if (network := self.atlas.network) and len(network.biases[0]) != len(network.biases[1]):
            raise LumigraphError(f"{self.path} has a network of two widths, of which one is read; export it anew")
        low, high = ((scale * corner + shift).clamp(-1, 1).tolist() for corner in corners)
        reach = reach_of(atlas, places) if atlas.contracted else 1.0
        rows = to_source.rows
        self.frame = Frame(
            (tuple(low), tuple(high)), reach, near=0.01, background=WHITE_BACKGROUND, source_from_scene=rows
        )

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The atlas, ready to render."""
        kind = methods.find("snerg")
        network = self.atlas.network
        numbers = {} if network is None else {"view_width": len(network.biases[0])}
        numbers |= {"block_size": self.atlas.block + 2, "whole": self.atlas.contracted}
        method = kind(self.frame, replace(kind.smallest(), **numbers))
        method.take(self.atlas)
        return method.to(device).eval()

    def cameras(self) -> dict[str, Camera]:
        """A ring of cameras around the middle, looking at it."""
        return {"train": ring(self.frame.bounds)}


def reach_of(atlas: Atlas, places: Int[Tensor, "voxel 3"]) -> float:
    """The least power of two with which rays go as far as what lies in these voxels of contracted coordinates."""
    radius = float((atlas.low + atlas.voxel * (places + 0.5)).norm(dim=-1).amax())
    farthest = 1 / max(2 - radius, 0.5 * atlas.voxel)
    return min(64.0, max(2.0, 2.0 ** math.ceil(math.log2(farthest / (2 * math.sqrt(3))))))


def within_reach(corners: Float[Tensor, "2 3"]) -> Similarity:
    """The way back from where a box lies in [-1, 1]^3: as it is if it lies there, else shrunk and moved."""
    low, high = corners.double()
    if float(corners.abs().max()) <= 1 + VOXEL_MARGIN:
        return Similarity.make(1.0)
    return Similarity.make(float((high - low).max()) / 2, torch.eye(3, dtype=torch.float64), (low + high) / 2)
