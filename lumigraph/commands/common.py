"""What several commands share: options' looks, devices, scenes, and where things go."""

from __future__ import annotations

import itertools
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from ..errors import LumigraphError

Reader = Literal["transforms", "blender", "colmap", "llff"]


def option(metavar: str, default: str | None = None) -> Any:
    """How an option looks in --help: what to put there, and what happens without it."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=default and f"(default: {default})")


def needed(metavar: str) -> Any:
    """How an argument without a default looks in --help."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


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


def say(text: str) -> None:
    """To stderr, where it does not mix with results."""
    print(text, file=sys.stderr, flush=True)


def show(rows: Mapping[str, str]) -> None:
    """Results, one to a line, names aligned."""
    console, width = Console(highlight=False, soft_wrap=True), max(map(len, rows))
    for name, value in rows.items():
        console.print(f"[dim]{name:<{width}}[/dim]  {value}")


def scene_name(source: str) -> str:
    """A short name for files: the last part of a path, or of "procedural:<name>"."""
    last = source.partition(":")[2] if source.startswith("procedural:") else Path(source).resolve().name
    return re.sub(r"[^\w.-]+", "-", last) or "scene"


def next_free(prefix: str) -> Path:
    """The first of prefix-1, prefix-2, ... that does not exist yet."""
    return next(path for n in itertools.count(1) if not (path := Path(f"{prefix}-{n}")).exists())


def exit_code(signal: int | None) -> int:
    """As shells count: 130 after Ctrl-C."""
    return 0 if signal is None else 128 + signal
