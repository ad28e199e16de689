"""Affine colours: a photograph's appearance as a change of the scene's colours, c' = (I + A) c + b.

The twelve numbers of A and b are a photograph's code (`PhotographCodes`): zeros change nothing. A camera's white
balance, exposure and most of a grey day are such a map (Rematas 2022, Urban Radiance Fields, section 4.2).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...kernels.spherical_harmonics import K00

COLOUR_NUMBERS = 12  # of a photograph's code: the nine of A by rows, the three of b
ZERO_COLOUR = 0.5  # colour of a Gaussian whose harmonics are zero
ROUNDS = 12  # of reweighted least squares, with which a code is fitted to a photograph
MAX_PIXELS = 1 << 14  # evenly chosen, that a code is fitted to
MIN_RESIDUAL = 0.01  # below which a pixel's weight stays the same
COLOUR_PRIOR = 3e-3  # weight of the squared change of A and b: a grey wall does not determine how channels mix
REST_PRIOR = 0.01  # weight of the squared change of the rest of a code, which most pixels do not determine


def recoloured(
    rgb: Float[Tensor, "*#row 3"], opacity: Float[Tensor, "*#row"], code: Float[Tensor, " number"]
) -> Float[Tensor, "*#row 3"]:
    """Colours over black in a photograph's appearance: the map is of the scene, and not of its background.

    rgb:     multiplied by the opacity, so that b is too
    opacity: of each colour
    """
    matrix, offset = _map(code)
    return rgb @ matrix.T + opacity[..., None] * offset


def recoloured_harmonics(
    harmonics: Float[Tensor, "gaussian coefficient 3"], code: Float[Tensor, " number"]
) -> Float[Tensor, "gaussian coefficient 3"]:
    """Coefficients whose colours are those of others in a photograph's appearance, from every side.

    A colour is 1/2 + sum_k Y_k h_k, so that h_k' = (I + A) h_k, and the constant takes up what is left of 1/2 and b.
    The same but where a colour is cut at 0, which comes after this and before `recoloured`.
    """
    matrix, offset = _map(code)
    out = harmonics @ matrix.T
    constant = out[:, :1] + (ZERO_COLOUR * (matrix.sum(-1) - 1) + offset) / K00
    return torch.cat([constant, out[:, 1:]], 1)


@torch.no_grad()
def fit_colours(
    start: Float[Tensor, " number"],
    rgb: Float[Tensor, "pixel 3"],
    opacity: Float[Tensor, " pixel"],
    target: Float[Tensor, "pixel 3"],
    behind: Float[Tensor, "pixel 9"] | None = None,
) -> Float[Tensor, " number"]:
    """The code whose picture is closest to a photograph by mean absolute difference, which is robust to distractors.

    The picture, rgb (I + A)^T + opacity b + (1 - opacity) behind s, is linear in all of it: so least squares whose
    pixels weigh one over their last error, a few times over (Schlossmacher 1973), get there at once.

    start:   what the code is drawn towards, and what comes back where there is no pixel
    rgb:     of the scene over black;  target: the photograph, less a background of which nothing is to be found
    behind:  harmonics of the directions, where a code holds a sky; it stays unless pixels say otherwise
    """
    few = slice(None, None, -(-len(target) // MAX_PIXELS) or 1)
    rgb, opacity, target = rgb[few].double(), opacity[few, None].double(), target[few].double()
    if not len(target):
        return start
    parts = [rgb, opacity] if behind is None else [rgb, opacity, (1 - opacity) * behind[few]]
    rows, matrix = torch.cat(parts, 1), _columns(start).double()
    held = torch.full_like(matrix, REST_PRIOR)
    held[:4] = COLOUR_PRIOR
    first, drawn = matrix, torch.diag_embed(held.T)
    for _ in range(ROUNDS):
        weights = 0.5 / (rows @ matrix - target).abs().clamp_min(MIN_RESIDUAL) / target.numel()
        normal = torch.einsum("nc,na,nb->cab", weights, rows, rows) + drawn
        wanted = torch.einsum("nc,na->ca", weights * target, rows) + (held * first).T
        matrix = torch.linalg.solve(normal, wanted).T
    return torch.cat([(matrix[:3].T - torch.eye(3).to(matrix)).flatten(), matrix[3:].flatten()]).to(start)


def _columns(code: Float[Tensor, " number"]) -> Float[Tensor, "row 3"]:
    """(I + A)^T, b and the rest of a code, three colours a row."""
    matrix, offset = _map(code)
    return torch.cat([matrix.T, offset[None], code[COLOUR_NUMBERS:].view(-1, 3)])


def _map(code: Float[Tensor, " number"]) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """I + A, and b, with which a photograph's code begins."""
    return torch.eye(3, device=code.device) + code[:9].view(3, 3), code[9:COLOUR_NUMBERS]
