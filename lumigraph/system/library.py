"""pycolmap, loaded so that SIGTERM stays ours: its logging library would answer by a stack of C++ and exit code -15."""

from .signals import untouched

with untouched():
    import pycolmap

__all__ = ["pycolmap"]
