"""Parts of several commands: devices, budgets, output."""

import contextlib
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

from .. import methods
from ..budget import about_quality
from ..errors import LumigraphError
from ..files import scene_name as scene_name
from ..files.names import next_free as next_free
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


def quality_of(kind: Any) -> str:
    """Help text of --quality, with the epochs and the least steps of a kind of method."""
    from ..method import RayMethod

    unit = "pixel" if issubclass(kind, RayMethod) else "photograph"
    said = ": {0.passes:g} epochs over all {1}s, at least {0.at_least:,} steps"
    return about_quality({name: said.format(effort, unit) for name, effort in kind.efforts.items()})


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
