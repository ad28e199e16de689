"""Files that open like runs: splat files, moving clouds and SNeRG viewer folders, with cameras around them."""

import math
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import methods
from ..camera import Camera
from ..composition import PlayedCloud
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..exchange import read_gaussians, read_moving, snerg
from ..exchange.baked import Atlas
from ..files.ranges import changed
from ..gaussians import Gaussians
from ..geometry import Similarity
from ..method import Method
from .opened import Opened

BOX_SHARE = 0.96  # of visible Gaussians inside the box of interest, along each axis
# Splat files have y pointing down by custom, as the cameras they were learnt from; scenes stand upright.
UPRIGHT_ROTATION = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
INNER_RING = 0.25  # size of a ring of cameras inside a room, of one around it
VOXEL_MARGIN = 0.02  # beyond [-1, 1]^3, that a voxel may reach
WHITE_BACKGROUND = (1.0, 1.0, 1.0)  # the background of that viewer


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


class SampleCloud(SplatFile):
    """A cloud of the package. metres: to a unit, of a room that is seen from inside; None for an object"""

    def __init__(self, path: Path, metres: float | None):
        super().__init__(path)
        self.inside = metres is not None
        self.frame = replace(self.frame, scale=metres or 1.0)

    def cameras(self) -> dict[str, Camera]:
        """A ring around an object; one within a room, each camera looking across the middle."""
        found = super().cameras()
        if not self.inside:
            return found
        pose = torch.cat([found["train"].pose[:, :, :3], INNER_RING * found["train"].pose[:, :, 3:]], -1)
        return {"train": replace(found["train"], pose=pose)}


class MovingFile(Opened):
    """A moving cloud in a file or a folder, with a ring of cameras around it."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.moving = read_moving(self.path)
        self.frame = replace(frame_of(self.moving.at(0.0)), times=(0.0, self.moving.duration))

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The moving cloud, ready to render."""
        return PlayedCloud(self.frame, self.moving.transformed(self.frame.to_source.inverse.matrix)).to(device)


def frame_of(gaussians: Gaussians) -> Frame:
    """Frame of a splat file: the source's axes are those of the file."""
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


def reach_of(atlas: Atlas, places: Int[Tensor, "voxel 3"]) -> float:
    """Smallest power of two as reach of a frame that holds these voxels of contracted coordinates."""
    radius = float((atlas.low + atlas.voxel * (places + 0.5)).norm(dim=-1).amax())
    farthest = 1 / max(2 - radius, 0.5 * atlas.voxel)
    return min(64.0, max(2.0, 2.0 ** math.ceil(math.log2(farthest / (2 * math.sqrt(3))))))


def within_reach(corners: Float[Tensor, "2 3"]) -> Similarity:
    """Similarity from a box scaled into [-1, 1]^3 back to the box; the identity if it lies there already."""
    low, high = corners.double()
    if float(corners.abs().max()) <= 1 + VOXEL_MARGIN:
        return Similarity.make(1.0)
    return Similarity.make(float((high - low).max()) / 2, torch.eye(3, dtype=torch.float64), (low + high) / 2)
