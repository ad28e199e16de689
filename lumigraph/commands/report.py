"""`lumigraph report`: a run on one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from .common import needed, show


@dataclass(frozen=True)
class Report:
    """Put everything about a run into one self-contained page, RUN/report.html.

    Curves, settings and timings are always there; the contact sheet once `eval` has run, a film once `render` has.
    """

    run_folder: Annotated[Positional[Path], needed("RUN")]
    """Folder of the run."""

    def run(self) -> int:
        from ..progress import counting
        from ..report import write_report
        from ..run import Run

        with counting("Putting the page together"):
            path = write_report(Run(self.run_folder))
        show({"report": str(path)})
        return 0
