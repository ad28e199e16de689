"""Options behind a procedural name: "still-life,size=400,seed=1"."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, TypeVar

from ..errors import LumigraphError
from ..files.ranges import Seed, between, typed

MAX_DIGITS = 20  # of a number
Options = TypeVar("Options")


@dataclass(frozen=True)
class Pictures:
    """Options of every scene.

    size: of the square pictures, pixels; views: number of photographs to learn from; seed: where cameras stand;
    jitter_poses: degrees, and percent of the box of interest, by which poses to learn from are off
    """

    size: Annotated[int, between(1, 8192)] = 200
    views: Annotated[int, between(1, 10_000)] = 100
    seed: Seed = 0
    jitter_poses: Annotated[int, between(0, 45)] = 0


def told(kind: type[Options], request: str) -> tuple[str, Options]:
    """The name, and the options as a dataclass of whole numbers. Raises LumigraphError for one that does not exist."""
    name, *rest = request.split(",")
    return name, typed(kind, dict(parse(kind, request, text) for text in rest), f"procedural:{request}")


def parse(kind: type, request: str, text: str) -> tuple[str, int]:
    """One option, "size=400"."""
    name, _, value = text.strip().partition("=")
    known = [field.name for field in fields(kind)]
    if name not in known:
        raise LumigraphError(f"procedural:{request}: there is no option {name!r}; there are {', '.join(known)}")
    if not value.isdecimal() or len(value) > MAX_DIGITS:
        raise LumigraphError(f"procedural:{request}: {name} must be a whole number, as in {name}=20; got {value!r}")
    return name, int(value)
