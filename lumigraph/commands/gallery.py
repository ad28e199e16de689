"""`lumigraph gallery`: every method on its smallest data, on one page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from .. import methods
from ..files.options import option
from ..files.ranges import Seconds
from .common import say, show


@dataclass(frozen=True)
class Gallery:
    """Train every method on the smallest data that it is meant for, and show all on one page.

    Pictures, scores, training times and published figures are on OUTPUT/gallery.html. Each method is a cell of a
    benchmark, trained and evaluated in a process of its own. Ctrl-C stops; the same command continues.
    """

    output: Annotated[Path, option("OUTPUT")] = Path("gallery")
    """Folder for runs, figures and the page."""
    methods: Annotated[tuple[str, ...], option("METHOD ...", "all")] = ()
    """Show these methods alone."""
    seconds: Annotated[Seconds, option("S")] = 60.0
    """Training time of each method in seconds; longer gives better pictures."""

    def run(self) -> int:
        from ..lab.benchmark.gallery import PAGE, SHOWPIECES, gallery

        names = [methods.check(name) for name in self.methods] or list(SHOWPIECES)
        code = gallery(names, self.seconds, self.output, say)
        if code:
            say("Stopped; what is done is kept, and the same command goes on")
            return code
        show({"page": str(self.output / PAGE), "figures": str(self.output / "results.json")})
        return 0
