"""Methods: one paper, one file or folder, found by its name."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
from pathlib import Path
from typing import Any

from ..errors import LumigraphError
from ..files.names import meant

# A method that is added comes behind these, so that no colour of theirs changes from one release to the next.
COLOURED = ("gaussian-splatting", "instant-ngp", "mip-nerf", "nerf", "fourier-features")


def available() -> list[str]:
    """The methods that are installed, as the user types them: instant_ngp.py is `instant-ngp`. A method may be a folder
    whose `__init__.py` is the paper, beside parts that no other method uses."""
    modules = (module.name for module in pkgutil.iter_modules(__path__))
    return sorted(name.replace("_", "-") for name in modules if not name.startswith("_"))


def colour(name: str) -> int:
    """The number of the colour that every chart draws a method in: that of COLOURED, or one behind them."""
    order = [*COLOURED, *(other for other in available() if other not in COLOURED)]
    return order.index(name) if name in order else len(order)


def summary(name: str) -> str:
    """The first line of a method's file: what it is and who published it. Reads the file without running it."""
    for folder in __path__:
        module = Path(folder) / name.replace("-", "_")
        file = next((x for x in (module.with_suffix(".py"), module / "__init__.py") if x.exists()), None)
        if file:
            return (ast.get_docstring(ast.parse(file.read_text("utf-8"))) or "").partition("\n")[0]
    return ""


def check(name: str) -> str:
    """The name of an installed method, or LumigraphError naming those there are."""
    name = name.replace("_", "-")
    if name not in available():
        near = meant(name, available())
        hint = f"; did you mean {near}?" if near else ""
        raise LumigraphError(f"No method {name!r} is installed; there are: {', '.join(available()) or 'none'}{hint}")
    return name


def find(name: str) -> type[Any]:
    """The subclass of Method in the module of that name. Raises LumigraphError if there is no such module."""
    from ..method import Method

    module = importlib.import_module(f"{__name__}.{check(name).replace('-', '_')}")
    here = [x for x in vars(module).values() if isinstance(x, type) and x.__module__ == module.__name__]
    (method,) = (x for x in here if issubclass(x, Method) and not inspect.isabstract(x))
    return method


def learning_from(dataset: type[Any]) -> list[str]:
    """The names of the installed methods that learn from a kind of dataset."""
    return [name for name in available() if issubclass(dataset, find(name).learns_from)]


def name_of(method: Any) -> str:
    """Name of a method or its class on the command line: that of its file."""
    kind = method if isinstance(method, type) else type(method)
    return kind.__module__.rpartition(".")[2].replace("_", "-")
