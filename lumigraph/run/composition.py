"""JSON files that open: compositions, and runs in the canonical frame of their category.

    {
      "format": "lumigraph composition 1",
      "lead": 0,
      "parts": [
        {"source": "runs/courtyard-1"},
        {"source": "toys.spz", "place": {"scale": 0.3, "rotation": 90, "translation": [0.5, 0, -0.4]}},
        {"source": "runs/lego-1", "place": [[...], [...], [...], [0, 0, 0, 1]], "box": [[-1, -1, 0], [1, 1, 1]]},
        {"source": "ball.glb", "place": {"translation": [0.1, 0.2, 0]}, "probes": "courtyard-probes"}
      ]
    }

source: of a part: anything that opens, from this file's folder or absolute
place:  similarity from the source's frame of the part to that of the composition, both those of photographs or files,
        where keyframes and exports lie as well. A 4 x 4 matrix, or a scale, a rotation (a quaternion w, x, y, z, or
        degrees about +z) and a translation, in this order; what is left out changes nothing
edits:  changes of a scene graph's things (neural-scene-graph), in order, each of a `node`: "remove", "shift" [x, y, z]
        and "turn" (degrees about its upright axis), "like" another thing, and its own "track" as in tracks.json. A node
        of a new name adds a thing. Lengths are of the source's frame of the part
box:    two corners in the part's scene frame, as `lumigraph info` prints its bounds and the viewer crops it
probes: of a part that is a mesh: the folder of probes that light it, in the composition's frame; see docs/probes.md
mask:   in place of a box, a file of voxels that `lumigraph segment` has cut; with "keep": "outside" all but them
lead:   the part whose cameras, background and vertical the composition has; by default the first

    {
      "format": "lumigraph canonical 1",
      "source": "../runs/chair-3",
      "place": {"scale": 0.61, "rotation": [0.2, 0.9, -0.3, 0.1], "translation": [0.02, 0.1, -0.05]},
      "bounds": [[-0.5, -0.5, -0.8], [0.5, 0.5, 0.8]],
      "agreement": 0.94
    }

place:     similarity from the run's source frame to the canonical frame
bounds:    two corners of the opaque region, in the canonical frame
agreement: similarity to the mean shape of the category, 1 for the same
"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

from .. import files
from ..camera import Camera
from ..camera.crop import Crop, CropBox
from ..composition import (
    Composed,
    LitComposition,
    LitMesh,
    Placed,
    ShadedMesh,
    VoxelMask,
    compose,
    frame_around,
    read_mask,
)
from ..datasets.scene import Frame
from ..datasets.tracks import TrackEdit, TrackEdits
from ..errors import LumigraphError
from ..files.ranges import Name, Point, Row, Share, between, typed
from ..files.reading import reads
from ..geometry import Similarity, Vector, is_similarity, to_matrix, to_quaternion
from ..light.probes import read_probes
from ..method import Method
from ..method.capabilities import HasGaussians, can
from ..readers.meshes import read_shape
from ..system.memory import ask_for
from .folder import Run
from .opened import Opened

MAX_PARTS = 1000  # parts of a composition, those of its compositions counted as often as they are named
MAX_DEPTH = 32  # compositions inside each other
CLOUD_COPIES = 2  # of each part's Gaussians while they are joined: in their place, and in the whole
FORMAT = "lumigraph composition 1"
CANONICAL_FORMAT = "lumigraph canonical 1"
Keep = Literal["inside", "outside"]


@dataclass(frozen=True)
class CompositionPart:
    """A part as in the file. source, probes, mask: paths as in the file; the rest: see above."""

    source: str
    place: Similarity
    box: CropBox | None = None
    probes: str | None = None
    edits: TrackEdits = TrackEdits(())
    mask: str | None = None
    keep: Keep = "inside"


@dataclass(frozen=True)
class Nesting:
    """Compositions that contain a part, and all opened parts by resolved path."""

    above: tuple[Path, ...] = ()
    opened: dict[Path, Opened] = field(default_factory=dict)


class Composition(Opened):
    """A composition's file, opened with all its parts, each path once. Raises LumigraphError for an invalid one.

    open_part: opens the source of a part
    within:    nesting of this composition in others
    count:     number of parts, those of nested compositions counted each time
    """

    count: int

    def __init__(self, path: Path | str, open_part: Callable[[Path, Nesting], Opened], within: Nesting | None = None):
        self.path, within = Path(path), within or Nesting()
        here = self.path.resolve()
        if here in within.above:
            raise LumigraphError(f"{self.path} holds itself, by way of its parts; take that part out of it")
        if len(within.above) >= MAX_DEPTH:
            raise LumigraphError(
                f"{self.path} lies inside {MAX_DEPTH} compositions, one inside another; "
                "name its parts in a composition nearer to the first"
            )
        self.parts, self.lead = read_composition(self.path)
        inner = Nesting((*within.above, here), within.opened)
        self.opened = [self._open(part, open_part, inner) for part in self.parts]
        self.count = sum(part.count if isinstance(part, Composition) else 1 for part in self.opened)
        if self.count > MAX_PARTS:
            raise LumigraphError(f"{self.path} has {self.count:,} parts, and {MAX_PARTS:,} are the most; name fewer")
        first = self.opened[self.lead].frame
        to_source = self.parts[self.lead].place @ first.to_source
        self.places = [
            to_source.inverse @ part.place @ opened.frame.to_source
            for part, opened in zip(self.parts, self.opened, strict=True)
        ]
        self.places[self.lead] = Similarity.make(1.0)  # to the last digit
        self.crops = [self._crop(part) for part in self.parts]
        every = zip(self.opened, self.places, self.crops, strict=True)
        others = [(opened.frame, place, boxed(crop)) for opened, place, crop in every]
        del others[self.lead]
        self.frame = replace(frame_around(first, others), source_from_scene=to_source.rows)

    def _open(self, part: CompositionPart, open_part: Callable[[Path, Nesting], Opened], inner: Nesting) -> Opened:
        """Open the scene or mesh of a part; each scene is opened once."""
        place = self.path.parent / files.expanded(part.source)
        if not files.exists(place):
            raise LumigraphError(
                f"{self.path} names {part.source} as a part, but there is no {place}; correct its path"
            )
        if part.probes is not None:
            return LitMeshFile(place, self.path.parent / files.expanded(part.probes))
        key = place.resolve()
        if key not in inner.opened or key in inner.above:
            inner.opened[key] = open_part(place, inner)
        return inner.opened[key]

    def _crop(self, part: CompositionPart) -> Crop | None:
        """Box or mask of a part; None for all of it."""
        if part.mask is None:
            return part.box
        return replace(read_mask(self.path.parent / files.expanded(part.mask)), outside=part.keep == "outside")

    def method(self, device: torch.device | str = "cpu") -> Method:
        """All parts in one picture. A source used several times is loaded once.

        Raises LumigraphError where its clouds, one for each part, do not fit into memory."""
        built: dict[Path, Method] = {}
        placed = []
        for i, (part, opened, place) in enumerate(zip(self.parts, self.opened, self.places, strict=True)):
            if isinstance(opened, LitMeshFile):
                to_probes = self.frame.to_export @ place
                placed.append(Placed(opened.lit(to_probes), place, self.crops[i]))
                continue
            name = opened.path.resolve()
            if name not in built:
                built[name] = opened.method(device)
            placed.append(Placed(self._edited(built[name], part, opened), place, self.crops[i], leads=i == self.lead))
        needed = CLOUD_COPIES * sum(cloud_bytes(part.method) for part in placed)
        ask_for(needed, torch.device(device), f"{self.path} with {self.count:,} parts", "name fewer parts")
        lit = any(isinstance(part.method, LitMesh) for part in placed)
        return (LitComposition if lit else compose)(self.frame, placed).to(device)

    def _edited(self, method: Method, part: CompositionPart, opened: Opened) -> Method:
        """The part's method with the part's edits. Raises LumigraphError for one without a scene graph."""
        if not part.edits.edits:
            return method
        if TrackEdits not in method.takes:
            raise LumigraphError(
                f"{self.path} edits things of {part.source}, which is no scene graph; train neural-scene-graph"
            )
        return method.given(part.edits.transformed(opened.frame.to_source.inverse))

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


class LitMeshFile(Opened):
    """A mesh in a file, in the light of probes: a part of a composition, which opens nowhere else."""

    def __init__(self, path: Path, probes: Path):
        self.path = path
        self.shape = read_shape(path, path.stem)
        if not len(self.shape.mesh.faces):
            raise LumigraphError(f"{path} holds points and no triangles; name a mesh")
        self.grid = read_probes(probes)
        self.frame = self.shape.frame

    def lit(self, to_probes: Similarity) -> LitMesh:
        """The mesh in the probes' light. to_probes: from the mesh's scene frame to that of the probes"""
        return LitMesh(self.frame, ShadedMesh.of(self.shape.mesh), self.grid, to_probes)

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The mesh where its file has it, in the light of probes in the same frame."""
        return self.lit(self.frame.to_source)


