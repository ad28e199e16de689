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
    if {"shape", "numel", "element_ty", "name"} == vars(tl.block_type(tl.int32, [1])).keys():
        _share_shapes()


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


def _share_shapes() -> None:
    """Let all blocks of one shape, and all tensors of these, have one shape: to make it takes a quarter of the time."""
    make_block, make_tensor = tl.block_type.__init__, tl.tensor.__init__
    shapes: dict[tuple, tuple[str, dict[str, Any]]] = {}

    @functools.wraps(make_block)
    def block(self: Any, element_ty: Any, shape: Any) -> None:
        key = (*shape,)
        if key not in shapes:
            make_block(self, element_ty, shape)
            tensor = tl.tensor.__new__(tl.tensor)
            make_tensor(tensor, None, self)
            shapes[key] = str(self.shape), vars(self) | {"of_tensors": (tensor.shape, tensor.numel)}
        said, shared = shapes[key]
        vars(self).update(shared, element_ty=element_ty, name=f"<{said}, {element_ty}>")

    @functools.wraps(make_tensor)
    def tensor(self: Any, handle: Any, type: Any) -> None:
        if not type.is_block():
            return make_tensor(self, handle, type)
        self.handle, self.type, self.dtype = handle, type, type.scalar
        self.shape, self.numel = type.of_tensors

    tl.block_type.__init__, tl.tensor.__init__ = block, tensor
