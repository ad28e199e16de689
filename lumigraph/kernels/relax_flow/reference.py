"""The definition: all pixels of one colour at once."""

import torch
from torch import Tensor
from torch.nn.functional import pad


def run(start, data, right, below, iterations, relaxation) -> Tensor:
    height, width = right.shape
    a, b, c, e, f = data.unbind(-1)
    u, v = start.unbind(-1)
    y, x = torch.meshgrid(*(torch.arange(n, device=start.device) for n in (height, width)), indexing="ij")
    right, below = right * (x < width - 1), below * (y < height - 1)
    left, above = pad(right, (1, 0))[:, :-1], pad(below, (0, 0, 1, 0))[:-1]
    total = right + left + below + above

    def pull(z: Tensor) -> Tensor:
        """Sum of w_n z_n over the neighbours."""
        beside = right * pad(z, (0, 1))[:, 1:] + left * pad(z, (1, 0))[:, :-1]
        return beside + below * pad(z, (0, 0, 0, 1))[1:] + above * pad(z, (0, 0, 1, 0))[:-1]

    for _ in range(iterations):
        for odd in (0, 1):
            here = (x + y) % 2 == odd
            u = torch.where(here, u + relaxation * ((pull(u) + e - b * v) / (a + total) - u), u)
            v = torch.where(here, v + relaxation * ((pull(v) + f - b * u) / (c + total) - v), v)
    return torch.stack([u, v], -1)
