"""PLY files (Turk 1994): elements, each of rows of named numbers and lists, as text or in either byte order.

Counts and lengths of a file are compared with its size before anything of that size is allocated.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

import numpy as np
import torch
from numpy.lib.recfunctions import repack_fields, structured_to_unstructured

from ..errors import LumigraphError
from ..system.memory import ask_for
from .atomic import Kind, replacing, without_waiting
from .ranges import format_value
from .reading import reading, reads

MAX_HEADER_BYTES = 1 << 20  # headers of Gaussians have about 1500
LIST_BYTES = 200  # of memory for each list of a column whose lists have different lengths
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
COPY_AGAIN = "copy or download it again"
NAMES = {  # by the type of numpy; the first is written
    "i1": ["char", "int8"],
    "u1": ["uchar", "uint8"],
    "i2": ["short", "int16"],
    "u2": ["ushort", "uint16"],
    "i4": ["int", "int32"],
    "u4": ["uint", "uint32"],
    "i8": ["int64"],
    "u8": ["uint64"],
    "f2": ["float16"],
    "f4": ["float", "float32"],
    "f8": ["double", "float64"],
}
TYPES = {name: code for code, names in NAMES.items() for name in names}


@dataclass(frozen=True)
class Property:
    """A number in each row, or a list of them after its length."""

    name: str
    dtype: np.dtype
    length: np.dtype | None = None


@dataclass(frozen=True)
class Element:
    count: int
    properties: list[Property]

    @property
    def has_lists(self) -> bool:
        return any(p.length is not None for p in self.properties)

    def min_bytes(self, text: bool) -> int:
        """Least size of all rows; in text two characters per number, the last of which may be missing."""
        row = sum(2 if text else (p.length or p.dtype).itemsize for p in self.properties)
        return max(0, self.count * row - text)


@dataclass(frozen=True)
class Header:
    text: bool
    size: int  # bytes, up to the first row
    elements: dict[str, Element]
    comments: list[str]

    @property
    def counts(self) -> dict[str, int]:
        return {name: element.count for name, element in self.elements.items()}

    @property
    def properties(self) -> dict[str, list[str]]:
        """Names of the plain numbers of each element, lists left out."""
        return {name: [p.name for p in one.properties if p.length is None] for name, one in self.elements.items()}


@reads("is no PLY file that can be read", COPY_AGAIN)
def read_header(path: Path) -> Header:
    """Read a header. Raises LumigraphError for a file that is no PLY file, or is shorter than its header declares."""
    with open(path, "rb", opener=without_waiting) as file:
        data = file.read(MAX_HEADER_BYTES)
        size = file.seek(0, 2)
    first = re.match(rb"ply[ \t]*(\r\n|\r|\n)", data)
    if first is None:
        raise LumigraphError(f"{path} is no PLY file, for it does not begin with 'ply'; name another one")
    line_end = b"\r" if first[1] == b"\r" else b"\n"  # behind \r, a \n belongs to the first row
    end = re.search(rb"(?<=%b)[ \t]*end_header[ \t\r]*?%b" % (line_end, line_end), data)
    if end is None:
        raise LumigraphError(f"{path} ends within its header; {COPY_AGAIN}")
    with reading(path, "has a header that cannot be understood", "write it again"):
        header = parsed(data[: end.end()])
    there, least = size - header.size, sum(element.min_bytes(header.text) for element in header.elements.values())
    if least > there:
        rows = ", ".join(f"{count} x {format_value(name)[1:-1]}" for name, count in header.counts.items())
        raise LumigraphError(
            f"{path} ends early: its header promises {rows}, at least {least} bytes, and {there} follow; {COPY_AGAIN}"
        )
    return header


def parsed(head: bytes) -> Header:
    """Parse a header. Raises ValueError for invalid lines."""
    order, elements, comments = "", dict[str, Element](), list[str]()
    for line in re.split(r"\r\n?|\n", head.decode("utf-8", "replace"))[1:]:
        match line.split():
            case ["format", kind, "1.0"] if kind in ORDERS and not order:
                order = ORDERS[kind]
            case ["element", name, count] if order and name not in elements and count.isdecimal():
                elements[name] = Element(int(count), [])
            case ["property", *kinds, name] if elements:
                add_property([*elements.values()][-1].properties, kinds, name, order)
            case ["comment", *_]:
                comments.append(line.strip()[len("comment") :].strip())
            case ["obj_info", *_] | ["end_header"] | []:
                pass
            case _:
                raise ValueError(f"{format_value(line)} has no meaning there")
    for name, element in elements.items():
        if element.count and not element.properties:
            raise ValueError(f"{format_value(name)} has no properties")
    return Header(order == "=", len(head), elements, comments)


def add_property(known: list[Property], kinds: list[str], name: str, order: str) -> None:
    """Add a property to an element. kinds: type of a number; or `list`, types of a list's length and numbers"""
    match [TYPES.get(kind, kind) for kind in kinds]:
        case [code] if code in NAMES:
            length = None
        case ["list", count, code] if code in NAMES and count in NAMES and count[0] != "f":
            length = np.dtype(order + count)
        case _:
            raise ValueError(f"{format_value(' '.join(kinds))} is no type of {format_value(name)}")
    if name in [p.name for p in known]:
        raise ValueError(f"{format_value(name)} is there twice")
    known.append(Property(name, np.dtype(order + code), length))


