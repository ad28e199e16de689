"""What a capture that is larger than memory takes: to be listed, opened and drawn from.

    python benchmarks/many_photographs.py [--photographs 20000] [--size 4000 3000] [--memory-gb 1] [--output FILE.json]

Makes a folder in a temporary place: transforms.json of a drive along streets, and as many links to a few photographs of
that size, which are noise over slopes, as hard to decompress as photographs are. Each part is measured in a process of
its own: listing alone (poses and lenses, no pixels), opening, and drawing batches until `--draws` are done. Memory is
what a process needed at most beyond what it had before it began.
"""

from __future__ import annotations

import lumigraph  # noqa: F401  ahead of PyTorch, as the command line does; isort: skip
import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from PIL import Image

FILES = 8  # real ones
BATCH = 4096  # rays
GIGABYTE = 1 << 30


@dataclass(frozen=True)
class Options:
    photographs: int = 20_000
    size: tuple[int, int] = (4000, 3000)
    downscale: int | None = 1  # none: as `lumigraph train` would
    memory_gb: float = 1.0  # of images
    draws: int = 200  # batches of 4096 rays
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> int:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "capture"
        make(folder, options)
        figures: dict[str, Any] = {}
        for part in (listed, drawn):
            figures |= apart(part, folder, options)
            print(json.dumps(figures, indent=1), flush=True)
    if options.output is not None:
        options.output.write_text(json.dumps({"options": asdict(options), **figures}, indent=1, default=str))
    return 0


def make(folder: Path, options: Options) -> None:
    """A capture whose photographs are links to a few files."""
    (folder / "images").mkdir(parents=True)
    width, height = options.size
    random = np.random.default_rng(0)
    for k in range(FILES):
        slopes = np.stack(np.meshgrid(np.linspace(0, 200, width), np.linspace(0, 200, height)), -1)
        picture = np.concatenate([slopes, np.full((height, width, 1), 30.0 * k)], -1)
        rough = np.kron(random.normal(0, 12, (-(-height // 4), -(-width // 4), 3)), np.ones((4, 4, 1)))
        picture = (picture + rough[:height, :width]).clip(0, 255).astype(np.uint8)
        Image.fromarray(picture).save(folder.parent / f"{k}.jpg", quality=90)
    frames = []
    for i in range(options.photographs):
        (folder / "images" / f"{i:06d}.jpg").symlink_to(folder.parent / f"{i % FILES}.jpg")
        street, along = divmod(i, 500)
        turn = np.radians(120.0 * (i % 3))
        right, forward = (np.cos(turn), np.sin(turn), 0.0), (-np.sin(turn), np.cos(turn), 0.0)
        pose = np.eye(4)
        pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, (0, 0, 1), -np.array(forward)
        pose[:3, 3] = 1.0 * along, 40.0 * street, 2.0
        frames.append({"file_path": f"images/{i:06d}.jpg", "transform_matrix": pose.tolist()})
    shared = {"w": width, "h": height, "fl_x": 0.7 * width, "fl_y": 0.7 * width}
    (folder / "transforms.json").write_text(json.dumps(shared | {"frames": frames}))


def apart(part: Callable[[Path, Options], dict[str, float]], folder: Path, options: Options) -> dict[str, float]:
    """What a part measured, in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(part, (folder, options))


def listed(folder: Path, options: Options) -> dict[str, float]:
    """Poses and lenses, without a look at pixels."""
    from lumigraph.readers import choose_reader

    before, begin = peak(), time.perf_counter()
    capture = choose_reader(folder).read(folder)
    positions = np.stack([shot.pose[:, 3] for shot in capture.shots])
    assert len(positions) == options.photographs
    return {"seconds to list": time.perf_counter() - begin, "megabytes to list": (peak() - before) / 1e6}


def drawn(folder: Path, options: Options) -> dict[str, float]:
    """Opening, and random rays."""
    from lumigraph.opening import open_scene

    before, begin = peak(), time.perf_counter()
    scene = open_scene(folder, options.downscale, memory=int(options.memory_gb * GIGABYTE), cache=folder.parent)
    opened, held = time.perf_counter() - begin, peak() - before
    generator = torch.Generator().manual_seed(0)
    scene.sample_rays(BATCH, generator)  # what is compiled or filled first
    begin = time.perf_counter()
    seen = set()
    for _ in range(options.draws):
        image = scene.sample_rays(BATCH, generator).rays.image_index
        assert image is not None
        seen |= set(image.unique().tolist())
    seconds = time.perf_counter() - begin
    return {
        "seconds to open": opened,
        "megabytes to open": held / 1e6,
        "rays per second": options.draws * BATCH / seconds,
        "photographs drawn from": len(seen),
        "megabytes in all": (peak() - before) / 1e6,
    }


def peak() -> int:
    from lumigraph.system.memory import peak_memory

    return peak_memory(torch.device("cpu"))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
