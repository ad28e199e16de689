"""One stage of COLMAP in a process of its own, so that Ctrl-C ends it at once and its memory and chatter stay outside.

Run as a script, with what to do as JSON in its only argument. It imports nothing of the package, so it starts in half a
second. It writes how much is done to standard output, a number to a line; whatever COLMAP says goes to standard error.
It ends when its standard input does, as the process that started it has then ended.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pycolmap

COUNTER = Path(__file__).with_name("counter.py")
BLOCK_PAIRS = 64  # pairs that COLMAP compares between two writes to the database
MIN_MODEL_VIEWS = 3  # photographs of a model
MAX_THREADS = 16  # more threads need more memory than they save time


def find_features(job: dict[str, Any]) -> None:
    """Scale-invariant features (Lowe 2004), as root-SIFT, where masks allow them; photographs that have theirs are
    passed over."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads = job["max_size"], job["threads"]
    options.sift.max_num_features = job["features"]
    reading = pycolmap.ImageReaderOptions()
    if job["masks"]:
        reading.mask_path = job["masks"]
    pycolmap.extract_features(
        job["database"],
        job["images"],
        image_names=job["names"],
        reader_options=reading,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def match(job: dict[str, Any]) -> None:
    """Compare listed pairs and keep what one motion between two views explains; pairs that are done are passed over."""
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.num_threads = job["threads"]
    pairing.match_list_path, pairing.block_size = job["pairs"], BLOCK_PAIRS
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    pycolmap.match_image_pairs(job["database"], options, pairing, verification, device=pycolmap.Device.cpu)


def place_one_by_one(job: dict[str, Any]) -> None:
    """Incremental structure from motion (Schönberger and Frahm 2016)."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = job["threads"], job["seed"]
    options.min_model_size = MIN_MODEL_VIEWS
    placed = 2

    def another() -> None:
        nonlocal placed
        placed += 1
        tell(placed)

    def begun() -> None:
        nonlocal placed
        placed = 2
        tell(placed)

    pycolmap.incremental_mapping(
        job["database"],
        job["images"],
        job["models"],
        options,
        initial_image_pair_callback=begun,
        next_image_callback=another,
    )


def place_all_at_once(job: dict[str, Any]) -> None:
    """Global structure from motion (GLOMAP, Pan 2024). Focal lengths that are guesses are first found from pairs."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = job["threads"], job["seed"]
    options.min_model_size = MIN_MODEL_VIEWS
    if job["calibrate"]:
        pycolmap.calibrate_view_graph(job["database"])
    pycolmap.global_mapping(job["database"], job["images"], job["models"], options)


STAGES: dict[str, tuple[Callable[[dict[str, Any]], None], str | None]] = {
    "features": (find_features, "keypoints"),
    "matching": (match, "two_view_geometries"),
    "incremental": (place_one_by_one, None),
    "global": (place_all_at_once, None),
}


def tell(count: int) -> None:
    print(count, file=REPORT, flush=True)


def end_with_input() -> None:
    sys.stdin.read()
    os._exit(1)


def main() -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # COLMAP's logging library has taken it
    job = json.loads(sys.argv[1])
    job["threads"] = min(os.cpu_count() or 1, MAX_THREADS)
    job["seed"] = 0
    threading.Thread(target=end_with_input, daemon=True).start()
    run, table = STAGES[job["stage"]]
    if table is None:
        run(job)
        return
    with counting(job["database"], table):
        run(job)


@contextmanager
def counting(database: str, table: str) -> Iterator[None]:
    """Meanwhile another process reports how many rows a table has."""
    command = [sys.executable, "-P", str(COUNTER), database, table]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=REPORT, stderr=subprocess.DEVNULL) as counter:
        try:
            yield
        finally:
            assert counter.stdin
            counter.stdin.close()


if __name__ == "__main__":
    REPORT = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever libraries print is chatter
    main()
