"""Open what was trained or exported: runs of one field or in blocks, splat files, SNeRG's folders and compositions."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from ..errors import LumigraphError
from ..exchange import is_moving, is_splat_file, place_of, snerg
from ..files import is_file, read_json
from ..files.reading import reads
from ..run import Opened, Run, Trained, is_block_run
from ..run.composition import CANONICAL_FORMAT, Canonicalised, Composition, Nesting
from ..run.files import MovingFile, SnergFolder, SplatFile
from .block_run import BlockRun

_held: ContextVar[Opened | None] = ContextVar("held", default=None)  # what `held_open` returns for its own path


@contextlib.contextmanager
def held_open(opened: Opened) -> Iterator[None]:
    """A block in which `open_any` and `open_run` return this object for its path, with the weights that it holds."""
    token = _held.set(opened)
    try:
        yield
    finally:
        _held.reset(token)


def held_at(path: Path) -> Opened | None:
    """The held object, if it is that of the path."""
    held = _held.get()
    return held if held is not None and held.path == path else None


@reads()
def open_any(path: Path | str, within: Nesting | None = None) -> Opened:
    """Open a path: a run's folder, one in blocks, a splat file (`exchange.SUFFIXES`, SOG, streamed or not), a moving
    one (.4dgs), a folder of SNeRG's viewer, a composition (.json), a run as `lumigraph canonicalise` placed it (.json).

    within: what it is opened as a part of
    Raises LumigraphError, in one sentence, for anything else.
    """
    path = Path(path)
    if within is None and (held := held_at(path)) is not None:
        return held
    if is_moving(path):
        return MovingFile(path)
    if is_splat_file(path):
        return SplatFile(place_of(path))
    if path.suffix.lower() == ".json" and not path.is_dir():
        said = read_json(path)
        if isinstance(said, dict) and said.get("format") == CANONICAL_FORMAT:
            return Canonicalised(path)
        return Composition(path, open_any, within)
    if is_file(path):
        raise LumigraphError(f"{path} is none of the files that open: a splat file, or a composition's JSON")
    return SnergFolder(path) if snerg.recognises(path) and not is_block_run(path) else open_run(path)


@reads()
def open_run(path: Path | str) -> Trained:
    """A run, of one field or in blocks. Raises LumigraphError for a folder that is neither."""
    held = held_at(Path(path))
    if isinstance(held, Trained):
        return held
    return BlockRun(path) if is_block_run(Path(path)) else Run(path)
