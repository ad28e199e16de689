"""Options of commands: how `--help` shows a field of a dataclass, in the field's annotation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from tyro.conf import arg

from .ranges import Downscale, Seed, Steps
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


DEVICE = "Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."
DeviceOption = Annotated[str, option("NAME", about=DEVICE)]
BEFORE_READING = "Reduce the photographs by this whole number before reading."
DownscaleOption = Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320", BEFORE_READING)]
PHOTOGRAPHS = "Path of the photographs, if they were moved since training."
PhotographsOption = Annotated[str | None, option("SCENE", "the path used in training", PHOTOGRAPHS)]
ReaderOption = Annotated[Reader | None, option("NAME", "detected", f"Layout of the folder: {LISTED}.")]
SeedOption = Annotated[Seed, option("N", about="Seed of all random choices.")]
INSTEAD = "Train for this number of steps instead."
StepsOption = Annotated[Steps | None, option("N", "as long as --seconds", INSTEAD)]
