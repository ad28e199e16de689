"""Depth supervision for every method: one group of numbers and one loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..datasets.scene import Scene
from ..files.ranges import NonNegative

DEPTH_LAYER, DEVIATION_LAYER = "depth", "depth_deviation"  # of a scene: lengths, and their standard deviations
DEPTH_DEVIATION = 0.01  # relative deviation of a measurement, where the capture gives none


@dataclass(frozen=True)
class DepthNumbers:
    """A Config's numbers of depth supervision."""

    depth_weight: NonNegative = 0.0  # weight of measured depth in the loss; higher: better geometry, worse colours


def depth_layers(config: Any, scene: Scene) -> tuple[str, ...]:
    """Names of the layers that a Config's depth term reads; none with weight 0."""
    if not (numbers := getattr(config, "measured", None)) or not numbers.depth_weight:
        return ()
    return (DEPTH_LAYER, *([DEVIATION_LAYER] if DEVIATION_LAYER in scene.layers else []))


def depth_terms(
    config: Any, extra: dict[str, Tensor], depth: Float[Tensor, "*pixels"], opacity: Float[Tensor, "*pixels"]
) -> dict[str, Tensor]:
    """The depth loss by name; none if it is disabled.

        L = weight mean(s (sqrt(1 + r^2) - 1) + 1 - opacity),    r = (depth - D) / (s D)

    over pixels with a measured distance D of relative deviation s. An error within the deviation has hardly a gradient;
    a larger one counts by its share of the distance, so that outliers do not dominate. Measured pixels are opaque.
    extra:          layers of the batch
    depth, opacity: of the rendering; depth is along the ray, infinite for empty rays
    """
    if not (numbers := getattr(config, "measured", None)) or not numbers.depth_weight:
        return {}
    measured = extra[DEPTH_LAYER]
    known = measured.isfinite() & (measured > 0)
    target = torch.where(known, measured, 1.0)
    share = torch.full_like(target, DEPTH_DEVIATION)
    if DEVIATION_LAYER in extra:
        stated = extra[DEVIATION_LAYER] / target
        share = torch.where(stated.isfinite() & (stated > 0), stated, share)
    seen = known & depth.isfinite()
    error = (torch.where(seen, depth, target) - target) / (share * target)
    each = share * ((1 + error.square()).sqrt() - 1) + 1 - opacity
    return {"measured": numbers.depth_weight * torch.where(known, each, 0.0).sum() / known.sum().clamp_min(1)}
