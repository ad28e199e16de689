"""Minecraft worlds: region files (.mca, Anvil), whose blocks become a block world.

The pictures are made here: the blocks in plain colours, from cameras above the ground. Needs anvil-parser2.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..datasets.world import LABELS
from ..errors import LumigraphError
from ..system.progress import track

EXPECTED_FILES = {"region files, r.*.*.mca, of Minecraft": ()}
LOOKED_FOR = ("r.*.*.mca", "region/r.*.*.mca")
SUFFIX = ".mca"
CHUNK, SIDE = 16, 4  # blocks of a chunk and of a section each way; chunks of the part that is read each way
SECTIONS = range(-4, 20)  # of 16 blocks, from the lowest to the highest that any version has
NEWEST = 4671  # DataVersion of the newest release whose layout is known here (1.21.10)
DEPTH = 4  # blocks that are kept below the lowest surface
NAMED = 6  # unknown blocks in a note
# The label of a block by its name, the first pattern that fits; see `LABELS`. Blocks that fill no cube count as air.
PATTERNS = tuple(
    (re.compile(pattern), label)
    for pattern, label in (
        (r"(^|_)air$|torch|rail|button|lever|sign|pressure_plate|^ladder|fence|door|cobweb", "sky"),
        (r"flower|dandelion|poppy|orchid|allium|bluet|tulip|daisy|lily|rose_bush|peony|lilac|sugar_cane", "sky"),
        (r"^(tall_)?(sea)?grass$|^short_grass$|fern|dead_bush|sapling|mushroom$|kelp|vine|^wheat|sweet_berry", "sky"),
        (r"^(carrots|potatoes|beetroots)$", "sky"),
        (r"leaves|_log$|_wood$|^bamboo|cactus|_stem$|mangrove_roots|azalea", "tree"),
        (r"snow|ice$", "snow"),
        (r"water|bubble_column", "water"),
        (r"sand", "sand"),
        (r"grass_block|moss|^grass_path|mycelium|nylium", "grass"),
        (r"dirt|podzol|farmland|mud|gravel|clay|^path|terracotta|planks|hay", "dirt"),
        (r"stone|ore$|granite|diorite|andesite|deepslate|tuff|basalt|calcite|bedrock|obsidian|brick", "stone"),
        (r"lava|magma", "stone"),
    )
)  # fmt: skip


def recognises(path: Path) -> bool:
    return path.suffix == SUFFIX if path.is_file() else bool(region_files(path))


def region_files(folder: Path) -> list[Path]:
    return sorted(file for pattern in LOOKED_FOR for file in folder.glob(pattern))


def read(path: Path) -> tuple[UInt8[np.ndarray, "x y z"], list[str]]:
    """Labels of blocks, x east, y north, z up, and what a user should know.

    Raises LumigraphError for files without a readable chunk, and for chunks of an unknown version.
    """
    anvil = library(path)
    files = [path] if path.is_file() else region_files(path)
    regions = {file: anvil.Region(file.read_bytes()) for file in files}
    damaged: list[str] = []
    chunks: dict[tuple[int, int], Any] = {}
    for file, region in regions.items():
        for x, z in there(region):
            try:
                chunk = anvil.Chunk.from_region(region, x, z)
            except KeyError as error:
                raise unknown_version(file, x, z, region) from error
            except Exception:  # a damaged chunk fails in many ways: zlib, struct, NBT
                damaged.append(f"({x}, {z})")
                continue
            chunks[chunk.x, chunk.z] = (file, chunk)
    if not chunks:
        fault = f"its chunks {', '.join(damaged[:NAMED])} are damaged" if damaged else "it has no chunks"
        raise LumigraphError(f"{path} holds no block that can be read, for {fault}; copy it from the world once more")
    first_x, first_z = densest(list(chunks))
    part = {at: chunk for at, chunk in chunks.items() if 0 <= at[0] - first_x < SIDE and 0 <= at[1] - first_z < SIDE}
    low = len(SECTIONS) * CHUNK
    labels, unknown = np.zeros((SIDE * CHUNK, SIDE * CHUNK, low), np.uint8), Counter[str]()
    for (x, z), (file, chunk) in track(part.items(), "Reading chunks", len(part)):
        at = (
            slice(CHUNK * (x - first_x), CHUNK * (x - first_x + 1)),
            slice(CHUNK * (z - first_z), CHUNK * (z - first_z + 1)),
        )
        try:
            labels[at] = chunk_labels(anvil, chunk, unknown)
        except Exception as error:
            raise unknown_version(file, x, z, regions[file]) from error
    if not labels.any():
        raise LumigraphError(f"{path} holds air alone; name a region with land")
    notes = [f"{path}: {len(damaged)} damaged chunks are left out, such as {damaged[0]}"] if damaged else []
    if unknown:
        names = ", ".join(name for name, _ in unknown.most_common(NAMED))
        notes.append(f"{path}: {len(unknown)} kinds of blocks have no label of their own and count as stone: {names}")
    newer = max(chunk.version for _, chunk in part.values())
    if newer > NEWEST:
        notes.append(
            f"{path} is of a newer version than is known here (DataVersion {newer} > {NEWEST}); check its labels"
        )
    return np.ascontiguousarray(trimmed(labels)[:, ::-1]), notes


def library(path: Path) -> Any:
    try:
        import anvil
    except ImportError as error:
        raise LumigraphError(
            f"{path} is a Minecraft region, and anvil-parser2, which reads those, is missing; "
            "pip install 'lumigraph[worlds]'"
        ) from error
    return anvil


def there(region: Any) -> Iterator[tuple[int, int]]:
    """Coordinates of the chunks of a region."""
    if len(region.data) < 8192:  # bytes of the header
        return
    for z in range(32):
        for x in range(32):
            if region.chunk_location(x, z) != (0, 0):
                yield x, z


def unknown_version(file: Path, x: int, z: int, region: Any) -> LumigraphError:
    """The error of a chunk whose layout is not known."""
    try:
        version = str(region.chunk_data(x, z)["DataVersion"].value)
    except Exception:
        version = "none"
    return LumigraphError(
        f"{file}: the chunk at ({x}, {z}) has a layout of an unknown version (DataVersion {version}); open the world "
        "in Minecraft 1.13 to 1.21 and save it once more"
    )


def densest(places: list[tuple[int, int]]) -> tuple[int, int]:
    """Lowest corner of the square of chunks with most chunks."""
    candidates = [(x - i, z - k) for x, z in places for i in range(SIDE) for k in range(SIDE)]
    return max(Counter(candidates).items(), key=lambda item: (item[1], -abs(item[0][0]), -abs(item[0][1])))[0]


def chunk_labels(anvil: Any, chunk: Any, unknown: Counter[str]) -> UInt8[np.ndarray, "x z y"]:
    """Labels of a chunk's blocks. unknown: counts blocks without a label of their own, by name"""
    known: dict[str, int] = {}

    def label(name: str) -> int:
        if name not in known:
            found = next((LABELS.index(to) for pattern, to in PATTERNS if pattern.search(name)), None)
            if found is None:
                unknown[name] += 1
            known[name] = LABELS.index("stone") if found is None else found
        return known[name]

    layers = []
    for number in SECTIONS:
        try:
            blocks = chunk.stream_blocks(section=number, force_new=True)
            values = np.fromiter((label(block.id) for block in blocks), np.uint8, CHUNK**3)
        except anvil.OutOfBoundsCoordinates:  # of versions with fewer sections
            values = np.zeros(CHUNK**3, np.uint8)
        layers.append(values.reshape(CHUNK, CHUNK, CHUNK))
    return np.concatenate(layers).transpose(2, 1, 0)


def trimmed(labels: UInt8[np.ndarray, "x z y"]) -> UInt8[np.ndarray, "_ _ _"]:
    """The columns with blocks, from a little below the lowest surface to above the highest."""
    solid = labels > 0
    columns = np.any(solid, 2)
    x, z = np.flatnonzero(np.any(columns, 1)), np.flatnonzero(np.any(columns, 0))
    tops = labels.shape[2] - solid[:, :, ::-1].argmax(2)
    low, high = max(int(tops[columns].min()) - DEPTH, 0), int(tops[columns].max()) + 1
    return labels[x[0] : x[-1] + 1, z[0] : z[-1] + 1, low:high]
