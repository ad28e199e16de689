"""pycolmap, imported after Pillow, without log files, and without its SIGTERM handler.

- If pycolmap is imported first, the first PNG that Pillow saves crashes the process by a double free.
- Its logging library answers SIGTERM with a C++ stack trace and exit code -15.
- It writes the names of all photographs to files in the system's temporary folder, which other users may read.
"""

import PIL.Image  # noqa: F401  # before pycolmap

from .signals import untouched

with untouched():
    import pycolmap

pycolmap.logging.logtostderr = True

__all__ = ["pycolmap"]
