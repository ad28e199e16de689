"""Numbers with their ranges: declared once, in a field's annotation, and checked for flags and files alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from .errors import LumigraphError

Kind = TypeVar("Kind")


def between(least: float, most: float) -> msgspec.Meta:
    """The range of a number, both ends included: `levels: Annotated[int, between(1, 32)] = 16`. NaN is in no range."""
    return msgspec.Meta(ge=least, le=most)


def typed(kind: type[Kind], value: Any, where: Path | str) -> Kind:
    """Plain JSON as a value of a kind: a dataclass, a tuple, a dictionary, a union; ranges and types are checked.

    where: the file or option to name. Raises LumigraphError that says which value is wrong, and what it should be.
    """
    try:
        return msgspec.convert(value, kind)
    except (msgspec.ValidationError, ValueError, TypeError) as error:
        raise LumigraphError(f"{where} does not hold what it should: {error}") from error
