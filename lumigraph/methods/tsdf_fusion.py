"""TSDF fusion in hashed blocks of voxels (Nießner et al. 2013; Curless and Levoy 1996): depth maps become a surface."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..budget import Quality
from ..camera import Camera
from ..camera.rays import Rays, Rendering
from ..datasets.mesh import Mesh
from ..datasets.scene import Frame, Photograph, Scene
from ..depth_maps import DepthMap, VoxelBlocks, release_weight, render_depth_maps, sensor_faults, trust_of
from ..depth_maps.voxel_blocks import BYTES_PER_BLOCK
from ..errors import LumigraphError, LumigraphWarning
from ..files.ranges import NonNegative, Positive, Share, between
from ..method import BaseConfig, Descend, RayMethod
from ..method.depth import DEPTH_DEVIATION, DEPTH_LAYER, DEVIATION_LAYER
from ..system.memory import free_memory

Length = Annotated[float, between(0, 1e6)]  # of the capture's frame
AUTOMATIC_CELLS = 256  # voxels along the longest side of the box of interest, where no size is given
MEMORY_SHARE = 0.5  # of the free memory that blocks may fill: growing copies them once
PRUNE_EVERY = 32  # depth maps between two searches for blocks that show no surface
TEACHER_VIEWS = 100  # depth maps of a method that is converted, at most
TEACHER_SIZE = 640  # pixels of their longer side
SAMPLE_WEIGHT, SENSOR_SPAN = 3.0, (0.4, 4.0)  # of the release's weight: that of one sample, and metres


@dataclass(frozen=True)
class Config(BaseConfig):
    """Numbers of the released program for the Kinect (its parameter file; voxels of 4 mm are those of sec. 6)."""

    voxel_size: Length = 0.004  # edge of a voxel, in units of the capture (metres); 0: a 256th of the box of interest
    truncation: Annotated[float, between(2, 64)] = 5.0  # voxels before and behind a surface; more bears more noise
    truncation_growth: Share = 0.01  # truncation added for each unit of depth; more bears more noise far away
    weighting: Literal["depth", "angle"] = "depth"  # weight of a pixel: the release's, by depth; or by viewing angle
    max_weight: Positive = 255.0  # of a voxel's mean; less follows changes sooner
    max_depth: Length = 3.0  # in units of the capture, beyond which depth is left out; 0: none
    trusted_depth: Length = 0.0  # units of the capture to which depth counts in full, weighted by angle; 0: all
    min_weight: NonNegative = 0.0  # of voxels that the mesh is made of; above 1, what was seen once is lost


SOURCES = {  # of the numbers of `paper`; the others are ours
    "niessner/VoxelHashing, DepthSensing/zParametersDefault.txt (421d548)": (
        "voxel_size truncation truncation_growth max_weight max_depth sample_weight sensor_span"
    ),
    "niessner/VoxelHashing, DepthSensing/Shaders/SceneRepSDF.hlsl (421d548)": "weighting",
}
BY_ANGLE = Config(truncation=4.0, truncation_growth=0.0, weighting="angle", max_depth=0.0)  # for any unit and range


class TSDFFusion(RayMethod):
    """A truncated signed distance with colours, averaged over the depth maps of a capture one after another."""

    Config = Config
    any_lens: ClassVar[bool] = True
    default_quality: ClassVar[Quality | None] = "good"  # each depth map once, however long it takes
    idle_render_share: ClassVar[float] = 0.5  # a map that grows while one walks is looked at
    taught_steps: ClassVar[int | None] = 1
    fused: Tensor  # depth maps so far
    count: Tensor  # of depth maps in all; 0 before any are known

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.unit = 1 / frame.to_source.scale  # scene units to one of the capture
        longest = max(high - low for low, high in zip(*frame.bounds, strict=True))
        edge = c.voxel_size * self.unit or longest / AUTOMATIC_CELLS
        if not longest / (1 << 16) < edge < longest:
            raise LumigraphError(
                f"voxels of {c.voxel_size:g} do not fit a box of interest of {longest / self.unit:.3g} units of the "
                "capture; give --voxel-size in its unit, or 0 for a 256th of the box"
            )
        most = int(MEMORY_SHARE * free_memory() / BYTES_PER_BLOCK)
        self.volume = VoxelBlocks(edge, c.truncation, c.max_weight, max(most, 1), c.truncation_growth)
        self.register_buffer("fused", torch.tensor(0))
        self.register_buffer("count", torch.tensor(-1))

    @classmethod
    def cpu_preset(cls) -> Any:
        """Voxels of a centimetre; depth beyond 3 m counts by its inverse variance."""
        return replace(BY_ANGLE, voxel_size=0.01, trusted_depth=3.0)

    @classmethod
    def taught_preset(cls, device: torch.device) -> Any:
        """Voxels by the box of interest: the unit of photographs is arbitrary."""
        return replace(BY_ANGLE, voxel_size=0.0)

    @classmethod
    def smallest(cls) -> Any:
        """Some thousand voxels."""
        return replace(BY_ANGLE, voxel_size=0.08, truncation=3.0)

    # Learning

    @property
    def complete(self) -> bool:
        """True after all depth maps are fused."""
        return int(self.fused) == int(self.count)

    def steps_per_pass(self, data: Any) -> float:
        return len(data.splits["train"])

    def steps_for(self, quality: Any, data: Any) -> int:
        """One step for each depth map."""
        return len(data.splits["train"])

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        for sentence in sensor_faults(data):
            warnings.warn(sentence, LumigraphWarning, stacklevel=2)
        self.count.fill_(len(data.splits["train"]))

    def batch(self, data: Scene, generator: torch.Generator) -> Photograph:  # type: ignore[override]
        """The next photograph with its depth, in the order of their names."""
        train = data.splits["train"]
        layers = [name for name in (DEPTH_LAYER, DEVIATION_LAYER) if name in data.layers]
        return data.photograph(int(train[min(int(self.fused), len(train) - 1)]), layers)

    @torch.no_grad()
    def step(self, batch: Photograph, step: int, descend: Descend) -> dict[str, Tensor]:
        """Fuse one depth map."""
        depth, stated = batch.extra[DEPTH_LAYER], batch.extra.get(DEVIATION_LAYER)
        sure = None if batch.mask is None else batch.mask.float()
        if stated is not None:  # inverse variance, beside that of a sure measurement
            share = (DEPTH_DEVIATION * depth / stated).square().clamp(max=1).nan_to_num(1.0)
            sure = share if sure is None else share * sure
        self._fuse(DepthMap.measured(batch.camera, depth, batch.before(self.frame.background)), sure)
        return {}

    def _fuse(self, seen: DepthMap, sure: Tensor | None = None) -> None:
        c = self.config
        farthest = c.max_depth or math.inf
        if c.weighting == "depth":
            trust = release_weight(seen, self.unit, SAMPLE_WEIGHT, SENSOR_SPAN, farthest)
        else:
            trust = trust_of(seen, c.trusted_depth * self.unit, farthest * self.unit)
        if sure is not None:
            trust = trust * sure.to(trust)
        if not self.volume.fuse(seen, trust):
            warnings.warn(
                f"Memory holds no more than {len(self.volume)} blocks, so new surfaces are left out; give a larger "
                "--voxel-size",
                LumigraphWarning,
                stacklevel=2,
            )
        self.fused += 1
        if int(self.fused) % PRUNE_EVERY == 0:
            self.volume.prune()
        self.figures = {"blocks": len(self.volume), "megabytes": self.volume.bytes / 1e6}

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Fuse the depth that a teacher renders."""
        background = self.frame.background
        for seen in render_depth_maps(teacher.render, cameras, background, TEACHER_VIEWS, TEACHER_SIZE):
            self._fuse(seen)
        self.count.copy_(self.fused)

    # Rendering

    @torch.no_grad()
    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        """The first surface along each ray, opaque."""
        depth, normals, rgb = self.volume.cast(rays)
        hit = depth.isfinite()
        rgb = torch.where(hit[:, None], rgb, background)
        return Rendering(rgb, depth, hit.float(), {"normals": normals * hit[:, None]})

    @torch.no_grad()
    def mesh(self) -> Mesh:
        """The zero level with its colours. Raises LumigraphError where there is none."""
        vertices, rgb, faces = (x.cpu() for x in self.volume.surface(self.config.min_weight))
        if not len(faces):
            raise LumigraphError("No surface was fused, so there is no mesh; look at the capture's depth and its unit")
        colours = (rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        return Mesh(vertices.numpy().astype(np.float64), faces.numpy(), colours)