@reads("cannot be read as a PLY file", COPY_AGAIN)
def read_rows(path: Path, wanted: Collection[str], header: Header | None = None) -> dict[str, np.ndarray]:
    """Rows of elements by name, as structured arrays; missing ones are left out.

    Binary rows are a view of the file. A list is a field of its numbers, or of type object if the rows' lists have
    different lengths, which takes memory. Raises LumigraphError if the rows cannot be read.
    """
    header = header or read_header(path)
    names = [*header.elements]
    last = max((names.index(name) + 1 for name in wanted if name in names), default=0)
    with open(path, "rb", opener=without_waiting) as file:
        read = text_reader(file, header, path) if header.text else BinaryReader(file, header, path).rows
        found = {name: rows_of(header.elements[name], read) for name in names[:last]}
    return {name: rows for name, rows in found.items() if name in wanted}


def rows_of(element: Element, read: Callable[[Element], np.ndarray]) -> np.ndarray:
    return read(element) if element.count else np.empty(0, layout(element, [0] * len(element.properties))[0])


def text_reader(file: io.BufferedReader, header: Header, path: Path) -> Callable[[Element], np.ndarray]:
    """Function that reads the next element's lines, skipping empty ones."""
    file.seek(header.size)
    lines = filter(str.strip, io.TextIOWrapper(file, "ascii"))

    def rows(element: Element) -> np.ndarray:
        mine = chain([next(lines)], islice(lines, element.count - 1))
        if element.has_lists:
            return in_columns(element, (text_row(line.split(), element) for line in mine), path)
        found = np.loadtxt(mine, [(p.name, p.dtype) for p in element.properties], comments=None, ndmin=1)
        if len(found) < element.count:
            raise ValueError(f"it has {len(found)} of {element.count} rows")
        return found

    return rows


def text_row(words: list[str], element: Element) -> Iterator[np.ndarray]:
    """The values of each property in a line of text."""
    rest = iter(words)
    for p in element.properties:
        count = 1 if p.length is None else int(next(rest, "-1"))
        values = np.array([*islice(rest, min(count, len(words)))], p.dtype)
        if len(values) != count:
            raise ValueError(f"a row has {len(values)} of {format_value(count)} numbers")
        yield values
    if next(rest, ""):
        raise ValueError("a row has more numbers than properties")


