"""`lumigraph convert`: a trained run becomes one of another method."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from ..console import console
from ..errors import LumigraphError
from ..quality import Quality
from ..ranges import Count, Seconds, Seed, Steps
from .common import about_quality, choose_device, method_config, option, show, told_budget, typed
from .compress import size

DEFAULT_SECONDS = 30.0
LONG = 4096  # letters; a table cuts its lines where the console ends
ABOUT = " What began as a field has half of it behind it."


@dataclass(frozen=True)
class Convert:
    """Make a run of another method out of a trained one, or out of a splat file.

    The new one begins as what the old one holds: grids and networks by its density and colour at points, Gaussians on
    its surfaces. Then it learns on, from the photographs where they are at hand, otherwise from what the old one
    renders. NEW/convert.json says how alike the two are in views that neither has learnt from, and what each takes.
    The same command goes on after Ctrl-C. `lumigraph convert RUN METHOD --help` adds the method's own options.
    """

    source: Annotated[Positional[Path | None], arg(metavar="RUN_OR_FILE", help_behavior_hint="")] = None
    """Folder of a run, which stays as it is, or a splat file."""
    method: Annotated[Positional[str | None], arg(metavar="METHOD", help_behavior_hint="")] = None
    """What to make of it, for example plenoxels."""
    output: Annotated[Path | None, arg(metavar="NEW", help_behavior_hint="")] = None
    """New folder for the run."""
    list: bool = False
    """Say what goes into what, and how, and do nothing else."""
    seconds: Annotated[Seconds | None, option("S", f"{DEFAULT_SECONDS:.0f}")] = None
    """Learn on for so long, once the old one is taken over."""
    steps: Annotated[Steps | None, option("N", "as long as --seconds")] = None
    """Learn on for so many steps instead."""
    quality: Annotated[Quality | None, option("draft|good|best", "as long as --seconds", about_quality() + ABOUT)] = (
        None
    )
    distil: bool = False
    """Learn from what the old one renders, even where photographs are at hand."""
    scene: Annotated[str | None, option("SCENE", "where they were")] = None
    """Where the photographs are now, if they have moved."""
    views: Annotated[Count, option("N")] = 8
    """Compare so many held-out views at most, evenly spread."""
    seed: Annotated[Seed, option("N")] = 0
    """Of all random choices."""
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """The method's own defaults: the paper's, or what learns most on a plain CPU; auto looks at --device."""

    def run(self) -> int:
        from .. import methods
        from ..conversion import Aim, convert
        from ..run import open_any

        if self.list:
            console(width=LONG, soft_wrap=True).print(listed())
            return 0
        if self.source is None or self.method is None or self.output is None:
            raise LumigraphError("Name a run, a method and a new folder: lumigraph convert RUN METHOD --output NEW")
        told_budget(self.steps, self.seconds, self.quality)
        name, device = methods.check(self.method), choose_device(self.device)
        counted = self.steps is not None or self.quality is not None
        aim = Aim(
            config=method_config(self, name),
            steps=self.steps,
            seconds=None if counted else self.seconds or DEFAULT_SECONDS,
            quality=self.quality,
            distil=self.distil,
            source=self.scene,
            views=self.views,
            seed=self.seed,
        )
        made = convert(open_any(self.source), name, self.output, aim, device, show=True)
        console().print(table(made))
        took = f"{made.taking_over:.1f} s to take over, {made.steps} steps in {made.seconds:.1f} s to learn on"
        rows = {"alike": f"{made.psnr:.2f} dB, the mean of {made.views} held-out views", "by": f"{made.how}; {took}"}
        rows |= {"learnt from": made.learnt_from, "saved": str(self.output)}
        show(rows | {"next": typed("view", self.output)})
        return 0


def table(made: Any) -> Any:
    """Both methods, side by side."""
    from rich.table import Table

    pair = made.teacher, made.student
    rows = Table("", *(x.method for x in pair))
    if all(x.psnr is not None for x in pair):
        rows.add_row("PSNR against photographs", *(f"{x.psnr:.2f} dB" for x in pair))
    rows.add_row("model", *(size(x.bytes) for x in pair))
    rows.add_row("a view", *(f"{x.seconds:.3g} s" for x in pair))
    return rows


def listed() -> Any:
    """What goes into what: a row for each method as it is, a column for each that it may become."""
    from rich.table import Table

    from ..conversion import ways

    found = ways()
    rows = Table("from / into", *found)
    for name, into in found.items():
        rows.add_row(name, *(way or "–" for way in into.values()))
    return rows
