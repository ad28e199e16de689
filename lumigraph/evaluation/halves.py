"""Halves of held-out photographs: codes and poses are fitted to the left one, and only the right one is compared.

The code of a photograph outside the training set is unknown, and one fitted to all of it would include the answer
(Martin-Brualla et al. 2021, section 5).
"""

from dataclasses import replace

import torch

from ..datasets.scene import Photograph, Scene
from ..method import Method

LEFT_HALVES = "each photograph's code is found on its left half, and its right half is compared"
RIGHT_HALVES = "right halves are compared; no code is found on left ones"


def judged_by_halves(method: Method) -> bool:
    """True if a method of Scenes accepts single photographs as evidence, and no control already selects a photograph's
    appearance."""
    takes = issubclass(method.learns_from, Scene) and Photograph in method.takes
    return takes and not any(control.of_photographs and control.name in method.settings for control in method.controls)


def left_half(photograph: Photograph) -> Photograph:
    """The same photograph, with only pixels left of the centre trusted."""
    mask = photograph.mask
    trusted = torch.ones(photograph.rgb.shape[:2], dtype=torch.bool) if mask is None else mask.clone()
    trusted[:, right_half(photograph)] = False
    return replace(photograph, mask=trusted)


def right_half(photograph: Photograph) -> slice:
    """The columns from the middle on."""
    return slice(photograph.rgb.shape[1] // 2, None)
