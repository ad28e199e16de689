"""Alignment of a depth frame with a signed distance field: Gauss-Newton on its pose.

The map is an implicit surface, so that back-projected points need no correspondences: their distance is the residual of
point-to-plane ICP (Bylow 2013, section III). Colours of the field at the same points are a second residual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from .trajectory import Pose, apply_twists

HUBER = 1.5  # deviations from which on a residual counts by its size, not its square
DAMPING = 1e-4  # of the normal matrix's diagonal
GREY = (0.299, 0.587, 0.114)  # of red, green, blue in luminance
MIN_POINTS = 50  # in the band of the field, below which a pose is not determined
SENSOR_DEVIATION = 0.005, 0.0025  # metres: of depth, and of its square by the metre (Khoshelham and Elberink 2012)
COLOUR_DEVIATION = 0.08  # of luminance
MOTION_DEVIATION = 0.01, 0.02  # of a frame's motion from the first estimate: radians, metres
INDEPENDENT_SHARE = 0.003  # of the points, whose errors count as independent beside that
LEVEL_SHARE = 2e-3  # of the measured pixels, that have the same depth if it has levels
SMALL_TURN, SMALL_SHIFT = 1e-5, 1e-5  # radians and scene units of a last step


@dataclass(frozen=True)
class Aligned:
    """A pose, and the share of inliers: points within half the field's truncation."""

    pose: Pose
    share: float


Field = Callable[[Float[Tensor, "point 3"]], tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]]


def aligned(
    field: Field,
    pose: Pose,
    points: Float[Tensor, "point 3"],
    rgb: Float[Tensor, "point 3"],
    deviation: Float[Tensor, " point"],
    colour_deviation: float,
    unit: float,
    iterations: int,
) -> Aligned:
    """Pose that aligns points with the field's surface.

    field:     signed distance over the truncation, and sRGB-encoded colour, at points of the world
    points:    in the camera's frame
    deviation: standard deviation of each point's distance, over the truncation
    colour_deviation: of luminance; 0: distance alone
    unit:      scene units of a metre
    Luminance is compared after a least-squares gain and offset, for the camera's exposure changes. A prior keeps the
    pose near the first one in directions that points and colours do not determine, as along a bare wall.
    """
    grey, share = rgb @ rgb.new_tensor(GREY), 0.0
    turn, shift = MOTION_DEVIATION
    known = torch.tensor([turn] * 3 + [shift * unit] * 3, dtype=torch.float64, device=points.device).pow(-2)
    known, motion = known * INDEPENDENT_SHARE * len(points), torch.zeros_like(known)
    for _ in range(iterations):
        world = (points @ pose[:, :3].T + pose[:, 3]).requires_grad_()
        distance, colour = field(world)
        (slope,) = torch.autograd.grad(distance.sum(), world, retain_graph=colour_deviation > 0)
        band = distance.detach().abs() < 0.95
        share = float((distance.detach().abs() < 0.5).float().mean())
        if int(band.sum()) < MIN_POINTS:
            break
        arm = world.detach() - pose[:, 3]
        hessian, gradient = normal_equations(distance.detach() / deviation, slope / deviation[:, None], arm, band)
        if colour_deviation:
            lum = colour @ colour.new_tensor(GREY)
            (slope,) = torch.autograd.grad(lum.sum(), world)
            gain, error = exposed(lum.detach(), grey, band)
            more = normal_equations(error / colour_deviation, gain * slope / colour_deviation, arm, band)
            hessian, gradient = hessian + more[0], gradient + more[1]
        hessian, gradient = hessian + known.diag(), gradient + known * motion
        damped = hessian + DAMPING * hessian.diagonal().diag() + 1e-9 * torch.eye(6).to(hessian)
        step = -torch.linalg.solve(damped, gradient)
        pose, motion = apply_twists(pose[None], step[None].to(pose))[0], motion + step
        if step[:3].norm() < SMALL_TURN and step[3:].norm() < SMALL_SHIFT:
            break
    return Aligned(pose, share)


def sensor_deviation(metres: Float[Tensor, " point"]) -> Float[Tensor, " point"]:
    """Standard deviation of measured depth, metres."""
    return SENSOR_DEVIATION[0] + SENSOR_DEVIATION[1] * metres.square()


def level_step(metres: Float[Tensor, " point"]) -> Float[Tensor, " point"]:
    """Distance of each depth from the next level, where depth has few levels, as of eight bits; else 0."""
    known = metres[metres.isfinite()]
    levels, counts = (1e4 * known).round().unique(return_counts=True)
    often = counts >= LEVEL_SHARE * len(known)
    levels = levels[often] / 1e4
    if len(levels) < 3 or int(counts[often].sum()) < 0.5 * len(known):
        return torch.zeros_like(metres)
    gaps, place = levels.diff(), torch.searchsorted(levels, metres.nan_to_num(0.0))
    return torch.minimum(gaps[(place - 1).clamp(0, len(gaps) - 1)], gaps[place.clamp(0, len(gaps) - 1)])


def normal_equations(residual: Tensor, slope: Tensor, arm: Tensor, band: Tensor) -> tuple[Tensor, Tensor]:
    """J^T W J and J^T W r in double precision. J = (arm x slope, slope) of rotation about the camera and shift; W are
    Huber's weights.

    residual: in deviations; slope: its derivative by the point; arm: from the camera to the point; band: valid points
    """
    weight = (HUBER / residual.abs().clamp_min(1e-9)).clamp(max=1) * band
    jacobian = torch.cat([torch.linalg.cross(arm, slope), slope], -1).double()
    weighted = jacobian * weight[:, None].double()
    return weighted.T @ jacobian, weighted.T @ residual.double()


def exposed(seen: Tensor, target: Tensor, band: Tensor) -> tuple[Tensor, Tensor]:
    """Gain, and residual of luminance after least-squares gain and offset."""
    a, b = seen - seen[band].mean(), target - target[band].mean()
    gain = ((a * b)[band].sum() / a[band].square().sum().clamp_min(1e-6)).clamp(0.5, 2.0)
    return gain, gain * a - b
