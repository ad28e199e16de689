"""A run in its category's canonical frame, written by `lumigraph canonicalise`: rotated, translated and scaled.

    {
      "format": "lumigraph canonical 1",
      "source": "../runs/chair-3",
      "place": {"scale": 0.61, "rotation": [0.2, 0.9, -0.3, 0.1], "translation": [0.02, 0.1, -0.05]},
      "bounds": [[-0.5, -0.5, -0.8], [0.5, 0.5, 0.8]],
      "agreement": 0.94
    }

source:    the run, from this file's folder or absolute
place:     similarity from the run's source frame to the canonical frame; as a composition says it
bounds:    two corners of what is opaque, in the canonical frame
agreement: how alike it is to what all of its kind have in common, 1 for the same
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from .. import files
from ..camera import Camera
from ..composition import Placed, compose
from ..datasets.scene import Frame, Vector
from ..files.ranges import Name, Point, Share, typed
from ..geometry import Similarity
from ..method import Method
from .composition import box_of, place_from_json, place_to_json
from .folder import Run
from .opened import Opened

FORMAT = "lumigraph canonical 1"


@dataclass(frozen=True)
class CanonicalRecord:
    """The file."""

    source: Name
    place: Any
    bounds: tuple[Point, Point]
    agreement: Share
    format: str = FORMAT


class Canonicalised(Opened):
    """A run in the canonical frame of its category, in which exports of it lie, and which stands upright in
    compositions. Raises LumigraphError for a file that is none, and where the run is gone."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        said = typed(CanonicalRecord, files.read_json(self.path), self.path, closed=True)
        box_of(said.bounds, self.path)
        self.agreement = said.agreement
        self.run = Run(self.path.parent / files.expanded(said.source))
        self.place = place_from_json(said.place, self.path) @ self.run.frame.to_source
        self.frame = canonical_frame(self.run.frame, self.place.scale, said.bounds)

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The run's method at its place."""
        return compose(self.frame, [Placed(self.run.method(device), self.place, leads=True)]).to(device)

    def cameras(self) -> dict[str, Camera]:
        """Cameras of the run, in the canonical frame."""
        return {split: cameras.transformed(self.place.matrix) for split, cameras in self.run.cameras().items()}

    @property
    def conversion_fault(self) -> str:
        return f"is a run at another place; convert {self.run.path}, and align that again"

    @property
    def photographed(self) -> bool:
        return self.run.photographed

    def view_names(self) -> dict[str, list[str]]:
        return self.run.view_names()


def canonical_frame(frame: Frame, scale: float, bounds: tuple[Vector, Vector]) -> Frame:
    """The frame of a run that was moved into the canonical one, which is its own source.

    scale: canonical units to one of the run's scene
    """
    farthest = max(abs(x) for corner in bounds for x in corner)
    if frame.is_open:
        farthest = max(farthest, frame.reach * scale)
    reach = 2.0 ** math.ceil(math.log2(max(farthest, 1.0)))
    rows = Similarity.make(1.0).rows
    return replace(frame, bounds=bounds, reach=reach, near=frame.near * scale, source_from_scene=rows, forward=None)


def write_canonicalised(
    path: Path, source: str, place: Similarity, bounds: tuple[Vector, Vector], agreement: float
) -> None:
    """Write the file of one run, in a folder that is made as a whole."""
    shown = [[round(x, 6) for x in corner] for corner in bounds]
    said = {"format": FORMAT, "source": source, "place": place_to_json(place), "bounds": shown}
    files.write_json(path, said | {"agreement": round(agreement, 4)}, ours=True)
