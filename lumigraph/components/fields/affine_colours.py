"""Affine colours: a photograph's light as a small change of the scene's colours, c' = (I + A) c + b.

The twelve numbers of A and b are a photograph's code (`PhotographCodes`): zeros change nothing. A camera's white
balance, exposure and most of a grey day are such a map (Rematas 2022, Urban Radiance Fields, section 4.2).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from .appearance import fitted

NUMBERS = 12  # of a photograph's code: the nine of A by rows, the three of b
CONSTANT = 0.28209479177387814  # Y_0 of the spherical harmonics
MIDDLE = 0.5  # the colour of a Gaussian whose harmonics are zero
FIT_STEPS, FIT_RATE = 200, 0.02  # of Adam, where the light of a photograph is found
FURTHER = 0.01  # weight of how far the rest of a code moves, which most pixels say nothing of, by the sum of squares


def changed(
    rgb: Float[Tensor, "*#row 3"], opacity: Float[Tensor, "*#row"], code: Float[Tensor, " number"]
) -> Float[Tensor, "*#row 3"]:
    """Colours over black, in a photograph's light: the map is of the scene, and not of what shows behind it.

    rgb:     multiplied by the opacity, so that b is too
    opacity: of each colour
    """
    matrix, offset = _map(code)
    return rgb @ matrix.T + opacity[..., None] * offset


def changed_harmonics(
    harmonics: Float[Tensor, "gaussian coefficient 3"], code: Float[Tensor, " number"]
) -> Float[Tensor, "gaussian coefficient 3"]:
    """Coefficients whose colours are those of others in a photograph's light, from every side.

    A colour is 1/2 + sum_k Y_k h_k, so that h_k' = (I + A) h_k, and the constant takes up what is left of 1/2 and b.
    The same but where a colour is cut at 0, which comes after this and before `changed`.
    """
    matrix, offset = _map(code)
    out = harmonics @ matrix.T
    constant = out[:, :1] + (MIDDLE * (matrix.sum(-1) - 1) + offset) / CONSTANT
    return torch.cat([constant, out[:, 1:]], 1)


@torch.no_grad()
def found(
    start: Float[Tensor, " number"],
    picture: Callable[[Float[Tensor, " number"]], Float[Tensor, "pixel 3"]],
    target: Float[Tensor, "pixel 3"],
) -> Float[Tensor, " number"]:
    """The code whose picture is closest to a photograph by mean absolute difference, which passers-by hardly sway.
    What it holds beyond a map of colours stays where it was, unless pixels say otherwise.

    start:   where the search begins, and what comes back where there is no pixel
    picture: the pixels' colours under a code, differentiable in it
    target:  those of the photograph
    """
    if not len(target):
        return start

    def loss(code: Float[Tensor, " number"]) -> Float[Tensor, ""]:
        further = (code - start)[NUMBERS:]
        return (picture(code) - target).abs().mean() + FURTHER * further.square().sum()

    return fitted(start, loss, FIT_STEPS, FIT_RATE)


def _map(code: Float[Tensor, " number"]) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """I + A, and b; what else a photograph's code holds comes after them."""
    return torch.eye(3, device=code.device) + code[:9].view(3, 3), code[9:NUMBERS]
