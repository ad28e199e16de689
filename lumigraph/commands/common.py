"""Parts of several commands: devices, budgets, output."""

from __future__ import annotations

import contextlib
import itertools
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from .. import methods
from ..budget import MEANS, Budget, Quality
from ..errors import LumigraphError
from ..files import scene_name as scene_name
from ..system.console import console, dim
from ..system.signals import exit_code as exit_code

MAX_LINES = 12  # lines of one kind that are printed
_kept: ContextVar[dict[str, Any] | None] = ContextVar("kept", default=None)  # rows in place of the terminal


def choose_device(name: str) -> Any:
    """A torch.device by name; `auto` takes a GPU where there is one. Raises LumigraphError if it is not there."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device("cuda" if name == "gpu" else name)
        torch.empty(1, device=device)
        if device.type == "meta":
            raise RuntimeError("it holds no numbers")
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise LumigraphError(f"Device {name!r} is not usable here ({reason}); try --device cpu") from error
    return device


def option_group(name: str) -> str:
    """The field that holds a method's own numbers; help shows its name above them."""
    return methods.check(name).replace("-", "_")


def method_config(command: Any, name: str) -> Any:
    """A method's Config, which the command line adds as another field; see `with_options_of`."""
    given = getattr(command, option_group(name), None)
    return given or default_config(type(command), methods.find(name), preset_device(command.device, command.preset))


def default_config(command: type, kind: Any, device: Any) -> Any:
    """A method's Config where the user chose none: for a command that starts from another method, that for this."""
    return (kind.taught_preset if getattr(command, "taught", False) else kind.preset)(device)


def preset_device(device: str, preset: str) -> Any:
    """Kind of machine for a method's default parameters, which need not be this one."""
    import torch

    return choose_device(device) if preset == "auto" else torch.device("cuda" if preset == "paper" else "cpu")


def value_of(name: str, arguments: Sequence[str], default: str) -> str:
    """The value of an option, before full parsing."""
    for i, argument in enumerate(arguments):
        if argument.startswith(f"{name}="):
            return argument.partition("=")[2]
        if argument == name and i + 1 < len(arguments):
            return arguments[i + 1]
    return default


def given_budget(steps: int | None, seconds: float | None, quality: Quality | None = None) -> Budget | None:
    """The Budget of --steps or --seconds; `None` without them. Raises LumigraphError, before anything is opened, for an
    impossible value, and for more than one of these options."""
    if sum(given is not None for given in (steps, seconds, quality)) > 1:
        raise LumigraphError("--steps, --seconds and --quality are ways to say how long; give one of them")
    return None if steps is None and seconds is None else Budget(steps, seconds)


def quality_budget(quality: Quality, method: Any, data: Any) -> Budget:
    """The steps of --quality for a method on its data."""
    return Budget(method.steps_for(quality, data), quality=quality)


def about_quality(kind: Any = None) -> str:
    """Help text of --quality; with the numbers of a kind of method, if given."""
    about = "Choose the steps by method, number of photographs and their size. "
    return about + "; ".join(f"{name}, {means}{numbers(kind, name)}" for name, means in MEANS.items()) + "."


def numbers(kind: Any, quality: Quality) -> str:
    """The epochs and the least steps of a quality, for a kind of method."""
    if kind is None:
        return ""
    from ..method import RayMethod

    effort, unit = kind.efforts[quality], "pixel" if issubclass(kind, RayMethod) else "photograph"
    return f": {effort.passes:g} epochs over all {unit}s, at least {effort.at_least:,} steps"


def say(text: str) -> None:
    """Print to stderr, separate from results."""
    print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def kept_rows() -> Iterator[dict[str, Any]]:
    """A block in which `show` prints nothing; the dictionary receives its rows."""
    rows: dict[str, Any] = {}
    token = _kept.set(rows)
    try:
        yield rows
    finally:
        _kept.reset(token)


def show_table(table: Any) -> None:
    """Print a rich Table, unless rows are kept."""
    if _kept.get() is None:
        console().print(table)


def show(rows: Mapping[str, Any]) -> None:
    """Results, text or rich Text, names aligned; further lines of a text stand below its first."""
    if (kept := _kept.get()) is not None:
        kept.update(rows)
        return
    out, width = console(soft_wrap=True), max(map(len, rows))
    for name, value in rows.items():
        if isinstance(value, str):
            value = value.replace("\n", "\n" + " " * (width + 2))
        out.print(dim(f"{name:<{width}}") + "  " + value)


def lines(items: Sequence[str], more: str) -> str:
    """At most 12 items, one below the other. more: where all of them are"""
    rest = [f"and {len(items) - MAX_LINES} more, in {more}"] if len(items) > MAX_LINES else []
    return "\n".join([*items[:MAX_LINES], *rest])


def finding_rows(found: Sequence[Any], more: str) -> dict[str, str]:
    """Rows of findings by fault, for `show`. more: the file that holds all of them"""
    from ..sfm.doctor import grouped

    return {fault: lines(sentences, more) for fault, sentences in grouped(found).items()}


def typed(*words: object) -> str:
    """A command to type next, quoted for a shell."""
    return shlex.join(["lumigraph", *map(str, words)])


def next_free(prefix: str) -> Path:
    """The first of prefix-1, prefix-2, ... that does not exist yet."""
    return next(path for n in itertools.count(1) if not (path := Path(f"{prefix}-{n}")).exists())
