"""Ranges on the command line: --help shows them beside the defaults, and what was typed is held to them.

Both are read from annotations (`ranges`), of the commands as of the methods' Configs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass, replace
from typing import Annotated, Any, get_args

from tyro.conf import arg
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from ..errors import LumigraphError
from ..files.ranges import coherent, domain, outside, shown

RULES = ConstructorRegistry()
beneath = False  # whether tyro is asked for what it would do without our rule


@RULES.struct_rule
def with_ranges(info: StructTypeInfo) -> StructConstructorSpec | None:
    """A dataclass as tyro reads it, each number with its range behind its default: (default: 16; 1 to 32)."""
    if beneath or not is_dataclass(info.type):
        return None
    with without_ranges():
        spec = ConstructorRegistry.get_struct_spec(info)
    if not isinstance(spec, StructConstructorSpec):
        return None
    return replace(spec, fields=tuple(replace(x, type=with_range(x.type)) for x in spec.fields))


@contextmanager
def without_ranges() -> Iterator[None]:
    """A block in which tyro goes by its own rules."""
    global beneath
    beneath = True
    try:
        yield
    finally:
        beneath = False


def with_range(kind: Any) -> Any:
    """An option's annotation with its range in what --help says of the default; itself where it has no range."""
    if not (range := domain(kind)):
        return kind
    hints = [x.help_behavior_hint for x in get_args(kind)[1:] if getattr(x, "help_behavior_hint", None) is not None]

    def hint(default: str) -> str:
        said = hints[-1] if hints else f"(default: {default})"
        return f"{said[:-1]}; {range})" if said else f"({range})"

    return Annotated[kind, arg(help_behavior_hint=hint)]


def held(command: Any) -> Any:
    """A command as it was typed. Raises LumigraphError for a number beyond its range, and for those that disagree."""
    for name, kind, value in outside(command):
        called = next((x.name for x in get_args(kind)[1:] if getattr(x, "name", None)), name).replace("_", "-")
        typed = " ".join(map(shown, value)) if isinstance(value, tuple) else shown(value)
        numbers = "numbers" if isinstance(value, tuple) else "a number"
        raise LumigraphError(f"--{called} cannot be {typed}; give it {numbers} from {domain(kind)}")
    coherent(command)
    return command
