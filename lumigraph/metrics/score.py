"""Score: what was measured, in which unit, and which way is better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from ..files.ranges import between

# Of one view, and of views' means: key, name, unit, better, digits.
KEYS = (
    ("psnr", "PSNR", "dB", "higher", 2),
    ("ssim", "SSIM", "", "higher", 4),
    ("lpips", "LPIPS", "", "lower", 4),
    ("clean_psnr", "clean PSNR", "dB", "higher", 2),
)


@dataclass(frozen=True)
class Score:
    """A figure that says how well something was done.

    unit:   as a user reads it; empty for a plain number
    digits: after the point, as it is shown
    """

    name: str
    value: float
    unit: str
    better: Literal["higher", "lower"]
    digits: Annotated[int, between(0, 16)] = 4

    def __str__(self) -> str:
        return f"{self.value:.{self.digits}f} {self.unit}".rstrip()

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def scores_of(result: dict[str, Any]) -> list[Score]:
    """The scores in what eval.json says, in what it says of one view, or in a benchmark's row; the headline first."""
    if "scores" in result:
        return [Score(**score) for score in result["scores"]]
    return [
        Score(name, result[key], unit, better, digits)  # type: ignore[arg-type]
        for key, name, unit, better, digits in KEYS
        if result.get(key) is not None
    ]


def named(scores: Sequence[Score], name: str) -> Score | None:
    """The score of a name, if it is among them."""
    return next((score for score in scores if score.name == name), None)
