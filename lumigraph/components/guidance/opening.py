"""Open a user's file or folder as a guide: CLIP, or a diffusion model."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch

from ...errors import LumigraphError
from .clip_files import read_clip
from .diffusion import DIFFUSION_INDEX, DiffusionGuide
from .guides import ClipGuide, Guide


def open_guide(path: Path, device: torch.device) -> Guide:
    """Open the model in a file or folder, cached for the process.

    A folder of diffusers is a diffusion model, anything else CLIP. Raises LumigraphError for any other content.
    """
    return _open(path, device)


@cache
def _open(path: Path, device: torch.device) -> Guide:
    if not path.exists():
        raise LumigraphError(f"{path} does not exist; name the folder or file of a model for --guidance")
    if (path / DIFFUSION_INDEX).is_file():
        return DiffusionGuide(path, device)
    network, tokenizer = read_clip(path)
    return ClipGuide(network.to(device), tokenizer)
