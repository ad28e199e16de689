"""The open format .4dgs of clouds that move, version 1 (https://4dgs.dev/docs/spec): Gaussians with spans of time.

Written is the model gaussian-birth with hard spans (profile box): static Gaussians once, in one chunk; moving ones once
for each span of linear motion, in chunks by CHUNK_LEVEL halvings of the time, ordered by Gaussian, so that constant
attributes compress to almost nothing. Numbers are quantised with steps of twice the error bounds in the file: positions
within POSITION_SHARE of the median size, scales 0.5 %, rotations 0.0005, colours and opacities 1/510, harmonics beyond
degree 0 4/255, clamped to [-4, 4]. Colours of degree 0 are clamped to [0, 1].
Read is any file of that model with deflated streams; objects, sounds and cameras in it are left out.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from .. import __version__
from ..errors import LumigraphError
from ..files import exists, expanded, write_bytes
from ..files.reading import reading
from ..gaussians.cloud import BAND_0
from ..gaussians.moving import MovingGaussians
from ..system.progress import counting
from .checks import check_room, checked
from .codes import MAX_SCALE, MIN_SCALE, array, cloud, morton_order, unit, with_largest, without_largest

SUFFIX = ".4dgs"
MAGIC = b"\x894DGS1\r\n"
HEADER, FOOTER, QUANTIZATION, WINDOWS, CHUNK, BAND, INDEX = 1, 2, 3, 4, 5, 7, 8  # opcodes
POSITION, SCALE, LARGEST, ROTATION, COLOUR, OPACITY, MOTION, MIDDLE, FADE, FLAGS, WINDOW = range(11)  # attributes
CHANNELS = {POSITION: 3, SCALE: 3, ROTATION: 3, COLOUR: 3, MOTION: 3}  # of attributes; the others have one
RECORD, STREAM = struct.Struct("<BQ"), struct.Struct("<BBBBBIQ")
RAW, DELTA, CONSTANT = 0, 1, 2  # modes of streams
MODEL, SCHEME, CUTOFF = "gaussian-birth", "uniform-v1", 0.05
CHUNK_LEVEL = 3  # halvings of the time that chunks follow: a seek reads an eighth of what moves, and what lasts longer
POSITION_SHARE = 0.005  # bound of positions, of the median largest deviation
BOUNDS = {"scale_rel": 0.005, "rot": 0.0005, "rgb": 1 / 510, "alpha": 1 / 510, "sigma_rel": 0.005, "time": 1e-4}
STEPS = "pos", "scale_rel", "rot", "rgb", "alpha", "motion", "time", "sigma_rel"  # of the grids, in their order
LIFE, CLASSES, SHORTEST, LONGEST = 0.5, (-4, 2), 0.02, 2.0  # of velocities' precision, section 6.3
MIDDLE_SHARE, MIDDLE_CLASSES = 0.05, (-10, 0)  # of middles' precision
HARMONICS_LOW, HARMONICS_STEP = -4.0, 8 / 255  # section 6.5
NEVER_FADES = 1  # flag
ENDLESS = 1e9  # seconds from which a span counts as endless


def is_moving_file(path: Path | str) -> bool:
    """True for the name of a file of this format, existing or not."""
    return str(path).lower().endswith(SUFFIX) and not expanded(path).is_dir()


# Writing


@torch.no_grad()
def write_moving(path: Path | str, moving: MovingGaussians) -> None:
    """Write a moving cloud, atomically. Raises LumigraphError for numbers that are not finite."""
    path = expanded(path)
    checked(moving.cloud, f"what is to be written to {path}", "remove them first")
    with counting(f"Writing {path.name}"):
        write_bytes(path, to_bytes(moving), "splats")


def to_bytes(moving: MovingGaussians) -> bytes:
    """Bytes of a file."""
    bins, steps, origin = binned(moving)
    spans = np.stack([array(moving.begins), array(moving.ends)], 1).astype(np.float64)
    table, window = np.unique(spans, axis=0, return_inverse=True)
    bins[WINDOW] = window.reshape(-1, 1)
    means, degree = moving.cloud.means.detach().cpu().double().numpy(), moving.cloud.degree
    box = [*means.min(0), *means.max(0)] if len(means) else [0.0] * 6
    data = bytearray(MAGIC)
    about = {"visibility_profile": "box", "color_space": "srgb", "producer": "lumigraph"}
    about["antialiased"] = "yes" if moving.cloud.antialiased else "no"
    header = text("") + text(f"lumigraph {__version__}") + struct.pack("<dQd", moving.duration, len(moving), CUTOFF)
    header += text(MODEL) + struct.pack("<6d", *box) + bytes([degree, 0]) + pairs(about)
    data += record(HEADER, header)
    grid = struct.pack("<11dB", *origin, *(steps[name] for name in STEPS), 1)
    stated = {name: repr(steps[name] / 2) for name in STEPS} | {"sh": "0"}
    stated |= {name: repr(math.expm1(steps[name] / 2)) for name in ("scale_rel", "sigma_rel")}
    data += record(QUANTIZATION, text(SCHEME) + grid + pairs(stated))
    data += record(WINDOWS, struct.pack("<I", len(table)) + table.astype("<f8").tobytes())
    index = b"".join(_chunk(data, bins, array(moving.cloud.harmonics), *part) for part in chunks(moving, table[window]))
    start = len(data)
    data += index
    crc = zlib.crc32(index) if index else 0
    data += record(FOOTER, struct.pack("<QQI", start if index else 0, 0, crc)) + MAGIC
    return bytes(data)


def binned(moving: MovingGaussians) -> tuple[dict[int, Int[np.ndarray, "gaussian _"]], dict[str, float], list[float]]:
    """Quantised attributes except for the window; quantisation steps; origin of positions."""
    c = moving.cloud
    means, scales = c.means.detach().cpu().double().numpy(), np.exp(array(c.log_scales).astype(np.float64))
    scales = scales.clip(MIN_SCALE, MAX_SCALE)
    size = float(np.median(scales.max(1))) if len(scales) else 1.0
    steps = {name: 2 * bound for name, bound in BOUNDS.items()} | {"pos": 2 * POSITION_SHARE * size}
    steps |= {"scale_rel": 2 * math.log1p(BOUNDS["scale_rel"]), "sigma_rel": 2 * math.log1p(BOUNDS["sigma_rel"])}
    steps["motion"] = steps["pos"] / LIFE
    origin = means.min(0).tolist() if len(means) else [0.0, 0.0, 0.0]
    largest, rest = without_largest(array(c.quaternions)[:, [1, 2, 3, 0]])  # x, y, z, w
    rgb = (0.5 + BAND_0 * array(c.harmonics)[:, 0]).clip(0, 1)
    red, green, blue = np.rint(rgb / steps["rgb"]).astype(np.int64).T
    fades = array(moving.fades).astype(np.float64)
    forever = ~np.isfinite(fades)
    fade = np.where(forever, 0, np.rint(np.log(np.where(forever, 1, fades)) / steps["sigma_rel"])).astype(np.int64)
    life = array(moving.ends).astype(np.float64) - array(moving.begins)
    velocity_step, middle_step = own_steps(fade, forever, life, steps, CUTOFF)
    found = {
        POSITION: np.rint((means - origin) / steps["pos"]),
        SCALE: np.rint(np.log(scales) / steps["scale_rel"]),
        LARGEST: largest,
        ROTATION: np.rint(rest / steps["rot"]),
        COLOUR: np.stack([green, red - green, blue - green], 1),
        OPACITY: np.rint(c.opacities.sigmoid().cpu().double().numpy() / steps["alpha"]),
        MOTION: np.rint(array(moving.velocities) / velocity_step[:, None]),
        MIDDLE: np.rint(array(moving.middles) / middle_step),
        FADE: fade,
        FLAGS: forever * NEVER_FADES,
    }
    return {name: x.reshape(len(means), -1).astype(np.int64) for name, x in found.items()}, steps, origin


def own_steps(
    fade: Int[np.ndarray, " gaussian"],
    forever: Any,
    life: Float[np.ndarray, " gaussian"],
    steps: dict[str, float],
    cutoff: float,
) -> tuple[Float[np.ndarray, " gaussian"], Float[np.ndarray, " gaussian"]]:
    """Steps of velocities and of middles, which depend on each Gaussian's lifetime (section 6.3)."""
    deviation = np.exp(fade * steps["sigma_rel"])
    half = np.where(forever, life, math.sqrt(-2 * math.log(cutoff)) * deviation).clip(SHORTEST, LONGEST)
    velocity = steps["motion"] * 2.0 ** -np.ceil(np.log2(half / LIFE)).clip(*CLASSES)
    target = np.where(forever, 1, np.minimum(1, MIDDLE_SHARE * deviation / steps["time"]))
    return velocity, steps["time"] * 2.0 ** np.floor(np.log2(target)).clip(*MIDDLE_CLASSES)


