"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .errors import LumigraphError

NUMBERS = re.compile(r"\[[-+.eE\d,\s]*\]")
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


def read_json(path: Path) -> Any:
    """Raises LumigraphError if the file is missing or is no JSON."""
    with explained(path):
        try:
            return json.loads(path.read_text("utf-8"))
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise LumigraphError(f"{path} cannot be read as JSON ({error}); restore it from a copy") from error


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
