"""Some of a cloud's Gaussians, kept for good: as a run that can be resumed, or as a splat file."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from .. import files
from ..errors import LumigraphError
from ..exchange import SUFFIXES, claim_splats, names_splats, write_gaussians
from ..method.capabilities import CanPrune, needs
from .checkpoint import Checkpoints
from .folder import Run, check_new
from .opened import Opened


def check_output(opened: Opened, output: Path, overwrite: bool | None = None, reads: Iterable[Path] = ()) -> None:
    """Raises LumigraphError unless what is picked may go there: to a file, see `files.claim`, or of a run to a new
    folder."""
    if not names_splats(output):
        if not isinstance(opened, Run):
            raise LumigraphError(
                f"{opened.path} is no run, so it cannot become another one; give --output a file that ends in "
                f"{', '.join(SUFFIXES)}"
            )
        check_new(output)
    else:
        claim_splats(output, overwrite, reads)


def save_picked(opened: Opened, keep: Bool[Tensor, " gaussian"], output: Path, why: dict[str, Any]) -> None:
    """Write the Gaussians that a mask picks of something that opens; the order is that of its method's `gaussians()`.

    output: a splat file in the source's frame, or a folder for a run at the same step, which `resume` goes on with
    why:    what the run's config.json says about it, under "cleaned"
    Raises LumigraphError as `check_output` does, and for a method that cannot learn on with fewer.
    """
    check_output(opened, output)
    if names_splats(output):
        write_gaussians(output, opened.source_gaussians()[keep])
    else:
        assert isinstance(opened, Run)
        write_run(opened, keep, output, why)


def write_run(run: Run, keep: Bool[Tensor, " gaussian"], folder: Path, why: dict[str, Any]) -> None:
    """The run again with fewer Gaussians: its settings, cameras and history, its optimizers' state of those left."""
    method, generator = needs(run.method(), CanPrune), torch.Generator()
    optimizers = method.optimizers()
    run.restore_training(optimizers, generator)
    method.prune(keep)
    settings = replace(run.settings, said=run.settings.said | {"cleaned": {"source": str(run.folder.resolve())} | why})
    with files.replacing_folder(folder) as partial:
        for name in ("cameras.json", "metrics.jsonl"):
            if (run.folder / name).exists():
                shutil.copy2(run.folder / name, partial / name)
        if (run.folder / "previews").is_dir():
            shutil.copytree(run.folder / "previews", partial / "previews")
        Checkpoints(partial, run.method_name).save(run.state, method, optimizers, generator)
        settings.write(partial / "config.json")
