"""open_any(): one door to everything that opens. A new kind of file is a line here and a file beside this one."""

from __future__ import annotations

from pathlib import Path

from ..errors import LumigraphError
from ..exchange import is_splat_file, place_of, snerg
from ..files import is_file
from .composition import Composition
from .folder import Run
from .opened import Opened
from .snerg_folder import SnergFolder
from .splat_file import SplatFile


def open_any(path: Path | str, within: tuple[Path, ...] = ()) -> Opened:
    """What lies at a path: a run's folder, a splat file (`exchange.SUFFIXES`, a folder of SOG), a folder of SNeRG's
    viewer, a composition (.json).

    within: compositions that it is opened as a part of
    Raises LumigraphError, in one sentence, for anything else.
    """
    path = Path(path)
    if is_splat_file(path):
        return SplatFile(place_of(path))
    if path.suffix.lower() == ".json" and not path.is_dir():
        return Composition(path, open_any, within)
    if is_file(path):
        raise LumigraphError(f"{path} is none of the files that open: a splat file, or a composition's JSON")
    return SnergFolder(path) if snerg.recognises(path) else Run(path)
