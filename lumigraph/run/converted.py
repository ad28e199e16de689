"""convert.json: what making one method's run of another's came to."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from .. import files
from ..ranges import Count, Lasted, Name, Tally

NAME = "convert.json"


@dataclass(frozen=True)
class Held:
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
    learnt_from: Literal["photographs", "renderings of the source"]
    teacher: Held
    student: Held
    psnr: float
    views: Count
    taking_over: Lasted
    steps: Tally
    seconds: Lasted

    def write(self, folder: Path) -> None:
        files.write_json(folder / NAME, asdict(self), ours=True)

    @staticmethod
    def read(folder: Path) -> Converted | None:
        """What a run's folder says; None where it was not converted. Raises LumigraphError for what is damaged."""
        return files.read_json(folder / NAME, Converted) if files.is_file(folder / NAME) else None
