"""`lumigraph report`: a run on one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from .common import Overwrite, needed, show


@dataclass(frozen=True)
class Report:
    """Put everything about a run into one self-contained page, RUN/report.html.

    Curves, settings and timings are always there; the contact sheet once `eval` has run, a film once `render` has.
    """

    run_folder: Annotated[Positional[Path], needed("RUN")]
    """Folder of the run."""
    overwrite: Overwrite = False

    def run(self) -> int:
        from ..progress import counting
        from ..report import claim_report, write_report
        from ..run import Run

        run = Run(self.run_folder)
        claim_report(run, self.overwrite)
        with counting("Putting the page together"):
            path = write_report(run)
        show({"report": str(path)})
        return 0
