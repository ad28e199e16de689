"""`lumigraph compose`: place one trained scene in another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files import claim
from ..files.ranges import Coordinate, Positive, between
from .common import show, typed
from .options import Overwrite, needed, option

Triple = tuple[Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class Compose:
    """Place one scene in another, and write both as a composition, a small JSON file.

    `view`, `render` and `export` open it like a run. By default both keep the frames of their photographs, which is
    right for two runs of one capture. With --at, --scale or --turn the second is upright in the first, and --at is its
    position. With --probes the part is a mesh in the lead's light.
    A composition may be a part of another one: compose twice for three scenes.
    """

    lead: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Scene that gives cameras, background and vertical: a run's folder, a splat file, or a composition."""
    part: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Scene to place in it; with --probes a mesh (.glb, .obj, .ply ...)."""
    output: Annotated[Path, needed("FILE.json")]
    """The new file. It holds the paths of its parts relative to its own folder."""
    at: Annotated[Triple | None, option("X Y Z", "the lead's lower side")] = None
    """Position of the middle of the part's lower side, in the frame of the lead's photographs."""
    scale: Annotated[Positive | None, option("TIMES", "1")] = None
    """Scale of the part: units of the lead's photographs per unit of its own."""
    turn: Annotated[Annotated[float, between(-1e6, 1e6)] | None, option("DEGREES", "0")] = None
    """Rotation of the part about the vertical, counterclockwise from above."""
    box: Annotated[tuple[Triple, Triple] | None, option("X Y Z X Y Z", "all of it")] = None
    """Crop the part to the box between two corners, in its scene's frame; `lumigraph info` shows its bounds."""
    probes: Annotated[Path | None, option("FOLDER", "none")] = None
    """Light probes of the lead, by `lumigraph export probes`: they light a mesh, which casts its shadow."""
    overwrite: Overwrite = False

    def run(self) -> int:
        import torch

        from ..camera.crop import CropBox
        from ..composition import standing
        from ..geometry import Similarity
        from ..run import open_any
        from ..run.composition import CompositionPart, LitMeshFile, relative, write_composition

        if self.output.suffix.lower() != ".json":
            raise LumigraphError(f"{self.output} should end in .json, as compositions do; rename it")
        claim(self.output, "composition", self.overwrite, [self.lead, self.part])
        if self.box is not None and not all(a < b for a, b in zip(*self.box, strict=True)):
            raise LumigraphError("The box holds nothing; give --box its lower corner first, then its upper one")
        lead = open_any(self.lead)
        part = open_any(self.part) if self.probes is None else LitMeshFile(self.part, self.probes)
        place = Similarity.make(1.0)
        if any(given is not None for given in (self.at, self.scale, self.turn)):
            spot = None if self.at is None else torch.tensor(self.at, dtype=torch.float64)
            place = standing(part.frame, lead.frame, spot, self.scale or 1.0, self.turn or 0.0)
        named = [CompositionPart(relative(self.lead, self.output), Similarity.make(1.0))]
        probes = None if self.probes is None else relative(self.probes, self.output)
        named.append(CompositionPart(relative(self.part, self.output), place, self.box and CropBox(*self.box), probes))
        write_composition(self.output, named)
        opened = open_any(self.output)
        low, high = opened.frame.bounds
        rows = {
            "composition": str(self.output),
            "bounds": f"({', '.join(f'{x:.3g}' for x in low)}) to ({', '.join(f'{x:.3g}' for x in high)})",
            "next": typed("view", self.output),
        }
        show(rows)
        return 0
