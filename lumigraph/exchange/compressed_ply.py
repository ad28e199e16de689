"""PlayCanvas's compressed PLY, as SuperSplat and splat-transform write it: 16 bytes per Gaussian, and 0.3 of its chunk.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply. 256 Gaussians make a chunk with bounds of
position, scale and colour, between which each Gaussian is quantised: positions and logarithms of scales in 11, 10 and
11 bits, colours in 8 each, so that half a step is 1/4094, 1/2046 and 1/510 of the chunk's range. Opacities are within
1/510; components of a rotation other than the largest have 10 bits and are within 0.0007. Harmonics take 1 byte each,
within 1/64 from -3.97 to 3.97, and 0 itself becomes 1/64. Scales are clamped to exp(±20).

Gaussians are written in Morton order, which keeps the chunks' bounds small: the set is preserved, the order is not.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from ..errors import LumigraphError
from ..files.ply import Header, columns, read_header, read_rows
from ..gaussians import Gaussians
from ..kernels.spherical_harmonics import K00
from .checks import check_room
from .codes import (
    LOGITS,
    Integers,
    Quaternions,
    Vectors,
    alpha_to_byte,
    array,
    cloud,
    morton_order,
    to_byte,
    with_largest,
    without_largest,
)
from .ply import by_channel, by_coefficient, is_antialiased, rest_names, save

CHUNK = 256
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
RANGES = {  # of chunks: lower and upper ends
    "mean": (["min_x", "min_y", "min_z"], ["max_x", "max_y", "max_z"]),
    "scale": (["min_scale_x", "min_scale_y", "min_scale_z"], ["max_scale_x", "max_scale_y", "max_scale_z"]),
    "colour": (["min_r", "min_g", "min_b"], ["max_r", "max_g", "max_b"]),
}
MAX_LOG_SCALE = 20.0
SHIFTS, STEPS = np.array([21, 11, 0]), np.array([2047, 1023, 2047])
MAX_HARMONIC = 4.0  # they span [-4, 4]


def recognises(header: Header) -> bool:
    return "chunk" in header.counts and PACKED[0] in header.properties.get("vertex", [])


def read(path: Path, header: Header | None = None) -> Gaussians:
    """Read with or without harmonics, and colours of chunks. Raises LumigraphError for inconsistent parts."""
    header = header or read_header(path)
    colours_span = RANGES["colour"][0][0] in header.properties["chunk"]  # in older files they are plain
    spans = [*RANGES] if colours_span else ["mean", "scale"]
    wanted = {"vertex": PACKED, "chunk": [name for span in spans for end in RANGES[span] for name in end]}
    missing = [name for element in wanted for name in wanted[element] if name not in header.properties[element]]
    if missing:
        raise LumigraphError(f"{path} lacks {', '.join(missing)} and so is no compressed PLY file; export it again")
    count, chunks = header.counts["vertex"], header.counts["chunk"]
    if chunks != math.ceil(count / CHUNK) or header.counts.get("sh", count) != count:
        raise LumigraphError(
            f"{path} has {chunks} chunks and {header.counts.get('sh', 'no')} rows of harmonics for {count} Gaussians, "
            f"which need one for every {CHUNK} and for each; export it again"
        )
    rest = rest_names(path, header.properties.get("sh", []))
    check_room(path, count, 1 + len(rest) // 3)
    rows = read_rows(path, ["chunk", "vertex", "sh"], header)
    chunk_of = np.arange(count) // CHUNK
    ends = {span: [columns(rows["chunk"], names)[chunk_of].astype(float) for names in RANGES[span]] for span in spans}
    position, rotation, scale, colour = columns(rows["vertex"], PACKED, np.uint32).T.astype(np.int64)
    parts = colour[:, None] >> np.array([24, 16, 8, 0]) & 255
    rgb = _between(parts[:, :3] / 255, *ends["colour"]) if colours_span else parts[:, :3] / 255
    harmonics = ((rgb - 0.5) / K00)[:, None]
    if rest:
        harmonics = np.concatenate([harmonics, _from_bytes(by_coefficient(columns(rows["sh"], rest)))], 1)
    return cloud(
        _between(_unpack(position), *ends["mean"]).astype(np.float32),
        _from_smallest_three(rotation),
        _between(_unpack(scale), *ends["scale"]),
        LOGITS[parts[:, 3]],
        harmonics,
        is_antialiased(header),
    )


def write(path: Path, gaussians: Gaussians) -> None:
    order = torch.from_numpy(morton_order(array(gaussians.means)))
    gaussians = gaussians.to("cpu")[order]
    count, starts = len(gaussians), np.arange(0, len(gaussians), CHUNK)
    spread = {
        "mean": array(gaussians.means),
        "scale": array(gaussians.log_scales).clip(-MAX_LOG_SCALE, MAX_LOG_SCALE),
        "colour": array(gaussians.harmonics[:, 0]) * np.float32(K00) + np.float32(0.5),
    }
    chunks = np.empty(len(starts), [(name, "<f4") for span in RANGES.values() for end in span for name in end])
    shares = {}
    for span, values in spread.items():
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        for names, end in zip(RANGES[span], (low, high), strict=True):
            for i, name in enumerate(names):
                chunks[name] = end[:, i]
        low, high = (np.repeat(end, CHUNK, 0)[:count].astype(float) for end in (low, high))
        shares[span] = (values - low) / np.where(high > low, high - low, 1)
    rgba = np.concatenate([to_byte(255 * shares["colour"]), alpha_to_byte(array(gaussians.opacities))[:, None]], 1)
    vertices = np.empty(count, [(name, "<u4") for name in PACKED])
    vertices["packed_position"] = _pack(shares["mean"])
    vertices["packed_rotation"] = _smallest_three(array(gaussians.quaternions))
    vertices["packed_scale"] = _pack(shares["scale"])
    vertices["packed_color"] = rgba.view(">u4")[:, 0]
    elements = {"chunk": chunks, "vertex": vertices}
    if gaussians.degree:
        rest = by_channel(array(gaussians.harmonics[:, 1:]))
        codes = np.floor(256 * (rest / (2 * MAX_HARMONIC) + 0.5)).clip(0, 255).astype(np.uint8)
        elements["sh"] = codes.view([(f"f_rest_{i}", "u1") for i in range(codes.shape[1])])[:, 0]
    save(path, elements, gaussians.antialiased)


def _between(share: Vectors, low: Vectors, high: Vectors) -> Vectors:
    return low * (1 - share) + high * share


def _pack(share: Vectors) -> Integers:
    """Pack numbers of [0, 1] in 11, 10 and 11 bits."""
    return (np.rint(share * STEPS).astype(np.int64) << SHIFTS).sum(-1)


def _unpack(code: Integers) -> Vectors:
    return (code[:, None] >> SHIFTS & STEPS) / STEPS


def _smallest_three(quaternions: Quaternions) -> Integers:
    """Pack quaternions: 2 bits name the largest of w, x, y, z; the others, within ±sqrt(1/2), have 10 bits each."""
    largest, rest = without_largest(quaternions)
    parts = np.rint(1023 * (rest * math.sqrt(0.5) + 0.5)).clip(0, 1023).astype(np.int64)
    return largest << 30 | (parts << np.array([20, 10, 0])).sum(-1)


def _from_smallest_three(code: Integers) -> Quaternions:
    parts = code[:, None] >> np.array([20, 10, 0]) & 1023
    return with_largest(code >> 30, (parts / 1023 - 0.5) / math.sqrt(0.5))


def _from_bytes(codes: Float[np.ndarray, "gaussian rest 3"]) -> Float[np.ndarray, "gaussian rest 3"]:
    """Values of bytes: the middle of each of 256 steps, but the ends of the range for the outermost."""
    shares = np.where(codes == 0, 0, np.where(codes == 255, 1, (codes + 0.5) / 256))
    return 2 * MAX_HARMONIC * (shares - 0.5)
