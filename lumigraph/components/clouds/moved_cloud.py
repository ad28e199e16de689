"""Pose refinement through a cloud: gradient of the pose by the Gaussians."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ...camera import Camera
from ...gaussians import Gaussians
from ...geometry import multiply, rotated
from ..training.pose_refinement import PoseRefinement


def seen_from(poses: PoseRefinement, cloud: Gaussians, camera: Camera) -> tuple[Gaussians, Camera]:
    """The cloud and the refined camera of one photograph, so that their rendering is differentiable in `poses`.

    The projection has gradients in Gaussians and none in cameras. To move a camera is to move the cloud inversely: with
    the camera's rotation exp(omega) and shift s fixed, and R = exp(omega) exp(omega_0)^T, which is the identity for
    omega = omega_0 and yet has a gradient,

        m' = eye + R^T (m - eye - (s - s_0))        q' = R^T q

    Exact for centres and shapes. Harmonics are not rotated: their colour changes little over a pose error.
    """
    if camera.image_index is None:
        return cloud, camera
    omega, shift = poses.moves[camera.image_index[0]].split(3)
    turn = turn_of(omega) @ turn_of(omega.detach()).T
    there = poses.refined(camera)
    means = (cloud.means - there.position - (shift - shift.detach())) @ turn + there.position  # a row m is R^T m
    back = turn.T
    skew = torch.stack([back[2, 1] - back[1, 2], back[0, 2] - back[2, 0], back[1, 0] - back[0, 1]])
    quaternion = torch.cat([skew.new_ones(1), skew / 4])  # exact to first order, and the value is the identity's
    return replace(cloud, means=means, quaternions=multiply(quaternion[None], cloud.quaternions)), there


def turn_of(omega: Tensor) -> Tensor:
    """Rotation matrix of a rotation vector."""
    return rotated(torch.eye(3, device=omega.device), omega.expand(3, 3)).T
