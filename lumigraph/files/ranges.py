"""Number ranges: declared in a field's annotation, and checked for flags and files alike.

    levels: Annotated[int, between(1, 32)] = 16         of a Config, or of a command
    frames: Annotated[Count | None, option("N")] = None

`check` validates a dataclass, `typed` parses one from plain JSON, `domain` describes a range. Constraints between
numbers, such as the coarsest level and the finest, are in a dataclass's method `check`.
"""

from __future__ import annotations

import re
import threading
import types
import typing
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec

from ..errors import LumigraphError


def between(least: float, most: float) -> msgspec.Meta:
    """Range of a number, both ends included: `levels: Annotated[int, between(1, 32)] = 16`. NaN is in no range."""
    return msgspec.Meta(ge=least, le=most)


UNSURPRISING, MAX_LEAST = 1_000_000, 4  # ranges from 4 or less to a million or more are not shown in help

# What recurs. Ranges are as wide as any use that makes sense, and no wider.
Count = Annotated[int, between(1, 1_000_000)]  # of photographs, views, frames
Steps = Annotated[int, between(1, 1_000_000_000)]
Seconds = Annotated[float, between(0.001, 1e8)]  # up to three years
Seed = Annotated[int, between(0, (1 << 32) - 1)]
Share = Annotated[float, between(0, 1)]
PositiveShare = Annotated[float, between(1e-6, 1)]  # a share that something is divided by
Positive = Annotated[float, between(1e-9, 1e9)]
Coordinate = Annotated[float, between(-1e9, 1e9)]
NonNegative = Annotated[float, between(0, 1e6)]  # weights of losses, thresholds
LearningRate = Annotated[float, between(0, 10)]
Width = Annotated[int, between(2, 8192)]  # of a layer
Layers = Annotated[int, between(1, 64)]
Depth = Annotated[int, between(2, 64)]  # of a network that needs a layer before the last
RaySamples = Annotated[int, between(4, 4096)]  # of one ray
BatchSize = Annotated[int, between(1, 1 << 22)]  # rays or pixels of one step
Octaves = Annotated[int, between(1, 32)]
CloudSize = Annotated[int, between(1, 100_000_000)]  # Gaussians, points
Cells = Annotated[int, between(0, 512)]  # of a grid, along each axis; 0 for none
Pixels = Annotated[int, between(16, 8192)]  # along the longer side
SphereSize = Annotated[int, between(64, 16_384)]  # width of a picture of the whole sphere
FramesPerSecond = Annotated[float, between(0.01, 1000)]
Downscale = Annotated[int, between(1, 1024)]
Scales = Annotated[int, between(1, 12)]  # of a picture, each half as large as the one before
Codes = Annotated[int, between(1, 65_536)]  # rows of a codebook
Decibels = Annotated[float, between(0, 100)]
Port = Annotated[int, between(1, 65_535)]

# What files hold besides.
Tally = Annotated[int, between(0, 10**12)]  # how many there were of something
Lasted = Annotated[float, between(0, 1e12)]  # seconds that something took
Side = Annotated[int, between(1, 10**5)]  # of a picture, pixels
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=4096, pattern=r"\A[^\x00]*\Z")]  # of a file
Point = tuple[Coordinate, Coordinate, Coordinate]
Row = tuple[Coordinate, Coordinate, Coordinate, Coordinate]  # of a matrix


def numbers(kind: Any) -> Iterator[tuple[type, Any]]:
    """Every number within an annotation, as (int or float, its range or None)."""
    if get_origin(kind) is Annotated:
        inner, *about = get_args(kind)
        ranges = [x for x in about if isinstance(x, msgspec.Meta)]
        yield from [(inner, ranges[0])] if ranges and inner in (int, float) else numbers(inner)
    elif kind in (int, float):
        yield kind, None
    elif get_origin(kind) is not Literal:
        for inner in get_args(kind):
            yield from numbers(inner)


def domain(kind: Any) -> str:
    """Range of an annotation's numbers in words, "1 to 32"; "" without one."""
    ranges = {(kind, x.ge, x.le): x for kind, x in numbers(kind) if x is not None}
    return " or ".join(f"{said(x.ge)} to {said(x.le)}" for x in ranges.values())


def is_surprising(kind: Any) -> bool:
    """True if a range is worth mentioning: not for any positive number or count."""
    return any(x.ge > MAX_LEAST or x.le < UNSURPRISING for _, x in numbers(kind) if x is not None)


def said(number: Any) -> str:
    """Number as text: 0.001, 1e8, 100,000,000."""
    return f"{number:,}" if isinstance(number, int) else re.sub(r"e\+?(-?)0*", r"e\1", f"{number:g}")


@cache
def hints(kind: Any) -> dict[str, Any]:
    """Fields of a dataclass with their full annotations."""
    said = typing.get_type_hints(kind, include_extras=True)
    return {field.name: said[field.name] for field in fields(kind)}


def changed(value: Any, **numbers: Any) -> Any:
    """A dataclass with some numbers replaced, by their names in it or in nested dataclasses."""
    own = {field.name for field in fields(value)}
    for name in own:
        if is_dataclass(inner := getattr(value, name)):
            below = {key: new for key, new in numbers.items() if key not in own and holds(inner, key)}
            value = replace(value, **{name: changed(inner, **below)}) if below else value
            numbers = {key: new for key, new in numbers.items() if key not in below}
    return replace(value, **numbers)


def value_of(value: Any, name: str) -> Any:
    """The number of a name, of a dataclass or one that it holds."""
    return next(getattr(group, name) for group in groups_of(value) if name in hints(group.__class__))


