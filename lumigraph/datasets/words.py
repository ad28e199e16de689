"""Words: a prompt, and a text-and-image model as guidance, to generate a scene without photographs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Int
from torch import Tensor

from ..camera import Camera, ring
from ..errors import LumigraphError
from .scene import Frame

WORDS = "words:"  # of a source, before the prompt
MAX_LETTERS = 1000  # of a prompt
PREVIEW_PIXELS = 256


@dataclass(frozen=True)
class Words:
    """Prompt of a text-to-3D scene. guidance: path of a model, see `components.guidance`; None for rendering only"""

    kind: ClassVar[str] = "words"

    prompt: str
    guidance: Path | None = None

    @staticmethod
    def read(source: str, guidance: str | Path | None = None) -> Words:
        """Prompt of "words:<prompt>". Raises LumigraphError for an empty or too long one, and missing guidance."""
        prompt = " ".join(source.removeprefix(WORDS).split())
        if not prompt or len(prompt) > MAX_LETTERS:
            wrong = "is empty" if not prompt else f"has {len(prompt):,} letters"
            raise LumigraphError(f'The prompt {wrong}; write it behind words:, as in "words:a red cube beside a ball"')
        path = None if guidance is None else Path(guidance).expanduser().resolve()
        if path is not None and not path.exists():
            raise LumigraphError(f"{path} does not exist; name a model for --guidance")
        return Words(prompt, path)

    @property
    def source(self) -> str:
        return WORDS + self.prompt

    @property
    def frame(self) -> Frame:
        """A cube around the origin with white background; cameras stay outside of it."""
        return Frame(background=(1.0, 1.0, 1.0), has_alpha=True)

    @cached_property
    def splits(self) -> dict[str, Int[Tensor, " item"]]:
        return {"train": torch.tensor([0]), "test": torch.tensor([0])}

    @property
    def names(self) -> list[str]:
        return [self.prompt]

    @property
    def warnings(self) -> list[str]:
        return []

    @property
    def options(self) -> dict[str, Any]:
        return {} if self.guidance is None else {"guidance": str(self.guidance)}

    def preview(self) -> Camera:
        return ring(self.frame.bounds, size=PREVIEW_PIXELS)[1]
