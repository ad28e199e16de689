"""`lumigraph bench views`: how many photographs methods need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ...ranges import Count, Seconds, Steps
from ..common import option, say
from .cells import Cells


@dataclass(frozen=True, kw_only=True)
class BenchViews(Cells):
    """Train methods on fewer and fewer photographs of a scene, and compare the same held-out views.

    The photographs are spread evenly over the cameras, and fewer are always among more. Otherwise as `lumigraph bench
    methods`; the chart shows PSNR over the number of photographs.
    """

    views: Annotated[tuple[Count | Literal["all"], ...], option("N")] = (2, 3, 4, 6, 9, 15, 25, 50, "all")
    """How many photographs to learn from; numbers that a scene does not have are left out."""
    seconds: Annotated[Seconds | None, option("S", "60")] = None
    """Train for so long."""
    steps: Annotated[Steps | None, option("N", "as long as --seconds")] = None
    """Train for so many steps instead."""

    def run(self) -> int:
        seconds = () if self.seconds is None else (self.seconds,)
        return self.conduct(seconds, () if self.steps is None else (self.steps,), self.possible)

    def possible(self, source: str) -> list[int | None]:
        """Those of the numbers that a scene has photographs for; None is all."""
        from ...capture import open_scene

        there = len(open_scene(source, downscale=self.downscale, reader=self.reader).splits["train"])
        left_out = [views for views in self.views if views != "all" and views > there]
        if left_out:
            say(f"{source} has {there} photographs to learn from; leaving out {', '.join(map(str, left_out))}")
        return [None if views == "all" else views for views in self.views if views not in left_out]