def chunks(
    moving: MovingGaussians, spans: Float[np.ndarray, "gaussian 2"]
) -> Iterator[tuple[float, float, int, Int[np.ndarray, " some"]]]:
    """Begin, end and level of each chunk, and its Gaussians in order. A chunk is the shortest dyadic interval, down to
    CHUNK_LEVEL, that contains the span."""
    duration, left = moving.duration, np.ones(len(spans), bool)
    found = []
    for level in reversed(range(CHUNK_LEVEL + 1)):
        edges = [duration * i / 2**level for i in range(2**level + 1)]
        for begin, end in pairwise(edges):
            inside = left & (spans[:, 0] >= begin - 1e-6) & (spans[:, 1] <= end + 1e-6) if level else left
            if inside.any():
                found.append((begin, end, level, np.flatnonzero(inside)))
            left = left & ~inside
    for begin, end, level, some in sorted(found, key=lambda part: (part[2], part[0])):
        still = level == 0  # those of one span each: the nearest beside each other
        yield begin, end, level, some[morton_order(array(moving.cloud.means)[some])] if still else some


def _chunk(
    data: bytearray,
    bins: dict[int, Int[np.ndarray, "gaussian _"]],
    harmonics: Float[np.ndarray, "gaussian coefficient 3"],
    begin: float,
    end: float,
    level: int,
    some: Int[np.ndarray, " some"],
) -> bytes:
    """Append a chunk and its bands of harmonics. Returns its entry in the index."""
    streams = b"".join(stream(attribute, bins[attribute][some]) for attribute in sorted(bins))
    at = len(data)
    body = struct.pack("<ddII", begin, end, level, len(some)) + text("")
    data += record(CHUNK, body + struct.pack("<QQ", len(streams), len(streams)) + streams)
    entry = struct.pack("<ddQQI", begin, end, at, len(data) - at, len(some))
    bands = []
    for band in range(1, math.isqrt(harmonics.shape[1])):
        some_band = harmonics[some, band**2 : (band + 1) ** 2].transpose(0, 2, 1).reshape(len(some), -1)
        codes = np.rint((some_band - HARMONICS_LOW) / HARMONICS_STEP).clip(0, 255).astype(np.int64)
        place = len(data)
        data += record(BAND, bytes([band]) + stream(BAND, codes))
        bands.append(struct.pack("<BQQ", band, place, len(data) - place))
    return record(INDEX, entry + struct.pack("<I", len(bands)) + b"".join(bands))


