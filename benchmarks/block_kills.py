"""Workers of a run in blocks are killed at random moments, and the driver too: every block is learnt all the same.

    python benchmarks/block_kills.py SCENE --output FOLDER --blocks 4 --steps 2000 --workers 2 --kills 10 --drivers 2

The command runs three times: undisturbed; with SIGKILL for a worker that holds a block, again and again; and with
SIGKILL for the driver, after which the same command is given again. The weights of all blocks are then compared to the
byte, and it is counted which of the kills met a block that was being learnt.
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

from lumigraph.run.block_plan import DONE, FOLDER

WEIGHTS = "checkpoints/*/weights.safetensors"


@dataclass(frozen=True)
class Options:
    scene: tyro.conf.Positional[str]
    output: Path
    blocks: int = 4
    steps: int = 2000  # of all blocks together
    workers: int = 2
    kills: int = 10  # of workers
    gap: tuple[float, float] = (2.0, 8.0)  # seconds from one kill to the next, at least and at most
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
    for lock in sorted((run / FOLDER).glob("*/lock.json")):
        with contextlib.suppress(OSError, ValueError):
            number = json.loads(lock.read_text())["process"]
            os.kill(number, 0)
            found.append((lock.parent.name, number))
    return found


def weights(run: Path) -> dict[str, bytes]:
    """Of all blocks that are done."""
    done = sorted(path.parent for path in (run / FOLDER).glob(f"*/{DONE}"))
    return {folder.name: next(folder.glob(WEIGHTS)).read_bytes() for folder in done}


def killed_workers(options: Options, run: Path, chance: random.Random) -> int:
    """How many workers were killed while they held a block."""
    process, kills = started(options, run), 0
    while kills < options.kills and process.poll() is None:
        time.sleep(chance.uniform(*options.gap))
        if there := holders(run):
            name, number = chance.choice(there)
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
                kills += 1
                print(f"  worker of block {name} killed", flush=True)
    ended(process)
    return kills


def killed_drivers(options: Options, run: Path, chance: random.Random, alone: float) -> int:
    """How many drivers were killed before they were done."""
    kills = 0
    for _ in range(options.drivers):
        process = started(options, run)
        time.sleep(chance.uniform(0.2, 0.7) * alone)
        if process.poll() is None:
            process.kill()
            kills += 1
            left = sum((folder / DONE).exists() for folder in (run / FOLDER).iterdir()) if run.exists() else 0
            print(f"  driver killed, {left} blocks done", flush=True)
        process.wait()
    ended(started(options, run))
    return kills


def main(options: Options) -> int:
    chance, begin = random.Random(options.seed), time.perf_counter()
    folders = [options.output / name for name in ("undisturbed", "workers", "drivers")]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    ended(started(options, folders[0]))
    alone = time.perf_counter() - begin
    expected = weights(folders[0])
    print(f"undisturbed: {len(expected)} blocks in {alone:.0f} s", flush=True)
    faults = 0
    for folder in folders[1:]:
        begin = time.perf_counter()
        if folder.name == "workers":
            kills = killed_workers(options, folder, chance)
        else:
            kills = killed_drivers(options, folder, chance, alone)
        found = weights(folder)
        same = sum(found.get(name) == content for name, content in expected.items())
        print(
            f"{kills} {folder.name} killed: {len(found)} of {len(expected)} blocks done in "
            f"{time.perf_counter() - begin:.0f} s, {same} identical to the byte",
            flush=True,
        )
        faults += len(expected) - same
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
