"""Options of several commands, and how `--help` shows a field of a dataclass, in the field's annotation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from tyro.conf import Fixed, Positional, Suppress, UseAppendAction, arg

from .ranges import Downscale, Port, Seed, Steps
from .readers import LISTED, NAMES

if TYPE_CHECKING:
    Reader = str
else:
    Reader = Literal[NAMES]


def option(metavar: str, default: str | None = None, about: str | None = None, name: str | None = None) -> Any:
    """An option in --help: its placeholder, its default in words, its description, its name if not the field's."""
    hint = default and f"(default: {default})"
    return arg(metavar=metavar, help_behavior_hint=hint, help=about, name=name)


def needed(metavar: str, about: str | None = None, name: str | None = None) -> Any:
    """An argument without a default in --help."""
    return option(metavar, "", about, name)


def option_name(field: str, kind: Any) -> str:
    """The name of a field's option, from Python: that of its annotation, or its own."""
    return next((x.name for x in get_args(kind)[1:] if getattr(x, "name", None)), field).replace("-", "_")


DeviceOption = Annotated[
    str, option("NAME", about="Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1.")
]
BEFORE_READING = "Reduce the photographs by this whole number before reading."
DownscaleOption = Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320", BEFORE_READING)]
PHOTOGRAPHS = "Path of the photographs, if they were moved since training."
PhotographsOption = Annotated[str | None, option("SCENE", "the path used in training", PHOTOGRAPHS)]
ReaderOption = Annotated[Reader | None, option("NAME", "detected", f"Layout of the folder: {LISTED}.")]
SeedOption = Annotated[Seed, option("N", about="Seed of all random choices.")]
StepsOption = Annotated[Steps | None, option("N", "as long as --seconds", "Train for this number of steps instead.")]
LOG = "Also write scalars, pictures and options for a logger: tensorboard, wandb, trackio, rerun, or one of a package."
Log = Annotated[tuple[str, ...], option("NAME ...", "none", LOG)]
OVERWRITE = (
    "Replace existing files of other origin too. Unchanged files that Lumigraph wrote are replaced anyway; folders "
    "with other files in them never are."
)
Overwrite = Annotated[bool, arg(help=OVERWRITE)]
RunOption = Annotated[Positional[Path], needed("RUN", "Folder of the run.")]
SOURCE = "Folder of a run, a splat file (.ply, .spz ...), or a composition (.json)."
SourceOption = Annotated[Positional[Path], needed("RUN_OR_FILE", SOURCE)]
# Secret of a viewer, for requests alone: `ps` shows options.
ViewerToken = Annotated[str, Fixed, Suppress]

SET = "Set a control of the method; `lumigraph info RUN` lists them. Can be given several times."
Set = UseAppendAction[Annotated[tuple[str, ...], needed("NAME=VALUE", SET, "set")]]
ANIMATE = "Change a control from A to B over the film, or on to C with A:B:C. Can be given several times."
Animate = UseAppendAction[Annotated[tuple[str, ...], needed("NAME=A:B", ANIMATE, "animate")]]


@dataclass(frozen=True)
class ViewerOptions:
    """Options of a viewer that shows training."""

    view: bool = False
    """Show the scene in the browser during training, and afterwards until Ctrl-C."""
    stay: bool = True
    """With --view, show the scene after training too, until Ctrl-C."""
    host: Annotated[str, option("ADDRESS", "127.0.0.1, this machine only")] = "127.0.0.1"
    """Address that --view listens at; 0.0.0.0 gives access to other machines."""
    port: Annotated[Port | None, option("N", "8080, or the next free port")] = None
    """Port that --view listens at."""
    token: ViewerToken = ""