def stream(attribute: int, values: Int[np.ndarray, "element channel"]) -> bytes:
    """An attribute stream (section 5.6), in the smallest encoding."""
    count, channels = values.shape
    if (values == values[:1]).all():
        return _packed(attribute, CONSTANT, values[:1], count)
    change = np.concatenate([values[:1], values[1:] - values[:-1]])
    return min((_packed(attribute, RAW, values, count), _packed(attribute, DELTA, change, count)), key=len)


def _packed(attribute: int, mode: int, values: Int[np.ndarray, "element channel"], count: int) -> bytes:
    symbols = ((values << 1) ^ (values >> 63)).ravel().astype(np.uint64)
    largest = int(symbols.max(initial=0))
    width = 1 if largest < 1 << 8 else 2 if largest < 1 << 16 else 4
    planes = symbols.astype(f"<u{width}").view(np.uint8).reshape(-1, width).T
    payload = zlib.compress(np.ascontiguousarray(planes).tobytes(), 9)
    return STREAM.pack(attribute, width, mode, 0, values.shape[1], count, len(payload)) + payload


def record(opcode: int, content: bytes) -> bytes:
    return RECORD.pack(opcode, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def pairs(values: dict[str, str]) -> bytes:
    body = b"".join(text(key) + text(value) for key, value in sorted(values.items()))
    return struct.pack("<I", len(body)) + body


# Reading


def read_moving(path: Path | str) -> MovingGaussians:
    """Read the moving cloud of a file. Raises LumigraphError for a truncated file, and for other models."""
    path = expanded(path)
    if exists(path) and not path.is_file():
        raise LumigraphError(f"{path} is no ordinary file; name a file that ends in {SUFFIX}")
    with reading(path, "is damaged", "copy or download it again"), counting(f"Reading {path.name}"):
        found = _read(path, path.read_bytes())
    checked(found.cloud, str(path), "restore it from a copy")
    return found


class Cursor:
    """Reader of a record's values, one after another. Raises ValueError beyond its end."""

    def __init__(self, data: memoryview):
        self.data, self.at = data, 0

    def take(self, count: int) -> memoryview:
        if not 0 <= count <= len(self.data) - self.at:
            raise ValueError(f"{count} bytes are named where {len(self.data) - self.at} are left")
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, layout: str) -> tuple:
        return struct.unpack(layout, self.take(struct.calcsize(layout)))

    def text(self) -> str:
        return bytes(self.take(*self.unpack("<I"))).decode()

    def pairs(self) -> dict[str, str]:
        body = Cursor(self.take(*self.unpack("<I")))
        found = {}
        while body.at < len(body.data):
            key = body.text()
            found[key] = body.text()
        return found


