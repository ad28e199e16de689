"""Whether memory stays flat while everything is done over and over in one process.

    python benchmarks/soak.py [--seconds 3600] [--output FILE.json]

Rounds of training, resuming, viewing, saving, rendering, evaluating and exporting, of each method in turn, on a small
scene drawn here. The viewer is asked by a client as a browser asks it. Resident memory is read after each round and
told once a minute. Exit code 1 if it grows: if the last tenth of the time has more than 5 % above what was there after
the first fifth, which is for loading, compiling and filling caches.
"""

from __future__ import annotations

import lumigraph  # ahead of PyTorch, as the command line does; isort: skip
import contextlib
import json
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))  # the client, and a small scene

STATUS = Path("/proc/self/status")
WARM, LAST = 0.2, 0.1  # shares of the time: what is left out, and what is compared
GROWTH = 0.05
MINUTE = 60.0
OF_METHOD = {
    "gaussian-splatting": ["--initial-gaussians", "2000", "--refine-until", "0"],
    "instant-ngp": ["--levels", "8", "--log2-hashmap-size", "14", "--max-resolution", "256"],
}
EXPORTS = {"gaussian-splatting": ("splats cloud.spz", "web page.html"), "instant-ngp": ("web page.html",)}


@dataclass(frozen=True)
class Options:
    seconds: float = 3600.0
    steps: int = 60  # of training in a round, and as many again when it is resumed
    pictures: int = 6  # that the viewer's client asks for in a round
    output: Path | None = None  # also write what was measured there, as JSON


@dataclass(frozen=True)
class Reading:
    """Resident memory at a moment: seconds since the beginning, rounds done, bytes, and how many threads there are."""

    seconds: float
    rounds: int
    memory: int
    threads: int


def main(options: Options) -> int:
    import tiny

    readings = [read(0.0, 0)]
    begin, told = time.perf_counter(), 0.0
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        scene = tiny.write_blender(Path(folder) / "ball")
        while (passed := time.perf_counter() - begin) < options.seconds:
            for method in OF_METHOD:
                one_round(method, scene, Path(folder) / "run", options)
            readings.append(read(time.perf_counter() - begin, len(readings)))
            if passed >= told:
                tell(readings[-1])
                told = passed - passed % MINUTE + MINUTE
    growth = grown(readings)
    show(readings, growth)
    if options.output:
        about = {"growth": growth, "readings": [asdict(reading) for reading in readings]}
        options.output.write_text(json.dumps(about, indent=1))
    return int(growth > GROWTH)


def one_round(method: str, scene: Path, run: Path, options: Options) -> None:
    """Everything once, in a folder that is gone afterwards."""
    steps = options.steps
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        must("train", method, scene, "--steps", steps, "--output", run, "--device", "cpu", *OF_METHOD[method])
        must("resume", run, "--steps", 2 * steps)
        look(run, options.pictures)
        must("render", run, "--frames", 4, "--size", 48)
        must("eval", run, "--views", 2)
        must("info", run)
        must("report", run)
        for kind, name in (export.split() for export in EXPORTS[method]):
            must("export", kind, run, run / name, *(["--views", 4, "--size", 48] if method == "instant-ngp" else []))
    shutil.rmtree(run)


def must(*words: object) -> None:
    """Run a command in this process; it has to go well."""
    from lumigraph.commands.cli import main as command

    if code := command([str(word) for word in words]):
        raise RuntimeError(f"lumigraph {' '.join(map(str, words))} ended with {code}")


def look(run: Path, pictures: int) -> None:
    """Open a run in the viewer, look at it from several places, save a path, go."""
    from viewer_client import Client

    from lumigraph.commands.view import subject_of
    from lumigraph.export.loaded import Loaded
    from lumigraph.large import open_any
    from lumigraph.viewer import Viewer, choose_address

    loaded = Loaded.of(open_any(run), "cpu")
    with Viewer(loaded.method, subject_of(loaded.opened, loaded.cameras), choose_address()) as viewer:
        client = Client(viewer.address.url)
        for i in range(pictures):
            client.look_from((3.0, 0.4 * i, 0.5))
            for _ in client.messages(0.3):
                pass
        client.close()


def read(seconds: float, rounds: int) -> Reading:
    """Memory now. Raises OSError where the system does not tell it."""
    about = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
    return Reading(seconds, rounds, 1024 * int(about["VmRSS"].split()[0]), int(about["Threads"]))


def grown(readings: list[Reading]) -> float:
    """Share by which memory is larger in the last tenth of the time than just after the first fifth."""
    whole = readings[-1].seconds
    early = [r.memory for r in readings if WARM * whole <= r.seconds <= (WARM + LAST) * whole]
    late = [r.memory for r in readings if r.seconds >= (1 - LAST) * whole]
    if not early or not late:
        raise ValueError("so few rounds tell nothing of memory; give --seconds more")
    return statistics.median(late) / statistics.median(early) - 1


def tell(reading: Reading) -> None:
    print(f"{reading.seconds / 60:6.1f} min  {reading.rounds:4} rounds  {reading.memory / 2**20:7.0f} MiB", flush=True)


def show(readings: list[Reading], growth: float) -> None:
    """A line for each minute with a bar, then the beginning, the end, and what lies between."""
    most = max(r.memory for r in readings)
    for reading in each_minute(readings):
        bar = "#" * round(50 * reading.memory / most)
        print(f"{reading.seconds / 60:6.1f} min {reading.memory / 2**20:7.0f} MiB {reading.threads:3} threads  {bar}")
    first, last = readings[0], readings[-1]
    print(
        f"start {first.memory / 2**20:.0f} MiB, end {last.memory / 2**20:.0f} MiB, most {most / 2**20:.0f} MiB;",
        end=" ",
    )
    print(f"{growth:+.1%} after warming up, over {last.rounds} rounds in {last.seconds:.0f} s")


def each_minute(readings: list[Reading]) -> Iterator[Reading]:
    """The first reading of each minute, and the last of all."""
    minute = -1
    for reading in readings:
        if (now := int(reading.seconds // MINUTE)) > minute:
            minute = now
            yield reading
    yield readings[-1]


if __name__ == "__main__":
    assert lumigraph.__version__
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
