"""Settings of a run, in config.json; and the memory that a Config needs."""

from __future__ import annotations

import sys
import warnings
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch

from .. import files, methods
from ..budget import Budget
from ..datasets.scene import Frame, Scene
from ..errors import LumigraphError, LumigraphWarning
from ..files.ranges import Count, Downscale, Name, Scales, Tally, between, format_value, hints, numbers, typed, value_of
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
        """The numbers as the Config of a kind of method. file: named in faults for invalid ones"""
        return typed(kind.Config, without_constants(self.config, kind.Config, file), file, closed=True)


def without_constants(said: Any, kind: Any, file: Path | str) -> Any:
    """JSON of a Config without options of older versions that have become constants: in capitals, in the module of the
    dataclass. Warns of one that had another value."""
    if not (isinstance(said, dict) and is_dataclass(kind)):
        return said
    known, module, kept = hints(kind), vars(sys.modules[kind.__module__]), {}  # type: ignore[arg-type]
    for name, value in said.items():
        if name in known or name.upper() not in module:
            kept[name] = without_constants(value, known.get(name), file)
        elif msgspec.to_builtins(constant := module[name.upper()]) != value:
            text = (
                f"{file}: {name} was {format_value(value)} in this training, and is always {format_value(constant)} now"
            )
            warnings.warn(text, LumigraphWarning, stacklevel=2)
    return kept


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
