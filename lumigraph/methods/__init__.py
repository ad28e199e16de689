"""Methods: one paper, one file or folder, found by its name.

Further methods come from other packages, by an entry point of the group `lumigraph.methods`; from a file, by
`--method-file my.py` or `load`; and from Python, by `register`. These are called after their class: SoftColours is
soft-colours.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import inspect
import pkgutil
import re
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from .. import files
from ..errors import LumigraphError
from ..files.names import meant
from ..system.cache import cache_folder

ENTRY_POINTS = "lumigraph.methods"  # group of entry points, each NAME = "package.module:Class"
LOADED_FILE = "methods.json"  # in the cache: files of methods that this user has loaded, and their SHA-256

# A method that is added comes behind these, so that no colour of theirs changes from one release to the next.
COLOURED = ("gaussian-splatting", "instant-ngp", "mip-nerf", "nerf", "fourier-features")

ALIASES = {  # words for the default method of a purpose
    "surface": "planar-splatting",
    "splats": "gaussian-splatting",
}
BOUNDED = {"surface": "neus"}  # instead of ALIASES, for scenes that are bounded

_registered: dict[str, type[Any]] = {}  # methods from elsewhere, by name
METHOD_FILE = "--method-file"  # an option of every command
MODULE_PREFIX = "lumigraph_method_"  # of the modules of loaded files


def available() -> list[str]:
    """The methods that are installed or registered, as the user types them: instant_ngp.py is `instant-ngp`. A method
    may be a folder whose `__init__.py` is the paper, beside parts that no other method uses."""
    return sorted({*own(), *elsewhere(), *_registered})


def own() -> set[str]:
    """The methods of this folder."""
    modules = (module.name for module in pkgutil.iter_modules(__path__))
    return {name.replace("_", "-") for name in modules if not name.startswith("_")}


@cache
def elsewhere() -> dict[str, EntryPoint]:
    """Entry points of other packages' methods, by name; those of our own names are passed over."""
    return {entry.name: entry for entry in entry_points(group=ENTRY_POINTS) if entry.name not in own()}


def register(kind: type[Any], name: str | None = None) -> type[Any]:
    """Let a Method of one's own be found by a name, by default that of its class; usable as a decorator.

    Raises LumigraphError for a class that cannot be a method, and for a name that another method has.
    """
    from ..method import Method

    if not (isinstance(kind, type) and issubclass(kind, Method)) or inspect.isabstract(kind):
        raise LumigraphError(f"{kind} is no method; derive it from lumigraph.Method and write what that asks for")
    name = name or name_of(kind)
    other = _registered.get(name)
    if name in own() or (other is not None and (other.__module__, other.__qualname__) != names_of_class(kind)):
        raise LumigraphError(f"There is another method {name}; register {kind.__name__} under another name")
    _registered[name] = kind
    return kind


