"""Proofs that are kept: a test that passed is skipped until something changes that it depends on.

What is kept lies in pytest's cache, one fingerprint for each test, and is there for a quick second run. Where the
environment says CI every test runs.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
import os
import platform
import sys
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path

import pytest

LIBRARIES = ["torch", "numpy", "numba", "llvmlite", "triton"]


def kept(depends: Callable[..., Iterable[Path] | None]) -> Callable[[Callable], Callable]:
    """Mark a test as a proof.

    depends: the files that it depends on besides its own, for the test's parameters that `depends` names; None where it
             is no proof and always runs
    """

    def mark(test: Callable) -> Callable:
        signature, names = inspect.signature(test), inspect.signature(depends).parameters

        @functools.wraps(test)
        def proof(*, request: pytest.FixtureRequest, **arguments):
            files = depends(**{name: arguments[name] for name in names})
            cache = getattr(request.config, "cache", None)
            if files is None or cache is None:
                return test(**arguments)
            now = fingerprint({Path(__file__), Path(inspect.getfile(test)), *files})
            key = f"proofs/{hashlib.sha256(request.node.nodeid.encode()).hexdigest()[:16]}"
            if cache.get(key, None) == now and not os.environ.get("CI"):
                pytest.skip("proved before, unchanged")
            test(**arguments)
            cache.set(key, now)

        request = inspect.Parameter("request", inspect.Parameter.KEYWORD_ONLY)
        proof.__signature__ = signature.replace(parameters=[*signature.parameters.values(), request])
        return proof

    return mark


def fingerprint(files: Iterable[Path]) -> str:
    """A number of the files' names and contents, the libraries' versions and what the tests run on."""
    on = sys.version, platform.machine(), os.environ.get("TRITON_INTERPRET")
    digest = hashlib.sha256(f"{on} {[version(name) for name in LIBRARIES]}".encode())
    for path in sorted(files):
        digest.update(f"{path}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:  # Triton is for Linux alone
        return None


@functools.cache
def sources(folder: Path) -> frozenset[Path]:
    """A folder's Python files, and all files of the package that they import, directly or by way of others."""
    found: set[Path] = set()
    ahead = list(folder.glob("*.py"))
    while ahead:
        path = ahead.pop()
        if path not in found:
            found.add(path)
            ahead += _imported(path)
    return frozenset(found)


def _imported(path: Path) -> Iterable[Path]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            origin = path.parents[node.level - 1] / (node.module or "").replace(".", "/")
            for place in (origin, *(origin / alias.name for alias in node.names)):
                yield from (file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file())
