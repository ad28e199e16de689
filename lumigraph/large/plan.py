"""blocks.json: division of a large scene into blocks, and the training of each. One file for all of a run.

{
  "format": "lumigraph blocks 1",
  "method": "block-nerf", "config": {...}, "scene": {"source": "/survey", "options": {}},
  "budget": {"steps": 2000}, "seed": 0, "device": "cpu", "upright": [[...], [...], [...]],
  "blocks": [{"name": "0", "centre": [12.5, 3.0, 1.6], "radius": 40.0, "photographs": ["0001.jpg", ...]}, ...],
  "appearance": {"0": [...], ...}
}
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from .. import files
from ..errors import LumigraphError
from ..files.ranges import Point, Positive, between, typed
from ..files.reading import reads
from ..readers import CapturePart
from ..run.settings import Source

PLAN_FORMAT = "lumigraph blocks 1"
PLAN_FILE, BLOCKS_FOLDER, TASK_FILE, DONE_FILE = "blocks.json", "blocks", "task.json", "done.json"
BlockLabel = Annotated[str, msgspec.Meta(pattern=r"\A[0-9]{1,6}\Z")]  # of a block, and of its folder
Turn = tuple[Point, Point, Point]  # rows of a rotation
Number = Annotated[float, between(-1e6, 1e6)]


def source_of(source: str, options: dict[str, Any]) -> Source:
    """Source of photographs of a scene or a block, without options that are unset."""
    path, said = Path(source), {name: value for name, value in options.items() if value is not None}
    return Source(str(path.resolve()) if path.exists() else source, said)


@dataclass(frozen=True)
class Block:
    """A block and its photographs.

    name:   of its folder
    centre, radius: in the source's frame and units
    photographs: by name, held-out ones included
    scene, budget: source and budget of a block that was retrained on other photographs
    """

    name: BlockLabel
    centre: Point
    radius: Positive
    photographs: list[str]
    scene: Source | None = None
    budget: dict[str, Any] | None = None


@dataclass(frozen=True)
class Task:
    """task.json: complete description of a block's training.

    scene:   source and options of `open_dataset`, with the block as `part`
    upright: the rotation from the source's frame that brings up to +z, the same for all blocks
    budget:  {"steps": n}, {"seconds": s} or {"quality": word}
    memory:  bytes of photographs in memory; larger captures use a file
    threads: per step; None for all
    """

    method: str
    config: dict[str, Any]
    scene: Source
    upright: Turn
    budget: dict[str, Any]
    seed: int = 0
    device: str = "cpu"
    memory: Annotated[int, between(0, 1 << 50)] = 1 << 30
    threads: Annotated[int, between(1, 4096)] | None = None

    @property
    def key(self) -> str:
        """Hash of everything that the block's weights depend on."""
        said = {name: value for name, value in asdict(self).items() if name != "threads"}
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()

    @staticmethod
    @reads()
    def read(folder: Path) -> Task:
        """The task in a block's folder. Raises LumigraphError, naming the file, where it is missing or damaged."""
        return files.read_json(folder / TASK_FILE, Task)


@dataclass(frozen=True)
class Done:
    """done.json, the last file of a block: its cost.

    key:     of the task
    seconds: of training, without compilation and opening the photographs
    """

    key: str
    steps: int
    seconds: float
    compile_seconds: float
    opening_seconds: float
    peak_memory: int
    photographs: int
    bytes: int


@dataclass(frozen=True)
class Plan:
    """The contents of blocks.json.

    budget:  of each block
    appearance: appearance code of each block, once they are aligned
    """

    method: str
    config: dict[str, Any]
    scene: Source
    upright: Turn
    blocks: list[Block]
    budget: dict[str, Any]
    seed: int = 0
    device: str = "cpu"
    processor: str = "unknown"
    versions: dict[str, str] = field(default_factory=dict)
    appearance: dict[str, list[Number]] = field(default_factory=dict)

    @staticmethod
    @reads()
    def read(path: Path) -> Plan:
        """The plan in a file. Raises LumigraphError, naming it, where it is foreign or damaged."""
        said = files.read_json(path)
        if not isinstance(said, dict) or said.get("format") != PLAN_FORMAT:
            raise LumigraphError(f"{path} was not written by this version of Lumigraph; open it with the one that did")
        plan = typed(Plan, said, path)
        if not plan.blocks or len({block.name for block in plan.blocks}) < len(plan.blocks):
            raise LumigraphError(f"{path} names no block, or two alike; restore it from a copy")
        return plan

    def write(self, path: Path) -> None:
        said = {name: value for name, value in asdict(self).items() if name not in ("scene", "blocks")}
        blocks = [{name: x for name, x in asdict(block).items() if x is not None} for block in self.blocks]
        files.write_json(
            path, {"format": PLAN_FORMAT, **said, "scene": self.scene.to_json(), "blocks": blocks}, ours=True
        )

    def block(self, name: str) -> Block:
        """Block by name. Raises LumigraphError, naming all blocks, if there is none."""
        blocks = {block.name: block for block in self.blocks}
        if name not in blocks:
            raise LumigraphError(f"There is no block {name}; there are {', '.join(blocks)}")
        return blocks[name]

    def task(self, block: Block) -> Task:
        """The task of a block."""
        scene = block.scene or self.scene
        part = asdict(CapturePart(block.photographs, block.centre, block.radius))
        told = replace(scene, options={**scene.options, "part": part})
        return Task(self.method, self.config, told, self.upright, block.budget or self.budget, self.seed, self.device)
