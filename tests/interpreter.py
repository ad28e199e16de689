"""Triton's interpreter, without work that it repeats: half of the time of kernels that call functions of their own."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import triton.language as tl
from triton.runtime import interpreter


def hasten() -> None:
    """Let the interpreter exchange the language's functions once a launch, and look each NumPy type up once.

    It exchanges them again in each call of a device function, over all members of the module. Where they are exchanged
    already, that has no effect. A version of Triton without these two functions runs as it is.
    """
    if patch := getattr(interpreter, "_patch_lang", None):
        interpreter._patch_lang = _once(patch)
    if types := getattr(interpreter, "_get_np_dtype", None):
        interpreter._get_np_dtype = _remembered(types)


def _once(patch: Callable[[Any], Any]) -> Callable[[Any], Any]:
    languages = tl, tl.core

    @functools.wraps(patch)
    def patched(function: Any) -> Any:
        named = [x for x in function.__globals__.values() if inspect.ismodule(x) and x in languages]
        if tl.core.is_builtin(tl.load) or any(tl.core.is_builtin(x.load) for x in named):
            return patch(function)
        return None  # which only calls of device functions get, and do not look at

    return patched


def _remembered(find: Callable[[Any], Any]) -> Callable[[Any], Any]:
    found = functools.cache(find)

    @functools.wraps(find)
    def remembered(kind: Any) -> Any:
        element = kind.element_ty if isinstance(kind, tl.block_type) else kind
        return find(element) if isinstance(element, tl.pointer_type) else found(element)

    return remembered
