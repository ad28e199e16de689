"""Regularizers: against fog near cameras, and on patches of unobserved views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rays, Samples
from ...geometry import look_at, nearest_to_lines
from ...kernels import distortion


def normalized_distance(t: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Normalised distances t / (1 + t): near ones get more weight than far ones, and the horizon is at 1."""
    return t / (1 + t)


def distortion_loss(samples: Samples, weights: Float[Tensor, " sample"]) -> Float[Tensor, ""]:
    """Distortion loss of weights along each ray, mean of all rays (Barron 2022, eq. 15)."""
    start, end = normalized_distance(samples.t_start), normalized_distance(samples.t_end)
    return distortion(weights, 0.5 * (start + end), end - start, samples.ray_starts).mean()


def depth_loss(
    samples: Samples, weights: Float[Tensor, " sample"], distance: Float[Tensor, " ray"], margin: float
) -> Float[Tensor, ""]:
    """Depth loss: share of each ray's light that does not end at its known distance, mean of all rays (as Deng 2022
    supervises depth; linear, since known distances may be wrong).

    distance: known distance along each ray
    margin:   tolerance in normalised distances, besides half a sample's own length
    """
    start, end = normalized_distance(samples.t_start), normalized_distance(samples.t_end)
    known = normalized_distance(distance)[samples.ray_index]
    there = (start - margin < known) & (known < end + margin)
    return 1 - (weights * there).sum() / len(distance)


def near_thickness(
    samples: Samples, density: Float[Tensor, " sample"], until: Float[Tensor, " ray"]
) -> Float[Tensor, " ray"]:
    """Optical thickness of each ray up to a distance. Yang 2023, eq. 5, has the mean density of a ray's first samples
    instead, which depends on the sampling density."""
    ray = samples.ray_index
    thickness = density * ((until[ray] - samples.t_start).clamp_min(0)).minimum(samples.length)
    return torch.zeros_like(until).index_add(0, ray, thickness)


class _Scaled(torch.autograd.Function):
    @staticmethod
    def forward(ctx, scale, *values):
        ctx.save_for_backward(scale)
        return values

    @staticmethod
    def backward(ctx, *grads):
        (scale,) = ctx.saved_tensors
        return None, *(g * scale.view(-1, *[1] * (g.ndim - 1)) for g in grads)


def scale_gradients(t: Float[Tensor, " sample"], *values: Float[Tensor, sample * _]) -> tuple[Tensor, ...]:
    """The same values of samples at distances t, with gradients scaled by min(1, t^2) (Philip 2023, eq. 7).

    The density of rays near a camera is the inverse square of the distance, and all are of one photograph: without
    scaling, learning would be fastest where least is known.
    """
    return _Scaled.apply(t.square().clamp(max=1), *values)


def cauchy(density: Float[Tensor, " sample"], rays: int) -> Tensor:
    """Sum of log(1 + 2 sigma^2) along a ray, mean of all (Hedman 2021, section 4.2; Fridovich-Keil 2022, eq. 4)."""
    return torch.log1p(2 * density.square()).sum() / max(rays, 1)


def opacity_entropy(opacity: Float[Tensor, " ray"]) -> Float[Tensor, ""]:
    """Binary entropy of each ray's opacity, mean of all (Sun 2022, eq. 13): 0 for empty and for opaque rays."""
    a = opacity.clamp(1e-6, 1 - 1e-6)
    return -(a * a.log() + (1 - a) * (1 - a).log()).mean()


ASTRAY = 0.125  # deviation of the point that an unseen camera looks at, of the distance to it (section 3.3)


def unseen_cameras(cameras: Camera, count: int, generator: torch.Generator) -> Camera:
    """Random cameras in the box around the given ones, with their mean up, looking at about their common point of
    interest, with the lens of one of them."""
    position, forward = cameras.position.cpu(), cameras.forward.cpu()
    low, high = position.amin(0), position.amax(0)
    focus = nearest_to_lines(position.double(), forward.double(), (position + forward).mean(0).double()).float()
    away = (focus - position).norm(dim=-1).mean()
    stand = low + torch.rand(count, 3, generator=generator) * (high - low)
    aim = focus + ASTRAY * away * torch.randn(count, 3, generator=generator)
    lent = cameras[torch.randint(len(cameras), (count,), generator=generator).to(cameras.pose.device)]
    pose = look_at(stand, aim - stand, -cameras.pose[:, :, 1].cpu().mean(0))
    return replace(lent, pose=pose.to(lent.pose), image_index=None)


