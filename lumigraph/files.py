"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any

import msgspec

from .errors import LumigraphError
from .ranges import typed

NUMBERS = re.compile(r"\[[-+.eE\d,\s]*\]")
DEEPEST = 100  # levels that JSON may nest; whoever walks through it again has room for them
BUT_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))
PARTIAL = ".partial"  # what is still being written, or being deleted; whoever reads a folder passes over it


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path to write a file or a folder to, in the folder of `path`; it takes that place once the block ends well.

    After a fault or a kill the place holds what it held before. Raises LumigraphError if the disk refuses.
    """
    partial = path.with_name(f"{path.stem}{PARTIAL}{path.suffix}")
    with explained(path):
        remove(partial)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            sync(partial)
            if path.is_dir():
                remove(path)  # a folder cannot be replaced in one step; Run never needs it
            os.replace(partial, path)
            sync_folder(path.parent)
        except BaseException:
            remove(partial)
            raise


def write_bytes(path: Path, data: bytes) -> None:
    with replacing(path) as partial:
        partial.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """JSON for programs and people: indented, but rows of numbers stay rows."""
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    text = NUMBERS.sub(lambda match: " ".join(match[0].split()).replace("[ ", "[").replace(" ]", "]"), text)
    write_bytes(path, text.encode() + b"\n")


def read_json(path: Path, kind: Any = Any) -> Any:
    """What a file of JSON says, as a value of a kind (see `ranges.typed`); as it stands there if none is named.

    Raises LumigraphError, naming the file, if it is missing, is no JSON (NaN, infinity and numbers of hundreds of
    digits are none either), nests deeper than anything sound does, or does not hold what the kind says.
    """
    with explained(path):
        return typed(kind, from_json(path.read_bytes(), path), path)


def from_json(data: bytes, where: Path | str) -> Any:
    """Plain values of JSON. where: what to name in a LumigraphError; see `read_json`."""
    nesting = accumulate(1 if bracket in b"[{" else -1 for bracket in data.translate(None, BUT_BRACKETS))
    if max(nesting, default=0) > DEEPEST:
        raise LumigraphError(f"{where} nests deeper than {DEEPEST} levels, as no sound file does; restore it")
    try:
        return msgspec.json.decode(data)
    except (ValueError, RecursionError) as error:
        at = re.search(r"byte (\d+)", str(error))
        line = f", line {1 + data.count(bytes([10]), 0, int(at[1]))}" if at else ""
        reason = str(error).partition(" (byte")[0]
        raise LumigraphError(f"{where} cannot be read as JSON ({reason}{line}); restore it from a copy") from error


def is_file(path: Path) -> bool:
    """Whether a file lies there; none does under a name that the system takes for no name."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def exists(path: Path) -> bool:
    """Whether something lies there; nothing does under a name that the system takes for no name."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def expanded(name: Path | str) -> Path:
    """A path with the home folder for its ~, or as it stands where nobody is called so."""
    try:
        return Path(name).expanduser()
    except RuntimeError:
        return Path(name)


def remove(path: Path) -> None:
    """Delete a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Make sure that what was written survives a loss of power."""
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
    """Turn the operating system's refusals into one sentence about `path`."""
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
    """A short name for files: the last part of a path, without a file's suffix, or of "procedural:<name>"."""
    path = Path(source).resolve()
    last = source.partition(":")[2] if source.startswith("procedural:") else path.stem if path.is_file() else path.name
    return re.sub(r"[^\w.-]+", "-", last) or "scene"
