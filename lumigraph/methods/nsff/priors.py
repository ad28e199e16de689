"""Priors of NSFF from the photographs: optical flow to neighbouring times, and depth of static parts."""

from __future__ import annotations

import json
import math
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from ...camera import Camera
from ...camera.lens import Lens
from ...components.fields.kept_photographs import WHERE, Kept, Taken
from ...components.training.dense_points import compile_sweep, seen_points
from ...datasets.scene import Batch, Photograph, Scene
from ...depth_maps.optical_flow import optical_flow, round_trip_error
from ...exchange.packing import Stored
from ...files import from_json
from ...files.ranges import typed
from ...method import Part
from ...method.depth import DEPTH_LAYER

MAX_ROUND_TRIP = 1.0  # pixels, up to which flow forward and back must return
MAX_SIDE = 256  # pixels along the longer side of pictures in which flow and depth are found
SWEEP_SHARE = 0.1  # of a budget of seconds that plane sweeps may take
UNKNOWN = -1  # in the place of a photograph

DepthSource = Literal["sweeps", "files"]


class MotionPriors(Part):
    """Optical flow from each training photograph to those before and after it, and its depth, in small pictures.

    size:    height and width of all small pictures
    row:     of each photograph among them; -1 for held-out ones
    partner: photographs at the time before and after, targets of the flow; -1 for none
    flow:    pixels (x, y) of small pictures, of each row, direction and pixel; NaN if unreliable
    depth:   along rays, scene units, of each row and pixel; NaN if unknown
    taken:   the cameras, as JSON
    """

    size: Tensor
    row: Tensor
    partner: Tensor

    def __init__(self, photographs: int, flows: bool, depth: DepthSource | None):
        super().__init__()
        self.flows, self.source = flows, depth
        self.register_buffer("size", torch.zeros(2, dtype=torch.long))
        self.register_buffer("row", torch.full((max(photographs, 1),), UNKNOWN))
        self.register_buffer("partner", torch.full((max(photographs, 1), 2), UNKNOWN))
        self.flow, self.depth = Kept(torch.zeros(0, 2, dtype=torch.half)), Kept(torch.zeros(0, dtype=torch.half))
        self.taken = Kept(torch.zeros(0, dtype=torch.uint8))

    def compile_begin(self) -> None:
        if self.source == "sweeps":
            compile_sweep()

    def begin(self, method: object, data: Scene, seconds: float) -> None:
        train, cameras, device = data.splits["train"], data.cameras, self.row.device
        smaller = math.ceil(int(cameras.size.max()) / MAX_SIDE)
        pictures = {i: data.photograph(i).reduced(smaller) for i in train.tolist()}
        height, width = (max(p.rgb.shape[axis] for p in pictures.values()) for axis in (0, 1))
        self.size.copy_(torch.tensor([height, width]))
        self.row[train] = torch.arange(len(train), device=device)
        said = {"pose": cameras.pose.tolist(), "lens": cameras.lens.to_json(), "size": cameras.size.tolist()}
        self.taken.rows = torch.frombuffer(bytearray(json.dumps(said).encode()), dtype=torch.uint8).to(device)
        if self.flows and cameras.time is not None:
            others_of = partners(cameras, train)
            self.partner[train] = others_of.to(device)
            flow = torch.full((len(train), 2, height, width, 2), math.nan, dtype=torch.half)
            for i, (photograph, others) in enumerate(zip(train.tolist(), others_of.tolist(), strict=True)):
                for way, other in enumerate(others):
                    if other != UNKNOWN:
                        offsets = checked_flow(bytes_of(pictures[photograph]), bytes_of(pictures[other]))
                        flow[i, way, : offsets.shape[0], : offsets.shape[1]] = offsets.half()
            self.flow.rows = flow.view(-1, 2).to(device)
        if self.source is not None:
            depth = self.known_depth(data, train.tolist(), smaller, (height, width), seconds)
            self.depth.rows = depth.flatten().to(device)

    def known_depth(
        self, data: Scene, train: list[int], smaller: int, size: tuple[int, int], seconds: float
    ) -> Float[Tensor, "photograph height width"]:
        """Depth from the capture's layer, or by plane sweeps, which match only static parts."""
        depth = torch.full((len(train), *size), math.nan, dtype=torch.half)
        if self.source == "files":
            for i, number in enumerate(train):
                known = data.photograph(number, [DEPTH_LAYER]).reduced(smaller).extra[DEPTH_LAYER]
                depth[i, : known.shape[0], : known.shape[1]] = known.half()
            return depth
        found = seen_points(data, SWEEP_SHARE * seconds)
        cameras, chosen = data.cameras, torch.tensor(train)
        if len(found.positions):
            distance = torch.cdist(found.origins, cameras.position[chosen])
            own = distance.argmin(1)
            pixels, visible = cameras.project(found.positions, chosen[own])
            x, y = (pixels / smaller).long().unbind(-1)
            inside = visible & (x >= 0) & (y >= 0) & (x < size[1]) & (y < size[0])
            away = (found.positions - found.origins).norm(dim=-1)
            depth[own[inside], y[inside], x[inside]] = away[inside].half()
        return depth

    @cached_property
    def cameras(self) -> Camera:
        """Cameras of all photographs."""
        said = typed(Taken, from_json(self.taken.rows.cpu().numpy().tobytes(), WHERE), WHERE)
        lens, pose, size = Lens.from_json(said.lens, WHERE), torch.tensor(said.pose), torch.tensor(said.size)
        return Camera(pose, lens, size).to(self.row.device)

    def flow_targets(self, batch: Batch, way: Int[Tensor, " ray"]) -> tuple[Float[Tensor, "ray 2"], Tensor]:
        """Optical-flow targets of rays in other photographs, pixels, NaN if unknown, and the photographs' numbers.

        way: 0 for the time before, 1 for the one after
        """
        image, sizes = batch.rays.image_index, self.cameras.size[batch.rays.image_index]
        row, within = self.cells(batch)
        moved = self.flow.rows[(2 * row + way) * int(self.size.prod()) + within].float()
        return batch.extra["place"] * sizes + moved * (sizes / self.small(sizes)), self.partner[image, way]

    def depth_targets(self, batch: Batch) -> Float[Tensor, " ray"]:
        """Depth of rays; NaN where it is not known."""
        row, within = self.cells(batch)
        return self.depth.rows[row * int(self.size.prod()) + within].float()

    def small(self, sizes: Int[Tensor, "ray 2"]) -> Int[Tensor, "ray 2"]:
        """Width and height of the small pictures of photographs."""
        return (sizes // math.ceil(int(self.cameras.size.max()) / MAX_SIDE)).clamp_min(1)

    def cells(self, batch: Batch) -> tuple[Int[Tensor, " ray"], Int[Tensor, " ray"]]:
        """Row of each ray's photograph, and the pixel's number in its small picture."""
        assert batch.rays.image_index is not None
        small = self.small(self.cameras.size[batch.rays.image_index])
        x, y = torch.minimum((batch.extra["place"] * small).long(), small - 1).unbind(-1)
        return self.row[batch.rays.image_index], y * self.size[1] + x

    def storage(self) -> dict[str, Stored]:
        """Rendering needs none of it."""
        return {f"{name}.rows": Stored("nothing") for name in ("flow", "depth", "taken")}


def partners(cameras: Camera, train: Int[Tensor, " photograph"]) -> Int[Tensor, "photograph 2"]:
    """For each training photograph the one at the moment before, and after, whose camera is nearest to its own."""
    assert cameras.time is not None
    times, position = cameras.time[train], cameras.position[train]
    moments = times.unique()
    found = torch.full((len(train), 2), UNKNOWN)
    for i, moment in enumerate(torch.searchsorted(moments, times).tolist()):
        for way, other in ((0, moment - 1), (1, moment + 1)):
            if 0 <= other < len(moments):
                there = (times == moments[other]).nonzero()[:, 0]
                found[i, way] = train[there[(position[there] - position[i]).norm(dim=-1).argmin()]]
    return found


def bytes_of(photograph: Photograph) -> UInt8[Tensor, "height width 3"]:
    """Colours over black."""
    return (photograph.before((0.0, 0.0, 0.0)) * 255).byte()


def checked_flow(
    first: UInt8[Tensor, "height width 3"], second: UInt8[Tensor, "rows columns 3"]
) -> Float[Tensor, "height width 2"]:
    """Optical flow from one picture to another, NaN where forward-backward consistency fails."""
    if first.shape != second.shape:
        second = interpolate(second.movedim(-1, 0)[None].float(), first.shape[:2], mode="area")[0].movedim(0, -1).byte()
    height, width = first.shape[:2]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels, flow = torch.stack([x, y], -1), optical_flow(first, second)
    there = pixels + flow
    inside = ((there >= 0.5) & (there <= torch.tensor([width, height]) - 0.5)).all(-1)
    sure = inside & (round_trip_error(pixels, flow, optical_flow(second, first)) < MAX_ROUND_TRIP)
    return torch.where(sure[..., None], flow, torch.nan)


def seen(mask: Bool[Tensor, " ray"], values: Float[Tensor, " ray"]) -> Float[Tensor, ""]:
    """Masked mean of values; 0 for an empty mask."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)
