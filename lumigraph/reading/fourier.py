"""Fourier features: why a network over coordinates draws a blur, and how waves mend it (Tancik et al. 2020).

A network learns slow functions first: nearby inputs look alike to it. gamma(v) spreads them out. Two places a few
pixels apart then have quite different inputs, and the network can give them different colours.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .camera import pixel_centres
from .data import photographs, psnr, save

FREQUENCIES, WIDTH, PIXELS, STEPS, RATE = 128, 128, 4096, 250, 3e-3
Places = Float[Tensor, "place 2"]
Rows = Float[Tensor, "frequency 2"]


def gamma(v: Places, B: Rows | None) -> Float[Tensor, "place feature"]:
    """gamma(v) = (cos 2 pi B v, sin 2 pi B v) (section 4); v itself without frequencies."""
    if B is None:
        return v
    angles = 2 * math.pi * v @ B.T
    return torch.cat([angles.cos(), angles.sin()], 1)


def gaussian(scale: float, count: int = FREQUENCIES) -> Rows:
    """B of N(0, sigma^2): sigma too small blurs, sigma too large makes grain between the pixels (section 6.1)."""
    return scale * torch.randn(count, 2)


def network(inputs: int, width: int = WIDTH) -> nn.Sequential:
    """Four layers; the last one gives colours."""
    widths = [inputs, width, width, width]
    hidden = [x for a, b in zip(widths, widths[1:], strict=False) for x in (nn.Linear(a, b), nn.ReLU())]
    return nn.Sequential(*hidden, nn.Linear(width, 3), nn.Sigmoid())


def train(net: nn.Module, B: Rows | None, places: Places, colours: Tensor, steps: int = STEPS, rate: float = RATE):
    """Adam on the squared error of random pixels. Returns the loss of each step."""
    optimizer, losses = torch.optim.Adam(net.parameters(), rate), []
    for _ in range(steps):
        chosen = torch.randint(len(places), (PIXELS,))
        loss = (net(gamma(places[chosen], B)) - colours[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses


def main() -> None:
    image = photographs("test")[0][0]
    height, width = image.shape[:2]
    places, colours = pixel_centres(width, height) / max(width, height), image.view(-1, 3)
    torch.manual_seed(0)
    shown, encodings = [image], {"no encoding": None} | {f"sigma {x}": gaussian(x) for x in (1, 8, 60)}
    for name, B in encodings.items():
        known = torch.rand(len(places)) < 0.5  # learn from every other pixel
        net = network(2 if B is None else 2 * FREQUENCIES)
        train(net, B, places[known], colours[known])
        with torch.no_grad():
            found = net(gamma(places, B))
        inside, between = (psnr(found[x], colours[x]) for x in (known, ~known))
        print(f"{name:12} {inside:5.1f} dB learnt   {between:5.1f} dB between")
        shown.append(found.view(height, width, 3))
    save("fourier", *shown)


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/fourier_features.py` is the same network as a method, with all encodings of the
# paper, and multiplies in bfloat16 where a processor is faster so. `components/fields/encodings.py` has the encodings
# of other papers: NeRF's octaves (B is then diagonal, in powers of two), and their mean over a cone (mip-NeRF).
