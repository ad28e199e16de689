"""`lumigraph demo`: every step once, on a procedural scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ..files.options import DeviceOption, option
from ..files.ranges import Count, Seconds
from ..system.console import bold
from ..training.options import TrainOptions
from .common import choose_device, exit_code, next_free, say, show, typed

FRAMES = 90


@dataclass(frozen=True)
class Demo:
    """Go from photographs to a film and a report in a few minutes: make a scene, train, evaluate, render.

    A small ray tracer renders the photographs, so nothing is downloaded.
    """

    output: Annotated[Path | None, option("RUN", "demo/run-N")] = None
    """New folder for the run."""
    seconds: Annotated[Seconds, option("S")] = 60.0
    """Training time in seconds."""
    method: Annotated[str, option("METHOD")] = "instant-ngp"
    """Method to train."""
    scene: Annotated[str, option("SCENE")] = "procedural:still-life"
    """Scene to train on."""
    frames: Annotated[Count, option("N")] = FRAMES
    """Number of frames of the film."""
    device: DeviceOption = "auto"

    def run(self) -> int:
        from .. import methods
        from ..evaluation.report import write_report
        from ..evaluation.run import evaluate_run
        from ..export.film import film
        from ..export.options import FilmOptions
        from ..metrics import scores_of
        from ..opening import open_dataset
        from ..paths import film_cameras
        from ..run import check_new
        from ..training.beginning import begin_run
        from ..training.loop import fit

        kind, device = methods.find(self.method), choose_device(self.device)
        output = self.output or next_free("demo/run")
        check_new(output)

        say(f"Photographing {self.scene}")
        data = open_dataset(self.scene, kind.learns_from)
        asked = TrainOptions(seconds=self.seconds)
        run, method, budget = begin_run(methods.check(self.method), data, kind.preset(device), device, asked, output)
        outcome = fit(method, data, run, budget=budget)
        if outcome.signal is not None:
            say(f"Stopped and saved after step {outcome.state.step}; go on with: {typed('resume', run.folder)}")
            return exit_code(outcome.signal)
        result = evaluate_run(run, method, data)
        orbit = run.folder / "renders" / "orbit.mp4"
        film(method, film_cameras(run.cameras(), run.frame, "orbit", self.frames), orbit, FilmOptions(depth=True))
        report = write_report(run)
        headline, what = scores_of(result)[0], "views" if "views" in result["protocol"] else "shapes"
        show(
            {
                f"held-out {headline.name}": bold(headline) + f" over {result['protocol'][what]} {what}",
                "film": str(orbit),
                "report": str(report),
                "run": str(run.folder),
            }
        )
        return 0
