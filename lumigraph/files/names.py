"""Names for users: natural order, counts, suggestions for misspelt ones."""

from __future__ import annotations

import atexit
import contextlib
import difflib
import itertools
import re
from collections.abc import Sequence
from pathlib import Path

MAX_DIGITS = 20  # more than any number in a file's name has: nanoseconds since 1970 have 19


def natural(name: str) -> tuple[str, str]:
    """Sort key by which numbers in names are ordered by value: 1, 2, 10.

    Names whose numbers have the same number of digits keep the order that `sorted` gives them.
    """
    return re.sub("[0-9]+", lambda number: number[0].zfill(MAX_DIGITS), name), name


def next_free(prefix: str) -> Path:
    """The first of prefix-1, prefix-2, ... that does not exist yet, made as an empty folder, so that no other process
    takes it. It is deleted at the end of this process if it is still empty."""
    for n in itertools.count(1):
        path = Path(f"{prefix}-{n}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError:  # said where it is written to
            return path
        atexit.register(discard, path)
        return path
    raise AssertionError("whole numbers do not end")


def discard(folder: Path) -> None:
    """Delete a folder if it is empty."""
    with contextlib.suppress(OSError):
        folder.rmdir()


def counted(number: int, noun: str) -> str:
    """Count with a noun: "3 photographs", "1 photograph", "no photographs"."""
    return f"{number or 'no'} {noun}{'' if number == 1 else 's'}"


def meant(name: str, known: Sequence[str]) -> str | None:
    """Best suggestion for a misspelt name; None without a close one.

    Compares letters only: equal ones ("instantngp"), a part of a name ("splat"), its words' initials ("3dgs", "ff"),
    and last the least edit distance to the name or a word of it. Among several, one of fewest words comes first.
    """
    said = letters(name)
    if not said:
        return None
    for fits in (
        lambda other: said == letters(other),
        lambda other: said in letters(other) or letters(other) in said,
        lambda other: said.endswith(initials(other)) and len(initials(other)) > 1,
    ):
        if found := sorted(filter(fits, known), key=lambda other: other.count("-")):
            return found[0]
    whole = {letters(other): other for other in known}
    parts = {
        part: other for other in reversed(known) for part in other.split("-")
    } | whole  # a whole name before another's part
    near = difflib.get_close_matches(said, parts, n=1)
    return parts[near[0]] if near else None


def letters(name: str) -> str:
    return re.sub("[^a-z]", "", name.lower())


def initials(name: str) -> str:
    return "".join(word[0] for word in re.split("[-_ ]", name.lower()) if word)
