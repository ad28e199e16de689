"""Options of several commands: their format in --help, devices, and controls of the method (--set, --animate)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Fixed, Positional, Suppress, UseAppendAction, arg

from ..files.options import DeviceOption as DeviceOption
from ..files.options import DownscaleOption as DownscaleOption
from ..files.options import PhotographsOption as PhotographsOption
from ..files.options import ReaderOption as ReaderOption
from ..files.options import SeedOption as SeedOption
from ..files.options import StepsOption as StepsOption
from ..files.options import needed as needed
from ..files.options import option as option
from ..files.ranges import Port

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
