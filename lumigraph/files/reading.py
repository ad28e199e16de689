"""Reading of foreign files: every parsing error becomes one sentence."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ParamSpec, TypeVar

from ..errors import LumigraphError
from .atomic import refusal

RUST_PANIC = "PanicException"  # of libraries in Rust; no Exception, and its class cannot be imported
MAX_REASON = 300  # characters of a library's message

P = ParamSpec("P")
R = TypeVar("R")


@contextmanager
def reading(path: Path | str, fault: str = "cannot be read", remedy: str = "restore it from a copy") -> Iterator[None]:
    """Context in which any exception becomes a LumigraphError: "PATH FAULT (reason); REMEDY".

    A LumigraphError passes unchanged, and so do warnings and Ctrl-C. The exception is the error's cause, which
    LUMIGRAPH_DEBUG=1 shows.
    """
    try:
        yield
    except (LumigraphError, Warning):
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != RUST_PANIC:
            raise
        raise LumigraphError(sentence(path, error, fault, remedy)) from error


def reads(
    fault: str = "cannot be read", remedy: str = "restore it from a copy"
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator that runs a function inside `reading` of its first path argument."""

    def behind_door(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def read(*args: P.args, **options: P.kwargs) -> R:
            path = next(x for x in (*args, *options.values()) if isinstance(x, Path | str))
            with reading(path, fault, remedy):
                return function(*args, **options)

        return read

    return behind_door


def sentence(path: Path | str, error: BaseException, fault: str, remedy: str) -> str:
    """Text of the LumigraphError for an exception."""
    from ..system.memory import want_of_memory  # loads PyTorch

    if isinstance(error, OSError) and error.errno is not None:
        return refusal(Path(error.filename) if isinstance(error.filename, str) else Path(path), error)
    if isinstance(error, MemoryError | RuntimeError) and (shortage := want_of_memory(error)):
        return f"{path} {fault}. {shortage}"
    return f"{path} {fault} ({reason_of(error)}); {remedy}"


def reason_of(error: BaseException) -> str:
    """Message of an exception on one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    text = " ".join(str(error).split()).rstrip(".")
    if "cannot identify" in text:
        return "unknown format"
    if not text or isinstance(error, LookupError):
        text = f"{type(error).__name__}: {text}".removesuffix(": ")
    return text if len(text) <= MAX_REASON else f"{text[:MAX_REASON]}..."
