"""A run that a prior made, of a few photographs or of nothing: what config.json says of it."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..camera import Camera
from ..datasets.scene import Frame, Scene
from ..files.ranges import Lasted, Name, Seed, Tally, typed
from ..method import Method
from ..method.prior import Prior
from .checkpoint import State
from .folder import Run, check_new
from .settings import Settings


@dataclass(frozen=True)
class Inferred:
    """prior: the run that it was made by; views: photographs that were looked at; seconds: that it took; seed: of the
    random code that it was drawn from, where nothing was looked at"""

    prior: Name
    views: Tally
    seconds: Lasted
    seed: Seed | None = None

    def within(self, settings: Settings) -> Settings:
        """Settings that say so."""
        return replace(settings, said=settings.said | {"inferred": asdict(self)})

    @staticmethod
    def of(settings: Settings, file: Path) -> Inferred | None:
        """Read from settings; None for a trained run. file: to name what is damaged in it"""
        told = settings.said.get("inferred")
        return None if told is None else typed(Inferred, told, f"{file}: inferred")


def infer(made_by: Run, prior: Prior, scene: Scene, output: Path, options: dict[str, Any]) -> Run:
    """The run of one scene, in a new or empty folder, that a prior makes of its photographs to learn from.

    options: what `open_dataset` was told of the scene, to open it again
    """
    check_new(output)
    begin = time.perf_counter()
    method = prior.infer(scene)
    seconds = time.perf_counter() - begin
    run = Run.create(output, method, scene, seed=made_by.settings.seed, options=options)
    return kept(run, method, Inferred(str(made_by.folder.resolve()), len(scene.splits["train"]), round(seconds, 3)))


def draw(made_by: Run, prior: Prior, seed: int, output: Path) -> Run:
    """The run of an object that nobody has photographed, in a new or empty folder. seed: by which it is drawn"""
    check_new(output)
    begin = time.perf_counter()
    method = prior.draw(seed)
    seconds = time.perf_counter() - begin
    run = Run.create(output, method, Drawn(f"{made_by.title}, seed {seed}", method.frame), seed=seed)
    return kept(run, method, Inferred(str(made_by.folder.resolve()), 0, round(seconds, 3), seed))


@dataclass(frozen=True)
class Drawn:
    """The Dataset that a drawn object has learnt from: none."""

    kind: ClassVar[str] = "a random code"

    source: str
    frame: Frame
    splits: dict[str, Tensor] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def preview(self) -> Camera | None:
        return None


def kept(run: Run, method: Method, said: Inferred) -> Run:
    """The run with its method saved, and what config.json says of how it was made."""
    run.settings = said.within(run.settings)
    run.settings.write(run.folder / "config.json")
    run.save(State(seconds=said.seconds), method, [], torch.Generator().manual_seed(0))
    return run
