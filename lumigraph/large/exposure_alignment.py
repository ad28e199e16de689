"""Exposure alignment: all blocks are rendered with one exposure. Stops count from the median of its photographs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from statistics import median

from ..composition import Placed
from ..datasets.scene import Photograph
from ..method.capabilities import HasExposure, can, needs
from ..method.controls import Control

EXPOSURE = "exposure"  # the control's name


def own_exposure(part: Placed) -> float | None:
    """log2 of the exposure that is usual in one part; None where it knows of none."""
    return needs(part.method, HasExposure).usual_exposure if can(part.method, HasExposure) else None


def exposed(part: Placed, exposure: float | None) -> Placed:
    """The same part as if photographed with an exposure, log2 of it, or as near to it as it learnt from."""
    usual, reach = own_exposure(part), own_range(part)
    if usual is None or reach is None or exposure is None:
        return part
    stops = min(max(exposure, reach[0]), reach[1]) - usual
    return replace(part, method=part.method.given(**{EXPOSURE: stops}))


def own_range(part: Placed) -> tuple[float, float] | None:
    """The least and the most exposure, log2 of it, that one part learnt from; None where it has no choice."""
    control = next((x for x in part.method.controls if x.name == EXPOSURE), None)
    own = own_exposure(part)
    if control is None or control.range is None or own is None:
        return None
    return own + control.range[0], own + control.range[1]


@dataclass(frozen=True)
class Asked:
    """Controls and exposures of many parts, each of which is asked once.

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
