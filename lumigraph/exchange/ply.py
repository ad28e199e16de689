"""The original PLY layout of 3-D Gaussian splatting (Kerbl 2023), which all programs read.

One row of float32 per Gaussian: x y z, an unused normal (zeros), f_dc_0..2, f_rest_* with all of red's
coefficients before green's and blue's, opacity (logit), scale_0..2 (logarithms), rot_0..3 (w, x, y, z). It is
lossless. A Gaussian takes 56 + 12 K bytes, 248 at degree 3. Two comments state that it is antialiased (ANTIALIASED).
"""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import LumigraphError, LumigraphWarning
from ..files.ply import Header, columns, read_header, read_rows, write_rows
from ..gaussians import Gaussians
from ..kernels.spherical_harmonics import K00
from .checks import FLATNESS, check_room
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
RGB = ["red", "green", "blue"]  # bytes in the place of COLOUR, as nerfstudio's --ply-color-mode rgb writes them
OPACITY = ["opacity"]
SCALE = ["scale_0", "scale_1", "scale_2"]
FLAT = "scale_2"  # the axis that 2DGS (Huang 2024) has none of
FILTER = "filter_3D"  # of Mip-Splatting
MOTION = re.compile(r"trbf_(center|scale)|motion_\d+|omega_\d+")  # of Spacetime Gaussians
KNOWN_ELEMENTS = ("face", "chunk", "sh")
ROTATION = ["rot_0", "rot_1", "rot_2", "rot_3"]
MAX_REST = 15  # harmonics beyond the constant, of degree 3


