"""Partial files: unique names in the destination folder, and removal of leftovers of killed processes.

A process locks a partial file while writing, and the system releases the lock when the process ends, even killed. So a
file with such a name and without a lock is a leftover of ours, deleted at the next write into the folder. On file
systems without locks it stays.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

PARTIAL_NAME = re.compile(r"\.lumigraph-[0-9a-f]{16}\.partial")

_swept: set[tuple[int, Path]] = set()  # processes and folders


@contextlib.contextmanager
def partial(folder: Path, is_folder: bool = False) -> Iterator[Path]:
    """A new empty file or folder to fill; deleted after the block unless renamed."""
    sweep(folder)
    while True:
        path, lock = folder / f".lumigraph-{os.urandom(8).hex()}.partial", None
        try:
            path.mkdir() if is_folder else path.touch(exist_ok=False)
            lock = locked(path)
            if path.exists():  # else another process took it for a leftover, before it was locked
                yield path
                return
        finally:
            remove(path)
            if lock is not None:
                os.close(lock)


def sweep(folder: Path) -> None:
    """Delete leftovers of killed processes, once for each folder."""
    if (os.getpid(), folder.absolute()) in _swept:
        return
    _swept.add((os.getpid(), folder.absolute()))
    for name in filter(PARTIAL_NAME.fullmatch, os.listdir(folder)):
        lock = locked(folder / name)
        if lock is not None:
            remove(folder / name)
            os.close(lock)


def locked(path: Path) -> int | None:
    """Descriptor that locks a file or folder; None if another process has the lock, or without locks."""
    if sys.platform == "win32":
        return None  # and files that are open could not be renamed
    import fcntl

    descriptor = None
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        if descriptor is not None:
            os.close(descriptor)
        return None
    return descriptor


def remove(path: Path) -> None:
    """Delete a file or a folder, if it exists. Of a link only the link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
