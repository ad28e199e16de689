"""`lumigraph report`: write a report of a run."""

from dataclasses import dataclass

from ..files.options import Overwrite, RunOption
from .common import show


@dataclass(frozen=True)
class Report:
    """Write everything about a run into one self-contained page, RUN/report.html.

    It always has curves, settings and timings; it has the contact sheet after `eval`, and a film after `render`.
    """

    run_folder: RunOption
    overwrite: Overwrite = False

    def run(self) -> int:
        from ..evaluation.report import claim_report, write_report
        from ..run import Run
        from ..system.progress import counting

        run = Run(self.run_folder)
        claim_report(run, self.overwrite)
        with counting("Putting the page together"):
            path = write_report(run)
        show({"report": str(path)})
        return 0
