"""Options of training in blocks, without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from ..files.options import option
from ..files.ranges import Count


@dataclass(frozen=True)
class BlockOptions:
    """A large scene is trained in blocks, each a run of its own; from few photographs one block, an ordinary run.

    --steps and --seconds are for all blocks together and divided evenly; the default is a minute for each block. After
    Ctrl-C, a crash or a lost machine the same command continues; finished blocks are kept. RUN/blocks.png shows the
    plan. `eval`, `render`, `view` and `export` open the run as one scene. --field METHOD, such as gaussian-splatting,
    trains each block with another method; for clouds, RUN/cloud.ply joins each block's own cell.
    """

    blocks: Annotated[str | None, option("auto|N|FILE", "auto from 200 photographs on, else one block")] = None
    """Positions of blocks: auto (street crossings, or evenly spread), a number of evenly spread ones, or a JSON file in
    the frame of the photographs: {"blocks": [{"centre": [x, y, z], "radius": r}, ...]}. With --into, a block's name."""
    workers: Annotated[Count | None, option("N", "1, in this process")] = None
    """Number of blocks to train at a time on this machine, with Ray."""
    address: Annotated[str | None, option("HOST:PORT", "this machine")] = None
    """Train blocks on an existing Ray cluster; --output must be on storage that all its machines share."""
    into: Annotated[Path | None, option("RUN", "a new run")] = None
    """Learn one block of this run again, from other photographs, as the run's own were learnt; the rest stays."""
    field: Annotated[str, arg(metavar="METHOD", help="The method that learns each block.")] = ""
