"""A small network from a rendering to what a photograph would show."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


class PictureDenoiser(nn.Module):
    """What is to be added to a picture, from a neighbourhood of about 30 pixels: convolutions at full resolution around
    others at half of it, which see farther.

    width: channels
    """

    def __init__(self, width: int):
        super().__init__()
        self.first = nn.Conv2d(3, width, 3, padding=1)
        self.down = nn.Conv2d(width, 2 * width, 3, stride=2, padding=1)
        self.inner = nn.ModuleList(
            nn.Conv2d(2 * width, 2 * width, 3, padding=dilation, dilation=dilation) for dilation in (1, 2, 3)
        )
        self.up = nn.Conv2d(2 * width, width, 1)
        self.last = nn.Conv2d(width, 3, 3, padding=1)
        nn.init.normal_(self.last.weight, std=1e-3)

    def forward(self, pictures: Float[Tensor, "picture 3 height width"]) -> Float[Tensor, "picture 3 height width"]:
        """sRGB-encoded colours, not clamped."""
        fine = F.relu(self.first(2 * pictures - 1))
        coarse = F.relu(self.down(fine))
        for layer in self.inner:
            coarse = coarse + F.relu(layer(coarse))
        above = F.interpolate(self.up(coarse), fine.shape[-2:], mode="bilinear", align_corners=False)
        return pictures + self.last(F.relu(fine + above))
