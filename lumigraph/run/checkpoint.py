"""Checkpoints: complete states of a run, each in a folder named after its step.

    000800/     weights.safetensors · optimizer.safetensors · state.json
    000800/     weights.packed · state.json     of a run that was compressed

A new checkpoint is written beside the previous one and renamed when complete; only then is the previous one deleted,
after a rename to a name that readers skip. So a complete checkpoint exists at any time, however the writer ends.
"""

import json
import os
import re
import zlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from torch import Tensor, nn

from .. import files
from ..errors import LumigraphError
from ..exchange import packing
from ..files.partials import partial
from ..files.plain import flatten, understood, unflatten
from ..files.ranges import Lasted, Tally, typed
from ..files.reading import reading
from ..method import Method
from ..system.memory import free_memory

CHECKPOINT_FORMAT = "lumigraph checkpoint 1"
GRID_AXES = 4  # axes of a grid of cells, of which the first is the number of the grid
WEIGHTS_FILE, OPTIMIZER_FILE, STATE_FILE = "weights.safetensors", "optimizer.safetensors", "state.json"
PACKED_FILE = "weights.packed"  # replaces both
STRUCTURE_KEY = "optimizers"
CHECKPOINT_NAME = re.compile(r"\d+")


@dataclass(frozen=True)
class State:
    """Progress of training: completed steps and their seconds; compilation is counted separately.

    peak_memory: bytes at most, see `memory.peak_memory`; 0 if unknown
    passes:      passes over the training data on average, see `verdict.shares_seen`; 0 if unknown
    """

    step: int = 0
    seconds: float = 0.0
    compile_seconds: float = 0.0
    peak_memory: int = 0
    passes: float = 0.0


@dataclass(frozen=True)
class Sum:
    """Checksum of a file."""

    bytes: Tally
    crc32: Tally


@dataclass(frozen=True)
class Saved:
    """Contents of state.json: progress as in `State`, checksums of all files, and the optimizers' state.

    files:      checksums by name; that of the optimizers' state is under the name of its entry
    optimizers: see `flatten`; their tensors are in a file of their own
    """

    method: str
    step: Tally
    seconds: Lasted
    compile_seconds: Lasted
    files: dict[str, Sum]
    optimizers: list[Any]
    peak_memory: Tally = 0
    passes: Lasted = 0.0


class Checkpoints:
    """The states in a run's folder.

    method: name of the run's method; a state of another one is refused
    """

    def __init__(self, run: Path, method: str):
        self.run, self.method = run, method
        self.folder = run / "checkpoints"

    def __bool__(self) -> bool:
        """True if there is a complete checkpoint."""
        return bool(self._all())

    @property
    def latest(self) -> Path:
        """Folder of the latest complete state. Raises LumigraphError if there is none."""
        if not self:
            raise LumigraphError(
                f"{self.run} has no saved state yet; `lumigraph resume {self.run}` trains it from the start"
            )
        return self._all()[-1]

    @property
    def state(self) -> State:
        """Progress of the latest complete checkpoint."""
        about = self._about(self.latest)
        return State(**{field.name: getattr(about, field.name) for field in fields(State)})

    def save(
        self, state: State, method: Method, optimizers: Iterable[torch.optim.Optimizer], generator: torch.Generator
    ) -> None:
        """Write a complete state, then delete the one before it. Does nothing if this step is there already."""
        folder = self.folder / f"{state.step:06d}"
        if folder.exists():
            return
        tensors: dict[str, Tensor] = {"generator": generator.get_state()}
        structure = flatten([optimizer.state_dict() for optimizer in optimizers], tensors)
        with files.replacing_folder(folder) as new:
            contents = {WEIGHTS_FILE: method.state_dict(), OPTIMIZER_FILE: tensors}
            sums = {name: write_tensors(new / name, content) for name, content in contents.items()}
            sums[STRUCTURE_KEY] = checksum(json.dumps(structure).encode())
            self._write_state(new, state, sums, structure)
        for path in self.folder.iterdir():
            if path != folder and is_state(path):  # renamed first, so that none is half deleted under its own name
                with files.explained(path), partial(path.parent, is_folder=True) as aside:
                    os.replace(path, aside / path.name)

    def save_packed(self, state: State, weights: bytes) -> None:
        """Write the checkpoint of a newly compressed run. weights: see `packing.write`"""
        with files.replacing_folder(self.folder / f"{state.step:06d}") as new:
            (new / PACKED_FILE).write_bytes(weights)
            self._write_state(new, state, {PACKED_FILE: checksum(weights)}, [])

    def _write_state(self, folder: Path, state: State, sums: dict[str, Sum], structure: Any) -> None:
        known = {name: asdict(total) for name, total in sums.items()}
        about = {"format": CHECKPOINT_FORMAT, "method": self.method, **asdict(state), "files": known}
        (folder / STATE_FILE).write_text(json.dumps({**about, STRUCTURE_KEY: structure}), "utf-8")

    @property
    def weights(self) -> Path:
        """The file of the latest state's weights."""
        packed = self.latest / PACKED_FILE
        return packed if files.is_file(packed) else self.latest / WEIGHTS_FILE

    def load_weights(self, method: Method) -> None:
        """Load the latest state's weights into a method."""
        checkpoint = self.latest
        tensors = self._read_tensors(checkpoint, self.weights.name)
        with reading(checkpoint, f"does not fit the method {self.method}"):
            take_shapes(method, tensors)
            check_kinds(method.state_dict(), tensors)
            method.load_state_dict(tensors)

    def load_training(self, optimizers: Iterable[torch.optim.Optimizer], generator: torch.Generator) -> None:
        """Load the latest state into optimizers and a random generator."""
        checkpoint = self.latest
        if self.weights.name == PACKED_FILE:
            raise LumigraphError(
                f"{self.run} was compressed, which keeps nothing to go on learning with; resume the run it was made of"
            )
        tensors, about = self._read_tensors(checkpoint, OPTIMIZER_FILE), self._about(checkpoint)
        structure = about.optimizers
        if about.files.get(STRUCTURE_KEY) != checksum(json.dumps(structure).encode()):
            raise LumigraphError(f"{checkpoint / STATE_FILE} is damaged: its optimizers are not those that were saved")
        with understood(checkpoint):
            generator.set_state(tensors["generator"])
            for optimizer, saved in zip(optimizers, unflatten(structure, tensors), strict=True):
                optimizer.load_state_dict(saved)
                check_moments(optimizer)

    def _all(self) -> list[Path]:
        found = [x for x in self.folder.iterdir() if CHECKPOINT_NAME.fullmatch(x.name)] if self.folder.is_dir() else []
        return sorted(found, key=lambda x: int(x.name))

    def _about(self, checkpoint: Path) -> Saved:
        said = files.read_json(path := checkpoint / STATE_FILE)
        if not isinstance(said, dict) or said.get("format") != CHECKPOINT_FORMAT:
            raise LumigraphError(f"{checkpoint} is not a checkpoint that Lumigraph wrote; restore it from a copy")
        about = typed(Saved, said, path)
        if about.method != self.method:
            raise LumigraphError(
                f"{checkpoint} belongs to a run of {about.method}, not of {self.method}; restore it from a copy"
            )
        return about

    def _read_tensors(self, checkpoint: Path, name: str) -> dict[str, Tensor]:
        path = checkpoint / name
        expected = self._about(checkpoint).files.get(name)
        data = files.read_bytes(path, free_memory())
        if checksum(data) != expected:
            raise LumigraphError(f"{path} is damaged: its checksum is not the one it was saved with; restore a copy")
        if name == PACKED_FILE:
            return packing.read(data, path)
        with reading(path, "holds no tensors"):
            return safetensors.torch.load(data)


