"""Loggers: scalars, pictures, options and commit of a training, in the formats of TensorBoard, W&B, trackio, rerun.

All are offline by default: they write into the run's folder (trackio: into its own cache). Further ones come from
packages, by an entry point of the group `lumigraph.loggers`: a class without arguments that has the four functions of
`Logger`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from ..errors import LumigraphError
from ..figures import to_image
from ..run import Run
from ..run.folder import commit
from ..run.records import flat
from ..system.plugins import offered, taken

PROJECT = "lumigraph"


@runtime_checkable
class Logger(Protocol):
    """Receiver of what a training measures."""

    def begin(self, run: Run, options: Mapping[str, Any]) -> None:
        """Open. options: those of the run by name, flat, with the commit; called again where a run is resumed"""

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Figures after a step, by names such as loss/tv."""

    def picture(self, step: int, name: str, rgb: Float[Tensor, "height width 3"]) -> None:
        """A rendering, sRGB-encoded."""

    def end(self) -> None:
        """Write what is left, and close."""


class TensorBoardLogger:
    """Event files in the folder `tensorboard` of the run: `tensorboard --logdir RUN/tensorboard`."""

    def begin(self, run: Run, options: Mapping[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.writer = SummaryWriter(str(run.folder / "tensorboard"))
        rows = "".join(f"|{name}|{value}|\n" for name, value in options.items())
        self.writer.add_text("options", f"|option|value|\n|-|-|\n{rows}")

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self.writer.add_scalar(name, value, step)

    def picture(self, step: int, name: str, rgb: Float[Tensor, "height width 3"]) -> None:
        self.writer.add_image(name, rgb.clamp(0, 1), step, dataformats="HWC")

    def end(self) -> None:
        self.writer.close()


class WandbLogger:
    """A run of Weights & Biases in the folder `wandb` of the run; WANDB_MODE=online sends it."""

    def begin(self, run: Run, options: Mapping[str, Any]) -> None:
        import wandb

        mode: Any = os.environ.get("WANDB_MODE", "offline")
        place, name = str(run.folder.resolve()), run.folder.resolve().name
        self.wandb = wandb
        self.run = wandb.init(project=PROJECT, name=name, dir=place, mode=mode, config=dict(options))

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        self.run.log(dict(values), step=step)

    def picture(self, step: int, name: str, rgb: Float[Tensor, "height width 3"]) -> None:
        self.run.log({name: self.wandb.Image(to_image(rgb))}, step=step)

    def end(self) -> None:
        self.run.finish()


class TrackioLogger:
    """A run of trackio, in its cache on this machine (TRACKIO_DIR): `trackio show --project lumigraph`."""

    def begin(self, run: Run, options: Mapping[str, Any]) -> None:
        import trackio

        self.trackio = trackio
        self.run = trackio.init(project=PROJECT, name=run.folder.resolve().name, config=dict(options), resume="allow")

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        self.run.log(dict(values), step=step)

    def picture(self, step: int, name: str, rgb: Float[Tensor, "height width 3"]) -> None:
        self.run.log({name: self.trackio.Image(to_image(rgb))}, step=step)

    def end(self) -> None:
        self.run.finish()


class RerunLogger:
    """A recording `rerun.rrd` in the run: `rerun RUN/rerun.rrd`. A resumed run begins another one behind its step."""

    def begin(self, run: Run, options: Mapping[str, Any]) -> None:
        import rerun

        name = f"rerun-{run.state.step}.rrd" if run.has_state else "rerun.rrd"
        self.rerun, self.stream = rerun, rerun.RecordingStream(PROJECT, recording_id=run.folder.resolve().name)
        self.stream.save(str(run.folder / name))
        text = "\n".join(f"{name}: {value}" for name, value in options.items())
        self.stream.log("options", rerun.TextDocument(text), static=True)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        self.stream.set_time("step", sequence=step)
        for name, value in values.items():
            self.stream.log(name, self.rerun.Scalars([value]))

    def picture(self, step: int, name: str, rgb: Float[Tensor, "height width 3"]) -> None:
        self.stream.set_time("step", sequence=step)
        self.stream.log(name, self.rerun.Image(to_image(rgb)))

    def end(self) -> None:
        self.stream.flush()
        self.stream.disconnect()


OWN: dict[str, type[Any]] = {
    "tensorboard": TensorBoardLogger,
    "wandb": WandbLogger,
    "trackio": TrackioLogger,
    "rerun": RerunLogger,
}


def logger_of(name: object) -> Logger:
    """A logger by its name, or itself. Raises LumigraphError for an unknown name, and for what is no logger."""
    if isinstance(name, str):
        if name not in OWN and name not in offered("loggers"):
            there = ", ".join([*OWN, *offered("loggers")])
            raise LumigraphError(f"There is no logger {name!r}; there are: {there}")
        return OWN[name]() if name in OWN else taken("loggers", name)()
    if not isinstance(name, Logger):
        raise LumigraphError(f"{name!r} is no logger; it needs begin, scalars, picture and end")
    return name


class Loggers:
    """Several loggers as one, for a run that trains. A block: `begin` at its start, `end` at its end."""

    def __init__(self, loggers: Iterable[str | Logger], run: Run | None):
        self.loggers, self.run = [logger_of(one) for one in loggers], run
        if self.loggers and run is None:
            raise LumigraphError("Loggers are for a run; give fit a run, or leave them out")

    def __enter__(self) -> Loggers:
        if self.run is not None and self.loggers:
            settings = self.run.settings
            known = {"method": settings.method, "scene": settings.scene.source, "seed": settings.seed}
            options = known | settings.config | {"budget": settings.budget, "commit": commit()} | settings.versions
            for one in self.loggers:
                try:
                    one.begin(self.run, flat(options))
                except ImportError as fault:
                    name = next((name for name, kind in OWN.items() if isinstance(one, kind)), "its package")
                    raise LumigraphError(
                        f"{type(one).__name__} lacks a package ({fault}); pip install {name}, or leave --log out"
                    ) from fault
        return self

    def row(self, step: int, row: Mapping[str, Any]) -> None:
        """Pass on a line of metrics.jsonl."""
        for one in self.loggers:
            one.scalars(step, {k: float(v) for k, v in flat(row).items() if isinstance(v, int | float) and k != "step"})

    def preview(self, step: int, rgb: Float[Tensor, "height width 3"]) -> None:
        """Pass on a preview."""
        for one in self.loggers:
            one.picture(step, "preview", rgb)

    def __exit__(self, *fault: object) -> None:
        for one in self.loggers:
            one.end()
