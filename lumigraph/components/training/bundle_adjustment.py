"""Bundle adjustment of cameras and points (Triggs 2000)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import bsr_matrix, csr_matrix
from torch import Tensor
from torch.nn.functional import normalize

from ...camera import PIXEL_RADIUS, Camera
from ...geometry import rotated
from .shared_points import Matches, Seen, Tracks, tracks

TURN, SHIFT = math.radians(3.0), 0.03  # deviations of poses as given: radians, and shares of the box's longest side
GATES = math.radians(5.0), math.radians(1.5), math.radians(0.7)  # off its epipolar line that a match may lie, by rounds
WRONG = 0.5  # share of two views' matches that lie farther off, from which none of them is believed
STEPS = 25  # of Gauss and Newton in a round
FALL = 0.8  # by which the error that is believed falls from step to step
REACH = 4.0  # scene units, the deviation of a point's step: one that nothing tells of stays


def adjusted(cameras: Camera, seen: Sequence[Seen], matches: Matches, extent: float, error: float) -> Camera:
    """Cameras adjusted to points shared between photographs; those without shared points stay.

        min over poses and points of  sum rho(|T y / |y||^2) + |omega|^2 / TURN^2 + |s|^2 / (SHIFT extent)^2

    y is a point in its camera's frame, T two axes orthogonal to its observed direction, omega and s the correction of a
    pose, and rho the estimator of Geman and McClure (1987), whose scale falls from step to step to `error`, which
    rejects wrong matches.

    extent: longest side of the box of interest, scene units
    error:  of a feature's position, radians
    """
    given = cameras.pose.double().cpu()
    pose, trust = given, torch.tensor([1 / TURN] * 3 + [1 / (SHIFT * extent)] * 3).double().square()
    for gate in GATES:
        kept = {pair: m[agreeing(pose, seen, pair, m, gate)] for pair, m in matches.items()}
        kept = {pair: m for pair, m in kept.items() if len(m) > (1 - WRONG) * len(matches[pair])}
        shared = tracks(seen, kept)
        points, scale = middles(pose, shared), gate
        for _ in range(STEPS if len(shared.point) else 0):
            pose, points = step(pose, points, shared, given, trust, scale)
            scale = max(FALL * scale, error)
    return replace(cameras, pose=pose.to(cameras.pose))


def agreeing(
    pose: Float[Tensor, "camera 3 4"],
    seen: Sequence[Seen],
    pair: tuple[int, int],
    m: Int[Tensor, "match 2"],
    gate: float,
) -> Tensor:
    """Mask of inlier matches of two views, near their epipolar lines."""
    i, j = pair
    a = seen[i].bearings[m[:, 0]].double() @ pose[i, :, :3].T
    b = seen[j].bearings[m[:, 1]].double() @ pose[j, :, :3].T
    across = normalize(torch.linalg.cross((pose[j, :, 3] - pose[i, :, 3]).expand_as(a), a), dim=-1)
    return (across * b).sum(-1).abs() < math.sin(gate)


def middles(pose: Float[Tensor, "camera 3 4"], shared: Tracks) -> Float[Tensor, "point 3"]:
    """Points closest to all rays that observe them."""
    eyes, turns = pose[shared.view, :, 3], pose[shared.view, :, :3]
    along = (turns @ shared.bearing.double()[:, :, None])[..., 0]
    across = torch.eye(3).double() - along[:, :, None] * along[:, None]
    count = int(shared.point.max()) + 1 if len(shared.point) else 0
    sums = torch.zeros(count, 3, 3).double().index_add_(0, shared.point, across) + 1e-6 * torch.eye(3).double()
    return torch.linalg.solve(
        sums, torch.zeros(count, 3).double().index_add_(0, shared.point, (across @ eyes[:, :, None])[..., 0])
    )


def step(
    pose: Float[Tensor, "camera 3 4"],
    points: Float[Tensor, "point 3"],
    shared: Tracks,
    given: Float[Tensor, "camera 3 4"],
    trust: Float[Tensor, " 6"],
    scale: float,
) -> tuple[Float[Tensor, "camera 3 4"], Float[Tensor, "point 3"]]:
    """One step of Gauss and Newton: (A - E^T C^-1 E) dp = -(a - E^T C^-1 c), dx = -C^-1 (c + E dp), with the blocks A
    of poses, C of points and E between them (Triggs 2000, section 6.1)."""
    eyes, turns, bearing = pose[shared.view, :, 3], pose[shared.view, :, :3], shared.bearing.double()
    away = points[shared.point] - eyes
    y = (turns.mT @ away[:, :, None])[..., 0]
    direction, distance = normalize(y, dim=-1), y.norm(dim=-1)[:, None, None]
    sideways = normalize(torch.linalg.cross(bearing, smallest_axis(bearing)), dim=-1)
    two = torch.stack([sideways, torch.linalg.cross(bearing, sideways)], 1)  # T
    left = (two @ direction[:, :, None])[..., 0]
    ahead = (direction * bearing).sum(-1) > 0.5
    weight = ahead / (1 + left.square().sum(-1) / (2 * scale) ** 2) / scale  # its root, as rows have it
    weight = weight[:, None, None]

    eye = torch.eye(3).double()
    of_point = weight * (two @ (eye - direction[:, :, None] * direction[:, None]) / distance @ turns.mT)
    turning = torch.linalg.cross(of_point, away[:, None].expand_as(of_point), dim=-1)  # row x away = row [away]x
    of_pose = torch.cat([turning, -of_point], -1)
    rest = (weight[:, :, 0] * left).flatten().numpy()

    k, j = (sparse(x, of, n) for x, of, n in ((of_point, shared.point, len(points)), (of_pose, shared.view, len(pose))))
    moved = torch.cat([rotation_vector(pose[:, :, :3] @ given[:, :, :3].mT), pose[:, :, 3] - given[:, :, 3]], -1)
    blocks = (of_point.mT @ of_point).new_zeros(len(points), 3, 3).index_add_(0, shared.point, of_point.mT @ of_point)
    inverse = torch.linalg.inv(blocks + eye / REACH**2).numpy()
    c_inverse = bsr_matrix((inverse, np.arange(len(points)), np.arange(len(points) + 1)))
    e, c = k.T @ j, k.T @ rest
    a = j.T @ j - e.T @ (c_inverse @ e)
    side = j.T @ rest - e.T @ (c_inverse @ c) + (trust * moved).flatten().numpy()
    dp = -np.linalg.solve(a.toarray() + np.diag(trust.repeat(len(pose)).numpy()), side)
    dx = torch.from_numpy(-(c_inverse @ (c + e @ dp))).view(-1, 3)
    omega, shift = torch.from_numpy(dp).view(-1, 6).split(3, -1)
    axes = [rotated(pose[:, :, i], omega) for i in range(3)]
    return torch.stack([*axes, pose[:, :, 3] + shift], -1), points + dx


def sparse(rows: Float[Tensor, "row 2 n"], of: Int[Tensor, " row"], count: int) -> csr_matrix:
    """A Jacobian with two rows for each observation, and `n` columns for each of `count` unknowns."""
    width = rows.shape[2]
    columns = (width * of[:, None, None] + torch.arange(width)).expand_as(rows).flatten()
    starts = np.arange(2 * len(rows) + 1) * width
    return csr_matrix((rows.flatten().numpy(), columns.numpy(), starts), (2 * len(rows), width * count))


def smallest_axis(vectors: Float[Tensor, "row 3"]) -> Float[Tensor, "row 3"]:
    """Coordinate axis most orthogonal to each vector."""
    return torch.nn.functional.one_hot(vectors.abs().argmin(-1), 3).to(vectors)


def rotation_vector(rotation: Float[Tensor, "camera 3 3"]) -> Float[Tensor, "camera 3"]:
    """Rotation vector of each rotation, up to a right angle."""
    r = rotation
    axis = torch.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], -1) / 2
    sine = axis.norm(dim=-1, keepdim=True).clamp(1e-12, 1)
    return axis / sine * sine.asin()


def pixel_angle(camera: Camera) -> float:
    """Angle in radians of a pixel at the centre of one camera's picture."""
    return float(camera.rays(camera.size / 2).radius[0]) / PIXEL_RADIUS