def take_shapes(method: nn.Module, tensors: dict[str, Tensor]) -> None:
    """Resize parameters and buffers to the saved shapes, where their module declares them as growing.

    Tables grow by rows, grids by cells, and all of one module alike; raises RuntimeError where they do not.
    """
    for place, module in method.named_modules():
        sizes = set()
        for name in getattr(module, "grows", ()):
            saved, own = tensors.get(f"{place}.{name}" if place else name), getattr(module, name)
            if saved is None:
                continue
            sizes.add(saved.shape if own.dim() == GRID_AXES else saved.shape[:1])
            if saved.shape[1:] == own.shape[1:] or (
                saved.dim() == own.dim() == GRID_AXES and saved.shape[0] == own.shape[0]
            ):
                sized = own.detach().new_empty(saved.shape)
                setattr(module, name, nn.Parameter(sized) if isinstance(own, nn.Parameter) else sized)
        if len(sizes) > 1:
            raise RuntimeError(f"the tensors of {place} are not of one size")


def check_kinds(own: dict[str, Tensor], saved: dict[str, Tensor]) -> None:
    """Raise RuntimeError for a saved tensor whose dtype kind differs from the method's own."""
    for name, tensor in saved.items():
        if name in own and tensor.is_floating_point() != own[name].is_floating_point():
            raise RuntimeError(f"{name} holds {tensor.dtype}, not {own[name].dtype}")


def check_moments(optimizer: torch.optim.Optimizer) -> None:
    """Raise ValueError for an optimizer state that does not fit its parameter: a number, or one for each of its rows or
    elements. Compiled loops rely on it."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            for name, value in optimizer.state.get(parameter, {}).items():
                if isinstance(value, Tensor) and value.shape != parameter.shape[: value.dim()]:
                    shape, own = list(value.shape), list(parameter.shape)
                    raise ValueError(f"the optimizer's {name} has shape {shape}, for a parameter of {own}")


def write_tensors(path: Path, tensors: dict[str, Tensor]) -> Sum:
    """Write a safetensors file. Returns its checksum."""
    data = safetensors.torch.save({name: x.detach().cpu().contiguous().clone() for name, x in tensors.items()})
    path.write_bytes(data)
    return checksum(data)


def checksum(data: bytes) -> Sum:
    return Sum(len(data), zlib.crc32(data))


def is_state(path: Path) -> bool:
    """True if a folder is a complete or partial checkpoint and contains no foreign files."""
    if not CHECKPOINT_NAME.fullmatch(path.name) or path.is_symlink() or not path.is_dir():
        return False
    own = WEIGHTS_FILE, OPTIMIZER_FILE, STATE_FILE, PACKED_FILE
    return all(file.name in own and not file.is_dir() for file in path.iterdir())
