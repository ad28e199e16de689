"""What several commands share: options' looks, devices, scenes, and where things go."""

from __future__ import annotations

import itertools
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.text import Text

from ..console import console, dim
from ..errors import LumigraphError
from ..files import scene_name as scene_name
from ..readers import LISTED, NAMES
from ..signals import exit_code as exit_code

if TYPE_CHECKING:
    Reader = str
else:
    Reader = Literal[NAMES]


def option(metavar: str, default: str | None = None) -> Any:
    """How an option looks in --help: what to put there, and what happens without it."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=default and f"(default: {default})")


def needed(metavar: str) -> Any:
    """How an argument without a default looks in --help."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


ReaderOption = Annotated[
    Reader | None,
    tyro.conf.arg(
        metavar="NAME", help_behavior_hint="(default: found by looking)", help=f"Layout of the folder: {LISTED}."
    ),
]


def choose_device(name: str) -> Any:
    """A torch.device by name; `auto` takes a GPU where there is one. Raises LumigraphError if it is not there."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device("cuda" if name == "gpu" else name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise LumigraphError(f"Device {name!r} is not usable here ({reason}); try --device cpu") from error
    return device


def budget_of(steps: int | None, seconds: float | None) -> dict[str, Any]:
    """What --steps and --seconds say, as fit() takes it; empty if they say nothing."""
    from ..train import Budget

    if steps is not None and seconds is not None:
        raise LumigraphError("--steps and --seconds are two ways to say how long; give one of them")
    told = {name: value for name, value in (("steps", steps), ("seconds", seconds)) if value is not None}
    if told:
        Budget(steps, seconds)  # refuses what makes no sense, before anything is opened
    return told


def check_film(frames: int | None, fps: float, size: int | None) -> None:
    """Refuse films that cannot be, before anything is rendered."""
    if frames is not None and frames < 1:
        raise LumigraphError(f"A film cannot have {frames} frames; give --frames a number above 0")
    if not 0 < fps <= 1000:
        raise LumigraphError(f"A film cannot show {fps:g} frames per second; give --fps a number from 1 to 1000")
    if size is not None and not 16 <= size <= 8192:
        raise LumigraphError(f"A film cannot be {size} pixels large; give --size a number from 16 to 8192")


def say(text: str) -> None:
    """To stderr, where it does not mix with results."""
    print(text, file=sys.stderr, flush=True)


def show(rows: Mapping[str, str | Text]) -> None:
    """Results, one to a line, names aligned."""
    out, width = console(soft_wrap=True), max(map(len, rows))
    for name, value in rows.items():
        out.print(dim(f"{name:<{width}}") + "  " + value)


def typed(*words: object) -> str:
    """A command to go on with, as a shell understands it whatever names are in it."""
    return shlex.join(["lumigraph", *map(str, words)])


def next_free(prefix: str) -> Path:
    """The first of prefix-1, prefix-2, ... that does not exist yet."""
    return next(path for n in itertools.count(1) if not (path := Path(f"{prefix}-{n}")).exists())
