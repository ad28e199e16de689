"""The layout in which the first release of 3-D Gaussian splatting wrote its clouds (Kerbl 2023), known to all programs.

One row of float32 per Gaussian: x y z, an unused normal (zeros), f_dc_0..2, f_rest_* with all of red's
coefficients before green's and blue's, opacity (logit), scale_0..2 (logarithms), rot_0..3 (w, x, y, z). Nothing is
lost. A Gaussian takes 56 + 12 K bytes, 248 at degree 3. Two comments state that it is antialiased (ANTIALIASED).
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plyfile
from jaxtyping import Float

from ..errors import LumigraphError
from ..files import replacing
from ..gaussians import Gaussians
from .checks import check_room
from .codes import array, cloud

MAX_HEADER_BYTES = 1 << 20  # bytes; headers of Gaussians have about 1500
END = re.compile(rb"(?<=[\r\n])end_header(\r\n|\r|\n)")
COUNT = re.compile(rb"(?<=[\r\n])(element[ \t]+[^ \t\r\n]+[ \t]+)([0-9]+)")

# Comments of Postshot and of Brush that opacities are for the filter of Mip-Splatting. Both are written, either is
# read, and the last one counts.
ANTIALIASED = ["antialiased 1", "SplatRenderMode: mip"]


@dataclass(frozen=True)
class Header:
    """Row count and plain properties of each element (lists left out), and all comments."""

    counts: dict[str, int]
    properties: dict[str, list[str]]
    comments: list[str]

    @property
    def antialiased(self) -> bool:
        lines = [" ".join(line.split()) for line in self.comments]
        lines = [line for line in lines if re.fullmatch(r"antialiased [01]|SplatRenderMode: \w+", line)]
        return bool(lines) and lines[-1] in ANTIALIASED


def read_header(path: Path) -> Header:
    """Raises LumigraphError if the file is no PLY file, or is shorter than its header declares.

    The rows of text are counted at two characters a number: more rows than that cannot be there.
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
        # plyfile parses the header with the row counts replaced by 0; the counts are kept here
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


MEAN = ["x", "y", "z"]
NORMAL = ["nx", "ny", "nz"]
COLOUR = ["f_dc_0", "f_dc_1", "f_dc_2"]
OPACITY = ["opacity"]
SCALE = ["scale_0", "scale_1", "scale_2"]
ROTATION = ["rot_0", "rot_1", "rot_2", "rot_3"]


def read(path: Path, header: Header | None = None) -> Gaussians:
    """Text and both binary orders, and any plain types. Raises LumigraphError if it holds points, or too little."""
    header = header or read_header(path)
    here = header.properties.get("vertex", [])
    missing = [name for name in [*MEAN, *COLOUR, *OPACITY, *SCALE, *ROTATION] if name not in here]
    if not {*COLOUR, *OPACITY, *SCALE, *ROTATION} & {*here}:
        raise LumigraphError(
            f"{path} holds {header.counts.get('vertex', 0)} points and no Gaussians, for it has neither scales nor "
            "rotations; name a file that a program for Gaussian splatting has written"
        )
    if missing:
        raise LumigraphError(f"{path} lacks {', '.join(missing)} and so is no cloud of Gaussians; export it again")
    rest = rest_names(path, here)
    check_room(path, header.counts["vertex"], 1 + len(rest) // 3)
    rows = read_rows(path)["vertex"]
    return cloud(
        columns(rows, MEAN),
        columns(rows, ROTATION),
        columns(rows, SCALE),
        columns(rows, OPACITY)[:, 0],
        np.concatenate([columns(rows, COLOUR)[:, None], by_coefficient(columns(rows, rest))], 1),
        header.antialiased,
    )


def write(path: Path, gaussians: Gaussians) -> None:
    rest = by_channel(array(gaussians.harmonics[:, 1:]))
    names = [*MEAN, *NORMAL, *COLOUR, *(f"f_rest_{i}" for i in range(rest.shape[1])), *OPACITY, *SCALE, *ROTATION]
    parts = [
        array(gaussians.means),
        np.zeros((len(gaussians), 3), np.float32),
        array(gaussians.harmonics[:, 0]),
        rest,
        array(gaussians.opacities)[:, None],
        array(gaussians.log_scales),
        array(gaussians.quaternions),
    ]
    rows = np.concatenate(parts, 1).astype("<f4").view([(name, "<f4") for name in names])[:, 0]
    save(path, [plyfile.PlyElement.describe(rows, "vertex")], gaussians.antialiased)


def save(path: Path, elements: list[plyfile.PlyElement], antialiased: bool) -> None:
    comments = ["written by Lumigraph", *(ANTIALIASED if antialiased else [])]
    with replacing(path, "splats") as partial, open(partial, "wb") as file:
        plyfile.PlyData(elements, byte_order="<", comments=comments).write(file)


def rest_names(path: Path, properties: list[str]) -> list[str]:
    """f_rest_0, f_rest_1, ... as far as they go. Raises LumigraphError if that is no whole degree from 0 to 3."""
    count = sum(name.startswith("f_rest_") for name in properties)
    names = [f"f_rest_{i}" for i in range(count)]
    if count not in (0, 9, 24, 45) or not {*names} <= {*properties}:
        raise LumigraphError(
            f"{path} has {count} properties f_rest_*, where f_rest_0 and on are 0, 9, 24 or 45 for harmonics of degree "
            "0 to 3; export it with one of these degrees"
        )
    return names


def by_channel(rest: Float[np.ndarray, "gaussian coefficient 3"]) -> Float[np.ndarray, "gaussian rest"]:
    """All of red's coefficients, then green's, then blue's."""
    return rest.transpose(0, 2, 1).reshape(len(rest), rest.shape[1] * 3)


def by_coefficient(rest: Float[np.ndarray, "gaussian rest"]) -> Float[np.ndarray, "gaussian coefficient 3"]:
    return rest.reshape(len(rest), 3, rest.shape[1] // 3).transpose(0, 2, 1)