def _read(path: Path, data: bytes) -> MovingGaussians:
    if data[: len(MAGIC)] != MAGIC:
        raise LumigraphError(f"{path} is no .4dgs file of version 1; name another one")
    cursor = Cursor(memoryview(data))
    cursor.take(len(MAGIC))
    header: dict[str, Any] = {}
    grid: dict[str, float] = {}
    table, chunk = np.zeros((1, 2)), None
    bands: dict[int, np.ndarray] = {}
    parts: list[tuple[dict[int, np.ndarray], dict[int, np.ndarray]]] = []
    while len(data) - cursor.at > len(MAGIC):
        opcode, size = cursor.unpack("<BQ")
        content = Cursor(cursor.take(size))
        if opcode == HEADER:
            header = _header(path, content, len(data))
        elif opcode == QUANTIZATION:
            if (scheme := content.text()) != SCHEME:
                raise LumigraphError(f"{path} has the grids {scheme!r}, which are not read; export it anew")
            header["origin"] = content.unpack("<3d")
            grid = dict(zip(STEPS, content.unpack("<8d"), strict=True))
        elif opcode == WINDOWS:
            (count,) = content.unpack("<I")
            table = np.frombuffer(content.take(16 * count), "<f8").reshape(-1, 2)
        elif opcode == CHUNK:
            chunk, bands = _streams(path, content, header["left"]), {}
            header["left"] -= len(chunk[POSITION])
            parts.append((chunk, bands))
        elif opcode == BAND and chunk is not None:
            band = content.unpack("<B")[0]
            _, bands[band] = unpacked(path, content, len(chunk[POSITION]))
    if not parts or not grid:
        raise LumigraphError(f"{path} holds no Gaussians, so there is nothing to show")
    return _dequantized(header, grid, table, parts)


def _header(path: Path, content: Cursor, size: int) -> dict[str, Any]:
    content.text(), content.text()
    duration, count, cutoff = content.unpack("<dQd")
    if (model := content.text()) != MODEL:
        raise LumigraphError(f"{path} has the model of time {model!r}; only {MODEL!r} is read; export it in that one")
    content.unpack("<6d")
    degree, _ = content.unpack("<BB")
    if degree > 3 or not 0 < duration < ENDLESS or not 0 < cutoff <= 1:
        raise ValueError(f"harmonics of degree {degree}, {duration:g} seconds, cutoff {cutoff:g}")
    check_room(path, count, (degree + 1) ** 2, size, count * (50 + 3 * (degree + 1) ** 2))
    antialiased = content.pairs().get("antialiased") == "yes"
    return {"duration": duration, "left": count, "cutoff": cutoff, "degree": degree, "antialiased": antialiased}


def _streams(path: Path, content: Cursor, room: int) -> dict[int, np.ndarray]:
    """Whole numbers of each attribute of a chunk. room: remaining number of Gaussians that the header declares"""
    _, _, _, count = content.unpack("<ddII")
    if content.text():
        raise LumigraphError(f"{path} has chunks packed as a whole, which are not read; export it without")
    if count > room:
        raise ValueError("its chunks hold more Gaussians than its header says")
    _, size = content.unpack("<QQ")
    body = Cursor(content.take(size))
    found = {}
    while body.at < size:
        attribute, values = unpacked(path, body, count)
        if attribute <= WINDOW and values.shape[1] != CHANNELS.get(attribute, 1):
            raise ValueError(f"attribute {attribute} has {values.shape[1]} channels")
        found[attribute] = values
    if missing := set(range(WINDOW + 1)) - set(found):
        raise ValueError(f"a chunk lacks the attributes {sorted(missing)}")
    return found


