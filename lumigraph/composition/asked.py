"""What many parts can be told, found out by asking each of them once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median

from ..controls import Control
from ..scene import Photograph
from .exposures import EXPOSURE, own_exposure, own_range
from .placed import Placed


@dataclass(frozen=True)
class Asked:
    """What parts say of themselves.

    photographs: whether each finds its own appearance in a photograph
    controls:    that any of them has, the first of each name, but for exposure and those that name photographs
    usual:       log2 of the exposure that is usual among them, the median of theirs; None where none of them knows
    exposures:   the least and the most that any learnt from, log2 of them; None where none has a choice
    """

    photographs: bool
    controls: tuple[Control, ...]
    usual: float | None
    exposures: tuple[float, float] | None

    @classmethod
    def of(cls, parts: Iterable[Placed]) -> Asked:
        """One part after the other is asked, and none is held."""
        photographs, controls = True, dict[str, Control]()
        usual, ranges = list[float](), list[tuple[float, float]]()
        for part in parts:
            photographs &= Photograph in part.method.takes
            for control in part.method.controls:
                if not control.of_photographs and control.name != EXPOSURE:
                    controls.setdefault(control.name, control)
            if (own := own_exposure(part)) is not None:
                usual.append(own)
            if (reach := own_range(part)) is not None:
                ranges.append(reach)
        return cls(
            photographs,
            tuple(controls.values()),
            median(usual) if usual else None,
            (min(least for least, _ in ranges), max(most for _, most in ranges)) if ranges else None,
        )
