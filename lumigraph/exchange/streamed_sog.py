"""PlayCanvas's streamed SOG: a scene at several levels of detail, which viewers load by camera.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog, version 1. A folder with
lod-meta.json, which has a tree of boxes, and folders of SOG (`sog`). Each leaf of the tree is a part of the scene;
for each level, 0 the finest, it names a file and the range of its Gaussians in it.

We split the finest level at the median of its longest side until leaves are small, so that they are small in dense
regions. Each leaf is simplified by itself (`gaussians.simplified`), and can be drawn at any level beside neighbours of
another. A file has neighbouring leaves of one level. The finest level loses as much as SOG does. Boxes contain each
Gaussian up to one standard deviation, as PlayCanvas's own writer has them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int

from ..errors import LumigraphError
from ..files import read_json, replacing_folder
from ..files.ranges import Name, Point, Tally, between, format_value, typed
from ..gaussians import Gaussians, joined, simplified
from ..geometry import to_matrix
from ..system.progress import track
from . import sog
from .checks import check_room
from .codes import array, morton_order

VERSION = 1
META = "lod-meta.json"
MIN_LEAVES_PER_FILE = 4  # leaves in a file of the finest level, at least
EXTENT_QUANTILE = 0.9  # of Gaussians determine the length of a side; the rest may be far out
MAX_LEVELS = 64

Bounds = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]


@dataclass(frozen=True)
class Detail:
    """Parameters of levels of detail.

    levels: number of levels, including the finest
    ratio:  Gaussians of a level per Gaussian of the next
    chunk:  largest number of Gaussians in a file
    """

    levels: Annotated[int, between(1, 10)] = 4
    ratio: Annotated[float, between(1.5, 16)] = 4.0
    chunk: Annotated[int, between(1024, 1 << 20)] = 1 << 16


@dataclass(frozen=True)
class LodRow:
    """Location of a leaf at a level: file number, its first Gaussian, and its number of Gaussians."""

    file: Annotated[int, between(0, 10**6)]
    offset: Tally
    count: Tally


@dataclass(frozen=True)
class LodBox:
    min: Point
    max: Point


@dataclass(frozen=True)
class LodNode:
    bound: LodBox | None = None
    children: list[LodNode] = field(default_factory=list)
    lods: dict[str, LodRow] = field(default_factory=dict)


@dataclass(frozen=True)
class LodMeta:
    """Content of lod-meta.json."""

    lodLevels: Annotated[int, between(1, MAX_LEVELS)]  # noqa: N815
    filenames: Annotated[list[Name], msgspec.Meta(min_length=1, max_length=10**6)]
    tree: LodNode
    version: int = VERSION
    counts: list[Tally] | None = None
    environment: Name | None = None


def recognises(folder: Path) -> bool:
    """True if a folder has a lod-meta.json."""
    return (folder / META).is_file()


# Reading


def read(folder: Path, level: int = 0) -> Gaussians:
    """Read a level, 0 the finest, with the environment if there is one. Raises LumigraphError for a file that is
    missing, or smaller than lod-meta.json states."""
    path = folder / META
    meta: LodMeta = typed(LodMeta, read_json(path), path)
    if meta.version != VERSION:
        raise LumigraphError(f"{path} is of version {meta.version}, of which {VERSION} is read; export it again")
    rows = sorted(rows_of(meta, level, path), key=lambda row: (row.file, row.offset))
    total = sum(row.count for row in rows)
    if not total or (meta.counts is not None and meta.counts[level : level + 1] != [total]):
        raise LumigraphError(f"{path} names {total:,} Gaussians of level {level} and counts others; export it again")
    check_room(path, total, 1, sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()), 20 * total)
    clouds = []
    for number in dict.fromkeys(row.file for row in rows):
        held = sog.read(inside(folder, meta.filenames[number]))
        for row in (row for row in rows if row.file == number):
            if row.offset + row.count > len(held):
                raise LumigraphError(
                    f"{path} names {row.offset + row.count:,} Gaussians of {format_value(meta.filenames[number])}, "
                    f"which holds {len(held):,}; export it again"
                )
            clouds.append(held[row.offset : row.offset + row.count])
    if meta.environment is not None:
        clouds.append(sog.read(inside(folder, meta.environment)))
    return joined(clouds)


def rows_of(meta: LodMeta, level: int, path: Path) -> Iterator[LodRow]:
    """The rows of all leaves at a level. Raises LumigraphError for one in an undeclared file."""
    nodes = [meta.tree]
    while nodes:
        node = nodes.pop()
        nodes.extend(node.children)
        if (row := node.lods.get(str(level))) is not None:
            if row.file >= len(meta.filenames):
                raise LumigraphError(f"{path} names no file of number {row.file}; export it again")
            yield row


def inside(folder: Path, name: str) -> Path:
    """The folder of SOG, or the .sog, that lod-meta.json names. Raises LumigraphError if missing or outside."""
    there = folder / name
    if not there.resolve().is_relative_to(folder.resolve()):
        raise LumigraphError(
            f"{folder / META} names {format_value(name)}, which lies outside its folder; export it again"
        )
    if not there.is_file():
        raise LumigraphError(f"{folder} lacks the file {format_value(name)}; copy the whole folder again")
    return there.parent if there.name == sog.META else there


# Writing


def write(path: Path, gaussians: Gaussians, detail: Detail | None = None) -> None:
    """Write the folder of a path to lod-meta.json. Raises LumigraphError for an empty cloud."""
    if not len(gaussians):
        raise LumigraphError(f"{path} cannot hold a cloud of no Gaussians; write it as .ply")
    detail, gaussians = detail or Detail(), gaussians.to("cpu")
    parts = leaves(array(gaussians.means), max(1, detail.chunk // MIN_LEAVES_PER_FILE))
    with replacing_folder(path.parent, "splats") as folder:
        leaf_by_leaf = track(parts, "Making levels of detail", len(parts))
        levels = [coarser(gaussians[torch.from_numpy(part)], detail) for part in leaf_by_leaf]
        bounds = [bound(clouds) for clouds in levels]
        rows, files = packed([[len(cloud) for cloud in clouds] for clouds in levels], detail.chunk)
        for name, level, members in track(files, "Packing chunks", len(files)):
            clouds = [levels[leaf][level] for leaf in members]
            chunk = joined([x[torch.from_numpy(morton_order(array(x.means)))] for x in clouds])
            (folder / name).parent.mkdir()
            for part, data in sog.encode(chunk, ordered=True).items():
                (folder / name).with_name(part).write_bytes(data)
        counts = [sum(len(clouds[level]) for clouds in levels) for level in range(detail.levels)]
        meta = {
            "version": VERSION,
            "asset": {"generator": "Lumigraph"},
            "count": sum(counts),
            "counts": counts,
            "lodLevels": detail.levels,
            "filenames": [name for name, _, _ in files],
            "tree": tree(bounds, rows),
        }
        (folder / META).write_text(json.dumps(meta, allow_nan=False))


def leaves(points: Float[np.ndarray, "point 3"], most: int) -> list[Int[np.ndarray, " some"]]:
    """Points in 2^n parts of equal size, at most `most` in each, by repeated median splits of the longest side. Parts
    2i and 2i + 1 are neighbours, as are the pairs of them, and so on."""
    parts = [np.arange(len(points))]
    while len(parts[0]) > most:
        parts = [half for part in parts for half in halves(points, part)]
    return parts


def halves(points: Float[np.ndarray, "point 3"], part: Int[np.ndarray, " some"]) -> list[Int[np.ndarray, " half"]]:
    """Median split along the axis of the largest central extent; the first half is the larger."""
    low, high = np.quantile(points[part], [0.5 - EXTENT_QUANTILE / 2, 0.5 + EXTENT_QUANTILE / 2], axis=0)
    order = np.argsort(points[part, (high - low).argmax()], kind="stable")
    return np.array_split(part[order], 2)


def coarser(gaussians: Gaussians, detail: Detail) -> list[Gaussians]:
    """A leaf at all levels, the finest first, each simplified from the previous one."""
    levels = [gaussians]
    for level in range(1, detail.levels):
        levels.append(simplified(levels[-1], max(1, round(len(gaussians) / detail.ratio**level))))
    return levels


def packed(counts: list[list[int]], most: int) -> tuple[list[dict[str, LodRow]], list[tuple[str, int, list[int]]]]:
    """The rows of each leaf by level, and files as (name, level, leaves in it).

    counts: Gaussians of each leaf at each level. most: of a file; neighbours share one if they fit
    """
    rows: list[dict[str, LodRow]] = [{} for _ in counts]
    files: list[tuple[str, int, list[int]]] = []
    for level in range(len(counts[0])):
        held, number = most, 0
        for leaf, count in enumerate(each[level] for each in counts):
            if held + count > most:
                files.append((f"{level}_{number}/{sog.META}", level, []))
                held, number = 0, number + 1
            rows[leaf][str(level)] = LodRow(len(files) - 1, held, count)
            files[-1][2].append(leaf)
            held += count
    return rows, files


def tree(bounds: list[Bounds], rows: list[dict[str, LodRow]]) -> dict[str, Any]:
    """Tree of bounding boxes above the leaves."""
    low, high = np.min([low for low, _ in bounds], 0), np.max([high for _, high in bounds], 0)
    node: dict[str, Any] = {"bound": {"min": [plain(x) for x in low], "max": [plain(x) for x in high]}}
    if len(rows) == 1:
        return node | {"lods": {level: vars(row) for level, row in rows[0].items()}}
    half = len(rows) // 2
    return node | {"children": [tree(bounds[:half], rows[:half]), tree(bounds[half:], rows[half:])]}


def bound(clouds: list[Gaussians]) -> Bounds:
    """Box around all levels of a leaf: each Gaussian up to one standard deviation along its own axes."""
    lows, highs = [], []
    for cloud in clouds:
        reach = (to_matrix(cloud.quaternions).abs() @ cloud.log_scales.exp()[..., None])[..., 0]
        lows.append(array(cloud.means - reach).min(0))
        highs.append(array(cloud.means + reach).max(0))
    return np.min(lows, 0), np.max(highs, 0)


def plain(number: np.floating[Any]) -> float:
    """A number rounded to the digits of a float32."""
    return float(f"{number:.8g}")
