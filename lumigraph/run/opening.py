"""open_any(): one door to everything that opens. A new kind of file is a line here and a file beside this one."""

from __future__ import annotations

import importlib
from pathlib import Path

from ..errors import LumigraphError
from ..exchange import is_splat_file, place_of, snerg
from ..files import is_file, read_json
from .canonicalised import FORMAT, Canonicalised
from .composition import Composition
from .folder import Run, is_block_run
from .opened import Opened, Trained
from .snerg_folder import SnergFolder
from .splat_file import SplatFile


def open_any(path: Path | str, within: tuple[Path, ...] = ()) -> Opened:
    """Open a path: a run's folder, one in blocks, a splat file (`exchange.SUFFIXES`, SOG, streamed or
    not), a folder of SNeRG's viewer, a composition (.json), a run as `lumigraph canonicalise` placed it (.json).

    within: compositions that it is opened as a part of
    Raises LumigraphError, in one sentence, for anything else.
    """
    path = Path(path)
    if is_splat_file(path):
        return SplatFile(place_of(path))
    if path.suffix.lower() == ".json" and not path.is_dir():
        said = read_json(path)
        if isinstance(said, dict) and said.get("format") == FORMAT:
            return Canonicalised(path)
        return Composition(path, open_any, within)
    if is_file(path):
        raise LumigraphError(f"{path} is none of the files that open: a splat file, or a composition's JSON")
    return SnergFolder(path) if snerg.recognises(path) and not is_block_run(path) else open_run(path)


def open_run(path: Path | str) -> Trained:
    """A run, of one field or in blocks. Raises LumigraphError for a folder that is neither."""
    if not is_block_run(Path(path)):
        return Run(path)
    large = importlib.import_module("..large", __package__)  # by name, for that room stands above this one
    return large.BlockRun(path)
