"""Atomic writing of files, without replacing foreign files.

A file is replaced only if Lumigraph wrote it, as the same kind, and it is unchanged since (`marks`), or if the user
gave --overwrite for it. A folder is replaced only if Lumigraph wrote it as one, with all its contents. Commands call
`claim` before any work; writers call it again.
"""

from __future__ import annotations

import codecs
import contextlib
import ctypes
import errno
import itertools
import json
import os
import re
import stat
import sys
from collections.abc import Callable, Container, Iterable, Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from ..errors import LumigraphError
from . import marks
from .marks import Kind as Kind
from .partials import partial
from .partials import remove as remove
from .ranges import typed

AT_FDCWD, RENAME_EXCHANGE = -100, 2  # Linux's AT_FDCWD, RENAME_EXCHANGE
NUMBER_LIST = re.compile(r"\[[-+.eE\d,\s]*\]")
MAX_TEXT_BYTES = 1 << 28  # bytes of a file of JSON, poses or a log
MAX_JSON_DEPTH = 100  # nesting levels of JSON; a recursive walk has room for them
BUT_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))

is_file, exists = os.path.isfile, os.path.exists  # False for a name that the system rejects

Seen = tuple[int, ...]  # by which a file is known to be the same, unchanged

_granted: dict[Path, Seen | None] = {}  # what lay there when this process was allowed to write there


def claim(path: Path, kind: Kind, overwrite: bool | None = None, reads: Iterable[Path] = ()) -> None:
    """Raise LumigraphError unless a file may be written. Commands call it before their work.

    kind:      of the new file; it replaces only files of its kind
    overwrite: whether the user allows replacing any file; None where no option asks
    reads:     inputs of the work, which are never replaced
    """
    place = Path(os.path.abspath(path))
    with explained(path):
        if any(one.exists() and path.exists() and one.samefile(path) for one in reads):
            raise LumigraphError(f"{path} would be replaced, and is what the command reads; choose another name")
        there = path_status(path)
        if place in _granted and _granted[place] == there:
            return
        check_room(place)
        if there is not None:
            if path.is_symlink():
                raise LumigraphError(
                    f"{path} is a link, which stays as it is; name the file that it leads to, or another one"
                )
            if not path.is_file():
                what = "a folder" if path.is_dir() else "no ordinary file"
                raise LumigraphError(f"{path} is {what}; choose another name for the file")
            if not (overwrite or marks.is_ours(path, kind)):
                option = "" if overwrite is None else ", or give --overwrite"
                raise LumigraphError(
                    f"{path} is there already, and not as Lumigraph has written it; move it away, choose another "
                    f"name{option}"
                )
        _granted[place] = there


def claim_folder(path: Path, kind: Kind | None = None) -> None:
    """Raise LumigraphError unless a whole folder may be written: a path free, empty, or of the same kind."""
    with explained(path):
        check_room(Path(os.path.abspath(path)))
        if path_status(path) is None:
            return
        if path.is_symlink() or not path.is_dir():
            raise LumigraphError(
                f"{path} is to be a folder and is something else; move it away, or choose another name"
            )
        if not any(path.iterdir()):
            return
        if kind is None or not marks.is_whole(path, kind):
            raise LumigraphError(f"{path} is a folder with something else in it; move it away, or choose another name")
        if foreign := marks.foreign_in(path, kind):
            raise LumigraphError(
                f"{path} would be replaced, and {foreign.relative_to(path)} in it is not as Lumigraph has written it; "
                "move that away, or choose another name"
            )


@contextlib.contextmanager
def replacing(path: Path, kind: Kind = "file", ours: bool = False) -> Iterator[Path]:
    """An empty file to fill, in the folder of `path`; it replaces `path` after the block succeeds.

    ours: the file is part of a folder of ours, such as a run's with config.json, so that an existing one is ours
    After an error or a kill `path` is unchanged. Raises LumigraphError as `claim` does, or if the disk refuses.
    """
    if not ours:
        claim(path, kind)
    with explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial(path.parent) as new:
            yield new
            sync(new)
            target = path
            if not ours:
                target = place_now(path, lambda: claim(path, kind))
                marks.note(target, kind, new)
            os.replace(new, target)
            if not ours:
                _granted[Path(os.path.abspath(target))] = path_status(target)
            sync_folder(path.parent)
        tell_if_moved(path, target)


