"""Runtime checks of array shapes in all modules that state any, while tests run.

jaxtyping's checks of every call took 40 % of the suite's time, nearly all of it in small functions that a test calls
thousands of times: the first CHECKED_CALLS calls of a function in each test are checked. Only annotations that state a
shape are (mypy checks the others): a checker of all types, made for each function, took 28 % of the contract's time.
"""

from __future__ import annotations

import ast
import builtins
import collections.abc
import functools
import inspect
import re
import sys
import types
import typing
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import jaxtyping
from jaxtyping._storage import get_shape_memo, pop_shape_memo, push_shape_memo, set_shape_memo, shape_str

CHECKED_CALLS = 5
JIT = re.compile(r"^\s*(import|from) (numba|triton)\b", re.MULTILINE)
PACKAGE = Path(__file__).parent.parent / "lumigraph"
# Loaded before anything else, and without shapes.
OWN = {"lumigraph.system", "lumigraph.system.isolation", "lumigraph.system.threads"}

test = 0  # number of the present one


def checked_modules() -> set[str]:
    """Modules that state shapes, but those that hold compiled functions: compilers cannot read them with checks."""
    sources = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    return {module_name(path) for path, x in sources.items() if "jaxtyping" in x and not JIT.search(x)}


parsed = functools.cache(ast.parse)  # the package's syntax trees, until a test file ends that has looked at them all


@functools.cache
def nodes(source: str) -> list[ast.AST]:
    """All nodes of a source, from its root."""
    return list(ast.walk(parsed(source)))


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


class Names(dict[str, Any]):
    """A module's names and Python's, for its annotations; Any for others, as those imported for mypy alone."""

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, Any)


def shaped(annotation: Any, names: dict[str, Any]) -> bool:
    """True for an annotation that states a shape, by itself or by a module's name for one, as `Pictures`."""
    texts = [str(annotation), *(str(names.get(name)) for name in re.findall(r"\b[A-Z]\w*", str(annotation)))]
    return any(re.search(r"""\[[\w. ]+, ?['"]""", text) for text in texts)


def stated(function: Any) -> dict[str, Any]:
    """The annotations of a function that state shapes, by parameter, and of what it returns by "return"."""
    names, found = Names(function.__globals__), {}
    for name, annotation in function.__annotations__.items():
        if shaped(annotation, function.__globals__):
            found[name] = eval(annotation, {}, names) if isinstance(annotation, str) else annotation
    return found


def agrees(value: Any, annotation: Any) -> bool:
    """True for a value with the shapes that an annotation states, those within containers and unions too."""
    kind, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if kind in (typing.Union, types.UnionType):
        return any(agrees(value, one) for one in inner)
    if kind is tuple and isinstance(value, tuple):
        if inner[1:] == (...,):
            return all(agrees_alone(one, inner[0]) for one in value)
        return len(inner) == len(value) and all(map(agrees, value, inner))
    if kind in (list, collections.abc.Sequence) and isinstance(value, list | tuple):
        return all(agrees_alone(one, inner[0]) for one in value)
    if kind in (dict, collections.abc.Mapping) and isinstance(value, dict):
        return all(agrees_alone(one, inner[1]) for one in value.values())
    if annotation is float:  # an int will do
        return isinstance(value, int | float)
    try:
        return isinstance(value, kind or annotation or type(None))
    except TypeError:  # a protocol, an alias or a name of mypy's alone
        return True


def agrees_alone(value: Any, annotation: Any) -> bool:
    """`agrees` for one of many that need not be alike, as pictures of several sizes: it names no axes for others."""
    before = [dict(axes) for axes in get_shape_memo()]
    found = agrees(value, annotation)
    set_shape_memo(*before)
    return found


def given(function: Any, args: tuple[Any, ...], words: dict[str, Any]) -> dict[str, Any]:
    """Values of a function's parameters in a call, but for those of `*args` and those left out."""
    return dict(zip(function.__code__.co_varnames[: function.__code__.co_argcount], args, strict=False)) | words


def defaults(function: Any) -> dict[str, Any]:
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    own = dict(zip(reversed(names), reversed(function.__defaults__ or ()), strict=False))
    return own | (function.__kwdefaults__ or {})


def compare(function: Any, values: dict[str, Any], annotations: dict[str, Any], axes: Any) -> None:
    for name, annotation in annotations.items():
        if name in values and not agrees(values[name], annotation):
            value = values[name]
            is_ = f"{value.dtype} {tuple(value.shape)}" if hasattr(value, "shape") else repr(value)[:80]
            wanted = function.__annotations__[name]
            raise ShapeError(f"{function.__qualname__}: {name} is {is_}, not {wanted}. {shape_str(axes)}")


class ShapeError(TypeError):
    """A value of other shapes than its annotation states."""


def first_calls(function: Any = None, *, typechecker: Any = None) -> Any:
    """Check the first CHECKED_CALLS calls of a function in each test; of a data class, those of its `__init__`."""
    if function is None:
        return functools.partial(first_calls, typechecker=typechecker)
    if isinstance(function, type):
        if is_dataclass(function) and "__init__" in vars(function):
            function.__init__ = first_calls(function.__init__)  # type: ignore[misc]
        return function
    if not inspect.isfunction(function):
        return function
    if not any(shaped(annotation, function.__globals__) for annotation in function.__annotations__.values()):
        return function
    annotations: dict[str, Any] | None = None
    last, calls = -1, 0

    @functools.wraps(function)
    def either(*args: Any, **words: Any) -> Any:
        nonlocal annotations, last, calls
        if last != test:
            last, calls = test, 0
        calls += 1
        if calls > CHECKED_CALLS:
            return function(*args, **words)
        annotations = stated(function) if annotations is None else annotations
        values = given(function, args, words)
        axes = push_shape_memo(defaults(function) | values)
        try:
            compare(function, values, annotations, axes)
            result = function(*args, **words)
            compare(function, {"return": result}, annotations, axes)
            return result
        finally:
            pop_shape_memo()

    return either


def install() -> None:
    """Begin to check what is imported from now on."""
    loaded = sorted(name for name in sys.modules if name.startswith("lumigraph.") and name not in OWN)
    assert not loaded, f"loaded before their shapes could be checked: {loaded}"
    jaxtyping.jaxtyped = first_calls
    manager = jaxtyping.install_import_hook(["lumigraph"], None)
    manager.hook.should_instrument = checked_modules().__contains__  # type: ignore[method-assign, attr-defined]


def next_test() -> None:
    """Begin to count each function's calls again."""
    global test
    test += 1
