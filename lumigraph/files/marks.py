"""Records of files that Lumigraph wrote into a folder: lines of JSON in a file `.lumigraph` there.

Each line is a file: its name, its kind, its bytes and their SHA-256. A file is ours if a line matches its present
content. A mark inside each file would fail: some formats have no room (.splat), and it would survive an edit or come
from another user's Lumigraph. So would a record in the user's home: folders are moved, copied, mounted in containers.

Lines are only appended, in one write: concurrent processes lose nothing, and a kill leaves half a line at most, which
is skipped. A line precedes its file; one whose file was never written matches no other. A `.lumigraph` of another
program is kept, and files beside it are not recognised later.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections import defaultdict
from pathlib import Path
from typing import Literal

MARKS_FILE = ".lumigraph"
FIRST_LINE = b'{"lumigraph": "what it wrote here, by which it knows its own again"}\n'
WHOLE_FOLDER = "."  # the name that stands for a folder which was written as one

Sum = tuple[int, str]  # bytes, SHA-256
Kind = Literal[
    "guidance",
    "film", "film of depth", "pictures of a film", "cameras of a film", "camera path", "composition",
    "page", "splats", "octree", "atlas", "points", "mesh", "panorama", "comparison", "drawings", "scores of drawings",
    "evaluation", "rendering", "report", "figure", "benchmark", "capture", "masks", "canonical", "depth maps",
    "light field", "quilt", "probes", "file",
]  # fmt: skip


def note(path: Path, kind: Kind, written: Path) -> None:
    """Record a file, still under another name, as ours at `path`. OSError if the disk is full."""
    add(path.parent, kind, {path.name: sum_of(written)})


def note_folder(folder: Path, kind: Kind) -> None:
    """Record a folder with all its contents as ours, of one kind. OSError if the disk is full."""
    for place, _, names in os.walk(folder):
        whole: dict[str, Sum] = {WHOLE_FOLDER: (0, "")} if Path(place) == folder else {}
        add(Path(place), kind, whole | {name: sum_of(Path(place, name)) for name in names if name != MARKS_FILE})


def is_ours(path: Path, kind: Kind) -> bool:
    """True if Lumigraph wrote this file as this kind and it is unchanged. False for links."""
    return is_among(known(path.parent, kind), path)


def is_whole(folder: Path, kind: Kind) -> bool:
    """True if Lumigraph wrote a folder as a whole of this kind; see `foreign_in` for later additions."""
    return WHOLE_FOLDER in known(folder, kind)


def foreign_in(folder: Path, kind: Kind) -> Path | None:
    """A file in a folder or its subfolders that Lumigraph did not write or that has changed since; or None."""
    for place, folders, names in os.walk(folder):
        here, sums = Path(place), known(Path(place), kind)
        own = {MARKS_FILE} if is_record(here / MARKS_FILE) else set()
        for name in {*folders, *names} - own:
            if (here / name).is_symlink() or (name in names and not is_among(sums, here / name)):
                return here / name
    return None


def is_among(sums: dict[str, set[Sum]], path: Path) -> bool:
    about, there = os.lstat(path), sums.get(path.name, set())
    looks_so = stat.S_ISREG(about.st_mode) and about.st_size in {size for size, _ in there}
    return looks_so and sum_of(path) in there


def sum_of(path: Path) -> Sum:
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return file.tell(), digest


def known(folder: Path, kind: Kind) -> dict[str, set[Sum]]:
    """Recorded files of this kind, by name; empty without a valid record."""
    sums: dict[str, set[Sum]] = defaultdict(set)
    for line in (folder / MARKS_FILE).read_bytes().splitlines() if is_record(folder / MARKS_FILE) else []:
        try:
            row = json.loads(line)
            if row["kind"] == kind:
                sums[row["name"]].add((row["bytes"], row["sha256"]))
        except (ValueError, LookupError, TypeError, RecursionError):
            continue
    return sums


def is_record(path: Path) -> bool:
    """True if a path is a record created by Lumigraph."""
    try:
        if not stat.S_ISREG(os.lstat(path).st_mode):
            return False
        with open(path, "rb") as file:
            return file.read(len(FIRST_LINE)) == FIRST_LINE
    except OSError:
        return False


def add(folder: Path, kind: Kind, sums: dict[str, Sum]) -> None:
    """Append lines to a folder's record; create it if missing."""
    path = folder / MARKS_FILE
    is_new = not os.path.lexists(path)
    if not (sums and (is_new or is_record(path))):
        return
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    try:
        file = open(os.open(path, flags, 0o666), "wb")
    except PermissionError:
        return  # another user's, in a folder that both may write to
    rows = [{"name": name, "kind": kind, "bytes": size, "sha256": sha256} for name, (size, sha256) in sums.items()]
    lines = b"".join(b"\n" + json.dumps(row).encode() + b"\n" for row in rows)  # after half a line, a line of its own
    with file:
        file.write((FIRST_LINE if is_new else b"") + lines)