def unpacked(path: Path, body: Cursor, expected: int) -> tuple[int, Int[np.ndarray, "element channel"]]:
    """An attribute stream: its number and values."""
    attribute, width, mode, codec, channels, count, size = body.unpack("<BBBBBIQ")
    payload = body.take(size)
    if codec:
        raise LumigraphError(f"{path} has streams packed by codec {codec}; only deflate is read; export it with that")
    if count != expected or width not in (1, 2, 4) or mode > CONSTANT or not 0 < channels <= 64:
        raise ValueError(f"stream {attribute} has {count} elements of {width} bytes where {expected} belong")
    symbols = channels * (1 if mode == CONSTANT else count)
    raw = zlib.decompressobj().decompress(payload, symbols * width + 1)
    if len(raw) != symbols * width:
        raise ValueError(f"stream {attribute} unpacks to {len(raw)} bytes where {symbols * width} belong")
    planes = np.frombuffer(raw, np.uint8).reshape(width, symbols)
    value = np.ascontiguousarray(planes.T).view(f"<u{width}").reshape(-1, channels).astype(np.int64)
    value = (value >> 1) ^ -(value & 1)
    if mode == CONSTANT:
        return attribute, np.repeat(value, count, 0)
    return attribute, np.cumsum(value, 0) if mode == DELTA else value


def _dequantized(header: dict[str, Any], grid: dict[str, float], table: Any, parts: list) -> MovingGaussians:
    bins = {key: np.concatenate([chunk[key] for chunk, _ in parts]) for key in range(WINDOW + 1)}
    if bins[WINDOW].min() < 0 or bins[WINDOW].max() >= len(table):
        raise ValueError(f"a span {bins[WINDOW].max()} of {len(table)}")
    if not np.isfinite([*header["origin"], *grid.values()]).all():
        raise ValueError("steps that are not finite")
    spans = table[bins[WINDOW][:, 0]]
    forever = (bins[FLAGS][:, 0] & NEVER_FADES).astype(bool)
    fade = bins[FADE][:, 0]
    velocity_step, middle_step = own_steps(fade, forever, spans[:, 1] - spans[:, 0], grid, header["cutoff"])
    green, red, blue = bins[COLOUR].T
    rgb = np.stack([red + green, green, blue + green], 1) * grid["rgb"]
    harmonics = np.zeros((len(spans), (header["degree"] + 1) ** 2, 3))
    harmonics[:, 0] = (rgb - 0.5) / BAND_0
    for band in range(1, header["degree"] + 1):
        codes = np.concatenate([bands[band] for _, bands in parts])
        harmonics[:, band**2 : (band + 1) ** 2] = codes.reshape(len(spans), 3, -1).transpose(0, 2, 1)
    harmonics[:, 1:] = HARMONICS_LOW + HARMONICS_STEP * harmonics[:, 1:]
    turns = with_largest(bins[LARGEST][:, 0], bins[ROTATION] * grid["rot"])[:, [3, 0, 1, 2]]
    alpha = (bins[OPACITY][:, 0] * grid["alpha"]).clip(1e-6, 1 - 1e-6)
    found = cloud(
        np.array(header["origin"]) + bins[POSITION] * grid["pos"],
        unit(turns),
        bins[SCALE] * grid["scale_rel"],
        np.log(alpha / (1 - alpha)),
        harmonics,
        header["antialiased"],
    )
    with np.errstate(over="ignore"):
        deviation = np.where(forever, np.inf, np.exp(fade * grid["sigma_rel"]))
    middles = bins[MIDDLE][:, 0] * middle_step
    seen = math.sqrt(-2 * math.log(header["cutoff"])) * deviation  # beyond, a Gaussian is not shown (section 3)
    spans = np.maximum(spans[:, 0], middles - seen), np.minimum(spans[:, 1], middles + seen)
    rows = bins[MOTION] * velocity_step[:, None], middles, *spans, deviation
    tensors = [torch.from_numpy(np.array(x, np.float32, order="C")) for x in rows]
    return MovingGaussians(found, header["duration"], *tensors)