def cloud_bytes(method: Method) -> int:
    """Bytes of the Gaussians that a method joins for a picture; 0 of one that has none."""
    if isinstance(method, Composed):
        return sum(cloud_bytes(part.method) for part in method.pieces)
    held = (*method.parameters(), *method.buffers()) if can(method, HasGaussians) else ()
    return sum(x.numel() * x.element_size() for x in held)


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
    probes: Name | None = None
    edits: tuple[TrackEdit, ...] = ()
    mask: Name | None = None
    keep: Keep = "inside"


@dataclass(frozen=True)
class CompositionRecord:
    """The file."""

    parts: list[PartSaid]
    lead: int = 0
    format: str = FORMAT


@reads()
def read_composition(path: Path) -> tuple[list[CompositionPart], int]:
    """The parts that a file names, and the number of the one that leads. Opens none of them."""
    said = files.read_json(path)
    if not isinstance(said, dict) or said.get("format") != FORMAT:
        raise LumigraphError(f"{path} is no composition: it does not say {FORMAT!r}; `lumigraph compose` makes one")
    found = typed(CompositionRecord, said, path, closed=True)
    if found.lead not in range(len(found.parts)):
        raise LumigraphError(f"{path}: part {found.lead} should lead, and there are {len(found.parts)}; correct it")
    parts = []
    for part in found.parts:
        place = place_from_json(part.place, path)
        for track in (edit.track for edit in part.edits if edit.track is not None):
            track.check()
        if part.box is not None and part.mask is not None:
            raise LumigraphError(f"{path}: {part.source} has a box and a mask; leave one of them out")
        box, edits = None if part.box is None else box_of(part.box, path), TrackEdits(part.edits)
        parts.append(CompositionPart(part.source, place, box, part.probes, edits, part.mask, part.keep))
    if found.parts[found.lead].probes is not None:
        raise LumigraphError(f"{path}: a mesh should lead, and has no cameras; correct `lead`")
    return parts, found.lead


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
    if part.probes is not None:
        said["probes"] = part.probes
    if part.edits.edits:
        usual = asdict(TrackEdit(""))
        said["edits"] = [{k: v for k, v in asdict(edit).items() if v != usual[k]} for edit in part.edits.edits]
    if part.mask is not None:
        said |= {"mask": part.mask, "keep": part.keep}
    return said


def boxed(crop: Crop | None) -> CropBox | None:
    """Bounding box of a crop; None without one, for a sphere, and for the outside of a mask."""
    if isinstance(crop, VoxelMask):
        return None if crop.outside else crop.box
    return crop if isinstance(crop, CropBox) else None


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


@dataclass(frozen=True)
class CanonicalRecord:
    """The file."""

    source: Name
    place: Any
    bounds: tuple[Point, Point]
    agreement: Share
    format: str = CANONICAL_FORMAT


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
    return replace(
        frame,
        bounds=bounds,
        reach=reach,
        near=frame.near * scale,
        source_from_scene=rows,
        forward=None,
        scale=1.0,
        origin=None,
        metric=False,
    )


def write_canonicalised(
    path: Path, source: str, place: Similarity, bounds: tuple[Vector, Vector], agreement: float
) -> None:
    """Write the file of one run, in a folder that is made as a whole."""
    shown = [[round(x, 6) for x in corner] for corner in bounds]
    said = {"format": CANONICAL_FORMAT, "source": source, "place": place_to_json(place), "bounds": shown}
    files.write_json(path, said | {"agreement": round(agreement, 4)}, ours=True)
