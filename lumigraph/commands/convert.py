"""`lumigraph convert`: turn a trained run into one of another method."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from ..budget import Quality
from ..errors import LumigraphError
from ..files.ranges import Count, Seconds
from ..system.console import console
from .common import about_quality, choose_device, given_budget, method_config, show, typed
from .compress import size
from .options import DeviceOption, PhotographsOption, SeedOption, StepsOption, needed, option

DEFAULT_SECONDS = 30.0
TABLE_WIDTH = 4096  # letters; a table cuts its lines where the console ends
ABOUT = about_quality() + " A conversion from a field trains for half of these steps."
QUALITY = option("draft|good|best", "as long as --seconds", ABOUT)


@dataclass(frozen=True)
class Convert:
    """Turn a trained run, or a splat file, into a run of another method.

    The new method is initialised from the old one: grids and networks from its density and colour at points, Gaussians
    on its surfaces. Then it trains on the photographs if they are available, otherwise on renderings of the old one.
    NEW/convert.json has the PSNR between the two on held-out views, and the size and speed of each. After Ctrl-C the
    same command continues. `lumigraph convert RUN METHOD --help` adds the method's own options.
    """

    source: Annotated[Positional[Path | None], needed("RUN_OR_FILE")] = None
    """Folder of a run, which does not change, or a splat file."""
    method: Annotated[Positional[str | None], needed("METHOD")] = None
    """Method to convert to, for example plenoxels."""
    output: Annotated[Path | None, needed("NEW")] = None
    """New folder for the run."""
    list: bool = False
    """Print the table of possible conversions, and exit."""
    seconds: Annotated[Seconds | None, option("S", f"{DEFAULT_SECONDS:.0f}")] = None
    """Training time in seconds after initialisation; longer improves the new method."""
    steps: StepsOption = None
    quality: Annotated[Quality | None, QUALITY] = None
    distil: bool = False
    """Train on renderings of the old method, even if photographs are available."""
    scene: PhotographsOption = None
    views: Annotated[Count, option("N")] = 8
    """Compare at most this number of held-out views, evenly spread."""
    seed: SeedOption = 0
    device: DeviceOption = "auto"
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the method's options: the paper's, or those tuned for a CPU; auto decides by --device."""

    def run(self) -> int:
        from .. import methods
        from ..derive.conversion import ConversionTarget, convert
        from ..run import open_any

        if self.list:
            console(width=TABLE_WIDTH, soft_wrap=True).print(listed())
            return 0
        if self.source is None or self.method is None or self.output is None:
            raise LumigraphError("Name a run, a method and a new folder: lumigraph convert RUN METHOD --output NEW")
        given_budget(self.steps, self.seconds, self.quality)
        name, device = methods.check(self.method), choose_device(self.device)
        counted = self.steps is not None or self.quality is not None
        aim = ConversionTarget(
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
    """Table of conversions: a row for each source method, a column for each target."""
    from rich.table import Table

    from ..derive.conversion import ways

    found = ways()
    rows = Table("from / into", *found)
    for name, into in found.items():
        rows.add_row(name, *(way or "–" for way in into.values()))
    return rows
