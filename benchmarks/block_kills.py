"""Workers of a run in blocks are killed at random moments, and the driver too: every block is learnt all the same.

    python benchmarks/block_kills.py SCENE --output FOLDER --blocks 4 --steps 2000 --workers 2 --kills 10 --drivers 2

The command runs undisturbed; then with SIGKILL for a worker that holds a block, again and again, and anew until there
were so many kills; and with SIGKILL for the driver, after which the same command is given again. The weights of all
blocks are compared to the byte after each run. A driver is killed only while a block is held, so while it is learnt.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from lumigraph.large.plan import BLOCKS_FOLDER, DONE_FILE

WEIGHTS = "checkpoints/*/weights.safetensors"


@dataclass(frozen=True)
class Options:
    scene: tyro.conf.Positional[str]
    output: Path
    blocks: int = 4
    steps: int = 2000  # of all blocks together
    workers: int = 2
    kills: int = 10  # of workers
    gap: tuple[float, float] = (1.0, 5.0)  # seconds from one kill to the next, at least and at most
    drivers: int = 2  # kills of the driver
    seed: int = 0


def command(options: Options, run: Path) -> list[str]:
    told = ["--blocks", options.blocks, "--steps", options.steps, "--workers", options.workers, "--output", run]
    return [sys.executable, "-m", "lumigraph", "train", "block-nerf", options.scene, *map(str, told)]


def started(options: Options, run: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command(options, run), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def ended(process: subprocess.Popen[bytes]) -> None:
    _, said = process.communicate()
    if process.returncode:
        raise SystemExit(f"it ended with {process.returncode}: {said.decode()[-500:]}")


def holders(run: Path) -> list[tuple[str, int]]:
    """Blocks that a process holds, and which."""
    found = []
    for lock in sorted((run / BLOCKS_FOLDER).glob("*/lock.json")):
        with contextlib.suppress(OSError, ValueError):
            number = json.loads(lock.read_text())["process"]
            os.kill(number, 0)
            found.append((lock.parent.name, number))
    return found


def weights(run: Path) -> dict[str, bytes]:
    """Of all blocks that are done."""
    done = sorted(path.parent for path in (run / BLOCKS_FOLDER).glob(f"*/{DONE_FILE}"))
    return {folder.name: next(folder.glob(WEIGHTS)).read_bytes() for folder in done}


def killed_workers(options: Options, run: Path, chance: random.Random, most: int) -> int:
    """How many workers were killed while they held a block."""
    process, kills = started(options, run), 0
    while kills < most and process.poll() is None:
        time.sleep(chance.uniform(*options.gap))
        if there := holders(run):
            name, number = chance.choice(there)
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
                kills += 1
                print(f"  worker of block {name} killed", flush=True)
    ended(process)
    return kills


def killed_drivers(options: Options, run: Path, chance: random.Random) -> int:
    """Number of drivers killed while a worker held a block."""
    kills = 0
    for _ in range(options.drivers):
        process = started(options, run)
        while process.poll() is None:
            time.sleep(chance.uniform(*options.gap))
            if there := holders(run):
                process.kill()
                kills += 1
                left = sum((folder / DONE_FILE).exists() for folder in (run / BLOCKS_FOLDER).iterdir())
                print(f"  driver killed, {left} blocks done, {len(there)} held", flush=True)
                process.wait()
    ended(started(options, run))
    return kills


def main(options: Options) -> int:
    chance, begin = random.Random(options.seed), time.perf_counter()
    alone = options.output / "undisturbed"
    shutil.rmtree(options.output, ignore_errors=True)
    ended(started(options, alone))
    seconds = time.perf_counter() - begin
    expected = weights(alone)
    print(f"undisturbed: {len(expected)} blocks in {seconds:.0f} s", flush=True)
    faults = kills = 0
    while kills < options.kills:
        run, begin = options.output / f"workers-{kills}", time.perf_counter()
        number = killed_workers(options, run, chance, options.kills - kills)
        faults += differing("workers", number, run, expected, time.perf_counter() - begin)
        kills += number
    if options.drivers:
        run, begin = options.output / "drivers", time.perf_counter()
        number = killed_drivers(options, run, chance)
        faults += differing("drivers", number, run, expected, time.perf_counter() - begin)
    return 1 if faults else 0


def differing(who: str, kills: int, run: Path, expected: dict[str, bytes], seconds: float) -> int:
    """How many blocks are not what they are undisturbed."""
    found = weights(run)
    same = sum(found.get(name) == content for name, content in expected.items())
    done = f"{len(found)} of {len(expected)} blocks done in {seconds:.0f} s"
    print(f"{kills} {who} killed: {done}, {same} identical to the byte", flush=True)
    return len(expected) - same


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
