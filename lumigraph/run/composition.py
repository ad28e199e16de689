"""A composition's file: which parts, where each stands, and which of them leads.

    {
      "format": "lumigraph composition 1",
      "lead": 0,
      "parts": [
        {"source": "runs/courtyard-1"},
        {"source": "toys.spz", "place": {"scale": 0.3, "rotation": 90, "translation": [0.5, 0, -0.4]}},
        {"source": "runs/lego-1", "place": [[...], [...], [...], [0, 0, 0, 1]], "box": [[-1, -1, 0], [1, 1, 1]]}
      ]
    }

source: of a part: anything that opens, from this file's folder or absolute
place:  similarity from the source's frame of the part to that of the composition, both those of photographs or files,
        where keyframes and exports lie as well. A 4 x 4 matrix, or a scale, a rotation (a quaternion w, x, y, z, or
        degrees about +z) and a translation, in this order; what is left out changes nothing
box:    two corners in the part's scene frame, as `lumigraph info` tells its bounds and the viewer crops it
lead:   the part whose cameras, background and vertical the composition has; the first, unless said
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import torch

from .. import files
from ..camera import Camera
from ..camera.crop import CropBox
from ..composition import Placed, compose, frame_around
from ..errors import LumigraphError
from ..files.ranges import Name, Point, Row, between, typed
from ..geometry import Similarity, Vector, is_similarity, to_matrix, to_quaternion
from ..method import Method
from .opened import Opened

FORMAT = "lumigraph composition 1"


@dataclass(frozen=True)
class CompositionPart:
    """A part as the file says it. source: a path as it stands there; place and box: see above."""

    source: str
    place: Similarity
    box: CropBox | None = None


class Composition(Opened):
    """A composition's file, opened with all its parts. Raises LumigraphError for one that cannot be.

    open_part: opens what a part names, given the files that it is a part of
    within:    those that this one is a part of
    """

    def __init__(
        self, path: Path | str, open_part: Callable[[Path, tuple[Path, ...]], Opened], within: tuple[Path, ...] = ()
    ):
        self.path = Path(path)
        here = self.path.resolve()
        if here in within:
            raise LumigraphError(f"{self.path} holds itself, by way of its parts; take that part out of it")
        self.parts, self.lead = read_composition(self.path)
        self.opened = [open_part(self._found(part), (*within, here)) for part in self.parts]
        first = self.opened[self.lead].frame
        to_source = self.parts[self.lead].place @ first.to_source
        self.places = [
            to_source.inverse @ part.place @ opened.frame.to_source
            for part, opened in zip(self.parts, self.opened, strict=True)
        ]
        self.places[self.lead] = Similarity.make(1.0)  # to the last digit
        every = zip(self.opened, self.places, self.parts, strict=True)
        others = [(opened.frame, place, part.box) for opened, place, part in every]
        del others[self.lead]
        self.frame = replace(frame_around(first, others), source_from_scene=to_source.rows)

    def _found(self, part: CompositionPart) -> Path:
        path = self.path.parent / files.expanded(part.source)
        if not files.exists(path):
            raise LumigraphError(f"{self.path} names {part.source} as a part, but there is no {path}; correct its path")
        return path

    def method(self, device: torch.device | str = "cpu") -> Method:
        """All parts in one picture. A source that is named several times is held once."""
        built: dict[Path, Method] = {}
        placed = []
        for i, (part, opened, place) in enumerate(zip(self.parts, self.opened, self.places, strict=True)):
            name = opened.path.resolve()
            if name not in built:
                built[name] = opened.method(device)
            placed.append(Placed(built[name], place, part.box, leads=i == self.lead))
        return compose(self.frame, placed).to(device)

    def cameras(self) -> dict[str, Camera]:
        """Cameras of the leading part."""
        return self.opened[self.lead].cameras()

    @property
    def conversion_fault(self) -> str:
        return "is a composition of several; convert its parts, and compose what comes of it"

    @property
    def photographed(self) -> bool:
        return self.opened[self.lead].photographed

    def view_names(self) -> dict[str, list[str]]:
        return self.opened[self.lead].view_names()


@dataclass(frozen=True)
class PlaceSaid:
    """A place as the file may say it; a matrix of four rows is the other way."""

    scale: Annotated[float, between(1e-9, 1e9)] = 1.0
    rotation: float | Row = 0.0
    translation: Point = (0.0, 0.0, 0.0)


Placing = PlaceSaid | tuple[Row, Row, Row, Row]


@dataclass(frozen=True)
class PartSaid:
    """A part as the file says it. place: see `Placing`"""

    source: Name
    place: Any = field(default_factory=dict)
    box: tuple[Point, Point] | None = None


@dataclass(frozen=True)
class CompositionRecord:
    """The file."""

    parts: list[PartSaid]
    lead: int = 0
    format: str = FORMAT


def read_composition(path: Path) -> tuple[list[CompositionPart], int]:
    """The parts that a file names, and the number of the one that leads. Opens none of them."""
    said = files.read_json(path)
    if not isinstance(said, dict) or said.get("format") != FORMAT:
        raise LumigraphError(f"{path} is no composition: it does not say {FORMAT!r}; `lumigraph compose` makes one")
    found = typed(CompositionRecord, said, path, closed=True)
    if found.lead not in range(len(found.parts)):
        raise LumigraphError(f"{path}: part {found.lead} should lead, and there are {len(found.parts)}; correct it")
    return [
        CompositionPart(
            part.source, place_from_json(part.place, path), None if part.box is None else box_of(part.box, path)
        )
        for part in found.parts
    ], found.lead


def write_composition(path: Path, parts: Sequence[CompositionPart], lead: int = 0) -> None:
    """Write a composition's file."""
    said = {"format": FORMAT, "lead": lead, "parts": [part_to_json(part) for part in parts]}
    files.write_json(path, said, "composition")


