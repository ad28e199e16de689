"""What each format of clouds keeps: bytes, and PSNR between renderings before a round trip through a file and after.

    python benchmarks/formats.py RUN_OR_FILE

Views are the held-out ones, or evenly some of the training cameras where there are none; colours over black.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.table import Table

from lumigraph.exchange import SUFFIXES, read_gaussians, write_gaussians
from lumigraph.gaussians.splatting import render
from lumigraph.geometry import evenly
from lumigraph.large import open_any
from lumigraph.method.capabilities import HasGaussians, needs
from lumigraph.metrics import psnr
from lumigraph.system.console import console

BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Options:
    source: tyro.conf.Positional[Path]
    views: int = 7
    size: int = 400  # longer side of a view, pixels


def main(options: Options) -> None:
    opened = open_any(options.source)
    cloud = needs(opened.method(), HasGaussians).gaussians().to("cpu")
    cameras = opened.cameras()
    seen_from = cameras.get("test", cameras["train"])
    views = [seen_from[i] for i in evenly(range(len(seen_from)), options.views)]
    views = [view.resized(options.size / max(view.size[0].tolist())) for view in views]
    before = [render(cloud, view, BLACK, opened.frame.near).rgb for view in views]
    table = Table("format", "bytes", "each", "PSNR", "written in", "read in", title=f"{len(cloud):,} Gaussians")
    with tempfile.TemporaryDirectory() as folder:
        for suffix in SUFFIXES:
            path, begin = Path(folder) / f"cloud{suffix}", time.perf_counter()
            write_gaussians(path, cloud)
            written = time.perf_counter()
            found = read_gaussians(path)
            read = time.perf_counter()
            pictures = (render(found, view, BLACK, opened.frame.near).rgb for view in views)
            levels = [psnr(a, b) for a, b in zip(before, pictures, strict=True)]
            table.add_row(
                suffix,
                f"{path.stat().st_size:,}",
                f"{path.stat().st_size / len(cloud):.1f}",
                f"{sum(levels) / len(levels):.1f} dB",
                f"{written - begin:.1f} s",
                f"{read - written:.1f} s",
            )
    console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Options))
