"""Folder locks, which the system releases when the process ends, even killed.

So the lock file of a killed process is no lock and need not be deleted.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from ..errors import LumigraphError
from .atomic import explained, read_json

LOCK_FILE = "lock.json"  # in the folder: the holder, for people; the system's lock on this file decides
FILE_START = b'{"process": '
LOCKED_BYTE = 1 << 30  # position of the byte that Windows locks, because it makes locked bytes unreadable

_ours: set[Path] = set()  # held by this process


@dataclass(frozen=True)
class Holder:
    """Contents of a lock file."""

    process: int
    host: str
    since: str


@contextlib.contextmanager
def lock_folder(folder: Path, doing: str) -> Iterator[None]:
    """Lock an existing folder inside this block; reentrant within a process.

    doing: activity of the lock, such as "trained"
    Raises LumigraphError, naming the holder, if another process has the lock.
    """
    place = folder.resolve() / LOCK_FILE
    if place in _ours:
        yield
        return
    check_place(folder)
    with explained(place):
        file = taken(place)
    if file is None:
        raise LumigraphError(f"{folder} is being {doing} by {holder(place)}; wait until that ends, or end it")
    _ours.add(place)
    try:
        yield
    finally:
        _ours.discard(place)
        with contextlib.suppress(OSError):  # Windows deletes no open file; then it stays, and means nothing
            place.unlink()
        file.close()


def check_place(folder: Path) -> None:
    """Raise LumigraphError for a foreign file at the path of a folder's lock, which would be replaced."""
    with explained(folder / LOCK_FILE):
        if not is_lock(folder / LOCK_FILE):
            raise LumigraphError(f"{folder / LOCK_FILE} is no lock of Lumigraph's; rename it, or choose another folder")


def is_lock(place: Path) -> bool:
    """True if the path is free for a lock file: it does not exist, or is a held or abandoned lock file."""
    if not os.path.lexists(place):
        return True
    if place.is_symlink() or not place.is_file():
        return False
    try:
        return place.read_bytes()[: len(FILE_START)] in (FILE_START, b"")
    except FileNotFoundError:
        return True  # it went just now


def taken(place: Path) -> TextIO | None:
    """The lock's file, open and locked; None if another process has the lock."""
    while True:
        file = open(place, "a+", encoding="utf-8")
        if not lock(file):
            file.close()
            return None
        if os.name == "nt" or is_still(place, file):
            file.truncate(0)
            json.dump({"process": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%F %T")}, file)
            file.flush()
            return file
        file.close()  # its holder deleted it just now: the next one will be another file


def is_still(place: Path, file: TextIO) -> bool:
    try:
        return os.path.samestat(os.stat(place), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def lock(file: TextIO) -> bool:
    """Try to lock an open file; True if it succeeds or the file system has no locks."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(LOCKED_BYTE)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as fault:
        return fault.errno in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
    return True


def holder(place: Path) -> str:
    """Description of a lock's holder."""
    try:
        said = read_json(place, Holder)
    except LumigraphError:  # it is being written just now
        return "another process"
    return f"process {said.process} on {said.host} since {said.since}"