def load(path: Path | str) -> list[str]:
    """Run a Python file and register the methods in it; gives their names. The file counts as trusted from then on, so
    that runs of its methods open by themselves. Raises LumigraphError where it fails, or holds none."""
    from ..method import Method

    path = Path(path).expanduser().resolve()
    data = files.read_bytes(path)
    module_name = f"{MODULE_PREFIX}{re.sub(r'[^a-zA-Z0-9_]', '_', path.stem)}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise LumigraphError(f"{path} is no Python file; name one that ends in .py")
    module = sys.modules[module_name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as fault:
        raise LumigraphError(f"{path} cannot be loaded ({type(fault).__name__}: {fault}); correct it") from fault
    here = [x for x in vars(module).values() if isinstance(x, type) and x.__module__ == module_name]
    found = [register(x) for x in here if issubclass(x, Method) and not inspect.isabstract(x)]
    if not found:
        raise LumigraphError(f"{path} holds no method: a class that derives from lumigraph.Method; add one")
    with suppress(LumigraphError):  # a cache that cannot be written
        loaded = loaded_files() | {str(path): hashlib.sha256(data).hexdigest()}
        files.write_json(cache_folder() / LOADED_FILE, loaded, ours=True)
    return [name_of(kind) for kind in found]


def loaded_files() -> dict[str, str]:
    """SHA-256 of each file of methods that this user has loaded, by its path."""
    path = cache_folder() / LOADED_FILE
    return files.read_json(path, dict[str, str]) if files.is_file(path) else {}


def known_again(name: str, file: str | None) -> bool:
    """True if a run's method is available, once its file is loaded. A file runs only if this user has loaded the same
    contents before: a run from elsewhere executes nothing."""
    if name in available():
        return True
    if file is None or not files.is_file(file):
        return False
    with suppress(LumigraphError):
        if loaded_files().get(file) == hashlib.sha256(files.read_bytes(Path(file))).hexdigest():
            load(file)
    return name in available()


def file_of(kind: type[Any]) -> str | None:
    """The file of a method from elsewhere, if it has one and is in no installed package."""
    if kind.__module__.startswith(f"{__name__}.") or name_of(kind) in elsewhere():
        return None
    module = sys.modules.get(kind.__module__)
    file = getattr(module, "__file__", None)
    return None if file is None else str(Path(file).resolve())


def loaded_here() -> list[str]:
    """The files that `load` has registered methods from in this process, for other processes to load."""
    here = (kind for kind in _registered.values() if kind.__module__.startswith(MODULE_PREFIX))
    return sorted({file for kind in here if (file := file_of(kind))})


def colour(name: str) -> int:
    """The number of the colour that every chart draws a method in: that of COLOURED, or one behind them."""
    order = [*COLOURED, *(other for other in available() if other not in COLOURED)]
    return order.index(name) if name in order else len(order)


def summary(name: str) -> str:
    """The first paragraph of a method's file, as one line: what it is and who published it. Reads the file without
    running it."""
    for folder in __path__:
        module = Path(folder) / name.replace("-", "_")
        file = next((x for x in (module.with_suffix(".py"), module / "__init__.py") if x.exists()), None)
        if file:
            return first_paragraph(ast.get_docstring(ast.parse(file.read_text("utf-8"))))
    kind = find(name)
    return first_paragraph(inspect.getdoc(sys.modules.get(kind.__module__)) or inspect.getdoc(kind))


def first_paragraph(docstring: str | None) -> str:
    """First paragraph of a docstring, as one line."""
    return " ".join((docstring or "").partition("\n\n")[0].split())


def check(name: str) -> str:
    """The name of an installed method, of itself or of a word in ALIASES; LumigraphError naming those there are."""
    name = ALIASES.get(name, name).replace("_", "-")
    if name not in available():
        near = meant(name, sorted(available(), key="gaussian-splatting".__ne__))  # the first of several
        hint = f"did you mean {near}? There are" if near else "there are"
        raise LumigraphError(f"No method {name!r} is installed; {hint}: {', '.join(available()) or 'none'}")
    return name


def find(name: str) -> type[Any]:
    """The subclass of Method of that name. Raises LumigraphError if there is none."""
    from ..method import Method

    if (name := check(name)) in elsewhere() and name not in _registered:
        try:
            register(elsewhere()[name].load(), name)
        except (ImportError, AttributeError) as fault:
            raise LumigraphError(f"{name} cannot be loaded ({fault}); install its package again") from fault
    if name in _registered:
        return _registered[name]
    module = importlib.import_module(f"{__name__}.{name.replace('-', '_')}")
    here = [x for x in vars(module).values() if isinstance(x, type) and x.__module__ == module.__name__]
    (method,) = (x for x in here if issubclass(x, Method) and not inspect.isabstract(x))
    return method


def learning_from(dataset: type[Any]) -> list[str]:
    """Names of the installed methods that train on a kind of dataset."""
    return [name for name in available() if issubclass(dataset, find(name).learns_from)]


def name_of(method: Any) -> str:
    """Name of a method or its class on the command line: that of its file here, of its class or as registered else."""
    kind = method if isinstance(method, type) else type(method)
    if kind.__module__.startswith(f"{__name__}."):
        return kind.__module__.rpartition(".")[2].replace("_", "-")
    known = (name for name, other in _registered.items() if other is kind)
    entry = (name for name, entry in elsewhere().items() if entry.value == ":".join(names_of_class(kind)))
    return next(known, None) or next(entry, None) or re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", kind.__name__).lower()


def names_of_class(kind: type[Any]) -> tuple[str, str]:
    """Module and name of a class, by which it is the same after its module was loaded again."""
    return kind.__module__, kind.__qualname__
