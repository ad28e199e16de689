"""Folder searches with limits of entries and seconds, so that no response of the app waits for a huge one."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Generic, TypeVar

from ..files.atomic import refusal

MAX_ENTRIES, MAX_DEPTH = 20_000, 64  # of one search
CARD_SECONDS, PAGE_SECONDS = 0.25, 3.0  # of one search for a card of many, and for the page of one item
CUT_SECONDS = 60.0  # until a folder that was not looked through is tried again
SETTLED_SECONDS = 0.1  # after which a further change gives a folder another time of change
MAX_KEPT = 4096  # folders whose findings are kept

T = TypeVar("T")


class Search:
    """A limited search through a folder.

    changed: modification times (content, permissions) of each folder that was read
    fault:   a sentence on what could not be read; is_cut: whether the search ended at a limit
    """

    def __init__(self, folder: Path, seconds: float):
        self.folder, self.begun, self._seconds = folder, time.monotonic(), seconds
        self.changed: dict[str, tuple[int, int]] = {}
        self.fault, self.is_cut, self._count = "", False, 0

    def entries(self, folder: Path) -> Iterator[Path]:
        """Entries of a folder; none of one that cannot be read."""
        self.is_cut |= len(folder.parts) - len(self.folder.parts) > MAX_DEPTH
        if self.is_cut:
            return
        try:
            self.changed[str(folder)] = times_of(folder)
            with os.scandir(folder) as found:
                for entry in found:
                    self._count += 1
                    if self._count > MAX_ENTRIES or time.monotonic() - self.begun > self._seconds:
                        self.is_cut = True
                    if self.is_cut:
                        return
                    yield Path(entry.path)
        except OSError as error:
            self.fault = self.fault or refusal(folder, error)
        except ValueError:  # NUL, which no path has
            self.fault = f"{str(folder)!r} is no path; name another folder of photographs"

    @property
    def sentence(self) -> str:
        """Sentence on an incomplete search; empty for a complete one."""
        if self.is_cut:
            return f"{self.folder} has more in it than a page shows; name a folder of photographs alone"
        return self.fault

    def is_current(self) -> bool:
        """True until one of the folders changes; for an incomplete search, for a while."""
        if self.is_cut:
            return time.monotonic() - self.begun < CUT_SECONDS
        try:
            return bool(self.changed) and all(times_of(one) == times for one, times in self.changed.items())
        except OSError:
            return False

    def is_settled(self) -> bool:
        """True if modification times will show every later change of a folder."""
        latest = max((max(times) for times in self.changed.values()), default=0)
        return time.time() - latest / 1e9 > SETTLED_SECONDS


def times_of(folder: Path | str) -> tuple[int, int]:
    about = os.stat(folder)
    return about.st_mtime_ns, about.st_ctime_ns


class Finder(Generic[T]):
    """Cached result of a folder search, valid while the folder is unchanged.

    find: searches the folder, for at most so many seconds
    """

    def __init__(self, find: Callable[[Search], T], seconds: float = CARD_SECONDS):
        self._find, self._seconds = find, seconds
        self._kept: dict[Path, tuple[Search, T]] = {}

    def __call__(self, folder: Path, until: float = float("inf")) -> tuple[Search, T] | None:
        """Search and result. until: time (time.monotonic) after which only a cached result is returned"""
        known = self._kept.get(folder)
        if time.monotonic() > until or (known and known[0].is_current()):
            return known
        search = Search(folder, self._seconds)
        found = search, self._find(search)
        if len(self._kept) > MAX_KEPT:
            self._kept.clear()
        if search.is_settled() or search.is_cut:
            self._kept[folder] = found
        return found


def _size(search: Search) -> int | None:
    total, ahead = 0, [search.folder]
    while ahead:
        for path in search.entries(ahead.pop()):
            with suppress(OSError):
                if path.is_dir() and not path.is_symlink():
                    ahead.append(path)
                elif path.is_file():
                    total += path.stat().st_size
    return None if search.is_cut else total


_sizes = Finder(_size)


def size_within(path: Path, until: float = float("inf")) -> int | None:
    """Bytes of a file, or of all files of a folder; None if the limits were exceeded."""
    if path.is_file():
        return path.stat().st_size
    found = _sizes(path, until)
    return found[1] if found else None