class BinaryReader:
    """Reader of the bytes after the header, one element after another."""

    def __init__(self, file: io.BufferedReader, header: Header, path: Path):
        self.data, self.at, self.path = np.asarray(np.memmap(file, np.uint8, "r")), header.size, path

    def rows(self, element: Element) -> np.ndarray:
        """The next element: a view if all lists are as long as the first. Raises ValueError for too few bytes."""
        begin = self.at
        dtype, lengths = layout(element, [len(values) for values in self.row(element)] if element.has_lists else [])
        end = begin + element.count * dtype.itemsize
        if end <= len(self.data):
            found = self.data[begin:end].view(lengths)
            if all((found[name] == found[name][0]).all() for name in lengths.names or ()):
                self.at = end
                return self.data[begin:end].view(dtype)
        self.at = begin
        return in_columns(element, (self.row(element) for _ in range(element.count)), self.path)

    def row(self, element: Element) -> Iterator[np.ndarray]:
        """The values of each property in the next row."""
        for p in element.properties:
            yield self.take(p.dtype, 1 if p.length is None else int(self.take(p.length, 1)[0]))

    def take(self, dtype: np.dtype, count: int) -> np.ndarray:
        begin, end = self.at, self.at + count * dtype.itemsize
        if not begin <= end <= len(self.data):
            raise ValueError(f"a row has {count} numbers, and {len(self.data) - begin} bytes follow")
        self.at = end
        return self.data[begin:end].view(dtype)


def in_columns(element: Element, rows: Iterable[Iterable[np.ndarray]], path: Path) -> np.ndarray:
    """Structured array of rows read one by one."""
    what = f"{path} has {element.count:,} rows with lists, which"
    ask_for(LIST_BYTES * element.count, torch.device("cpu"), what, "make all faces triangles in a mesh editor")
    columns: list[list[np.ndarray]] = [[] for _ in element.properties]
    for row in rows:
        for column, values in zip(columns, row, strict=True):
            column.append(values)
    if len(columns[0]) < element.count:
        raise ValueError(f"it has {len(columns[0])} of {element.count} rows")
    shapes = [{len(values) for values in column} for column in columns]
    fields = [
        (p.name, p.dtype, () if p.length is None else (*shape,)) if len(shape) == 1 else (p.name, object)
        for p, shape in zip(element.properties, shapes, strict=True)
    ]
    made = np.empty(element.count, fields)
    for (name, dtype, *_), column in zip(fields, columns, strict=True):
        made[name] = column if dtype is object else np.stack(column).reshape(made[name].shape)
    return made


def layout(element: Element, list_lengths: list[int]) -> tuple[np.dtype, np.dtype]:
    """Types of rows with lists of equal lengths: of their numbers, and of the lengths before the lists."""
    numbers, lengths, at = [], [], 0
    for i, p in enumerate(element.properties):
        shape: tuple[int, ...] = ()
        if p.length is not None:
            lengths.append((p.name, p.length, at))
            at, shape = at + p.length.itemsize, (list_lengths[i],)
        dtype = np.dtype((p.dtype, shape))
        numbers.append((p.name, dtype, at))
        at += dtype.itemsize
    return record(numbers, at), record(lengths, at)


def record(fields: list[tuple[str, np.dtype, int]], size: int) -> np.dtype:
    """Structured type of names, types and offsets, in rows of `size` bytes."""
    names, formats, offsets = zip(*fields, strict=True) if fields else ((), (), ())
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})


def columns(rows: np.ndarray, names: Sequence[str], dtype: type = np.float32) -> np.ndarray:
    """Plain numbers of rows side by side: [row, name]; a view if nothing needs conversion."""
    if not names:
        return np.empty((len(rows), 0), dtype)
    with np.errstate(over="ignore", invalid="ignore"):  # what does not fit becomes infinite, and is found later
        chosen = rows[[*names]]
        return structured_to_unstructured(repack_fields(chosen) if rows.dtype.hasobject else chosen, dtype)


def plain_names(rows: np.ndarray) -> list[str]:
    """Names of the plain numbers of rows, lists left out."""
    return [name for name in rows.dtype.names or () if rows[name].ndim == 1 and not rows.dtype[name].hasobject]


def write_rows(path: Path, kind: Kind, elements: Mapping[str, np.ndarray], comments: Iterable[str] = ()) -> None:
    """Write structured arrays of plain numbers as a binary, little-endian file, atomically."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, rows in elements.items():
        types = [(NAMES[rows.dtype[field].str[1:]][0], field) for field in rows.dtype.names or ()]
        lines += [f"element {name} {len(rows)}", *(f"property {type_} {field}" for type_, field in types)]
    with replacing(path, kind) as partial, open(partial, "wb") as file:
        file.write("".join(f"{line}\n" for line in [*lines, "end_header"]).encode())
        for rows in elements.values():
            rows.astype(rows.dtype.newbyteorder("<"), copy=False).tofile(file)
