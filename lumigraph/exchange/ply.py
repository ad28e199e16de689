"""The original PLY layout of 3-D Gaussian splatting (Kerbl 2023), which all programs read.

One row of float32 per Gaussian: x y z, an unused normal (zeros), f_dc_0..2, f_rest_* with all of red's
coefficients before green's and blue's, opacity (logit), scale_0..2 (logarithms), rot_0..3 (w, x, y, z). It is
lossless. A Gaussian takes 56 + 12 K bytes, 248 at degree 3. Two comments state that it is antialiased (ANTIALIASED).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import LumigraphError
from ..files.ply import Header, columns, read_header, read_rows, write_rows
from ..gaussians import Gaussians
from .checks import check_room
from .codes import array, cloud

# Comments of Postshot and of Brush that opacities are for the filter of Mip-Splatting. Both are written, either is
# read, and the last one counts.
ANTIALIASED = ["antialiased 1", "SplatRenderMode: mip"]


def is_antialiased(header: Header) -> bool:
    lines = [" ".join(line.split()) for line in header.comments]
    lines = [line for line in lines if re.fullmatch(r"antialiased [01]|SplatRenderMode: \w+", line)]
    return bool(lines) and lines[-1] in ANTIALIASED


MEAN = ["x", "y", "z"]
NORMAL = ["nx", "ny", "nz"]
COLOUR = ["f_dc_0", "f_dc_1", "f_dc_2"]
OPACITY = ["opacity"]
SCALE = ["scale_0", "scale_1", "scale_2"]
ROTATION = ["rot_0", "rot_1", "rot_2", "rot_3"]


def read(path: Path, header: Header | None = None) -> Gaussians:
    """Read text and both binary orders, with any scalars. Raises LumigraphError for point clouds and short files."""
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
    rows = read_rows(path, ["vertex"], header)["vertex"]
    return cloud(
        columns(rows, MEAN),
        columns(rows, ROTATION),
        columns(rows, SCALE),
        columns(rows, OPACITY)[:, 0],
        np.concatenate([columns(rows, COLOUR)[:, None], by_coefficient(columns(rows, rest))], 1),
        is_antialiased(header),
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
    save(path, {"vertex": rows}, gaussians.antialiased)


def save(path: Path, elements: dict[str, np.ndarray], antialiased: bool) -> None:
    write_rows(path, "splats", elements, ["written by Lumigraph", *(ANTIALIASED if antialiased else [])])


def rest_names(path: Path, properties: list[str]) -> list[str]:
    """f_rest_0, f_rest_1, ..., all in the file. Raises LumigraphError unless they make a whole degree from 0 to 3."""
    count = sum(name.startswith("f_rest_") for name in properties)
    names = [f"f_rest_{i}" for i in range(count)]
    if count not in (0, 9, 24, 45) or not {*names} <= {*properties}:
        raise LumigraphError(
            f"{path} has {count} properties f_rest_*, where f_rest_0 and on are 0, 9, 24 or 45 for harmonics of degree "
            "0 to 3; export it with one of these degrees"
        )
    return names


def by_channel(rest: Float[np.ndarray, "gaussian coefficient 3"]) -> Float[np.ndarray, "gaussian rest"]:
    """Coefficients ordered by channel: all of red's, then green's, then blue's."""
    return rest.transpose(0, 2, 1).reshape(len(rest), rest.shape[1] * 3)


def by_coefficient(rest: Float[np.ndarray, "gaussian rest"]) -> Float[np.ndarray, "gaussian coefficient 3"]:
    return rest.reshape(len(rest), 3, rest.shape[1] // 3).transpose(0, 2, 1)
