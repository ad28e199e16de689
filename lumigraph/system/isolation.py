"""Isolation from the working directory, which another user may have made."""

import os
import sys

PACKAGES = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
# Numba reads .numba_config.yaml in the working directory; the environment's values win over it. Both name code to load.
NUMBA_PATHS = "NUMBA_CACHE_DIR", "NUMBA_CACHE_LOCATOR_CLASSES"


def ignore_working_directory() -> None:
    """Import no module of the working directory, where `python -m lumigraph` looks first, and no code cached there.

    To be called before any module is imported that Python has not loaded at its start. A checkout that is not installed
    stays on the path.
    """
    if sys.argv[:1] == ["-m"] and not sys.flags.safe_path and os.path.abspath(sys.path[0]) != PACKAGES:
        del sys.path[0]
    for name in NUMBA_PATHS:
        os.environ.setdefault(name, "")
