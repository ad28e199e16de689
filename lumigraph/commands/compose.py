"""`lumigraph compose`: place one trained scene in another, or edit the things of a scene graph."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, UseAppendAction

from ..errors import LumigraphError
from ..files import claim
from ..files.options import Overwrite, needed, option
from ..files.ranges import Coordinate, Positive, between
from .common import show, typed

if TYPE_CHECKING:
    from ..datasets.tracks import TrackEdits

Triple = tuple[Coordinate, Coordinate, Coordinate]
Shift = tuple[str, Coordinate, Coordinate, Coordinate]
Rotation = tuple[str, Annotated[float, between(-1e6, 1e6)]]
Pair = tuple[str, str]
Addition = tuple[str, str, Coordinate, Coordinate, Coordinate]
REMOVE = "Remove a thing of the lead's scene graph. Can be given several times, as the other edits."
SHIFT = "Shift a thing of the lead's scene graph, in the frame and unit of its photographs."
ROTATE = "Turn a thing of the lead's scene graph about its upright axis, counterclockwise from above."
SWAP = "Swap the looks of two things of one category of the lead's scene graph."
ADD = "Add a thing with the looks and the track of another one, shifted, to the lead's scene graph."


@dataclass(frozen=True)
class Compose:
    """Place one scene in another, and write both as a composition, a small JSON file.

    `view`, `render` and `export` open it like a run. By default both keep the frames of their photographs, which is
    right for two runs of one capture. With --at, --scale or --turn the second is upright in the first, and --at is its
    position. With --probes the part is a mesh in the lead's light. A composition may be a part of another one: compose
    twice for three scenes. A run of neural-scene-graph needs no second scene: its things can be removed, shifted,
    turned, swapped and added.
    """

    lead: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Scene that gives cameras, background and vertical: a run's folder, a splat file, or a composition."""
    output: Annotated[Path, needed("FILE.json")]
    """The new file. It holds the paths of its parts relative to its own folder."""
    part: Annotated[Positional[Path | None], option("RUN_OR_FILE", "none, with edits of the lead")] = None
    """Scene to place in it; with --probes a mesh (.glb, .obj, .ply ...)."""
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
    remove: UseAppendAction[Annotated[tuple[str, ...], needed("THING", REMOVE)]] = ()
    shift: UseAppendAction[Annotated[tuple[Shift, ...], needed("THING X Y Z", SHIFT)]] = ()
    rotate: UseAppendAction[Annotated[tuple[Rotation, ...], needed("THING DEGREES", ROTATE)]] = ()
    swap: UseAppendAction[Annotated[tuple[Pair, ...], needed("THING THING", SWAP)]] = ()
    add: UseAppendAction[Annotated[tuple[Addition, ...], needed("NAME THING X Y Z", ADD)]] = ()
    overwrite: Overwrite = False

    @property
    def edits(self) -> TrackEdits:
        """Edits of the lead's scene graph."""
        from ..datasets.tracks import TrackEdit, TrackEdits

        changes = [TrackEdit(name, like=like, shift=(x, y, z)) for name, like, x, y, z in self.add]
        changes += [TrackEdit(*pair) for a, b in self.swap for pair in ((a, b), (b, a))]
        changes += [TrackEdit(name, shift=(x, y, z)) for name, x, y, z in self.shift]
        changes += [TrackEdit(name, turn=degrees) for name, degrees in self.rotate]
        return TrackEdits((*changes, *(TrackEdit(name, remove=True) for name in self.remove)))

    def run(self) -> int:
        import torch

        from ..camera.crop import CropBox
        from ..composition import standing
        from ..datasets.tracks import nodes_of
        from ..geometry import Similarity
        from ..large import open_any
        from ..large.opening import without_sample
        from ..run.composition import CompositionPart, LitMeshFile, relative, write_composition

        if self.output.suffix.lower() != ".json":
            raise LumigraphError(f"{self.output} should end in .json, as compositions do; rename it")
        lead_path, part_path = without_sample(self.lead), self.part and without_sample(self.part)
        sources = [lead_path, *([] if part_path is None else [part_path])]
        claim(self.output, "composition", self.overwrite, sources)
        if self.box is not None and not all(a < b for a, b in zip(*self.box, strict=True)):
            raise LumigraphError("The box holds nothing; give --box its lower corner first, then its upper one")
        if self.part is None and self.probes is not None:
            raise LumigraphError("--probes light a mesh; name the mesh after the scene")
        lead, here = open_any(self.lead), Similarity.make(1.0)
        named = [CompositionPart(relative(lead_path, self.output), here, edits=self.edits)]
        if self.part is not None and part_path is not None:
            part = open_any(self.part) if self.probes is None else LitMeshFile(self.part, self.probes)
            place = here
            if any(given is not None for given in (self.at, self.scale, self.turn)):
                spot = None if self.at is None else torch.tensor(self.at, dtype=torch.float64)
                place = standing(part.frame, lead.frame, spot, self.scale or 1.0, self.turn or 0.0)
            box = self.box and CropBox(*self.box)
            probes = None if self.probes is None else relative(self.probes, self.output)
            named.append(CompositionPart(relative(part_path, self.output), place, box, probes))
        elif not self.edits.edits:
            raise LumigraphError(
                f"Name a scene to place in {self.lead}, or edit its scene graph by --remove, --shift, --rotate, --swap "
                "or --add"
            )
        nodes_of(lead.frame.tracks, self.edits)
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
