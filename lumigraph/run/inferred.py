"""A run that a prior made of a few photographs, without learning anything: what config.json says of it."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ..prior import Prior
from ..ranges import Count, Lasted, Name, typed
from ..scene import Scene
from .checkpoint import State
from .folder import Run, check_new
from .settings import Settings


@dataclass(frozen=True)
class Inferred:
    """prior: the run that it was made by; views: photographs that were looked at; seconds: that it took"""

    prior: Name
    views: Count
    seconds: Lasted

    def within(self, settings: Settings) -> Settings:
        """Settings that say so."""
        return replace(settings, said=settings.said | {"inferred": asdict(self)})

    @staticmethod
    def of(settings: Settings, file: Path) -> Inferred | None:
        """What settings say; None of a run that was trained. file: to name what is damaged in it"""
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
    said = Inferred(str(made_by.folder.resolve()), len(scene.splits["train"]), round(seconds, 3))
    run.settings = said.within(run.settings)
    run.settings.write(run.folder / "config.json")
    run.save(State(seconds=seconds), method, [], torch.Generator().manual_seed(0))
    return run
