"""How long blocks take on many machines: a discrete simulation of what was measured in a run, compared with that run.

    python benchmarks/large_simulation.py RUN --workers 1 2 4
    python benchmarks/large_simulation.py RUN --workers 35 --blocks 35 --photographs 2_800_000 --steps 200_000

RUN is a finished run in blocks. Its done.json files say what opening a photograph, a step, compiling and saving a block
took; these are the model's numbers. The simulation has workers that take one block after the other, storage whose
bandwidth those share that read, and machines that are lost now and then, which costs what was not saved.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from lumigraph import files
from lumigraph.large.plan import DONE_FILE, PLAN_FILE, Done, Plan
from lumigraph.large.planning import place_of
from lumigraph.large.worker import SAVE_SECONDS


@dataclass(frozen=True)
class Costs:
    """What was measured of blocks: seconds to open a photograph, to begin, of a step, to compile; bytes of weights."""

    per_photograph: float
    beginning: float
    per_step: float
    compiling: float
    weights: float


@dataclass(frozen=True)
class Machines:
    """Who computes, and what they share.

    starting:  seconds until a worker takes its first block
    bandwidth: bytes that storage gives in a second, to all together
    lost:      hours of a worker's work after which it is lost, on average; 0 for never
    """

    workers: int
    starting: float = 0.0
    bandwidth: float = float("inf")
    lost: float = 0.0


@dataclass(frozen=True)
class Work:
    """A block: photographs, the bytes of their files, steps."""

    photographs: int
    bytes: float
    steps: int


def measured(done: list[Done]) -> Costs:
    """The model's numbers: opening by least squares over the blocks, the rest as means."""
    photographs = np.array([x.photographs for x in done], float)
    opening = np.array([x.opening_seconds for x in done])
    slope, offset = np.polyfit(photographs, opening, 1) if np.ptp(photographs) > 0 else (0.0, opening.mean())
    if slope < 0 or offset < 0:  # so alike that they tell no slope: all of it by photographs
        slope, offset = opening.sum() / photographs.sum(), 0.0
    return Costs(
        float(slope),
        float(offset),
        sum(x.seconds for x in done) / sum(x.steps for x in done),
        float(np.mean([x.compile_seconds for x in done])),
        float(np.mean([x.bytes for x in done])),
    )


def simulate(work: list[Work], costs: Costs, machines: Machines, seed: int = 0) -> tuple[float, float, int]:
    """Seconds until all blocks are done, the share of that in which workers were busy, and how many were lost.

    Each worker takes the next block as soon as it is free. Photographs are read at the rate that storage gives to so
    many readers as there are workers, which is a bound from above: not all read at once.
    """
    random = np.random.default_rng(seed)
    rate = machines.bandwidth / machines.workers
    free = [(machines.starting, number) for number in range(machines.workers)]
    heapq.heapify(free)
    busy, losses = 0.0, 0
    for one in work:
        begin, number = heapq.heappop(free)
        opening = costs.beginning + one.photographs * costs.per_photograph + one.bytes / rate
        ahead = opening + costs.compiling
        left, took = one.steps * costs.per_step, 0.0
        while True:
            until = random.exponential(3600 * machines.lost) if machines.lost else float("inf")
            if until >= ahead + left:
                took += ahead + left
                break
            losses += 1
            took += until
            left -= max(0.0, until - ahead) // SAVE_SECONDS * SAVE_SECONDS
        busy += took
        heapq.heappush(free, (begin + took, number))
    end = max(at for at, _ in free)
    return end, busy / (end * machines.workers), losses


@dataclass(frozen=True)
class Options:
    run: tyro.conf.Positional[Path]
    workers: tuple[int, ...] = (1, 2, 4)
    starting: float = 0.0  # seconds until workers begin
    blocks: int | None = None  # as many as the run has
    photographs: int | None = None  # of all blocks, overlap counted twice; as the run has
    steps: int | None = None  # of each block; as the run has
    photograph_bytes: float = 0.0  # of a photograph's file, beside what opening it took here
    bandwidth: float = float("inf")  # of storage, bytes in a second
    lost: float = 0.0  # hours after which a worker is lost, on average
    faster: float = 1.0  # times as fast in learning as the machine that was measured
    seconds: float | None = None  # that the first number of workers really took, to compare with


def main(options: Options) -> None:
    plan = Plan.read(options.run / PLAN_FILE)
    done = [files.read_json(place_of(options.run, block) / DONE_FILE, Done) for block in plan.blocks]
    costs = measured(done)
    print(
        f"measured, {len(done)} blocks: {1e3 * costs.per_photograph:.2f} ms to open a photograph, "
        f"{costs.beginning:.2f} s to begin, {1e3 * costs.per_step:.2f} ms a step, {costs.compiling:.2f} s compiling, "
        f"{costs.weights / 1e6:.1f} MB of weights, {max(x.peak_memory for x in done) / 1e9:.2f} GB of memory at most"
    )
    if options.blocks or options.photographs or options.steps:
        count = options.blocks or len(done)
        each = (options.photographs or sum(x.photographs for x in done)) // count
        work = [Work(each, each * options.photograph_bytes, options.steps or done[0].steps)] * count
    else:
        work = [Work(x.photographs, x.photographs * options.photograph_bytes, x.steps) for x in done]
    fast = Costs(costs.per_photograph, costs.beginning, costs.per_step / options.faster, costs.compiling, costs.weights)
    for workers in options.workers:
        machines = Machines(workers, options.starting, options.bandwidth, options.lost)
        seconds, busy, losses = simulate(work, fast, machines)
        told = f"{workers} workers: {seconds:,.1f} s ({seconds / 3600:.2f} h), busy {100 * busy:.0f} %"
        if losses:
            told += f", {losses} lost"
        if options.seconds and workers == options.workers[0]:
            told += f"; really {options.seconds:,.1f} s, so {100 * (seconds / options.seconds - 1):+.0f} %"
        print(told)


if __name__ == "__main__":
    main(tyro.cli(Options))
