"""One exposure for all blocks: each counts stops from what its own photographs usually had."""

from __future__ import annotations

from dataclasses import replace

from .placed import Placed

EXPOSURE = "exposure"  # the control's name


def own_exposure(part: Placed) -> float | None:
    """log2 of the exposure that is usual in one part; None where it knows of none."""
    return getattr(part.method, "usual_exposure", None)


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
