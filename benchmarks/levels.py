"""What levels of detail keep: bytes of each, and PSNR of its renderings beside the whole cloud's, from near and afar.

    python benchmarks/levels.py RUN_OR_FILE

Views are the held-out ones, or evenly some of the training cameras where there are none; colours over black. A view of
half the size is what the camera sees from twice as far.
"""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.table import Table

from lumigraph.exchange import streamed_sog
from lumigraph.gaussians.splatting import render
from lumigraph.geometry import evenly
from lumigraph.large import open_any
from lumigraph.method.capabilities import HasGaussians, needs
from lumigraph.metrics import psnr
from lumigraph.system.console import console

BLACK = (0.0, 0.0, 0.0)
FARTHER = 1, 2, 4, 8


@dataclass(frozen=True)
class Options:
    source: tyro.conf.Positional[Path]
    views: int = 7
    size: int = 400  # longer side of a view, pixels
    levels: int = 4
    ratio: float = 4.0
    chunk: int = 1 << 16


def main(options: Options) -> None:
    opened = open_any(options.source)
    cloud = needs(opened.method(), HasGaussians).gaussians().to("cpu")
    cameras = opened.cameras()
    seen_from = cameras.get("test", cameras["train"])
    views = [seen_from[i] for i in evenly(range(len(seen_from)), options.views)]
    views = [view.resized(options.size / max(view.size[0].tolist())) for view in views]
    with tempfile.TemporaryDirectory() as place:
        folder, begin = Path(place) / "cloud", time.perf_counter()
        detail = streamed_sog.Detail(options.levels, options.ratio, options.chunk)
        streamed_sog.write(folder / streamed_sog.META, cloud, detail)
        took = time.perf_counter() - begin
        names = json.loads((folder / streamed_sog.META).read_text())["filenames"]
        title = f"{len(cloud):,} Gaussians, written in {took:.0f} s"
        table = Table("level", "Gaussians", "bytes", *(f"PSNR, {n} times as far" for n in FARTHER), title=title)
        for level in range(options.levels):
            found = streamed_sog.read(folder, level)
            parts = [(folder / name).parent for name in names if name.startswith(f"{level}_")]
            size = sum(file.stat().st_size for part in parts for file in part.iterdir())
            scores = []
            for farther in FARTHER:
                smaller = [view.resized(1 / farther) for view in views]
                pairs = [[render(x, view, BLACK, opened.frame.near).rgb for x in (cloud, found)] for view in smaller]
                scores.append(sum(psnr(a, b) for a, b in pairs) / len(pairs))
            table.add_row(str(level), f"{len(found):,}", f"{size:,}", *(f"{score:.1f} dB" for score in scores))
    console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Options))
