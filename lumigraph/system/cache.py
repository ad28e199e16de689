"""Cache folder of a user."""

import atexit
import os
import shutil
import stat
import sys
import tempfile
import warnings
from functools import cache
from pathlib import Path

from ..errors import LumigraphWarning


def cache_folder() -> Path:
    """Folder of this user for data that can be made again; where it cannot be written, one in the temporary folder."""
    if chosen := os.environ.get("LUMIGRAPH_CACHE"):
        return Path(chosen)
    home = Path(os.path.expanduser("~"))
    if sys.platform == "darwin":
        wanted = home / "Library" / "Caches" / "lumigraph"
    elif sys.platform == "win32":
        wanted = Path(os.environ.get("LOCALAPPDATA", home)) / "lumigraph" / "cache"
    else:
        wanted = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "lumigraph"
    return wanted if can_be_written(wanted) else temporary_cache(wanted)


def can_be_written(folder: Path) -> bool:
    """True if a folder, or one to make it in, can be written."""
    there = next((one for one in (folder, *folder.parents) if one.exists()), None)
    return folder.is_absolute() and there is not None and there.is_dir() and os.access(there, os.W_OK | os.X_OK)


@cache
def temporary_cache(wanted: Path) -> Path:
    """A folder of this user alone: what it keeps is run, so nobody else may have made it."""
    folder = Path(tempfile.gettempdir()) / f"lumigraph-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
        own = stat.S_ISDIR(about.st_mode) and not about.st_mode & 0o077 and about.st_uid == os.getuid()
    except (OSError, AttributeError):
        own = False
    if not own:
        folder = Path(tempfile.mkdtemp(prefix="lumigraph-"))
        atexit.register(shutil.rmtree, folder, True)
    warnings.warn(
        f"{wanted} cannot be written, so what is kept between commands lies in {folder}; set LUMIGRAPH_CACHE to a "
        "folder that stays",
        LumigraphWarning,
        stacklevel=3,
    )
    return folder
