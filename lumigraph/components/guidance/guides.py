"""Guides: models that score pictures by a prompt; CLIP as one (Radford 2021)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from ...files.ranges import NonNegative
from ...metrics import Score
from .clip import Clip
from .tokenizer import Tokenizer

Pictures = Float[Tensor, "picture 3 side side"]
MIN_TIME = 0.02  # share of the noise schedule at which the least noise is drawn; higher: coarser advice
MAX_TIME = 0.98  # share of the noise schedule at which the most noise is drawn


@dataclass(frozen=True)
class DistillationNumbers:
    """A Config's numbers of score distillation (Poole 2022, section 3); CLIP uses none of them."""

    guidance_scale: NonNegative = 100.0  # omega of eq. 4; higher: closer to the prompt, less varied, gaudier


@runtime_checkable
class Guide(Protocol):
    """Model that scores pictures by a prompt.

    pixels:      sides of its input pictures
    named_views: True for prompts with the name of the view (Poole 2022, section 3.2)
    """

    pixels: int
    named_views: bool

    def loss(
        self, pictures: Pictures, prompts: tuple[str, ...], generator: torch.Generator, numbers: DistillationNumbers
    ) -> Tensor:
        """Loss of pictures, sRGB in [0, 1], for their prompts."""

    def score(self, pictures: Pictures, prompt: str) -> Score:
        """Mean agreement of pictures with a prompt."""


class ClipGuide:
    """Agreement of picture and caption by CLIP, the guidance of Dream Fields (Jain 2022, eq. 5)."""

    named_views = False

    def __init__(self, network: Clip, tokenizer: Tokenizer):
        self.network, self.tokenizer, self.pixels = network, tokenizer, network.sizes.picture
        self.captions = cache(self._captions)

    @torch.no_grad()
    def _captions(self, prompts: tuple[str, ...]) -> Float[Tensor, "prompt embedding"]:
        return self.network.of_captions(self.tokenizer(prompts).to(self.network.logit_scale.device))

    def cosines(self, pictures: Pictures, prompts: tuple[str, ...]) -> Float[Tensor, "picture prompt"]:
        """Cosines between the embeddings of pictures and of captions."""
        return self.network.of_pictures(pictures) @ self.captions(prompts).T

    def loss(
        self, pictures: Pictures, prompts: tuple[str, ...], generator: torch.Generator, numbers: DistillationNumbers
    ) -> Tensor:
        """1 - g(I)^T h(y), averaged over pictures (Jain 2022, eq. 5, without the constant)."""
        return 1 - (self.network.of_pictures(pictures) * self.captions(prompts)).sum(-1).mean()

    @torch.no_grad()
    def score(self, pictures: Pictures, prompt: str) -> Score:
        return Score("similarity to the prompt", float(self.cosines(pictures, (prompt,)).mean()), "", "higher")
