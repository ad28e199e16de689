"""Runtime checks of array shapes in all modules that state any, while tests run.

jaxtyping's checks of every call took 40 % of the suite's time, nearly all of it in small functions that a test calls
thousands of times. The first CHECKED_CALLS calls of a function in each test are checked.
"""

from __future__ import annotations

import ast
import functools
import inspect
import re
import sys
from pathlib import Path
from typing import Any

import jaxtyping

CHECKED_CALLS = 5
JIT = re.compile(r"^\s*(import|from) (numba|triton)\b", re.MULTILINE)
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"  # an int will do for a float
PACKAGE = Path(__file__).parent.parent / "lumigraph"
# Loaded before anything else, and without shapes.
OWN = {"lumigraph.system", "lumigraph.system.isolation", "lumigraph.system.threads"}

every_call = jaxtyping.jaxtyped
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


def first_calls(function: Any = None, *, typechecker: Any) -> Any:
    """jaxtyping's decorator, but for calls of a function beyond the first CHECKED_CALLS of a test. The check is made
    at the first call: those of functions that no test of a process calls took a fifth of its start."""
    if function is None:
        return functools.partial(first_calls, typechecker=typechecker)
    if not inspect.isfunction(function):
        return every_call(function, typechecker=typechecker)
    checked, last, calls = None, -1, 0

    @functools.wraps(function)
    def either(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked, last, calls
        if last != test:
            last, calls = test, 0
        calls += 1
        if calls > CHECKED_CALLS:
            return function(*args, **kwargs)
        checked = checked or every_call(function, typechecker=typechecker)
        return checked(*args, **kwargs)

    return either


def install() -> None:
    """Begin to check what is imported from now on."""
    loaded = sorted(name for name in sys.modules if name.startswith("lumigraph.") and name not in OWN)
    assert not loaded, f"loaded before their shapes could be checked: {loaded}"
    jaxtyping.jaxtyped = first_calls
    manager = jaxtyping.install_import_hook(["lumigraph"], CHECKER)
    manager.hook.should_instrument = checked_modules().__contains__  # type: ignore[method-assign, attr-defined]


def next_test() -> None:
    """Begin to count each function's calls again."""
    global test
    test += 1
