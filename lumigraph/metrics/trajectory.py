"""Trajectories: TUM's text format, absolute trajectory error and relative pose error (Sturm et al. 2012).

Poses are camera-to-world. The errors are those of the program evo with alignment and without correction of scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..geometry import to_quaternion
from . import Score

Poses = Float[np.ndarray, "pose 3 4"]


def aligned(estimate: Poses, truth: Poses) -> Poses:
    """The estimate aligned to the truth by a least-squares rotation and shift of its positions (Umeyama 1991, eqs. 40
    and 41, with a scale of 1)."""
    a, b = estimate[:, :, 3], truth[:, :, 3]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    rotation = u * [1, 1, np.sign(np.linalg.det(u @ vt))] @ vt
    shift = b.mean(0) - rotation @ a.mean(0)
    return np.concatenate([rotation @ estimate[:, :, :3], (a @ rotation.T + shift)[:, :, None]], -1)


def position_errors(estimate: Poses, truth: Poses) -> Float[np.ndarray, " pose"]:
    """Distance of each position from the true one after alignment."""
    return np.linalg.norm(aligned(estimate, truth)[:, :, 3] - truth[:, :, 3], axis=-1)


def relative_errors(
    estimate: Poses, truth: Poses, interval: int = 1
) -> tuple[Float[np.ndarray, " pair"], Float[np.ndarray, " pair"]]:
    """Shift and rotation in degrees of E = (Q_i^-1 Q_i+d)^-1 (P_i^-1 P_i+d) (Sturm 2012, eq. 1).

    interval: d, poses from the first of a pair to the second; pairs do not overlap, as in evo
    """
    (turn_a, shift_a), (turn_b, shift_b) = (motions(poses[::interval]) for poses in (estimate, truth))
    shift = np.linalg.norm(np.einsum("nji,nj->ni", turn_b, shift_a - shift_b), axis=-1)
    trace = np.einsum("nji,nji->n", turn_b, turn_a)
    return shift, np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def motions(poses: Poses) -> tuple[Float[np.ndarray, "pair 3 3"], Float[np.ndarray, "pair 3"]]:
    """Rotation and shift from each pose to the next, in the frame of the first."""
    first, second = poses[:-1], poses[1:]
    back = first[:, :, :3].transpose(0, 2, 1)
    return back @ second[:, :, :3], np.einsum("nij,nj->ni", back, second[:, :, 3] - first[:, :, 3])


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of an estimated trajectory, in the unit of its positions and in degrees.

    ate:      root mean square of the distances after alignment
    largest:  of these distances
    rpe, rpe_degrees: root mean square of the relative error from one frame to the next, shift and rotation
    path:     length of the true path
    """

    ate: float
    largest: float
    rpe: float
    rpe_degrees: float
    path: float

    @staticmethod
    def of(estimate: Poses, truth: Poses) -> TrajectoryErrors:
        away, (shift, turn) = position_errors(estimate, truth), relative_errors(estimate, truth)
        path = float(np.linalg.norm(np.diff(truth[:, :, 3], axis=0), axis=-1).sum())
        return TrajectoryErrors(rms(away), float(away.max()), rms(shift), rms(turn), path)

    @property
    def scores(self) -> list[Score]:
        """In centimetres, for trajectories in metres."""
        return [
            Score("ATE", 100 * self.ate, "cm", "lower", 2),
            Score("ATE of the path", 100 * self.ate / max(self.path, 1e-9), "%", "lower", 2),
            Score("RPE", 100 * self.rpe, "cm a frame", "lower", 3),
            Score("RPE of rotation", self.rpe_degrees, "degrees a frame", "lower", 3),
        ]


def rms(values: Float[np.ndarray, " value"]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def to_tum(moments: Sequence[float], poses: Poses) -> str:
    """Text of a trajectory, a pose to a line: moment, position, quaternion (x, y, z, w)."""
    turns = to_quaternion(torch.from_numpy(poses[:, :, :3])).numpy()[:, [1, 2, 3, 0]]
    rows = np.concatenate([poses[:, :, 3], turns], -1).tolist()
    lines = (f"{t:.6f} " + " ".join(f"{x:.8f}" for x in row) for t, row in zip(moments, rows, strict=True))
    return "# timestamp tx ty tz qx qy qz qw\n" + "".join(line + "\n" for line in lines)
