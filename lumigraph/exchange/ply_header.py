"""Header of a PLY file: parsed before any row is read, and checked against the size of the file."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plyfile

from ..errors import LumigraphError

MAX_HEADER_BYTES = 1 << 20  # bytes; headers of Gaussians have about 1500
END = re.compile(rb"(?<=[\r\n])end_header(\r\n|\r|\n)")
COUNT = re.compile(rb"(?<=[\r\n])(element[ \t]+[^ \t\r\n]+[ \t]+)([0-9]+)")

# How programs say that opacities are meant for the filter of Mip-Splatting: Postshot and Brush, each in its way. Both
# are written, either is understood, and the last one counts.
ANTIALIASED = ["antialiased 1", "SplatRenderMode: mip"]


@dataclass(frozen=True)
class Header:
    """Row count and plain properties of each element (lists left out), and all comments."""

    counts: dict[str, int]
    properties: dict[str, list[str]]
    comments: list[str]

    @property
    def antialiased(self) -> bool:
        said = [" ".join(line.split()) for line in self.comments]
        said = [line for line in said if re.fullmatch(r"antialiased [01]|SplatRenderMode: \w+", line)]
        return bool(said) and said[-1] in ANTIALIASED


def read_header(path: Path) -> Header:
    """Raises LumigraphError if the file is no PLY file, or ends before all that it promises could have come.

    The rows of text are counted at two characters a number: what is promised beyond that cannot be there either.
    """
    with open(path, "rb") as file:
        data = file.read(MAX_HEADER_BYTES)
        size = file.seek(0, 2)
    if data[:3] != b"ply":
        raise LumigraphError(f"{path} is no PLY file, for it does not begin with 'ply'; name another one")
    end = END.search(data)
    if end is None:
        raise LumigraphError(f"{path} ends within its header; copy or download it again")
    head = data[: end.end()]
    try:
        # plyfile understands the header of a file without rows; how many rows there should be is noted aside.
        counts = [int(match[2]) for match in COUNT.finditer(head)]
        empty = plyfile.PlyData.read(io.BytesIO(COUNT.sub(rb"\g<1>0", head)))
        names = [element.name for element in empty]
        promised = sum(count * _row(element, empty.text) for count, element in zip(counts, empty, strict=True))
    except Exception as fault:
        raise LumigraphError(f"{path} has a header that cannot be understood ({fault}); write it again") from fault
    if promised > size - len(head):
        rows = ", ".join(f"{count} x {name}" for name, count in zip(names, counts, strict=True))
        raise LumigraphError(
            f"{path} ends early: its header promises {rows}, at least {promised} bytes, and {size - len(head)} follow; "
            "copy or download it again"
        )
    return Header(
        counts=dict(zip(names, counts, strict=True)),
        properties={element.name: [p.name for p in element.properties if not _is_list(p)] for element in empty},
        comments=[*empty.comments, *(line for element in empty for line in element.comments)],
    )


def read_rows(path: Path) -> plyfile.PlyData:
    """All rows, binary ones as a view of the file. Raises LumigraphError if they cannot be read."""
    try:
        return plyfile.PlyData.read(path)
    except Exception as fault:
        raise LumigraphError(f"{path} cannot be read as a PLY file ({fault}); copy or download it again") from fault


def columns(rows: plyfile.PlyElement, names: Sequence[str], dtype: type = np.float32) -> np.ndarray:
    """Properties side by side: [row, property]."""
    table: np.ndarray = np.empty((len(rows.data), len(names)), dtype)
    with np.errstate(over="ignore", invalid="ignore"):  # what does not fit becomes infinite, and is found later
        for i, name in enumerate(names):
            table[:, i] = rows[name]
    return table


def _is_list(item: plyfile.PlyProperty) -> bool:
    return isinstance(item, plyfile.PlyListProperty)


def _row(element: plyfile.PlyElement, text: bool) -> int:
    """The least number of bytes that a row takes."""
    if text:
        return 2 * len(element.properties)
    return sum(np.dtype(p.list_dtype()[0] if _is_list(p) else p.dtype()).itemsize for p in element.properties)
