"""`lumigraph track`: find the poses of a moving depth camera while its surroundings are mapped."""

import dataclasses
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from .. import methods
from ..budget import Budget
from ..errors import LumigraphError
from ..files.options import ViewerOptions, needed, option
from ..training.options import TRACKED_SIDE, TrackOptions
from .common import choose_device, exit_code, method_config, next_free, scene_name
from .results import Output


@dataclass(frozen=True, kw_only=True)
class Track(ViewerOptions, TrackOptions, Output):
    """Find the poses of a depth camera's frames in order, and map what it sees.

    RECORDING is a folder of colour and depth, or procedural:room,depth. Poses in it are used for errors alone. RUN is
    an ordinary run (`view`, `render`, `eval`, `export mesh`), and trajectory.txt has the pose of each frame in TUM's
    format. tracking.json has ATE and RPE as evo defines them, path.svg shows the path with its loops, drift.svg the
    error along it. Ctrl-C saves;
    `lumigraph resume` continues. `lumigraph track METHOD --help` adds the method's own options.
    """

    method: Annotated[Positional[str], needed("METHOD")]
    """Method that tracks and maps: imap or splat-slam."""
    recording: Annotated[Positional[str], needed("RECORDING")]
    """Frames with depth: a folder, or procedural:room,depth."""
    output: Annotated[Path | None, option("RUN", "runs/RECORDING-METHOD-N")] = None
    """New folder for the run."""

    def run(self) -> int:
        from ..opening import confirm, open_scene
        from ..run import Run, build, check_new
        from ..training.loop import fit
        from .outcome import show_tracking
        from .view import keep_showing, watching

        kind, device = methods.find(self.method), choose_device(self.device)
        if "tracking" not in {x.name for x in dataclasses.fields(kind.Config)}:
            there = [n for n in methods.available() if hasattr(methods.find(n).Config, "tracking")]
            raise LumigraphError(f"{self.method} finds no poses; track with {' or '.join(there)}")
        confirm(self.recording)
        output = self.output or next_free(f"runs/{scene_name(self.recording)}-{methods.check(self.method)}")
        check_new(output)
        asked = {"extent": self.extent, "frames": self.frames}
        unposed = {name: value for name, value in asked.items() if value is not None}
        options: dict[str, Any] = {"reader": self.reader, "downscale": self.downscale, "unposed": unposed}
        if self.downscale is None:
            options["downscale"] = tracked_downscale(self.recording, self.reader)
        data = open_scene(self.recording, **options)
        config = method_config(self, self.method)
        config = replace(config, tracking=replace(config.tracking, track=True))
        seed = getattr(config, "seed", self.seed)
        method: Any = build(kind, data.frame, config, device, seed, learning=True)
        budget = Budget(len(method.tracker.sequence(data)) + (self.steps_after or 0))
        run = Run.create(output, method, data, seed=seed, options=options, budget=budget.to_json())
        with watching(self, method, data, run) as watch:
            begin = time.process_time()
            with run.kept_if_learnt():
                outcome = fit(method, data, run, budget=budget, seed=seed, pause_at=self.pause_at, watch=watch)
            show_tracking(run, outcome, method, data, time.process_time() - begin)
            keep_showing(watch if self.stay else None, outcome.signal)
        return exit_code(outcome.signal)


def tracked_downscale(recording: str, reader: str | None) -> int:
    """Whole number by which the frames of a recording are reduced for tracking."""
    from ..opening import read_capture

    sizes = [max(shot.size) for shot in read_capture(recording, reader).shots[:1] if shot.size]
    return max(1, round(max(sizes, default=TRACKED_SIDE) / TRACKED_SIDE))
