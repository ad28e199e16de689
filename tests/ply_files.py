"""PLY files as other programs write them: text, either byte order, any line end; independent of Lumigraph's writer."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
CODES |= {"uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}
KINDS = {"text": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}

Element = tuple[str, dict[str, str], Sequence[Sequence[Any]]]  # name; type by property, "list A B" too; rows


def ply_file(elements: Sequence[Element], order: str = "<", end: str = "\n", gap: str = " ", extra: Sequence[str] = ()):
    """Bytes of a file. order: a key of KINDS; end: of lines; gap: between words; extra: lines behind the format"""
    lines = ["ply", f"format {KINDS[order]} 1.0", *extra]
    for name, properties, rows in elements:
        lines.append(f"element {name} {len(rows)}")
        lines += [f"property {kind} {key}" for key, kind in properties.items()]
    head = end.join(line.replace(" ", gap) for line in [*lines, "end_header", ""])
    body = [row_bytes(properties, row, order, end, gap) for _, properties, rows in elements for row in rows]
    return head.encode() + b"".join(body)


def row_bytes(properties: dict[str, str], row: Sequence[Any], order: str, end: str, gap: str) -> bytes:
    numbers: list[tuple[str, Any]] = []
    for kind, value in zip(properties.values(), row, strict=True):
        words = kind.split()
        numbers += [(words[1], len(value)), *((words[2], x) for x in value)] if len(words) == 3 else [(kind, value)]
    if order == "text":
        return (gap.join(repr(x) for _, x in numbers) + end).encode()
    return struct.pack(order + "".join(CODES[kind] for kind, _ in numbers), *(x for _, x in numbers))
