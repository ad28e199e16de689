"""Commands of values from Python: `command("export mesh", run, "a.glb", from_="depth")` is the dataclass of it.

Options have the names of the command line, with `_` for `-`: `--few-views yes` is few_views="yes", `--no-holes` is
holes=False, `--from depth` is from_="depth", `--set time=0.3` is set={"time": 0.3}. Values are checked against the
types and ranges of the fields. No text is parsed as a command line.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from typing import Any, TypeVar, get_args, get_origin

from tyro.conf import Fixed, Positional

from ..errors import LumigraphError
from ..files.names import counted
from ..files.options import option_name
from ..files.ranges import coherent, hints, members, typed
from ..system.children import Request
from ..system.progress import Listener, heard_by
from ..system.work import at_work
from .common import kept_rows
from .request import kind_of

T = TypeVar("T")


def command(name: str, /, *arguments: object, **options: Any) -> Any:
    """The command of a name, as "render" or "export mesh", with its positional arguments in order and its options.

    Options of None are as if left out. Raises LumigraphError, naming the option, for values that the command refuses.
    """
    values = {key.rstrip("_"): value for key, value in options.items() if value is not None}
    values |= by_name(name, arguments, values)
    kind, where = kind_of(Request(name, values)), f"`lumigraph {name}`"
    made = filled(kind, values, where)
    if values:
        raise LumigraphError(
            f"{where} has no option {next(iter(values))}; `lumigraph {name} --help` lists what there is"
        )
    coherent(made)
    return made


def by_name(name: str, arguments: tuple[object, ...], options: Mapping[str, Any]) -> dict[str, Any]:
    """Positional arguments by the names of their fields; a field of several values takes all the rest."""
    places = [
        (field, kind)
        for field, kind in hints(kind_of(Request(name))).items()
        if Positional in get_args(kind)[1:] and field not in options
    ]
    given, rest = dict[str, Any](), list(arguments)
    for field, kind in places:
        if rest:
            given[field], rest = (rest, []) if row_of(kind) else (rest[0], rest[1:])
    if rest:
        raise LumigraphError(f"`lumigraph {name}` is given {counted(len(rest), 'argument')} too many")
    return given


def filled(kind: Any, options: dict[str, Any], where: str, default: Any = None) -> Any:
    """A dataclass, with nested dataclasses, from options by name, which are removed from `options`.

    default: initial value, instead of the defaults of the fields
    """
    given = dict[str, Any]()
    for field in fields(kind):
        hint = hints(kind)[field.name]
        name = option_name(field.name, hint)
        inner = next((x for x in members(hint) if is_dataclass(x)), None)
        if Fixed in get_args(hint)[1:]:
            continue
        if inner is not None:
            start = getattr(default, field.name, None) or field.default
            given[field.name] = filled(inner, options, where, start if is_dataclass(start) else None)
        elif name in options:
            given[field.name] = typed(hint, plain(options.pop(name), hint), f"Option {name} of {where}")
        elif default is None and field.default is MISSING and field.default_factory is MISSING:
            raise LumigraphError(f"{where} lacks {name}; give it as an argument")
    return kind(**given) if default is None else replace(default, **given)


def row_of(kind: Any) -> Any:
    """The tuple in an annotation of an option with several values; None for any other."""
    return next((x for x in members(kind) if get_origin(x) is tuple), None)


def plain(value: Any, kind: Any) -> Any:
    """A value of Python as JSON has it: paths as text, arrays as lists, {"time": 0.3} as ["time=0.3"]."""
    if isinstance(value, Mapping):
        value = [f"{name}={one}" for name, one in value.items()]
    elif isinstance(value, os.PathLike):
        value = os.fspath(value)
    elif hasattr(value, "tolist"):  # of NumPy or PyTorch
        value = value.tolist()
    if row := row_of(kind):
        several = [value] if isinstance(value, str | int | float) else value
        return [plain(one, get_args(row)[0]) for one in several]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return str(value) if number and str in members(kind) else value


@at_work()
def quietly(work: Callable[[], T], progress: Listener | None = None) -> tuple[T, dict[str, Any]]:
    """The result of a command's function, and the rows that it would print. progress: see `heard_by`"""
    with kept_rows() as rows, heard_by(progress):
        return work(), rows


def finished(code: int) -> None:
    """Raise KeyboardInterrupt for the exit code of a command that Ctrl-C ended, with its work saved."""
    if code:
        raise KeyboardInterrupt
