"""Settings of a run, in config.json; and the memory that a Config needs."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch

from .. import files, methods
from ..budget import Budget
from ..datasets.scene import Frame, Scene
from ..errors import LumigraphError, LumigraphWarning
from ..files.ranges import (
    Count,
    Downscale,
    Name,
    Scales,
    Tally,
    between,
    format_value,
    groups_of,
    hints,
    numbers,
    typed,
    value_of,
)
from ..files.reading import reads
from ..method import Method
from ..readers import CapturePart, Unposed
from ..system.memory import ask_for, free_on

RUN_FORMAT = "lumigraph run 1"
BYTES_FACTOR = 4  # copies of a parameter: itself, its gradient, and the two moments of optimizers like Adam


@dataclass(frozen=True)
class SourceOptions:
    """Options of a run for `open_dataset`: see `opening.open_scene`, `meshes.read_shapes` and `Words.read`."""

    downscale: Downscale | None = None
    reader: str | None = None
    views: Count | None = None
    scales: Scales | None = None
    whole: bool | None = None
    part: CapturePart | None = None
    partial: bool | None = None
    unposed: Unposed | None = None
    depth_from: str | None = None
    guidance: str | None = None


@dataclass(frozen=True)
class Source:
    """Source of a dataset: its path, its options for `open_dataset`, and its kind."""

    source: Name
    options: dict[str, Any] = field(default_factory=dict)
    kind: str = Scene.kind

    def to_json(self) -> dict[str, Any]:
        """JSON of the source; the kind is omitted for photographs."""
        return {name: value for name, value in asdict(self).items() if (name, value) != ("kind", Scene.kind)}


@dataclass(frozen=True)
class Settings:
    """Settings of a run: method, dataset and budget.

    method:    as the user types it
    config:    the method's numbers by name, as written with the run; see `method_config`
    splits:    number of photographs or shapes by purpose
    seed:      of all random choices
    budget:    {"steps": n} or {"seconds": s}, and further fields of `Budget.to_json`
    device:    of the start of training;  processor: its hardware name
    method_file: the Python file of an external method, see `methods.load`; never executed without consent
    said:      the file's contents as read. Fields of newer versions are preserved when it is written again
    """

    method: str
    config: dict[str, Any]
    frame: Frame
    scene: Source
    splits: dict[str, Tally] = field(default_factory=dict)
    seed: Annotated[int, between(-(2**63), 2**63 - 1)] = 0
    budget: dict[str, Any] = field(default_factory=dict)
    device: str = "cpu"
    processor: str = "unknown"
    versions: dict[str, str] = field(default_factory=dict)
    method_file: str | None = None
    said: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @staticmethod
    @reads()
    def read(file: Path) -> Settings:
        """Read a config.json. Raises LumigraphError, naming the file, if it is foreign or damaged."""
        said = files.read_json(file)
        if not isinstance(said, dict) or said.get("format") != RUN_FORMAT:
            raise LumigraphError(f"{file} was not written by this version of Lumigraph; open it with the one that did")
        settings = typed(Settings, said, file)
        frame = Frame.from_json(said["frame"], f"{file}: frame")
        typed(SourceOptions, settings.scene.options, f"{file}: scene.options", closed=True)
        if settings.budget:
            Budget.from_json(settings.budget, f"{file}: budget")
        return replace(settings, frame=frame, said=said)

    def write(self, file: Path) -> None:
        files.write_json(file, self.to_json(), ours=True)

    def to_json(self) -> dict[str, Any]:
        """Contents of config.json, under the same names."""
        own: dict[str, Any] = {x.name: getattr(self, x.name) for x in fields(self) if x.name != "said"}
        if self.method_file is None:
            del own["method_file"]
        parts = {"frame": self.frame.to_json(), "scene": self.scene.to_json()}
        return {"format": RUN_FORMAT} | self.said | own | parts

    def method_config(self, kind: type[Method], file: Path) -> Any:
        """The numbers as the Config of a kind of method. file: to name where one is unknown, of another type, or beyond
        its range"""
        return typed(kind.Config, of_this_version(self.config, kind.Config, file), file, closed=True)


def of_this_version(said: dict[str, Any], kind: Any, file: Path | str) -> dict[str, Any]:
    """JSON of a Config, each option at its place in this version; no two options of a Config have one name. What is a
    constant now, by its name in capitals beside the Config or a part of it, or follows from other options, as a
    property, is left out, with a warning of another value."""
    parts = [*parts_of(kind)]
    modules = [vars(sys.modules[part.__module__]) for part in parts]
    known = {name: held for part in parts for name, held in hints(part).items()}

    def constants(name: str) -> list[Any]:
        return [module[name.upper()] for module in modules if name.upper() in module and name not in known]

    def following(name: str) -> list[Any]:
        if not any(isinstance(getattr(part, name, None), property) for part in parts):
            return []
        return [getattr(x, name) for x in groups_of(typed(kind, made, file)) if hasattr(x, name)]

    def leaves(said: dict[str, Any]) -> Iterator[tuple[str, Any]]:
        for name, value in said.items():
            is_part = isinstance(value, dict) and is_dataclass(known.get(name, kind)) and not constants(name)
            yield from leaves(value) if is_part else [(name, value)]

    def placed(part: Any) -> dict[str, Any]:
        inner = {name: held for name, held in hints(part).items() if is_dataclass(held)}
        own = {name: found.pop(name) for name in hints(part) if name in found and name not in inner}
        return own | {name: placed(held) for name, held in inner.items()}

    found = dict(leaves(said))
    made = placed(kind)
    for name, value in found.items():
        if not (values := constants(name) or following(name)):
            made[name] = value
        elif value not in map(msgspec.to_builtins, values):
            was, now = format_value(value), format_value(values[0])
            text = f"{file}: {name} was {was} in this training, and is always {now} now"
            warnings.warn(text, LumigraphWarning, stacklevel=2)
    return made


def parts_of(kind: Any) -> Iterator[Any]:
    """A dataclass and those that it holds."""
    yield kind
    for part in filter(is_dataclass, hints(kind).values()):
        yield from parts_of(part)


def check_memory(kind: type[Method], frame: Frame, config: Any, device: torch.device, learning: bool = False) -> None:
    """Raise LumigraphError for a method that exceeds free memory, naming the numbers to reduce."""

    def needed(config: Any) -> int:
        return bytes_of(kind, frame, config, learning)

    def remedy() -> str:
        smaller = {name: needed(less) for name, less in halved(config)}
        if not smaller:
            return "end other programs"
        name = min(smaller, key=smaller.__getitem__)
        less = config
        while needed(less) > free_on(device) and (half := dict(halved(less))[name]) != less:
            less = half
        fits = f"; {value_of(less, name):,} would fit" if needed(less) <= free_on(device) else ""
        return f"give a smaller --{name.replace('_', '-')} than {value_of(config, name):,}{fits}"

    ask_for(needed(config), device, f"{methods.name_of(kind)} with these numbers", remedy)


def bytes_of(kind: type[Method], frame: Frame, config: Any, learning: bool) -> int:
    """Bytes of a method's parameters with gradients and optimizer state, its buffers, and `further_bytes`.

    The method is built on the meta device. Where its constructor reads values, which that does not allow, only
    `further_bytes` is known.
    """
    further = kind.further_bytes(frame, config, learning)
    try:
        with torch.random.fork_rng(devices=[]), torch.device("meta"):
            method = kind(frame, config)
    except LumigraphError:
        raise
    except (RuntimeError, TypeError, ValueError):
        return further
    parameters = sum(x.numel() * x.element_size() for x in method.parameters())
    buffers = sum(x.numel() * x.element_size() for x in method.buffers())
    return (BYTES_FACTOR if learning else 1) * parameters + buffers + further


def halved(config: Any) -> list[tuple[str, Any]]:
    """Copies of a Config with one of its whole numbers halved, or at its range's minimum, by name."""
    found = []
    for name, kind in hints(config.__class__).items():
        if is_dataclass(inner := getattr(config, name)):
            found += [(number, replace(config, **{name: less})) for number, less in halved(inner)]
            continue
        ranges = [range for number, range in numbers(kind) if number is int and range is not None]
        if ranges and isinstance(value := getattr(config, name), int):
            found.append((name, replace(config, **{name: max(value // 2, int(ranges[0].ge or 0))})))
    return found
