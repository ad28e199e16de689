"""Reference implementation."""

import torch
from torch import Tensor

from ...camera.lens import bend
from ...geometry import to_matrix
from ..spherical_harmonics.reference import run as harmonics_of
from . import MIN_ALPHA


def run(means, quaternions, scales, opacities, harmonics, view, bands, blur, compensate) -> tuple[Tensor, ...]:
    rotation, eye, focal, centre, distortion, limits = (
        x.to(means) for x in (view.rotation, view.eye, view.focal, view.centre, view.distortion, view.limits)
    )
    p = (means - eye) @ rotation.T
    front = p[:, 2] > view.near
    z = torch.where(front, p[:, 2], 1)
    plane = p[:, :2] / z[:, None]
    x, y = plane[:, 0].clamp(limits[0], limits[1]), plane[:, 1].clamp(limits[2], limits[3])
    bent, jacobian = bend(x, y, distortion.unbind())
    slope = focal[:, None] * torch.stack(jacobian, -1).view(-1, 2, 2)  # of the lens
    beyond = plane - torch.stack([x, y], -1)
    centres = focal * torch.stack(bent, -1) + (slope @ beyond[:, :, None])[:, :, 0] + centre

    onto = torch.stack([1 + 0 * x, 0 * x, -x, 0 * x, 1 + 0 * x, -y], -1).view(-1, 2, 3) / z[:, None, None]
    T = slope @ onto @ rotation @ (to_matrix(quaternions) * scales[:, None, :])
    narrow = torch.linalg.cross(T[:, 0], T[:, 1]).square().sum(-1)  # det T T^T, without cancellation
    a, b, c = T[:, 0].square().sum(-1) + blur, (T[:, 0] * T[:, 1]).sum(-1), T[:, 1].square().sum(-1) + blur
    det = narrow + blur * (a + c - blur)
    conics = torch.stack([c, -b, a], -1) / det[:, None]
    if compensate:
        opacities = opacities * (narrow / det).clamp_min(1e-8).sqrt()

    directions = torch.nn.functional.normalize(means - eye, dim=-1)
    Y = harmonics_of(directions, bands)
    colours = (0.5 + (Y[:, :, None] * harmonics[:, : bands**2]).sum(1)).clamp_min(0)

    # Where opacity exp(-q / 2) is still 1/255, the offset along an axis is sqrt(q C_ii).
    reach = 2 * (opacities / MIN_ALPHA).clamp_min(1).log()
    extent = (reach[:, None] * torch.stack([a, c], -1)).clamp_min(1e-12).sqrt()
    size = means.new_tensor(view.size)
    inside = ((centres + extent >= 0.5) & (centres - extent <= size - 0.5)).all(-1)
    seen = front & (opacities > MIN_ALPHA) & inside
    columns, one = seen[:, None], means.new_zeros(())
    return (
        torch.where(columns, centres, one),
        torch.where(columns, conics, one),
        torch.where(seen, z, one),
        torch.where(columns, colours, one),
        torch.where(seen, opacities, one),
    )