NEAREST_VIEWS = 3  # cameras around one, of which a camera between is drawn
SIDEWAYS = 0.1  # deviation of a camera between two others, of their distance


def camera_between(cameras: Camera, generator: torch.Generator) -> Camera:
    """A camera between a given one and one of its nearest neighbours, slightly shifted, with the first's lens."""
    poses = cameras.pose.cpu()
    position = poses[:, :, 3]
    first = int(torch.randint(len(poses), (1,), generator=generator))
    away = (position - position[first]).norm(dim=-1)
    near = away.argsort()[1 : NEAREST_VIEWS + 1] if len(poses) > 1 else torch.tensor([first])
    second = int(near[torch.randint(len(near), (1,), generator=generator)])
    share = torch.rand(1, generator=generator)
    aside = SIDEWAYS * away[second] * torch.randn(3, generator=generator)
    stand = torch.lerp(position[first], position[second], share) + aside
    left, _, right = torch.linalg.svd(torch.lerp(poses[first, :, :3], poses[second, :, :3], share))
    pose = torch.cat([left @ right, stand[:, None]], 1)[None]
    return replace(cameras[torch.tensor([first])], pose=pose.to(cameras.pose), image_index=None)


def places_between(
    places: Float[Tensor, "point 3"], stands: Float[Tensor, "camera 3"], generator: torch.Generator
) -> Float[Tensor, "point 3"]:
    """Random points between each given point and one of its nearest cameras."""
    near = torch.cdist(places, stands).argsort(1)[:, 1 : NEAREST_VIEWS + 1]
    if not near.shape[1]:
        return places
    chosen = torch.randint(near.shape[1], (len(places), 1), generator=generator).to(near.device)
    share = torch.rand(len(places), 1, generator=generator).to(places.device)
    return torch.lerp(places, stands[near.gather(1, chosen)[:, 0]], share)


def patches(cameras: Camera, side: int, strides: Sequence[int], generator: torch.Generator) -> Rays:
    """Rays of one square patch of each camera, row by row: side * side of them.

    strides: pixels between neighbouring rays of a patch, one chosen for each, limited by the picture
    """
    count, sizes = len(cameras), cameras.size.cpu()
    chosen = torch.tensor(strides)[torch.randint(len(strides), (count,), generator=generator)]
    stride = torch.minimum(chosen, (sizes.amin(-1) // side).clamp_min(1))[:, None]
    corner = torch.rand(count, 2, generator=generator) * (sizes - stride * (side - 1) - 1).clamp_min(0)
    rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    steps = torch.stack([columns, rows], -1).view(-1, 2)
    pixels = corner.floor()[:, None] + 0.5 + steps * stride[:, None]
    index = torch.arange(count, device=cameras.pose.device).repeat_interleave(side * side)
    rays = cameras.rays(pixels.view(-1, 2).to(cameras.pose), index)
    wider = stride.expand(-1, side * side).flatten().to(rays.radius)
    return replace(rays, radius=rays.radius * wider)


def roughness(
    depth: Float[Tensor, "patch row column"], opacity: Float[Tensor, "patch row column"]
) -> Float[Tensor, ""]:
    """Depth smoothness: squared differences of neighbouring depths of a patch, where both are opaque, mean of all
    (Niemeyer 2022, eq. 6, without opacity there)."""
    counts = opacity.detach()
    across = (depth[:, :, 1:] - depth[:, :, :-1]).square() * counts[:, :, 1:] * counts[:, :, :-1]
    down = (depth[:, 1:] - depth[:, :-1]).square() * counts[:, 1:] * counts[:, :-1]
    return across.mean() + down.mean()
