"""Probes as files: FOLDER/probes.json, radiance.png and distance.png. `docs/probes.md` gives every byte."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float, UInt16
from PIL import Image

from ...errors import LumigraphError
from ...files import exists, read_json, replacing_folder, write_json
from ...files.ranges import Point, Positive, between, typed
from ...files.reading import reads
from .grid import ProbeGrid
from .harmonics import MAX_ORDER
from .octahedral import BORDER

FORMAT = "lumigraph probes 1"
INDEX, RADIANCE, DISTANCE = "probes.json", "radiance.png", "distance.png"
ORDERS = 2, MAX_ORDER  # lowest and highest band of harmonics that a file may have
MAX_PROBES, MAX_TEXELS = 65_535, 64  # probes of a grid; texels along a side of an octahedral map
STEPS = 65_535  # of a 16-bit number
MIN_RANGE = 1e-9  # between the lowest and the highest value of a coefficient

Counts = tuple[Annotated[int, between(1, MAX_PROBES)], ...]


@dataclass(frozen=True)
class ProbeRecord:
    """The index of a folder of probes."""

    counts: Counts
    origin: Point
    axes: tuple[Point, Point, Point]
    up: Point
    order: int
    side: Annotated[int, between(1, MAX_TEXELS)]
    far: Positive
    low: list[Point]
    high: list[Point]
    state: list[Annotated[int, between(0, 2)]]
    geographic: Any = None
    format: str = FORMAT


def write_probes(folder: Path, grid: ProbeGrid, geographic: dict[str, float] | None = None) -> None:
    """Write a folder of probes, atomically. geographic: origin of the frame on Earth, see `Frame.origin`"""
    radiance = grid.radiance.double().numpy()
    low, high = radiance.min(0), radiance.max(0)
    high = np.maximum(high, low + MIN_RANGE)
    said = {
        "format": FORMAT,
        "counts": grid.counts,
        "origin": grid.origin.tolist(),
        "axes": grid.axes.tolist(),
        "up": grid.up.tolist(),
        "order": grid.order,
        "side": grid.mean.shape[1] - 2 * BORDER,
        "far": grid.far,
        "low": low.tolist(),
        "high": high.tolist(),
        "state": grid.state.tolist(),
        **({} if geographic is None else {"geographic": geographic}),
    }
    moments = [tiled((x / scale).double().numpy(), grid.counts) for x, scale in _moments(grid)]
    with replacing_folder(folder, "probes") as partial:
        save(partial / RADIANCE, ((radiance - low) / (high - low)).reshape(len(grid), -1))
        save(partial / DISTANCE, np.concatenate(moments))
        write_json(partial / INDEX, said, ours=True)


@reads("cannot be read as probes", "export the probes again")
def read_probes(path: Path | str) -> ProbeGrid:
    """The probes of a folder, or of its probes.json. Raises LumigraphError for anything else."""
    path = Path(path)
    folder = path.parent if path.name == INDEX else path
    where = folder / INDEX
    if not exists(where):
        raise LumigraphError(f"{folder} holds no {INDEX}; make probes by `lumigraph export probes RUN {folder}`")
    said = read_json(where)
    if not isinstance(said, dict) or said.get("format") != FORMAT:
        raise LumigraphError(f"{where} is no index of probes: it does not say {FORMAT!r}; export the probes again")
    found = typed(ProbeRecord, said, where, closed=True)
    if not ORDERS[0] <= found.order <= ORDERS[1]:
        raise LumigraphError(
            f"{where} has harmonics of order {found.order}, and {ORDERS[0]} and {ORDERS[1]} are read; "
            "export the probes again with --order"
        )
    count, coefficients, wide = int(np.prod(found.counts)), (found.order + 1) ** 2, found.side + 2 * BORDER
    if len(found.counts) != 3 or count > MAX_PROBES or len(found.state) != count:
        raise LumigraphError(f"{where} names {len(found.state):,} probes and counts {found.counts}; export them again")
    if len(found.low) != coefficients or len(found.high) != coefficients:
        raise LumigraphError(f"{where} lacks the range of some of its {coefficients} coefficients; export it again")
    axes = torch.tensor(found.axes, dtype=torch.float32)
    if not float(torch.linalg.det(axes.double()).abs()) > 0:
        raise LumigraphError(f"{where} has axes that span no space; export the probes again")
    low, high = np.array(found.low), np.array(found.high)
    shape = count, 3 * coefficients
    stored = load(folder / RADIANCE, shape).reshape(count, coefficients, 3) / STEPS
    columns, rows = found.counts[0], found.counts[1] * found.counts[2]
    both = load(folder / DISTANCE, (2 * rows * wide, columns * wide)) / STEPS
    mean, squared = (untiled(x, (columns, rows), wide) for x in np.split(both, 2))
    return ProbeGrid(
        torch.tensor(found.origin),
        axes,
        (found.counts[0], found.counts[1], found.counts[2]),
        torch.from_numpy(low + stored * (high - low)).float(),
        torch.from_numpy(mean * found.far).float(),
        torch.from_numpy(squared * found.far**2).float(),
        torch.tensor(found.state),
        found.far,
        torch.tensor(found.up),
    )


def _moments(grid: ProbeGrid) -> tuple[tuple[torch.Tensor, float], ...]:
    """Distances and their squares, and the value of 65535 for each."""
    return (grid.mean, grid.far), (grid.squared, grid.far**2)


def tiled(maps: Float[np.ndarray, "probe wide wide"], counts: tuple[int, int, int]) -> Float[np.ndarray, "row column"]:
    """Maps tiled in one picture: probe (i, j, k) in column i and row j + n_1 k of tiles."""
    wide = maps.shape[1]
    rows = maps.reshape(counts[1] * counts[2], counts[0], wide, wide).transpose(0, 2, 1, 3)
    return rows.reshape(counts[1] * counts[2] * wide, counts[0] * wide)


def untiled(
    picture: Float[np.ndarray, "row column"], tiles: tuple[int, int], wide: int
) -> Float[np.ndarray, "probe wide wide"]:
    """The inverse of `tiled`. tiles: columns and rows of them"""
    columns, rows = tiles
    return picture.reshape(rows, wide, columns, wide).transpose(0, 2, 1, 3).reshape(rows * columns, wide, wide)


def save(path: Path, shares: Float[np.ndarray, "row column"]) -> None:
    """Write shares in [0, 1] as a grey PNG of 16 bits."""
    values: UInt16[np.ndarray, "row column"] = np.rint(shares.clip(0, 1) * STEPS).astype(np.uint16)
    Image.fromarray(values).save(path)


@reads("cannot be read", "export the probes again, or copy it anew")
def load(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Numbers of a grey PNG of 16 bits. Raises LumigraphError for one that is missing, truncated or of another size."""
    with Image.open(path) as image:
        if image.size != shape[::-1] or not image.mode.startswith("I"):
            raise LumigraphError(
                f"{path} has {image.size[0]}x{image.size[1]} pixels of mode {image.mode}, and its index promises "
                f"{shape[1]}x{shape[0]} of 16 bits; export the probes again"
            )
        return np.asarray(image, np.float64)