@contextlib.contextmanager
def replacing_folder(path: Path, kind: Kind | None = None, ours: bool = False) -> Iterator[Path]:
    """An empty folder to fill; otherwise as `replacing`. Without a kind it replaces nothing, now or later."""
    if not ours:
        claim_folder(path, kind)
    with explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial(path.parent, is_folder=True) as new:
            yield new
            sync(new)
            target = path
            if kind is not None:
                marks.note_folder(new, kind)
            if not ours:
                target = place_now(path, lambda: claim_folder(path, kind))
            exchange(new, target)
            sync_folder(path.parent)
        tell_if_moved(path, target)


def exchange(new: Path, place: Path) -> None:
    """Rename a folder to `place`. An existing one gets the folder's name, and is deleted with it."""
    if path_status(place) is None:
        os.replace(new, place)
    elif not swapped(new, place):  # no such call: a kill between these two costs what was there, and was to go
        with partial(place.parent, is_folder=True) as aside:
            old = aside / place.name
            os.replace(place, old)
            try:
                os.replace(new, place)
            except BaseException:
                if path_status(old) is not None:
                    os.replace(old, place)
                raise


def swapped(one: Path, other: Path) -> bool:
    """Swap two paths atomically; False on systems without such a call (Linux has `renameat2`)."""
    call = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    return call is not None and call(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0


def place_now(path: Path, ask: Callable[[], None]) -> Path:
    """Destination of a finished output: the requested path, or one next to it if it has been taken meanwhile."""
    try:
        ask()
        return path
    except LumigraphError:
        beside = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))
        return next(other for other in beside if path_status(other) is None)


def tell_if_moved(wanted: Path, place: Path) -> None:
    if place != wanted:
        raise LumigraphError(f"{wanted} has been changed by somebody else meanwhile; what was made is {place}")


def path_status(path: Path) -> Seen | None:
    """Status of a path without following links; None if it does not exist."""
    try:
        about = os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    return about.st_dev, about.st_ino, about.st_mode, about.st_size, about.st_mtime_ns


def refuse_link(path: str | Path) -> None:
    """Raise LumigraphError for a symbolic link at a path to be written: it would write elsewhere."""
    if os.path.islink(path):
        raise LumigraphError(f"{path} is a link, which may lead our files elsewhere; put a copy in its place")


def refuse_links(folder: Path, read_only: Container[str] = ()) -> None:
    """Raise LumigraphError for a symbolic link below a folder to be written.

    read_only: names of folders in it without writes
    """
    for place, folders, names in os.walk(folder):
        for name in (*folders, *names):
            refuse_link(os.path.join(place, name))
        if Path(place) == folder:
            folders[:] = [name for name in folders if name not in read_only]


def open_anew(path: Path) -> BinaryIO:
    """Create a file readable by this user alone, open for writing. An existing one is deleted, not a link's target."""
    with explained(path):
        path.unlink(missing_ok=True)
        return open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")


def check_room(place: Path) -> None:
    """Raise OSError unless the place is writable, as far as that can be checked beforehand."""
    above = next(folder for folder in [*place.parents, Path(place.anchor)] if os.path.lexists(folder))
    if not above.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(above))
    if not os.access(above, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(above))


def write_bytes(path: Path, data: bytes, kind: Kind = "file", ours: bool = False) -> None:
    with replacing(path, kind, ours) as new:
        new.write_bytes(data)


def write_json(path: Path, value: Any, kind: Kind = "file", ours: bool = False) -> None:
    """Write JSON, indented, with rows of numbers on single lines."""
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    text = NUMBER_LIST.sub(lambda match: " ".join(match[0].split()).replace("[ ", "[").replace(" ]", "]"), text)
    write_bytes(path, text.encode() + b"\n", kind, ours)


