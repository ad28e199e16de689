"""convert.json: what making one method's run of another's came to; and what config.json says of it until then."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from .. import files
from ..files.ranges import Count, Lasted, Name, Tally, typed
from .settings import Settings

CONVERT_FILE = "convert.json"
LearntFrom = Literal["photographs", "renderings of the source"]


@dataclass(frozen=True)
class ConversionStart:
    """A conversion that is under way, as `converted` in config.json.

    source:      the run or file that is converted
    learnt_from: what the student goes on learning from
    taking_over: seconds that beginning as the teacher took
    """

    source: str
    learnt_from: LearntFrom
    taking_over: Lasted

    def within(self, settings: Settings) -> Settings:
        """Settings that say so."""
        return replace(settings, said=settings.said | {"converted": asdict(self)})

    @staticmethod
    def of(settings: Settings, file: Path) -> ConversionStart | None:
        """Read from settings; None for a run that was trained from scratch. file: to name what is damaged in it"""
        told = settings.said.get("converted")
        return None if told is None else typed(ConversionStart, told, f"{file}: converted")


@dataclass(frozen=True)
class MeasuredModel:
    """One of the two.

    bytes:   of the model, as it is stored
    seconds: that rendering a view took
    psnr:    of held-out views against their photographs, in dB; None where these are not at hand
    """

    method: Name
    bytes: Tally
    seconds: Lasted
    psnr: float | None = None


@dataclass(frozen=True)
class Converted:
    """Teacher and student.

    source:  the run or file that was converted
    how:     by the teacher's field, its Gaussians, the depth that it shows, or its pictures alone
    learnt_from: what the student went on learning from
    psnr:    of the student's held-out views against the teacher's, in dB
    views:   how many
    taking_over: seconds that beginning as the teacher's field took
    steps, seconds: of learning on
    """

    source: str
    how: Literal["field", "gaussians", "depth", "pictures"]
    learnt_from: LearntFrom
    teacher: MeasuredModel
    student: MeasuredModel
    psnr: float
    views: Count
    taking_over: Lasted
    steps: Tally
    seconds: Lasted

    def write(self, folder: Path) -> None:
        files.write_json(folder / CONVERT_FILE, asdict(self), ours=True)

    @staticmethod
    def read(folder: Path) -> Converted | None:
        """Read the record of a converted run; None for other runs. Raises LumigraphError for a damaged record."""
        return files.read_json(folder / CONVERT_FILE, Converted) if files.is_file(folder / CONVERT_FILE) else None
