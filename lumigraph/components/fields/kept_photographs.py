"""Training photographs of a collection's members, and photographs stored among a method's tensors."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ...camera import Camera
from ...camera.lens import Lens
from ...camera.rays import Rays
from ...datasets.dataset import Dataset
from ...datasets.scene import Batch, Frame, Photograph, Scene, Vector
from ...errors import LumigraphError
from ...files import from_json
from ...files.ranges import Row, Side, typed

WHERE = "what a checkpoint says of its photographs"


@dataclass(frozen=True)
class Taken:
    """Cameras of photographs, a row for each. lens: see `Lens.to_json`."""

    pose: list[tuple[Row, Row, Row]]
    lens: dict[str, Any]
    size: list[tuple[Side, Side]]


class Kept(nn.Module):
    """Buffer whose number of rows is that of the saved one."""

    grows: ClassVar[tuple[str, ...]] = ("rows",)
    rows: Tensor

    def __init__(self, rows: Tensor):
        super().__init__()
        self.register_buffer("rows", rows)


class KeptPhotographs(nn.Module):
    """Photographs with cameras, and optionally features: a row for each cell.

    features: length of a row
    """

    def __init__(self, features: int):
        super().__init__()
        nothing = torch.empty(0, dtype=torch.uint8)
        self.pixels, self.taken = Kept(nothing), Kept(nothing.clone())
        self.found = Kept(torch.empty(0, features))

    def __bool__(self) -> bool:
        return len(self.taken.rows) > 0

    @staticmethod
    def of(photographs: list[Photograph], background: Vector, features: int) -> KeptPhotographs:
        """Photographs' colours over a background, with eight bits."""
        kept = KeptPhotographs(features)
        camera = Camera.cat([photograph.camera for photograph in photographs]).to("cpu")
        said = {"pose": camera.pose.tolist(), "lens": camera.lens.to_json(), "size": camera.size.tolist()}
        colours = [photograph.before(background).mul(255).round().byte().flatten() for photograph in photographs]
        kept.pixels.rows = torch.cat(colours)
        kept.taken.rows = torch.frombuffer(bytearray(json.dumps(said).encode()), dtype=torch.uint8)
        return kept

    def cameras(self) -> Camera:
        """Cameras of the photographs, on the CPU. Raises LumigraphError for a damaged description."""
        said = typed(Taken, from_json(self.taken.rows.cpu().numpy().tobytes(), WHERE), WHERE)
        lens, pose, size = Lens.from_json(said.lens, WHERE), torch.tensor(said.pose), torch.tensor(said.size)
        if not len(lens) == len(pose) == len(size) or 3 * int(size.prod(-1).sum()) != len(self.pixels.rows):
            raise LumigraphError(f"{WHERE} does not fit their pixels; restore it from a copy")
        return Camera(pose, lens, size)

    def pictures(self) -> list[Float[Tensor, "height width 3"]]:
        sizes = self.cameras().size.tolist()
        parts = self.pixels.rows.split([3 * width * height for width, height in sizes])
        return [part.view(height, width, 3).float() / 255 for part, (width, height) in zip(parts, sizes, strict=True)]


def padded(pictures: list[Float[Tensor, "_ _ 3"]]) -> Float[Tensor, "view 3 height width"]:
    """Pictures of any sizes as one batch, padded at right and bottom by their border."""
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))

    def grown(picture: Tensor) -> Tensor:
        rest = (0, width - picture.shape[1], 0, height - picture.shape[0])
        return nn.functional.pad(picture.permute(2, 0, 1)[None], rest, mode="replicate")[0]

    return torch.stack([grown(picture) for picture in pictures])


def photographed(member: Dataset, method: str) -> Scene:
    """A member as photographs. Raises LumigraphError for any other kind. method: named in the error"""
    if not isinstance(member, Scene):
        raise LumigraphError(
            f"{method} learns from collections of photographs, and {member.source} holds {member.kind}; "
            "name a folder of scenes"
        )
    return member


def rays_through(photographs: Sequence[Photograph], count: int, boxed: bool, generator: torch.Generator) -> Batch:
    """Rays of random pixels, about as many of each photograph. boxed: see `pixels_of`"""
    parts = []
    counts = [len(x) for x in torch.arange(count).tensor_split(len(photographs))]
    for photograph, wanted in zip(photographs, counts, strict=True):
        places = pixels_of(photograph, boxed)
        x, y = places[torch.randint(len(places), (wanted,), generator=generator)].unbind(-1)
        alpha = None if photograph.alpha is None else photograph.alpha[y, x]
        parts.append(Batch(photograph.camera.rays(torch.stack([x, y], -1) + 0.5), photograph.rgb[y, x], alpha))
    names = ("origins", "directions", "radius")
    rays = Rays(*(torch.cat([getattr(part.rays, name) for part in parts]) for name in names))
    known = [part.alpha for part in parts if part.alpha is not None]
    return Batch(rays, torch.cat([part.rgb for part in parts]), torch.cat(known) if len(known) == len(parts) else None)


def pixels_of(photograph: Photograph, boxed: bool) -> Int[Tensor, "pixel 2"]:
    """Trusted pixels (x, y); boxed: only those in the bounding box of opaque ones, if any."""
    height, width = photograph.rgb.shape[:2]
    there = torch.ones(height, width, dtype=torch.bool) if photograph.mask is None else photograph.mask.clone()
    if boxed and photograph.alpha is not None and (opaque := photograph.alpha > 0.5).any():
        rows, columns = opaque.any(1).nonzero(), opaque.any(0).nonzero()
        box = torch.zeros_like(there)
        box[int(rows.min()) : int(rows.max()) + 1, int(columns.min()) : int(columns.max()) + 1] = True
        there = there & box if (there & box).any() else there
    return there.nonzero().flip(-1)


def square(photograph: Photograph, frame: Frame, size: int) -> tuple[Float[Tensor, "3 size size"], Camera]:
    """Central square of a photograph over its background, resized, and its camera."""
    rgb, camera = photograph.before(frame.background).permute(2, 0, 1), photograph.camera
    height, width = rgb.shape[1:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    if (height, width) != (side, side):
        lens: Any = camera.lens
        lens = replace(lens, centre=lens.centre - torch.tensor([float(left), float(top)]))
        camera = replace(camera, lens=lens, size=torch.full_like(camera.size, side))
        rgb = rgb[:, top : top + side, left : left + side]
    picture = nn.functional.interpolate(rgb[None], (size, size), mode="bilinear", antialias=True)[0]
    return picture, camera.resized(size / side)


def chance(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))
