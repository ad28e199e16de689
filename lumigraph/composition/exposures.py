"""One exposure for all blocks: each counts stops from what its own photographs usually had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import median

from .placed import Placed

EXPOSURE = "exposure"  # the control's name


def usual_exposure(parts: Sequence[Placed]) -> float | None:
    """log2 of the exposure that is usual among parts, the median of theirs; None where none of them knows."""
    known = [found for part in parts if (found := own_exposure(part)) is not None]
    return median(known) if known else None


def own_exposure(part: Placed) -> float | None:
    """log2 of the exposure that is usual in one part; None where it knows of none."""
    return getattr(part.method, "usual_exposure", None)


def exposed(part: Placed, exposure: float | None) -> Placed:
    """The same part as if photographed with an exposure, log2 of it, or as near to it as it learnt from."""
    control = next((x for x in part.method.controls if x.name == EXPOSURE), None)
    usual = own_exposure(part)
    if control is None or control.range is None or usual is None or exposure is None:
        return part
    least, most = control.range
    stops = min(max(exposure - usual, least), most)
    return replace(part, method=part.method.given(**{EXPOSURE: stops}))


def span(parts: Sequence[Placed]) -> tuple[float, float] | None:
    """The least and the most exposure, log2 of it, that any part learnt from; None where none has a choice."""
    ranges = [
        (own + control.range[0], own + control.range[1])
        for part in parts
        for control in part.method.controls
        if control.name == EXPOSURE and control.range is not None and (own := own_exposure(part)) is not None
    ]
    return (min(a for a, _ in ranges), max(b for _, b in ranges)) if ranges else None
