"""Record files of a run: cameras.json, poses of its photographs, so that films need no photographs; the lines of
metrics.jsonl; the contents of eval.json and related files."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from .. import files
from ..camera import Camera
from ..camera.lens import Lens
from ..datasets.scene import Scene
from ..errors import LumigraphError, LumigraphWarning
from ..files.names import counted
from ..files.ranges import Coordinate, Lasted, Row, Side, Tally, typed
from ..files.reading import reads
from ..geometry import RIGID_TOLERANCE
from ..metrics import Score

MAX_PIXELS = 10**9  # of one picture
COMPARED = "views", "shapes", "renderings", "frames"  # kinds of what evaluations compare; a protocol counts one
MAX_NAMES = 3  # photographs that a warning names


@dataclass(frozen=True)
class Line:
    """A line of metrics.jsonl, the fields in use. Not every method has a PSNR or a loss."""

    step: Tally
    seconds: Lasted
    terms: dict[str, float] = field(default_factory=dict)
    statistics: dict[str, float] = field(default_factory=dict)
    psnr: float = 0.0
    mean_loss: float = 0.0
    passes: float = 0.0


@dataclass(frozen=True)
class Protocol:
    """Evaluation protocol in eval.json, the fields in use: number of compared views, shapes, renderings of words or
    frames of a walk, total, split."""

    split: str
    of: Tally = 0
    views: Tally | None = None
    shapes: Tally | None = None
    renderings: Tally | None = None
    frames: Tally | None = None
    members: Tally | None = None
    resolution: str | list[str] = ""
    background: list[float] | None = None
    masked: bool = False
    halves: str | None = None
    poses: str | None = None

    def __post_init__(self) -> None:
        if all(getattr(self, kind) is None for kind in COMPARED):
            raise ValueError("should say how many `views`, `shapes`, `renderings` or `frames` were compared")


def compared_kind(protocol: dict[str, Any]) -> str:
    """Kind of the compared items of an evaluation."""
    return next(kind for kind in COMPARED if kind in protocol)


@dataclass(frozen=True, kw_only=True)
class Means:
    """Mean scores of some views."""

    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    clean_psnr: float | None = None
    moving_psnr: float | None = None
    moving_ssim: float | None = None


@dataclass(frozen=True, kw_only=True)
class ViewScores(Means):
    """The scores of one view."""

    name: str
    psnr: float


@dataclass(frozen=True, kw_only=True)
class PartScores(Means):
    """The scores of all views of one size, or of one kind of held-out views. views: number of them"""

    views: Tally


@dataclass(frozen=True, kw_only=True)
class EvaluationRecord(Means):
    """Contents of eval.json, the fields in use. scores: means of all, by name"""

    protocol: Protocol
    steps: Tally
    views: list[ViewScores] = field(default_factory=list)
    by_resolution: dict[str, PartScores] = field(default_factory=dict)
    by_held_out: dict[str, PartScores] = field(default_factory=dict)
    scores: list[Score] = field(default_factory=list)
    seconds_per_view: Lasted | None = None
    training_seconds: Lasted | None = None
    evaluated_on: str = "unknown"


def flat(row: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A row of metrics.jsonl or options without nesting: {"terms": {"tv": 1}} is {"loss/tv": 1}; lists by number."""
    found = dict[str, Any]()
    for name, value in row.items():
        name = prefix + {"terms": "loss", "statistics": "figures"}.get(name, str(name))
        inner: Any = dict(enumerate(value)) if isinstance(value, list) else value
        found |= flat(inner, f"{name}/") if isinstance(inner, Mapping) else {name: value}
    return found


@reads()
def read_rows(path: Path) -> list[dict[str, Any]]:
    """The lines of metrics.jsonl; damaged ones, such as a truncated last line, are skipped."""
    if not path.exists():
        return []
    rows = []
    lines = files.read_bytes(path).splitlines()
    for line in lines:
        try:
            row = files.from_json(line, path)
            typed(Line, row, path)
        except LumigraphError:
            continue
        rows.append({"terms": {}, "statistics": {}} | row)
    return rows


