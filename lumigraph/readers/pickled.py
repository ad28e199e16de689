"""Arrays and dictionaries of them in pickled .npy files, as some data sets are published, without unpickling.

A pickle is a program for a stack machine. Nothing of it is executed: only opcodes for lists, dictionaries, texts and
numbers are interpreted, and calls of the six functions by which NumPy describes an array. Arrays are then made from
their bytes.
"""

from __future__ import annotations

import codecs
import io
import math
import pickletools
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.lib import format as npy

from ..files import read_bytes
from ..files.reading import reads

MAX_VALUES = 1 << 19  # numbers and texts of a file, each counted wherever it is referred to
MAX_OPCODES = 4 * MAX_VALUES
MAX_DEPTH = 50  # lists within lists
MAX_AXES = 32
MAX_KEY = 1 << 60  # of a dictionary: larger integers can be chosen to have one hash
OPCODES = {opcode.code: opcode for opcode in pickletools.opcodes}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
VALUES = {"INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"}  # pushed as they are
VALUES |= {"STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"}
VALUES |= {"BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"}
TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}  # values that each takes
CALLED = {
    "_codecs.encode", "builtins.bytes", "numpy.dtype", "numpy._core.multiarray._reconstruct",
    "numpy._core.multiarray.scalar", "numpy._core.numeric._frombuffer",
}  # fmt: skip
NAMED = CALLED | {"numpy.ndarray"}
DTYPE = re.compile(r"b1|[iu][1248]|f[248]|[SU][1-9]\d{0,3}")
OBJECTS = ("O", "O4", "O8")  # names of the type of references


@reads("cannot be read as arrays")
def load_pickled(path: Path) -> Any:
    """Load the dictionary of arrays, numbers and lists in a pickled .npy file. Raises LumigraphError for others."""
    file = io.BytesIO(read_bytes(path))
    version = npy.read_magic(file)
    shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
    if dtype != np.dtype(object) or shape != ():
        raise ValueError("it holds numbers and no dictionary")
    return Values().of(described(opcodes(file)))[0]


@dataclass(frozen=True)
class NamedFunction:
    """A function or class that a pickle names."""

    name: str

    @staticmethod
    def of(module: str, name: str) -> NamedFunction:
        """Name of an allowed function. Raises ValueError for any other."""
        found = f"{module}.{name}".replace("numpy.core.", "numpy._core.").replace("__builtin__.", "builtins.")
        if found not in NAMED:
            raise ValueError(f"it names {module}.{name}, which is no array")
        return NamedFunction(found)


@dataclass(eq=False)
class Call:
    """A call described by a pickle, and the state for its result."""

    name: str
    arguments: tuple
    state: tuple = ()


def opcodes(file: io.BytesIO) -> Iterator[tuple[str, Any]]:
    """Name and argument of each opcode, as `pickletools.genops`, but also of Python 2 strings with bytes above 127."""
    for _ in range(MAX_OPCODES):
        opcode = OPCODES.get(file.read(1).decode("latin-1"))
        if opcode is None:
            raise ValueError("it ends early, or is no pickle")
        if opcode.name == "STRING":
            quoted = pickletools.read_stringnl(file, decode=False)
            yield opcode.name, codecs.escape_decode(quoted)[0].decode("latin-1")
        else:
            yield opcode.name, opcode.arg.reader(file) if opcode.arg else None
    raise ValueError(f"it has more than {MAX_OPCODES:,} opcodes")


def described(program: Iterable[tuple[str, Any]]) -> Any:
    """Lists, dictionaries, values and `Call`s of opcodes. Raises ValueError for other opcodes."""
    stack, below, memo = list[Any](), list[list[Any]](), dict[int, Any]()
    for name, argument in program:
        if name in VALUES:
            stack.append(argument)
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name])
        elif name in TUPLES:
            first = len(stack) - TUPLES[name]
            if first < 0:
                raise ValueError("a tuple lacks values")
            stack[first:] = [tuple(stack[first:])]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            memo[len(memo) if argument is None else argument] = stack[-1]
        elif name == "MARK":
            below.append(stack)
            stack = []
        elif name in ("LIST", "TUPLE", "DICT", "APPENDS", "SETITEMS"):
            items, stack = stack, below.pop()
            if name == "LIST":
                stack.append(items)
            elif name == "TUPLE":
                stack.append(tuple(items))
            elif name == "DICT":
                stack.append({})
                extend(stack[-1], dict, items)
            else:
                extend(stack[-1], list if name == "APPENDS" else dict, items)
        elif name in ("APPEND", "SETITEM"):
            first = len(stack) - (1 if name == "APPEND" else 2)
            items, stack[first:] = stack[first:], []
            extend(stack[-1], list if name == "APPEND" else dict, items)
        elif name in ("EMPTY_LIST", "EMPTY_DICT"):
            stack.append([] if name == "EMPTY_LIST" else {})
        elif name == "GLOBAL":
            module, _, attribute = argument.partition(" ")
            stack.append(NamedFunction.of(module, attribute))
        elif name == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            stack.append(NamedFunction.of(str(module), str(attribute)))
        elif name == "REDUCE":
            arguments, called = stack.pop(), stack.pop()
            if not (isinstance(called, NamedFunction) and called.name in CALLED and isinstance(arguments, tuple)):
                raise ValueError("it calls something else than NumPy's functions of arrays")
            stack.append(Call(called.name, arguments))
        elif name == "BUILD":
            state = stack.pop()
            if not (isinstance(stack[-1], Call) and isinstance(state, tuple) and not stack[-1].state):
                raise ValueError("it changes the state of something else than an array")
            stack[-1].state = state
        elif name == "STOP":
            return stack[-1]
        elif name not in ("PROTO", "FRAME"):
            raise ValueError(f"it has the opcode {name}, which no array needs")
    raise ValueError("it ends early")