def relative(source: Path, file: Path) -> str:
    """A part's path as the composition's file should say it: from that file's folder, where both are on one disk."""
    try:
        return Path(os.path.relpath(source.resolve(), file.parent.resolve())).as_posix()
    except ValueError:  # on another drive
        return str(source.resolve())


def part_to_json(part: CompositionPart) -> dict[str, Any]:
    said: dict[str, Any] = {"source": part.source}
    if place := place_to_json(part.place):
        said["place"] = place
    if part.box is not None:
        said["box"] = [list(part.box.lower), list(part.box.upper)]
    return said


def box_of(corners: tuple[Vector, Vector], where: Path | str) -> CropBox:
    """Raises LumigraphError, naming `where`, for corners that hold nothing."""
    if not all(a < b for a, b in zip(*corners, strict=True)):
        raise LumigraphError(
            f"{where}: the box {corners} has nothing between its lower and its upper corner; correct it"
        )
    return CropBox(*corners)


def place_from_json(said: Any, where: Path | str = "a composition") -> Similarity:
    """A similarity from a matrix, or from what it is made of. Raises LumigraphError, naming `where`, for none."""
    place: Placing = typed(Placing, said, where, closed=True)
    if not isinstance(place, PlaceSaid):
        matrix = torch.tensor(place, dtype=torch.float64)
        if not is_similarity(matrix):
            raise LumigraphError(f"{where}: the place {said} does more than move, turn and scale; correct it")
        return Similarity(matrix)
    turn = place.rotation
    if not isinstance(turn, tuple):
        half = 0.5 * math.radians(turn)
        turn = (math.cos(half), 0.0, 0.0, math.sin(half))
    if not any(turn):
        raise LumigraphError(f"{where}: the quaternion {turn} turns nothing; correct it or leave it out")
    rotation = to_matrix(torch.tensor([turn], dtype=torch.float64))[0]
    return Similarity.make(place.scale, rotation, torch.tensor(place.translation, dtype=torch.float64))


def rounded(number: float) -> float:
    """A number as a person would write it: without what rounding has left in the last digits."""
    return float(f"{number:.14g}")


def place_to_json(place: Similarity) -> dict[str, Any]:
    """The scale, rotation and translation of a similarity, without those that change nothing."""
    quaternion = to_quaternion(place.rotation)
    quaternion = quaternion * (1.0 if quaternion[0] > 0 else -1.0) + 0.0  # one of the two, without negative zeros
    said: dict[str, Any] = {"scale": rounded(place.scale), "rotation": [rounded(x) for x in quaternion.tolist()]}
    said["translation"] = [rounded(x) for x in place.matrix[:3, 3].tolist()]
    nothing: dict[str, Any] = {"scale": 1.0, "rotation": [1.0, 0.0, 0.0, 0.0], "translation": [0.0] * 3}
    return {name: value for name, value in said.items() if value != nothing[name]}
