"""Halves: a method with a code for each photograph is told of a held-out one's left half, and judged by its right.

A code cannot be known of a photograph that nobody has learnt from, and one found on all of it would know the answer
(Martin-Brualla et al. 2021, section 5).
"""

from __future__ import annotations

from dataclasses import replace

import torch

from ..datasets.scene import Photograph, Scene
from ..method import Method

DEFINITION = "each photograph's code is found on its left half, and its right half is compared"
RIGHT_HALF_DEFINITION = "right halves are compared; nothing is told of left ones"


def judged_by_halves(method: Method) -> bool:
    """True if a method of Scenes accepts single photographs as evidence, and no control already selects a photograph's
    appearance."""
    takes = issubclass(method.learns_from, Scene) and Photograph in method.takes
    return takes and not any(control.of_photographs and control.name in method.settings for control in method.controls)


def definition(method: Method, right_halves: bool) -> str | None:
    """Definition of halves in an evaluation; None if photographs are compared as a whole."""
    return DEFINITION if judged_by_halves(method) else RIGHT_HALF_DEFINITION if right_halves else None


def left_half(photograph: Photograph) -> Photograph:
    """The same photograph, of which only pixels left of the middle are to be trusted."""
    trusted = torch.ones(photograph.rgb.shape[:2], dtype=torch.bool) if photograph.mask is None else photograph.mask
    trusted = trusted.clone()
    trusted[:, right_half(photograph)] = False
    return replace(photograph, mask=trusted)


def right_half(photograph: Photograph) -> slice:
    """The columns from the middle on."""
    return slice(photograph.rgb.shape[1] // 2, None)