def extend(target: Any, kind: type, items: Sequence[Any]) -> None:
    """Append items to a list, or pairs of them to a dictionary."""
    if not isinstance(target, kind):
        raise ValueError(f"it adds items to something else than a {kind.__name__}")
    if isinstance(target, list):
        target.extend(items)
        return
    assert isinstance(target, dict)
    for key, value in zip(items[::2], items[1::2], strict=True):
        if not (isinstance(key, str) or (isinstance(key, int) and abs(key) < MAX_KEY)):
            raise ValueError(f"a key is a {type(key).__name__}")
        target[key] = value


class Values:
    """Plain values from described ones, with the number of values in each after following all references.

    References multiply: a few bytes can describe lists that would fill any memory.
    """

    def __init__(self) -> None:
        self.known = dict[int, tuple[Any, int] | None]()  # by identity; None while its items are looked at

    def of(self, value: Any, depth: int = 0) -> tuple[Any, int]:
        if isinstance(value, NamedFunction):
            raise ValueError(f"it holds {value.name} itself")
        if not isinstance(value, list | tuple | dict | Call):
            return value, 1
        if id(value) not in self.known:
            if depth > MAX_DEPTH:
                raise ValueError(f"it nests deeper than {MAX_DEPTH} levels")
            self.known[id(value)] = None
            self.known[id(value)] = found = self.composed(value, depth + 1)
            if found[1] > MAX_VALUES:
                raise ValueError(f"it has more than {MAX_VALUES:,} values where its references are followed")
        if (done := self.known[id(value)]) is None:
            raise ValueError("it holds a list that is within itself")
        return done

    def composed(self, value: Any, depth: int) -> tuple[Any, int]:
        if isinstance(value, Call):
            is_class_named = value.name.endswith("_reconstruct")  # first among arguments that say nothing else
            arguments, size = ((), 0) if is_class_named else self.of(value.arguments, depth)
            state, more = self.of(value.state, depth)
            made = result(value.name.rpartition(".")[2], arguments, state)
            return made, size + more + (made.size if isinstance(made, np.ndarray) else 1)
        items = [self.of(item, depth) for item in (value.values() if isinstance(value, dict) else value)]
        plain, count = [item for item, _ in items], 1 + sum(size for _, size in items)
        return (dict(zip(value, plain, strict=True)) if isinstance(value, dict) else type(value)(plain)), count


def result(name: str, arguments: tuple, state: tuple) -> Any:
    """Result of a described call, without executing it."""
    if name == "bytes" and not arguments:
        return b""
    if name == "encode":
        return arguments[0].encode("latin-1")
    if name == "dtype":
        return dtype_of(arguments[0], state[1] if state else "=")
    if name == "scalar":
        dtype, data = arguments
        return array_of((), dtype, data)[()]
    if name == "_frombuffer":
        data, dtype, shape, order = arguments
        return array_of(shape, dtype, data, order)
    _, shape, dtype, is_fortran, data = state
    return array_of(shape, dtype, data, "F" if is_fortran else "C")


def dtype_of(code: str, order: str) -> np.dtype:
    """NumPy type of numbers or texts. Raises ValueError for others."""
    if code in OBJECTS:
        return np.dtype(object)
    if not (isinstance(code, str) and DTYPE.fullmatch(code) and order in ("<", ">", "=", "|")):
        raise ValueError(f"it holds an array of type {str(code)[:20]}, which is no type of numbers or texts")
    return np.dtype(order + code)


def array_of(shape: tuple[int, ...], dtype: np.dtype, data: Any, order: Literal["C", "F"] = "C") -> Any:
    """Array from bytes; for object arrays the only item, or a list of items."""
    if not (isinstance(shape, tuple) and isinstance(dtype, np.dtype) and order in ("C", "F")):
        raise ValueError("it holds an array whose shape or type is none")
    if len(shape) > MAX_AXES or not all(type(side) is int and 0 <= side <= MAX_VALUES for side in shape):
        raise ValueError(f"it holds an array of shape {str(shape)[:50]}")
    count = math.prod(shape)
    if dtype.hasobject:
        if not isinstance(data, list) or len(shape) > 1 or len(data) != count:
            raise ValueError("it holds an array of references with other items than its shape says")
        return data if shape else data[0]
    stored = data.encode("latin-1") if isinstance(data, str) else data  # Python 2 has bytes as texts
    if not isinstance(stored, bytes | bytearray) or len(stored) != count * dtype.itemsize or count > MAX_VALUES:
        raise ValueError(f"it holds an array of {count:,} numbers of {dtype} with other bytes than these have")
    if dtype.kind == "b":
        return np.ndarray(shape, np.uint8, stored, order=order) != 0
    if dtype.kind == "U":
        letters: np.ndarray = np.ndarray(len(stored) // 4, dtype.byteorder + "u4", stored)
        if letters.max(initial=0) > sys.maxunicode:
            raise ValueError("it holds a text with characters that do not exist")
    return np.ndarray(shape, dtype, stored, order=order)
