"""The order in which a store keeps pixels: shuffled, so that random batches are short reads; trusted ones first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor


@dataclass(frozen=True)
class Runs:
    """Masks as runs of trusted pixels, row by row: a run begins at pixel `start` and is preceded by `before` trusted
    pixels, counted from the first image on. Image i owns count[i] trusted pixels."""

    start: Int[Tensor, " run"]
    before: Int[Tensor, " run"]
    count: Int[Tensor, " image"]

    def columns(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """start, before, the trusted pixels ahead of each image, and each image's first run, one longer than images."""
        ahead = self.count.cumsum(0) - self.count
        first_run = torch.searchsorted(self.before, torch.cat([ahead, self.count.sum()[None]]))
        return self.start, self.before, ahead, first_run

    @staticmethod
    def of(masks: Sequence[np.ndarray]) -> Runs:
        starts, lengths = [], []
        for mask in masks:
            edges = np.flatnonzero(np.diff(mask.ravel().astype(np.int8), prepend=0, append=0))
            starts.append(edges[::2])
            lengths.append(edges[1::2] - edges[::2])
        length = torch.from_numpy(np.concatenate(lengths))
        count = torch.tensor([int(x.sum()) for x in lengths])
        return Runs(torch.from_numpy(np.concatenate(starts)), length.cumsum(0) - length, count)

    def mask(self, image: int, pixels: int) -> Bool[Tensor, " pixel"]:
        ahead, own = int(self.count[:image].sum()), int(self.count[image])
        rank = torch.arange(ahead, ahead + own)
        run = torch.searchsorted(self.before, rank, right=True) - 1
        trusted = torch.zeros(pixels, dtype=torch.bool)
        trusted[self.start[run] + rank - self.before[run]] = True
        return trusted


def spread(count: int) -> int:
    """The factor a of the shuffle of `count` pixels."""
    a = max(round(count * (math.sqrt(5) - 1) / 2), 1)
    while math.gcd(a, count) != 1:
        a += 1
    return a


def shuffled_order(pixels: int, mask: Tensor | np.ndarray | None) -> Int[np.ndarray, " pixel"]:
    """Pixel at each position of the file: unmasked ones shuffled, then the others."""
    trusted = np.arange(pixels) if mask is None else np.flatnonzero(np.asarray(mask))
    shuffled = trusted[np.arange(len(trusted)) * spread(len(trusted)) % max(len(trusted), 1)]
    return shuffled if mask is None else np.concatenate([shuffled, np.flatnonzero(~np.asarray(mask).ravel())])