def read(path: Path, header: Header | None = None, moving: bool = False) -> Gaussians:
    """Text and both binary orders, and any plain types. Raises LumigraphError if it holds points, or too little.

    moving: whether the caller reads the motion of Spacetime Gaussians, which is refused otherwise
    """
    header = header or read_header(path)
    here = header.properties.get("vertex", [])
    flat = FLAT not in here and {*SCALE} - {FLAT} <= {*here}
    scales = [name for name in SCALE if name in here] if flat or {*SCALE} & {*here} == {*SCALE[:1]} else SCALE
    colours = RGB if {*RGB} <= {*here} and not {*COLOUR} & {*here} else COLOUR
    refuse_networks(path, here)
    missing = [name for name in [*MEAN, *colours, *OPACITY, *scales, *ROTATION] if name not in here]
    if not {*COLOUR, *OPACITY, *SCALE, *ROTATION} & {*here}:
        raise LumigraphError(
            f"{path} holds {header.counts.get('vertex', 0)} points and no Gaussians, for it has neither scales nor "
            "rotations; name a file that a program for Gaussian splatting has written"
        )
    if missing:
        raise LumigraphError(f"{path} lacks {', '.join(missing)} and so is no cloud of Gaussians; export it again")
    if not moving and any(MOTION.match(name) for name in here):
        raise LumigraphError(
            f"{path} holds Gaussians that move; make a file of all moments of it (lumigraph export splats {path} "
            "moving.4dgs), or of one (--set time=0.5 and another ending)"
        )
    rest = rest_names(path, here)
    told(path, header, here, flat)
    check_room(path, header.counts["vertex"], 1 + len(rest) // 3)
    rows = read_rows(path, ["vertex"], header)["vertex"]
    doubles = all(rows.dtype[name].itemsize == 8 for name in MEAN)
    log_scales, logits = columns(rows, scales), columns(rows, OPACITY)[:, 0]
    log_scales = np.repeat(log_scales, 3, 1) if len(scales) == 1 else log_scales
    plain = columns(rows, colours)
    plain = (plain / 255 - 0.5) / K00 if colours is RGB else plain
    if flat:
        log_scales = np.concatenate([log_scales, log_scales.min(1, keepdims=True) + np.float32(math.log(FLATNESS))], 1)
    if FILTER in here:
        log_scales, logits = with_filter(log_scales, logits, columns(rows, [FILTER]))
    return cloud(
        columns(rows, MEAN, np.float64 if doubles else np.float32),
        columns(rows, ROTATION),
        log_scales,
        logits,
        np.concatenate([plain[:, None].astype(np.float32), by_coefficient(columns(rows, rest))[:, :MAX_REST]], 1),
        is_antialiased(header),
    )


def refuse_networks(path: Path, here: list[str]) -> None:
    """Raise LumigraphError for Gaussians of which a network or a time decides, beside the file."""
    if any(name.startswith("f_anchor_feat") for name in here):
        raise LumigraphError(
            f"{path} holds anchors of Scaffold-GS, whose Gaussians a network in its folder makes for each view; train "
            "on the photographs here, or export Gaussians there"
        )
    if "beta" in here and any(name.startswith("sb_params") for name in here):
        raise LumigraphError(
            f"{path} holds kernels of Beta Splatting (Liu 2025), which are no Gaussians; train on the photographs here"
        )
    if {"t", "scale_t"} <= {*here}:
        raise LumigraphError(
            f"{path} holds Gaussians in space and time (4D-GS), and all moments would be shown at once; export one "
            "moment or a numbered .ply for each frame"
        )


def told(path: Path, header: Header, here: list[str], flat: bool) -> None:
    """Warn of what a file's properties mean beside those of the first release, and of those that are not used."""
    known = {*MEAN, *NORMAL, *COLOUR, *(() if {*COLOUR} & {*here} else RGB), *OPACITY, *SCALE, *ROTATION, FILTER}
    unused = [x for x in here if x not in known and not x.startswith("f_rest_") and not MOTION.match(x)]
    found = [f"passed over: {', '.join(unused)}"] if unused else []
    if f"f_rest_{3 * MAX_REST}" in here:
        found.append("harmonics of degree 4 are passed over; those of degree 1 to 3 are kept")
    found += [f"Gaussians without {FLAT} are flat, as 2DGS has them; they get a thin third axis"] if flat else []
    if others := [name for name in header.elements if name not in ("vertex", *KNOWN_ELEMENTS)]:
        found.append(f"elements passed over: {', '.join(others)}")
    for text in found:
        warnings.warn(f"{path}: {text}", LumigraphWarning, stacklevel=3)


def with_filter(
    log_scales: Float[np.ndarray, "gaussian 3"], logits: Float[np.ndarray, " gaussian"], size: np.ndarray
) -> tuple[Float[np.ndarray, "gaussian 3"], Float[np.ndarray, " gaussian"]]:
    """Scales and opacities with the 3-D smoothing filter of Mip-Splatting (Yu 2024, equation 7): variances add, and the
    opacity falls by the root of the ratio of determinants."""
    variances = np.exp(2 * log_scales.astype(np.float64))
    wider = variances + np.square(size.astype(np.float64))
    share = np.sqrt((variances / wider).prod(1))
    with np.errstate(divide="ignore"):
        alpha = share / (1 + np.exp(-logits.astype(np.float64)))
        return 0.5 * np.log(wider), np.log(alpha) - np.log1p(-alpha)


def write(path: Path, gaussians: Gaussians) -> None:
    rest = by_channel(array(gaussians.harmonics[:, 1:]))
    names = [*MEAN, *NORMAL, *COLOUR, *(f"f_rest_{i}" for i in range(rest.shape[1])), *OPACITY, *SCALE, *ROTATION]
    parts = [
        gaussians.means.detach().cpu().numpy(),
        np.zeros((len(gaussians), 3), np.float32),
        array(gaussians.harmonics[:, 0]),
        rest,
        array(gaussians.opacities)[:, None],
        array(gaussians.log_scales),
        array(gaussians.quaternions),
    ]
    values = [column for part in parts for column in part.T]
    rows = np.empty(len(gaussians), [(name, x.dtype.newbyteorder("<")) for name, x in zip(names, values, strict=True)])
    for name, column in zip(names, values, strict=True):
        rows[name] = column
    save(path, {"vertex": rows}, gaussians.antialiased)


def save(path: Path, elements: dict[str, np.ndarray], antialiased: bool) -> None:
    write_rows(path, "splats", elements, ["written by Lumigraph", *(ANTIALIASED if antialiased else [])])


def rest_names(path: Path, properties: list[str]) -> list[str]:
    """f_rest_0, f_rest_1, ..., all in the file. Raises LumigraphError unless they make a whole degree from 0 to 4."""
    count = sum(name.startswith("f_rest_") for name in properties)
    names = [f"f_rest_{i}" for i in range(count)]
    if count not in (0, 9, 24, 45, 72) or not {*names} <= {*properties}:
        raise LumigraphError(
            f"{path} has {count} properties f_rest_*, where f_rest_0 and on are 0, 9, 24, 45 or 72 for harmonics of "
            "degree 0 to 4; export it with one of these degrees"
        )
    return names


def by_channel(rest: Float[np.ndarray, "gaussian coefficient 3"]) -> Float[np.ndarray, "gaussian rest"]:
    """Coefficients ordered by channel: all of red's, then green's, then blue's."""
    return rest.transpose(0, 2, 1).reshape(len(rest), rest.shape[1] * 3)


def by_coefficient(rest: Float[np.ndarray, "gaussian rest"]) -> Float[np.ndarray, "gaussian coefficient 3"]:
    return rest.reshape(len(rest), 3, rest.shape[1] // 3).transpose(0, 2, 1)
