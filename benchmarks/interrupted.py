"""Kill -9 while frames are fused or tracked: the resumed run beside one that was never stopped.

    python benchmarks/interrupted.py RECORDING [--method imap] [--kills 10] [--frames 40] [--downscale 4]

RECORDING is what `lumigraph track` takes, for tsdf-fusion a posed capture of a depth camera. Both runs save twice a
second. One is killed by SIGKILL a random moment after a checkpoint, and resumed, as often as asked. Written: the
largest difference between the trajectories in metres, and whether all tensors are equal to the bit.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from lumigraph.budget import Budget
from lumigraph.run import Run
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

SAVE_SECONDS = 0.5
MAX_DELAY = 1.0  # seconds from a checkpoint to a kill, at most


def go_on(folder: Path) -> None:
    """Train a run to its end."""
    run = Run(folder)
    settings = run.settings
    ended = fit(
        run.new_method("cpu"),
        run.scene(),
        run,
        budget=Budget.from_json(settings.budget, folder),
        seed=settings.seed,
        save_every=SAVE_SECONDS,
        show=False,
    )
    go_on_unless(ended.signal)


def child(folder: Path) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, __file__, str(folder), "--go-on"])


def steps(folder: Path) -> int:
    run = Run(folder)
    return run.state.step if run.has_state else 0


def killed(folder: Path, kills: int, chance: random.Random) -> int:
    """Kill a run so often, each time after it has learnt something; gives the number of kills that it lived through."""
    for kill in range(kills):
        before, process = steps(folder), child(folder)
        while steps(folder) == before and process.poll() is None:
            time.sleep(0.1)
        time.sleep(chance.uniform(0, MAX_DELAY))
        if process.poll() is not None:
            return kill
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        print(f"killed after step {steps(folder)}", flush=True)
    return kills


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recording", type=str)
    parser.add_argument("--method", default="imap")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--downscale", type=int, default=4)
    parser.add_argument("--go-on", action="store_true")
    given = parser.parse_args()
    if given.go_on:
        go_on(Path(given.recording))
        return
    tracked = given.method != "tsdf-fusion"
    words = ["track", given.method, given.recording, "--frames", str(given.frames)] if tracked else []
    words = words or ["train", given.method, given.recording, "--steps", str(given.frames)]
    with TemporaryDirectory() as place:
        whole, broken = Path(place) / "whole", Path(place) / "broken"
        for folder in (whole, broken):
            command = [
                sys.executable,
                "-m",
                "lumigraph",
                *words,
                "--downscale",
                str(given.downscale),
                "--pause-at",
                "1",
            ]
            subprocess.run([*command, "--output", str(folder)], stdout=subprocess.DEVNULL, check=False)
        child(whole).wait()
        count = killed(broken, given.kills, random.Random(0))
        child(broken).wait()
        one, other = (Run(folder).method("cpu") for folder in (whole, broken))
    states = one.state_dict(), other.state_dict()
    equal = states[0].keys() == states[1].keys() and all(torch.equal(x, states[1][n]) for n, x in states[0].items())
    print(f"{given.method}: {count} kills; tensors {'equal to the bit' if equal else 'differ'}")
    if tracked:
        scale = one.frame.to_source.scale
        poses = [method.tracker.trajectory.poses for method in (one, other)]
        print(f"largest difference of a position: {float((poses[0] - poses[1])[:, :, 3].abs().max()) * scale:.2g} m")
    raise SystemExit(not equal)


if __name__ == "__main__":
    main()