@reads()
def read_evaluation(path: Path) -> dict[str, Any]:
    """Read eval.json. Raises LumigraphError, naming the file, if it is invalid."""
    said = files.read_json(path)
    typed(EvaluationRecord, said, path)
    return {"lpips": None, "evaluated_on": "unknown"} | {key: x for key, x in said.items() if x is not None}


@dataclass(frozen=True)
class CamerasRecord:
    """Contents of cameras.json: one row per camera, and row numbers by split. lens: see `Lens.to_json`; digests: of the
    photographs' files, see `Scene`; masked: whether some may have masks"""

    names: list[str]
    splits: dict[str, list[int]]
    pose: list[tuple[Row, Row, Row]]
    lens: dict[str, Any]
    size: list[tuple[Side, Side]]
    time: list[Coordinate] | None = None
    digests: list[str] = field(default_factory=list)
    masked: bool = True


def cameras_json(scene: Scene) -> dict[str, Any]:
    camera = scene.cameras.to("cpu")
    return {
        "names": list(scene.names),
        "splits": {name: index.tolist() for name, index in scene.splits.items()},
        "pose": camera.pose.tolist(),
        "lens": camera.lens.to_json(),
        "size": camera.size.tolist(),
        "time": None if camera.time is None else camera.time.tolist(),
        **({"digests": scene.digests} if any(scene.digests) else {}),
        "masked": scene.images.may_have_masks,
    }


def warn_of_changes(known: Mapping[str, str], data: Scene, run: Path) -> None:
    """Warn of photographs that differ from the training photographs. known: digests by name"""
    own = dict(zip(data.names, data.digests, strict=False))
    if changed := [name for name, digest in known.items() if digest and own.get(name, digest) not in ("", digest)]:
        more = f" and {len(changed) - MAX_NAMES} more" if len(changed) > MAX_NAMES else ""
        warnings.warn(
            f"{counted(len(changed), 'photograph')} of {data.source} changed since {run} learnt from them: "
            f"{', '.join(changed[:MAX_NAMES])}{more}; restore them, or train a new run",
            LumigraphWarning,
            stacklevel=3,
        )


@reads()
def read_cameras(path: Path) -> CamerasRecord:
    """Read cameras.json. Raises LumigraphError, naming it, if its rows are inconsistent."""
    said = files.read_json(path, CamerasRecord)
    count = len(said.pose)
    rows = {"names": len(said.names), "size": len(said.size), "time": count if said.time is None else len(said.time)}
    rows |= {"digests": len(said.digests)} if said.digests else {}
    if wrong := [f"{number} of {name}" for name, number in rows.items() if number != count]:
        raise LumigraphError(f"{path} has {count} poses, but {', '.join(wrong)}; restore it from a copy")
    if not said.splits.get("train") or any(i not in range(count) for index in said.splits.values() for i in index):
        raise LumigraphError(f"{path} has splits that name other cameras than its {count}, or none to learn from")
    if any(width * height > MAX_PIXELS for width, height in said.size):
        raise LumigraphError(f"{path} has pictures of more than {MAX_PIXELS:,} pixels; correct their size")
    return said


def cameras_of(path: Path, photographs: int) -> dict[str, Camera]:
    """Cameras by split. photographs: their number; further cameras belong to reduced copies of the same ones

    Raises LumigraphError, naming the file, for invalid cameras.
    """
    said = read_cameras(path)
    lens = Lens.from_json(said.lens, path)
    pose = torch.tensor(said.pose)
    axes = pose[:, :, :3].double()
    if len(lens) != len(pose) or float((axes @ axes.mT - torch.eye(3)).abs().max()) > RIGID_TOLERANCE:
        raise LumigraphError(f"{path} has poses that are not rigid, or not a lens for each; restore it from a copy")
    time = None if said.time is None else torch.tensor(said.time)
    camera = Camera(pose, lens, torch.tensor(said.size), time, torch.arange(len(pose)) % max(photographs, 1))
    return {name: camera[torch.tensor(index, dtype=torch.int64)] for name, index in said.splits.items()}
