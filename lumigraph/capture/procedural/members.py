"""Collections of procedural objects: "toys,count=200" are many, "toys,member=3" is one of them as a scene of its own.

Its pictures are traced once and then lie in the user's cache, for a collection is gone through again and again.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

from ...ranges import Seed, between
from . import categories
from .options import told
from .stage import Stage

Number = Annotated[int, between(0, 99_999)]


@dataclass(frozen=True)
class Member:
    """size: of the square pictures, pixels; views: to learn from; seed: of everything; member: its number."""

    size: Annotated[int, between(1, 8192)] = 64
    views: Annotated[int, between(1, 10_000)] = 20
    seed: Seed = 0
    member: Number = 0


@dataclass(frozen=True)
class Many:
    """As `Member`; count: of members."""

    count: Annotated[int, between(1, 100_000)] = 200
    size: Annotated[int, between(1, 8192)] = 64
    views: Annotated[int, between(1, 10_000)] = 20
    seed: Seed = 0


def is_category(request: str) -> bool:
    return request.partition(",")[0] in categories.available()


def is_collection(request: str) -> bool:
    """Whether a request is for all members of a category, rather than for one, or for a scene."""
    return is_category(request) and not any(text.strip().startswith("member=") for text in request.split(",")[1:])


def members_of(request: str) -> dict[str, str]:
    """What to ask for each member of a collection by, by its name."""
    name, many = told(Many, request)
    shared = ",".join(f"{key}={value}" for key, value in asdict(many).items() if key != "count")
    return {f"{name}-{i:04d}": f"{name},member={i},{shared}" for i in range(many.count)}


def member_stage(request: str) -> Stage:
    """One object and the cameras around it."""
    name, one = told(Member, request)
    return categories.stage(name, one.member, one.size, one.views, one.seed)
