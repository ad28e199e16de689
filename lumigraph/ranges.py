"""Numbers with their ranges: declared once, in a field's annotation, and checked for flags and files alike."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import msgspec

from .errors import LumigraphError

PLACE = re.compile(r" - at `(?:key` in `)?\$?(.*)`$")  # where in a file msgspec found a fault


def between(least: float, most: float) -> msgspec.Meta:
    """The range of a number, both ends included: `levels: Annotated[int, between(1, 32)] = 16`. NaN is in no range."""
    return msgspec.Meta(ge=least, le=most)


# What many files hold: numbers that stay finite when they are squared in single precision, and names of files.
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=4096, pattern=r"\A[^\x00]*\Z")]
Length = Annotated[float, between(-1e9, 1e9)]
Share = Annotated[float, between(0, 1)]
Count = Annotated[int, between(0, 10**12)]
Pixels = Annotated[int, between(1, 10**5)]
Seconds = Annotated[float, between(0, 1e12)]
Numbers3 = tuple[Length, Length, Length]
Numbers4 = tuple[Length, Length, Length, Length]


def typed(kind: Any, value: Any, where: Path | str, closed: bool = False) -> Any:
    """Plain JSON as a value of a kind: a dataclass, a tuple, a dictionary, a union; ranges and types are checked.

    where:  the file or option to name
    closed: refuse keys that no dataclass has, where a misspelt one would go unnoticed; else they are passed over
    Raises LumigraphError that says which value is wrong, and what it should be.
    """
    try:
        made = msgspec.convert(value, kind)
        if closed and (key := surplus(value, msgspec.to_builtins(made))):
            raise ValueError(f"nothing is known of a {key!r}")
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise LumigraphError(f"{where} does not hold what it should: {fault(error)}; correct it") from error
    return made


def fault(error: Exception) -> str:
    """What msgspec found, with the place in front: "`frame.reach` should be `float` <= 64"."""
    text = " ".join(str(error).split())
    place = PLACE.search(text)
    text = PLACE.sub("", text).replace("Expected", "should be", 1).replace("Object missing required field", "lacks")
    return f"`{place[1].lstrip('.')}` {text}" if place else text[:1].lower() + text[1:]


def surplus(said: Any, known: Any) -> str | None:
    """A key of plain JSON that its typed value, made plain again, has not; None if there is none."""
    if isinstance(said, dict) and isinstance(known, dict):
        new = next((key for key in said if key not in known), None)
        return new or next(filter(None, (surplus(value, known[key]) for key, value in said.items())), None)
    if isinstance(said, list | tuple) and isinstance(known, list | tuple):
        return next(filter(None, map(surplus, said, known)), None)
    return None
