"""Run as a program: start a process that does nothing but save, kill it at a random moment, look at what is left.

Processes are forked, because each would otherwise spend seconds on imports.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path

import tiny
import torch

from lumigraph.run import Run, State

KILLS = 20


def save_forever(folder: Path, parent: int) -> None:
    run, generator = Run(folder), torch.Generator()
    method = run.new_method()
    (optimizer,) = method.optimizers()
    sum(p.sum() for p in method.parameters()).backward()
    optimizer.step()
    step = run.state.step
    while os.getppid() == parent:  # not beyond the test, if that is killed itself
        step += 1
        for parameter in method.parameters():
            parameter.data.fill_(step)
            optimizer.state[parameter]["exp_avg"].fill_(step)
        generator.manual_seed(step)
        run.save(State(step, float(step)), method, [optimizer], generator)


def check(folder: Path) -> int:
    """The state that a folder holds, which must be of one piece."""
    run, generator = Run(folder), torch.Generator()
    method, step = run.method(), run.state.step
    (optimizer,) = method.optimizers()
    run.restore_training([optimizer], generator)
    assert generator.initial_seed() == step, "random numbers are of another step"
    for parameter in method.parameters():
        assert (parameter == step).all(), "weights are of another step"
        assert (optimizer.state[parameter]["exp_avg"] == step).all(), "the optimizer is of another step"
    return step


def newest(folder: Path) -> int:
    return max(int(path.name) for path in (folder / "checkpoints").iterdir() if path.name.isdecimal())


def main(folder: Path) -> None:
    torch.set_num_threads(1)  # a forked process has no other threads
    chance, before, halfway = random.Random(5), 0, 0
    run = tiny.new_run(folder)
    method = run.new_method()
    run.save(State(), method, method.optimizers(), torch.Generator())
    for _ in range(KILLS):
        parent, child = os.getpid(), os.fork()
        if child == 0:
            save_forever(folder, parent)
            os._exit(1)
        while newest(folder) == before:  # reading more would race with the child, who deletes what is old
            assert os.waitpid(child, os.WNOHANG) == (0, 0), "the saving process ended by itself"
            time.sleep(0.001)
        time.sleep(chance.random() * 0.05)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        halfway += any("partial" in path.name for path in (folder / "checkpoints").iterdir())
        step = check(folder)
        assert step > before, "a complete state was lost"
        before = step
    assert halfway >= KILLS // 4, f"only {halfway} kills came while something was being written: prove nothing"
    print(f"{KILLS} kills, {halfway} of them halfway, {before} states")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
