"""Plugins: methods, additions, readers, exports and loggers of other packages, by entry points of `lumigraph.GROUP`.

    [project.entry-points."lumigraph.methods"]
    soft-colours = "my_package.module:SoftColours"

Only what the user has installed is ever loaded, and only when its name is asked for, or its group is listed.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from ..errors import LumigraphError

GROUPS = ("methods", "additions", "readers", "exports", "loggers")


@cache
def offered(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group of GROUPS, by their names on the command line."""
    return {entry.name.replace("_", "-"): entry for entry in entry_points(group=f"lumigraph.{group}")}


def taken(group: str, name: str) -> Any:
    """Object of an entry point. Raises LumigraphError for a name that no package offers, and for one that fails."""
    if (entry := offered(group).get(name)) is None:
        there = ", ".join(offered(group)) or "none"
        raise LumigraphError(f"No package offers {name!r} of lumigraph.{group}; there are: {there}")
    try:
        return entry.load()
    except Exception as fault:
        why = f"{type(fault).__name__}: {fault}"
        raise LumigraphError(f"{name} cannot be loaded ({why}); install its package again") from fault
