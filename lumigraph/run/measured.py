"""Measurements of a run: the lines of metrics.jsonl, and the contents of eval.json and related files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import files
from ..errors import LumigraphError
from ..files.ranges import Lasted, Tally, typed
from ..metrics import Score


@dataclass(frozen=True)
class Line:
    """A line of metrics.jsonl, as far as anybody relies on it. Not every method has a PSNR or a loss."""

    step: Tally
    seconds: Lasted
    terms: dict[str, float] = field(default_factory=dict)
    statistics: dict[str, float] = field(default_factory=dict)
    psnr: float = 0.0
    mean_loss: float = 0.0
    passes: float = 0.0


@dataclass(frozen=True)
class Protocol:
    """Evaluation protocol in eval.json, the fields in use: number of compared views or shapes, total, split."""

    split: str
    of: Tally = 0
    views: Tally | None = None
    shapes: Tally | None = None
    members: Tally | None = None
    resolution: str | list[str] = ""
    background: list[float] | None = None
    masked: bool = False
    halves: str | None = None

    def __post_init__(self) -> None:
        if self.views is None and self.shapes is None:
            raise ValueError("should say how many `views` or `shapes` were compared")


@dataclass(frozen=True)
class ViewScores:
    """The scores of one view."""

    name: str
    psnr: float
    ssim: float | None = None
    lpips: float | None = None
    clean_psnr: float | None = None


@dataclass(frozen=True)
class Size:
    """The scores of all views of one size, of which there are so many."""

    views: Tally
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    clean_psnr: float | None = None


@dataclass(frozen=True)
class EvaluationRecord:
    """Contents of eval.json, the fields in use. scores: means of all, by name"""

    protocol: Protocol
    steps: Tally
    views: list[ViewScores] = field(default_factory=list)
    by_resolution: dict[str, Size] = field(default_factory=dict)
    scores: list[Score] = field(default_factory=list)
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    clean_psnr: float | None = None
    seconds_per_view: Lasted | None = None
    training_seconds: Lasted | None = None
    evaluated_on: str = "unknown"


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The lines of metrics.jsonl; those that are damaged, as one that a kill cut short, are passed over."""
    if not path.exists():
        return []
    rows = []
    with files.explained(path):
        lines = path.read_bytes().splitlines()
    for line in lines:
        try:
            row = files.from_json(line, path)
            typed(Line, row, path)
        except LumigraphError:
            continue
        rows.append({"terms": {}, "statistics": {}} | row)
    return rows


def read_evaluation(path: Path) -> dict[str, Any]:
    """Read eval.json. Raises LumigraphError, naming the file, if it is invalid."""
    said = files.read_json(path)
    typed(EvaluationRecord, said, path)
    return {"lpips": None, "evaluated_on": "unknown"} | {key: x for key, x in said.items() if x is not None}
