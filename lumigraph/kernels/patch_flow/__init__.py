"""Flow of patches: where small squares of one picture are in another, by inverse search."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="patches", unit_axes=2, outputs=1, differentiable=(), typical=1, compiled=1)

MIN_GRADIENT = 1e-3  # added to the diagonal of H, so that flat patches stay where they are


@door
def patch_flow(
    start: Float[Tensor, "row column 2"],
    first: Float[Tensor, "height width"],
    second: Float[Tensor, "height width"],
    gradient: Float[Tensor, "height width 2"],
    size: int,
    stride: int,
    iterations: int,
) -> Float[Tensor, "row column 2"]:
    """Displacement u = (right, down) of each patch (Kroeger 2016, eq. 3 and 4; Baker & Matthews 2001).

    Patch (i, j) covers `size` by `size` pixels from row i `stride` and column j `stride` on; pixels beyond the picture
    repeat its border. With the template T of the first picture, its gradient g less the patch's mean, and S of the
    second picture looked up between four pixels at x + u,

        H = sum g g^T + e        u <- u - H^-1 sum g (S - T)

    is repeated, always with the same H. A patch that has moved farther than its size from its start returns there.
    Not differentiable.
    """
    require(size > 0 and stride > 0 and iterations >= 0, f"patches of {size} pixels, {stride} apart, cannot be")
    require(first.numel() > 0 or not start.numel(), "patches of an empty picture")
    with torch.no_grad():
        return implementation("patch_flow", start)(start, first, second, gradient, size, stride, iterations)


def cases(generator: torch.Generator):
    """Inputs that every engine must agree on: small pictures, patches over the border, flat ones, leaps."""
    for height, width, size, stride, iterations in [
        (1, 1, 1, 1, 2),
        (18, 25, 8, 4, 3),
        (9, 30, 5, 3, 2),
        (7, 6, 8, 4, 1),
    ]:
        yield _inputs(height, width, size, stride, iterations, generator)
    start, first, second, gradient, *others = _inputs(16, 20, 8, 4, 2, generator)
    yield start, first, second, torch.zeros_like(gradient), *others
    yield start + 100, first, second, gradient, *others
    yield start, first, 50 * second, 0.05 * gradient, *others  # all of them leap, and return
    yield start[:0], first, second, gradient, *others


def benchmark_case(generator: torch.Generator, size: int = 2**14):
    """A square number of patches of 8 x 8 pixels, 4 apart, six iterations."""
    side = 4 * max(round(size**0.5), 1) + 4
    return _inputs(side, side, 8, 4, 6, generator)


def _inputs(height, width, size, stride, iterations, generator):
    """A smooth picture, and the same a little aside."""
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    phase = 6 * torch.rand(2, generator=generator)

    def wave(x, y):
        return 0.5 + 0.2 * (0.7 * x + 0.3 * y + phase[0]).sin() + 0.2 * (0.2 * x - 0.6 * y + phase[1]).cos()

    rows, columns = (max(-(-(n - size) // stride), 0) + 1 for n in (height, width))
    start = torch.rand(rows, columns, 2, generator=generator) - 0.5
    first, second = wave(x, y), wave(x - 0.4, y + 0.3)
    gradient = torch.stack([(wave(x + 1, y) - wave(x - 1, y)) / 2, (wave(x, y + 1) - wave(x, y - 1)) / 2], -1)
    return start, first, second, gradient, size, stride, iterations
