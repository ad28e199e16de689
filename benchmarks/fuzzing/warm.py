"""A process that has loaded all there is to load, so that copies of it begin a command at once.

Copies are made by fork, which no threads survive. So everything has one thread (`alone`), and nothing is computed.
"""

from __future__ import annotations

import lumigraph  # ahead of PyTorch, as the command line does; isort: skip
import contextlib
import importlib
import pkgutil
import sys
from types import ModuleType

import torch
from numba.core.dispatcher import Dispatcher

LATE = ("torch._dynamo", "av", "pycolmap", "trimesh", "PIL.ImageFile", "msgspec", "scipy.spatial")


def warm() -> None:
    """Load every module of the package, what they load late, and the kernels that were compiled before."""
    torch.set_num_threads(1)
    from lumigraph.system.signals import untouched

    with untouched():
        for name in LATE:
            importlib.import_module(name)
    for found in pkgutil.walk_packages(lumigraph.__path__, "lumigraph."):
        if found.name.rpartition(".")[2] not in ("__main__", "gpu"):
            compiled(importlib.import_module(found.name))
    importlib.import_module("PIL.Image").init()  # it knows its formats only when it first opens something


def compiled(module: ModuleType) -> None:
    """Load what Numba keeps on disk of a module's functions, so that no copy has to."""
    for function in vars(module).values():
        if isinstance(function, Dispatcher) and function.py_func.__module__ == module.__name__:
            kept = getattr(function._cache, "_cache_file", None)
            for signature, *_ in kept._load_index() if kept else ():
                with contextlib.suppress(Exception):  # of another machine: it is compiled when it is needed
                    function.compile(signature)


def run(arguments: list[str]) -> int:
    """Run `python -m lumigraph`, or a reader's function, in a process of its own. Returns the exit code."""
    import traceback

    from lumigraph.__main__ import main

    from .functions import read

    sys.argv = ["lumigraph", *arguments]
    try:
        return read(*arguments[1:]) if arguments[:1] == ["read"] else int(main() or 0)
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else int(leave.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1


def guests() -> set[str]:
    """Methods that the tests bring along, which are no part of the package."""
    folder = importlib.import_module("pathlib").Path(__file__).resolve().parents[2] / "tests" / "methods"
    return {path.stem.replace("_", "-") for path in folder.glob("*.py")}
