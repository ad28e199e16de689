"""Shared Numba cache of an installed package's kernels, for all environments with the same files.

Importing this module registers KernelLocator first with Numba, so rooms with kernels import it before any is defined.
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
    """Cache name of a package's kernels: a hash of its files and Numba's version, independent of their location."""
    digest = hashlib.sha256(numba.__version__.encode())
    for file in sorted(package.rglob("*.py")):
        content = file.read_bytes()
        digest.update(f"\n{file.relative_to(package).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


class KernelLocator(UserWideCacheLocator):
    """Numba cache folder, common to all environments with the same package.

    Numba's own folders depend on the source file's path, so each environment would compile all kernels anew. The
    processor and the argument types are part of Numba's index. In a source tree, whose files change one by one, in a
    read-only folder and with NUMBA_CACHE_DIR Numba's own folders are used.
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
