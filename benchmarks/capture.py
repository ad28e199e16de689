"""Lumigraph's captures beside COLMAP's own defaults: photographs placed, share of the matches that the model confirms,
reprojection error, points, seconds.

Seconds are given twice: elapsed, and those of all processors, which other programs on the machine hardly change.

    python benchmarks/capture.py FOLDER [FOLDER ...] [--count 12 25] [--no-exif] [--half] [--output F.json]

Each folder of photographs (or its `images`) is given to `lumigraph capture` and to pycolmap's feature extraction,
exhaustive matching and incremental mapping, all with their defaults and each in its own process, one after the other.
A video becomes ten frames, chosen evenly. With --count, also so many photographs of each folder, chosen evenly.
--no-exif: photographs without their EXIF data. --half: photographs at half their size.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import av
import pycolmap
import tyro
from PIL import Image, ImageOps
from rich.table import Table

from lumigraph import files
from lumigraph.geometry import evenly
from lumigraph.readers.pictures import list_images
from lumigraph.sfm.agreement import agreement
from lumigraph.sfm.diagnosis import read_matches
from lumigraph.system.console import console

VIDEO_FRAMES = 10
DEFAULTS = """
import sys, pycolmap
database, images, models = sys.argv[1:]
pycolmap.extract_features(database, images, device=pycolmap.Device.cpu)
pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
pycolmap.incremental_mapping(database, images, models)
"""


@dataclass(frozen=True)
class Options:
    folders: tyro.conf.Positional[tuple[Path, ...]]
    count: tuple[int, ...] = ()
    no_exif: bool = False
    half: bool = False
    output: Path | None = None


@dataclass(frozen=True)
class Placed:
    """Result of one reconstruction. photographs: in the largest model; confirmed: share of all matches, see
    `Agreement`; error: mean reprojection error in pixels."""

    photographs: int
    confirmed: float
    apart: list[int]
    error: float
    points: int
    seconds: float
    processor_seconds: float


def frames_of(video: Path, folder: Path) -> list[Path]:
    with av.open(str(video)) as container:
        pictures = [frame.to_image() for frame in container.decode(video=0)]
    paths = []
    for i, picture in enumerate(evenly(pictures, VIDEO_FRAMES)):
        paths.append(folder / f"{i:03d}.png")
        picture.save(paths[-1])
    return paths


def prepare(photographs: list[Path], folder: Path, options: Options) -> None:
    """Copy photographs to a folder, changed as the options ask. Pixels are recompressed where they change."""
    for path in photographs:
        target = folder / path.name
        if not (options.no_exif or options.half):
            target.write_bytes(path.read_bytes())
            continue
        with Image.open(path) as picture:
            exif = b"" if options.no_exif else picture.getexif().tobytes()
            if options.no_exif:
                picture = ImageOps.exif_transpose(picture)
            if options.half:
                picture = picture.reduce(2)
            picture.convert("RGB").save(target, **({"exif": exif} if exif else {}), quality=95)


def timed(command: list[str]) -> tuple[subprocess.CompletedProcess[str], tuple[float, float]]:
    """A command's result, and its seconds: elapsed, and of all processors, its own child processes included."""
    started, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    log = subprocess.run(command, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return log, (time.perf_counter() - started, processor)


def measured(models: Path, database: Path, seconds: tuple[float, float]) -> Placed:
    found = [pycolmap.Reconstruction(place) for place in models.iterdir() if (place / "images.bin").is_file()]
    found.sort(key=lambda model: -model.num_reg_images())
    if not found:
        return Placed(0, 0.0, [], 0.0, 0, *seconds)
    best = found[0]
    apart = [model.num_reg_images() for model in found[1:]]
    share, error = agreement(best, database, read_matches(database)).share, best.compute_mean_reprojection_error()
    return Placed(best.num_reg_images(), share, apart, error, best.num_points3D(), *seconds)


def compare(photographs: Path, work: Path) -> tuple[Placed, Placed]:
    """Results of Lumigraph and of COLMAP's defaults."""
    ours, models = work / "ours", work / "models"
    log, seconds = timed([sys.executable, "-m", "lumigraph", "capture", str(photographs), "--output", str(ours)])
    if log.returncode:
        console().print(log.stdout[-300:] + log.stderr[-300:])
    (ours / "sparse").mkdir(parents=True, exist_ok=True)
    first = measured(ours / "sparse", ours / "work" / "database.db", seconds)
    models.mkdir()
    _, seconds = timed([sys.executable, "-c", DEFAULTS, str(work / "database.db"), str(photographs), str(models)])
    return first, measured(models, work / "database.db", seconds)


def main(options: Options) -> None:
    names = "placed", "confirmed", "apart", "error, px", "points", "seconds", "processor seconds"
    table = Table("capture", "photographs", *names, caption="Lumigraph / COLMAP's defaults")
    rows = []
    for source in options.folders:
        for count in (None, *options.count):
            with tempfile.TemporaryDirectory() as place:
                work, photographs = Path(place), Path(place) / "photographs"
                photographs.mkdir()
                if source.is_file():
                    paths = frames_of(source, work)
                else:
                    folder = source / "images" if (source / "images").is_dir() else source
                    paths = [folder / name for name in list_images(folder)]
                if count is not None and count >= len(paths):
                    continue
                chosen = paths if count is None else evenly(paths, count)
                prepare(chosen, photographs, options)
                results = compare(photographs, work)
            name = source.stem if source.name[:6] not in ("images", "video.") else f"{source.parent.name}/{source.name}"
            rows.append([name, len(chosen), *map(asdict, results)])
            cells = [
                (
                    r.photographs,
                    f"{r.confirmed:.0%}",
                    " ".join(map(str, r.apart)) or "-",
                    f"{r.error:.2f}",
                    r.points,
                    f"{r.seconds:.0f}",
                    f"{r.processor_seconds:.0f}",
                )
                for r in results
            ]
            pairs = [f"{ours} / {theirs}" for ours, theirs in zip(*cells, strict=True)]
            table.add_row(name, str(len(chosen)), *pairs)
            print(name, len(chosen), *pairs, sep="  ", flush=True)
            if options.output:
                files.write_json(options.output, rows)
    console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
