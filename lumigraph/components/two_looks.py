"""The loss of methods that look twice along each ray: first evenly, then where something was found."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from ..rays import Look
from ..volume import composite


def squared_errors(
    looks: list[Look], target: Float[Tensor, "ray 3"], background: Float[Tensor, "#ray 3"], coarse_loss: float
) -> dict[str, Tensor]:
    """How far the coarse and the fine look's pictures are from what was photographed (Mildenhall 2020, eq. 6).

    coarse_loss: weight of the coarse look's error; 0 leaves it out
    """
    coarse, fine = looks

    def error(look: Look) -> Tensor:
        return (composite(look.samples, look.density, look.rgb, background).rgb - target).square().mean()

    terms = {"fine": error(fine)}
    return terms | {"coarse": coarse_loss * error(coarse)} if coarse_loss else terms