def holds(value: Any, name: str) -> bool:
    """True if a dataclass, or a nested one, has a field of this name."""
    return any(name in hints(group.__class__) for group in groups_of(value))


def groups_of(value: Any) -> Iterator[Any]:
    """A dataclass, and those within it."""
    yield value
    for field in fields(value):
        if is_dataclass(inner := getattr(value, field.name)):
            yield from groups_of(inner)


def outside(value: Any) -> Iterator[tuple[str, Any, Any]]:
    """Fields of a dataclass and nested ones with values of wrong type or out of range, as (name, annotation, value)."""
    for name, kind in hints(value.__class__).items():
        found = getattr(value, name)
        if is_dataclass(found):
            yield from outside(found)
        elif any(range is not None for _, range in numbers(kind)):
            try:
                msgspec.convert(found, kind)
            except msgspec.ValidationError:
                yield name, kind, found


def coherent(value: Any) -> None:
    """Call `check` of a dataclass and nested ones, which raises LumigraphError for inconsistent numbers."""
    for name in hints(value.__class__):
        if is_dataclass(inner := getattr(value, name)):
            coherent(inner)
    if hasattr(value, "check"):
        value.check()


def check(value: Any, where: Path | str) -> None:
    """Raise LumigraphError for out-of-range or inconsistent numbers of a dataclass. where: named in the error"""
    for name, kind, found in outside(value):
        raise LumigraphError(f"{where}: {name} cannot be {format_value(found)}; it is from {domain(kind)}")
    coherent(value)


# msgspec 0.22 crashes where two threads convert to a class for the first time.
_converting = threading.RLock()


def typed(kind: Any, value: Any, where: Path | str, closed: bool = False) -> Any:
    """Parse plain JSON as a type: a dataclass, a tuple, a dictionary, a union; ranges and types are checked.

    where:  the file or option, named in errors
    closed: refuse unknown keys, which may be misspelt; else they are ignored
    No union in a type may have both a range and a tuple of fixed length: msgspec 0.22 crashes on those.
    Raises LumigraphError with the wrong value and its allowed ones.
    """
    try:
        with _converting:
            made = msgspec.convert(value, kind, dec_hook=path_of)
        if is_dataclass(made):
            coherent(made)
        key = surplus(value, msgspec.to_builtins(made, enc_hook=str)) if closed else None
    except LumigraphError as error:  # from a dataclass that looks at itself
        raise LumigraphError(f"{where}: {str(error)[:1].lower()}{str(error)[1:]}") from error
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        fault, _, path = " ".join(str(error).split()).partition(" - at `$")
        name = path.rstrip("`").lstrip(".")
        if lacking := re.match(r"Object missing required field (`\w+`)", fault):
            what = f"{name or 'it'} lacks {lacking[1]}"
        else:
            found, wanted = found_at(kind, value, name) if name else (value, kind)
            ranged = domain(wanted) if re.match(r"Expected `\w+` [<>]", fault) else ""
            should = f"be from {ranged}" if ranged else fault.replace("Expected", "be", 1)
            should = "be a name" if "matching regex" in should else should
            if choices := [x for one in members(wanted) if get_origin(one) is Literal for x in get_args(one)]:
                should = f"be {' or '.join(map(str, choices))}"
            what = f"{name or 'it'} is {format_value(found)}, and should {should}"
        raise LumigraphError(f"{where} does not hold what it should: {what}") from error
    if key is not None:
        raise LumigraphError(f"{where} does not hold what it should: nothing is known of {format_value(key)}")
    return made


def path_of(kind: type, value: Any) -> Any:
    """JSON text as a path, for msgspec. Raises ValueError for other text."""
    if kind is not Path or not isinstance(value, str) or not value or "\0" in value:
        raise ValueError(f"Expected `{kind.__name__}`")
    return Path(value)


def surplus(said: Any, known: Any) -> str | None:
    """A key of plain JSON that is missing in its parsed value; None if there is none."""
    if isinstance(said, dict) and isinstance(known, dict):
        new = [key for key in said if key not in known]
        return new[0] if new else first_of(surplus(value, known[key]) for key, value in said.items())
    if isinstance(said, list | tuple) and isinstance(known, list | tuple):
        return first_of(map(surplus, said, known))
    return None


def first_of(found: Iterable[str | None]) -> str | None:
    """First item that is not None, or None."""
    return next((key for key in found if key is not None), None)


def found_at(kind: Any, value: Any, path: str) -> tuple[Any, Any]:
    """Value at a path of msgspec's, "grids.channels[1]", and its annotation; None if unknown."""
    for name, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", path):
        kind = next((x for x in members(kind) if is_dataclass(x) or get_origin(x) is tuple), None)
        try:
            value = value[name or int(index)]
        except (KeyError, IndexError, TypeError):
            return value, None
        if is_dataclass(kind):
            kind = hints(typing.cast(type, kind)).get(name)
        elif index:
            inner = [x for x in get_args(kind) if x is not Ellipsis]
            kind = inner[min(int(index), len(inner) - 1)] if inner else None
    return value, kind


def members(kind: Any) -> Iterator[Any]:
    """Members of a union, or the annotation itself, without metadata."""
    if get_origin(kind) is Annotated:
        yield from members(get_args(kind)[0])
    elif get_origin(kind) in (typing.Union, types.UnionType):
        for inner in get_args(kind):
            yield from members(inner)
    else:
        yield kind


def format_value(value: Any) -> str:
    """A value for a sentence, shortened to a line."""
    if isinstance(value, int) and abs(value) > 10**60:  # Python writes out no integer of thousands of digits
        return "an integer of more than 60 digits"
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
