"""Compiled kernels of an installed package, kept for the next environment with the same files (Numba).

Importing this module has Numba ask KernelLocator first, so rooms with kernels import it before any is defined.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CacheImpl, UserWideCacheLocator

from .cache import cache_folder

PACKAGE = Path(__file__).parents[1]


@cache
def fingerprint(package: Path) -> str:
    """Name for the kernels of a package: changes with any of its files and with Numba, not with where they lie."""
    digest = hashlib.sha256(numba.__version__.encode())
    for file in sorted(package.rglob("*.py")):
        content = file.read_bytes()
        digest.update(f"\n{file.relative_to(package).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


class KernelLocator(UserWideCacheLocator):
    """Folder in which Numba keeps a function's machine code: the same for all environments that hold the same package.

    Numba's own folders depend on where the source file lies, so each environment would compile all kernels anew. The
    processor and the types of the arguments are part of Numba's index. In a source tree, whose files change one by one,
    in a folder that cannot be written and with NUMBA_CACHE_DIR Numba's own folders hold.
    """

    package = PACKAGE

    def __init__(self, function: Any, file: str):
        self._py_file, self._lineno = file, function.__code__.co_firstlineno
        self._stamp = fingerprint(self.package)
        below = Path(file).relative_to(self.package).parent
        self._cache_path = str(cache_folder() / "kernels" / self._stamp / below)

    def get_source_stamp(self) -> str:
        return self._stamp

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> KernelLocator | None:
        source_tree = (cls.package.parent / "pyproject.toml").exists()
        if source_tree or numba.config.CACHE_DIR or cls.package not in Path(file).parents:
            return None
        return super().from_function(function, file)


class LastLocator(KernelLocator):
    """The same folder where Numba has none: neither the package nor the user's home can be written."""

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> KernelLocator | None:
        if cls.package not in Path(file).parents:
            return None
        return super(KernelLocator, cls).from_function(function, file)


CacheImpl._locator_classes = [KernelLocator, *CacheImpl._locator_classes, LastLocator]
