"""Reference implementation: every hypothesis at every pixel, (P, H, W), one neighbour after the other."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from . import BEHIND_DEPTH, MIN_VARIANCE


def run(reference, trust, neighbours, neighbour_trust, warps, hypotheses, window, best) -> Tensor:
    height, width = reference.shape
    x, y = (torch.arange(n, device=reference.device).to(reference) + 0.5 for n in (width, height))
    pixels = torch.stack([x.expand(height, width), y[:, None].expand(height, width), torch.ones_like(reference)], -1)

    def mean(values: Tensor) -> Tensor:
        """Mean over the window around each pixel, zeros beyond the border."""
        return avg_pool2d(values[:, None], window, 1, window // 2)[:, 0] if len(values) else values

    def cost(picture: Tensor, its_trust: Tensor, warp: Tensor) -> Tensor:
        places = pixels @ warp[:, :3].T + hypotheses[:, None, None, None] * warp[:, 3]
        seen, weighted = look_up(torch.stack([its_trust, its_trust * picture]), places)
        w, a, b = trust * seen, reference, weighted / seen.clamp_min(1e-12)
        share = mean(w)
        n = share.clamp_min(1e-12)
        mean_a, mean_b = mean(w * a) / n, mean(w * b) / n
        variance_a, variance_b = mean(w * a * a) / n - mean_a**2, mean(w * b * b) / n - mean_b**2
        covariance = mean(w * a * b) / n - mean_a * mean_b
        return 1 - share * covariance / ((variance_a + MIN_VARIANCE) * (variance_b + MIN_VARIANCE)).sqrt()

    costs = torch.stack([cost(*one) for one in zip(neighbours, neighbour_trust, warps, strict=True)])
    return costs.sort(0).values[:best].mean(0)


def look_up(pictures: Tensor, places: Tensor) -> Tensor:
    """Bilinear interpolation (picture, plane, height, width) at homogeneous coordinates; zero outside."""
    planes, rows, columns = len(places), *pictures.shape[1:]
    behind = places[..., 2:] <= BEHIND_DEPTH
    at = places[..., :2] / torch.where(behind, 1, places[..., 2:]) * (2 / places.new_tensor([columns, rows])) - 1
    at = torch.where(behind, -4, at)  # from -1 to 1 is inside
    return grid_sample(pictures[:, None].expand(-1, planes, -1, -1).transpose(0, 1), at, align_corners=False).movedim(
        1, 0
    )
