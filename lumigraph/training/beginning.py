"""Begin a run: check its data, build its method, decide how long it trains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from .. import methods
from ..budget import Budget
from ..datasets.dataset import Dataset, check_kind
from ..files import scene_name
from ..files.names import next_free
from ..method import Method
from ..opening import confirm, kind_of
from ..run import Run, build, check_new
from .options import DEFAULT_SECONDS, TrainOptions


def check_source(scene: str, method: str) -> None:
    """Raises LumigraphError unless a scene is there, of a kind that a method learns from."""
    kind = methods.find(method)
    found = kind_of(scene, kind.learns_from)
    if found is not kind.learns_from:
        confirm(scene)  # a missing path has no kind
    check_kind(methods.check(method), kind.learns_from, found, scene, methods.learning_from)


def begin_run(
    name: str, data: Dataset, config: Any, device: torch.device, options: TrainOptions, output: Path | None = None
) -> tuple[Run, Method, Budget]:
    """Begin a run of a method on its data. output: None for the next free runs/SCENE-METHOD-N

    Returns it with its method, before any training, and its budget.
    """
    output = output or next_free(f"runs/{scene_name(data.source)}-{name}")
    check_new(output)
    seed = getattr(config, "seed", options.seed)
    method = build(methods.find(name), data.frame, config, device, seed, learning=True)
    if (budget := options.budget) is None:
        quality = options.quality or method.default_quality
        steps = method.steps_for(quality, data) if quality else None
        budget = Budget(steps, quality=quality) if quality else Budget(seconds=DEFAULT_SECONDS)
    run = Run.create(output, method, data, seed=seed, options=options.of_dataset, budget=budget.to_json())
    return run, method, budget
