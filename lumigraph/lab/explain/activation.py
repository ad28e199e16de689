"""Pre-, in- and post-activation of a voxel grid on a sharp edge (Sun 2022, section 4.1)."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate, softplus

from ...figures import Row, contact_sheet, save_picture
from ...metrics import psnr

SIDE = 256  # pixels of the picture that is learnt
SHIFT = -4.6  # of softplus, so that a voxel of zero stops 1 % of the light
RATE = 0.3

Grid = Float[Tensor, "1 1 corner corner"]
Picture = Float[Tensor, "1 1 height width"]


def alpha(density: Tensor) -> Tensor:
    """Opacity of a voxel."""
    return 1 - torch.exp(-density)


def blended(grid: Grid) -> Picture:
    """Bilinear interpolation between corners."""
    return interpolate(grid, (SIDE, SIDE), mode="bilinear", align_corners=True)


ORDERS: dict[str, Callable[[Grid], Picture]] = {
    "pre-activation": lambda grid: blended(alpha(softplus(grid + SHIFT))),
    "in-activation": lambda grid: alpha(blended(softplus(grid + SHIFT))),
    "post-activation": lambda grid: alpha(softplus(blended(grid) + SHIFT)),
}


@dataclass(frozen=True)
class ActivationFit:
    """Picture of the edge fitted with one order, and its PSNR in dB."""

    name: str
    picture: Float[Tensor, "height width"]
    psnr: float


def edge() -> Float[Tensor, "height width"]:
    """A leaf: opaque where two discs overlap, transparent elsewhere; edges in every direction, and two sharp ends."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIDE), torch.linspace(-1, 1, SIDE), indexing="ij")
    return (((x - 0.35).hypot(y - 0.2) < 0.95) & ((x + 0.35).hypot(y + 0.2) < 0.95)).float()


def fits(cells: int, steps: int) -> list[ActivationFit]:
    """Fits of the leaf by grids of `cells` cells along an axis that differ only in the order."""
    target, found = edge(), []
    for name, order in ORDERS.items():
        grid = torch.zeros(1, 1, cells + 1, cells + 1, requires_grad=True)
        adam = torch.optim.Adam([grid], lr=RATE)
        for _ in range(steps):
            adam.zero_grad()
            (order(grid)[0, 0] - target).square().mean().backward()
            adam.step()
        picture = order(grid.detach())[0, 0]
        found.append(ActivationFit(name, picture, float(psnr(picture, target))))
    return found


def draw(path: Path, found: list[ActivationFit], cells: int) -> None:
    """Draw the leaf and its fits side by side."""
    pictures = [edge(), *(fit.picture for fit in found)]
    columns = ["the edge", *(f"{fit.name} · {fit.psnr:.1f} dB" for fit in found)]
    rows = [Row("", [picture[..., None].expand(-1, -1, 3) for picture in pictures])]
    title = f"A sharp edge in a grid of {cells}x{cells} cells: alpha before, during and after interpolation"
    save_picture(path, contact_sheet(title, columns, rows, SIDE), "figure")