def read_json(path: Path, kind: Any = Any) -> Any:
    """Read JSON as a value of a type (see `ranges.typed`), or unchecked if no type is given.

    Raises LumigraphError, naming the file, if it is missing, is not JSON (NaN, infinity and numbers of hundreds of
    digits included), nests too deep, or does not match the type.
    """
    return typed(kind, from_json(read_bytes(path), path), path)


def read_bytes(path: Path, most: int = MAX_TEXT_BYTES) -> bytes:
    """Contents of a regular file of at most `most` bytes.

    Raises LumigraphError, naming the file, if it is missing, too large, or a device or pipe.
    """
    with explained(path), open(path, "rb", opener=without_waiting) as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise LumigraphError(f"{path} is no ordinary file but a device, a pipe or a folder; name a file")
        if about.st_size > most:
            raise LumigraphError(
                f"{path} has {about.st_size:,} bytes, and {most:,} are the most for such a file; restore it from a copy"
            )
        return file.read(most)


def read_text(path: Path) -> str:
    """Text of a regular file, as `read_bytes`; invalid UTF-8 becomes a replacement character."""
    return without_mark(read_bytes(path)).decode("utf-8", errors="replace")


def without_mark(data: bytes) -> bytes:
    """Text in UTF-8 without the byte-order mark that editors of Windows begin it with; text in UTF-16 as UTF-8."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace").encode()
    return data.removeprefix(codecs.BOM_UTF8)


def without_waiting(path: str, flags: int) -> int:
    """Descriptor of a file, opened without blocking on a pipe."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def from_json(data: bytes, where: Path | str) -> Any:
    """Parse JSON. where: named in a LumigraphError; see `read_json`"""
    data = without_mark(data)
    nesting = accumulate(1 if bracket in b"[{" else -1 for bracket in data.translate(None, BUT_BRACKETS))
    if max(nesting, default=0) > MAX_JSON_DEPTH:
        raise LumigraphError(f"{where} nests deeper than {MAX_JSON_DEPTH} levels, as no sound file does; restore it")
    try:
        return msgspec.json.decode(data)
    except (ValueError, RecursionError) as error:
        at = re.search(r"byte (\d+)", str(error))
        line = f", line {1 + data.count(bytes([10]), 0, int(at[1]))}" if at else ""
        reason = str(error).partition(" (byte")[0]
        raise LumigraphError(f"{where} cannot be read as JSON ({reason}{line}); restore it from a copy") from error


def expanded(name: Path | str) -> Path:
    """A path with the home folder for its ~; unchanged for an unknown user."""
    return Path(os.path.expanduser(name))


def sync(path: Path) -> None:
    """Flush a file or folder to disk, against loss of power."""
    if path.is_dir():
        for file in path.rglob("*"):
            if file.is_file():
                sync(file)
        sync_folder(path)
        return
    with open(path, "rb+") as handle:
        os.fsync(handle.fileno())


def sync_folder(folder: Path) -> None:
    if os.name == "nt":
        return  # Windows has no such call for folders, and does not need it
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """Context that turns operating system errors into one sentence about `path`."""
    try:
        yield
    except OSError as error:
        raise LumigraphError(refusal(path, error)) from error


def refusal(path: Path, error: OSError) -> str:
    match error.errno:
        case errno.ENOSPC | errno.EDQUOT:
            return f"{path} could not be written because the disk is full; free some space and try again"
        case errno.ENOENT:
            return f"{path} does not exist; check the path"
        case errno.EACCES | errno.EPERM | errno.EROFS:
            return f"{path} may not be read or written by this user; change its permissions or choose another place"
        case errno.EEXIST | errno.ENOTDIR:
            return f"{path} needs a folder where a file of that name lies; choose another place"
        case _:
            return f"{path} could not be read or written ({error.strerror or error}); choose another place"


def scene_name(source: str) -> str:
    """Short name for files: last part of a path, without suffix, or the part after "procedural:" or "words:"."""
    path = Path(source).resolve()
    own = path.stem if path.is_file() else path.name
    last = source.partition(":")[2] if source.startswith(("procedural:", "words:")) else own
    return re.sub(r"[^\w.-]+", "-", last) or "scene"
