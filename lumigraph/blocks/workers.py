"""Who computes blocks, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass

from ..run.block_plan import Done


@dataclass(frozen=True)
class Workers:
    """Who computes.

    count:   blocks at a time on this machine, each in a process of its own; None for this process alone
    address: of a Ray cluster that is there already, HOST:PORT
    cpus, gpus, memory: what a block asks of its machine: processors, GPUs, bytes
    """

    count: int | None = None
    address: str | None = None
    cpus: int = 1
    gpus: float = 0.0
    memory: int = 2 << 30


@dataclass(frozen=True)
class Conducted:
    """What came of it: what blocks took by name, a sentence for each that failed, and the signal that stopped it."""

    done: dict[str, Done]
    failed: dict[str, str]
    signal: int | None = None
