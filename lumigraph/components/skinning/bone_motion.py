"""Bones of a character at any time, with learnt corrections of its pose (Weng 2022, section 3.2)."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import diags_array
from torch import Tensor, nn
from torch.nn.functional import normalize

from ...datasets.scene import Frame, Scene
from ...datasets.skeleton import Skeleton, between_moments, local_of, posed, rigid_inverse, rigid_product
from ...errors import LumigraphError, LumigraphWarning
from ...exchange.bones import SUFFIXES, read_motion
from ...files.ranges import LearningRate, Share
from ...geometry import evenly, multiply, to_matrix, to_quaternion
from ...method import Part
from ...method.controls import Control, Value, moment
from ..training.pose_refinement import PoseAdam
from ..training.schedules import falling

CAPTURED, AT_REST = "captured", "rest"  # values of the control `pose` for bones of the capture, and for those at rest
FALL = 0.05  # of the rate of corrections that is left at the end of the budget
MIN_OUTPUT = 1e-5  # weights of the correction network's last layer at first
MIN_ANGLE = 1e-8  # radians, squared, against division by zero
CHECKED_PHOTOGRAPHS, BACKGROUND_DIFFERENCE, MIN_BACKGROUND = 4, 0.1, 0.5  # of a colour; share of a picture's edge
KEPT_CLIPS = 8  # files of poses that are kept in memory
MIN_MOMENTS = 5  # that a smoothing spline goes through
SMOOTHINGS = 10  # over the budget, of given poses at its beginning and then of corrections
SMOOTHING_SHARE = 0.02  # of the budget's seconds that smoothing may take
SMOOTHING_WEIGHTS = np.geomspace(1e-3, 1e6, 19)  # of curvature, for moments 1 apart: hardly any, to a straight line
MIN_POSE_ERROR, MAX_POSE_ERROR = 1.0, 10.0  # degrees; a joint below is exact, above it moves too fast for its moments
MIN_DISTURBED_SHARE = 0.5  # of the joints with such errors; fewer are sudden motions of an exact body
TRACE_STEP = 1e-3  # of the weight's logarithm

POSE_WIDTH = 256  # channels of the network's layers
POSE_DEPTH = 4  # its hidden layers


@dataclass(frozen=True)
class BoneNumbers:
    """A Config's numbers of pose correction."""

    pose_correction: Literal["no", "table", "network"] = "network"  # corrections of joints: none, of each moment, a MLP
    pose_lr: LearningRate = 5e-5  # learning rate of the corrections; of a table in radians a step
    pose_from: Share = 0.0  # share of the budget before corrections are learnt; later: a better body first
    pose_smoothing: bool = False  # smooth given poses over time, as far as cross-validation finds; exact ones stay


class BoneMotion(Part):
    """Transforms of bones from rest to a time: M_k = G_k G_k(rest)^-1.

    Every joint turns in its parent by the capture's rotation and a learnt one (Weng 2022, eq. 6); lengths of bones
    stay. Between two times of the capture joints are interpolated.
    quaternions: given rotations of joints in their parents; with `pose_smoothing` after it
    seen:     times with photographs, which are smoothed;  smoothings: number of smoothings completed or left out
    turns:    learnt rotation vectors of each time's joints, radians, one after another, with "table"
    network:  maps angles of all joints to these, with "network"
    """

    times: Tensor
    positions: Tensor
    quaternions: Tensor
    home: Tensor
    back: Tensor
    seen: Tensor
    smoothings: Tensor

    def __init__(self, frame: Frame, numbers: BoneNumbers):
        super().__init__()
        skeleton = skeleton_of(frame)
        self.numbers, self.skeleton, self.frame = numbers, skeleton, frame
        local = local_of(skeleton.parents, skeleton.track())
        for name, value in (
            ("times", torch.tensor(skeleton.times)),
            ("positions", local[..., 3].float()),
            ("home", rigid_inverse(skeleton.rest.matrices).float()),
            ("back", to_quaternion(local_of(skeleton.parents, skeleton.rest.matrices)[..., :3].mT).float()),
        ):
            self.register_buffer(name, value, persistent=False)
        for name, value in (
            ("quaternions", to_quaternion(local[..., :3]).float()),
            ("seen", torch.zeros(len(skeleton.times), dtype=torch.bool)),
            ("smoothings", torch.zeros((), dtype=torch.long)),
        ):
            self.register_buffer(name, value, persistent=numbers.pose_smoothing)
        bones, n = len(skeleton), numbers
        self.turns = nn.Parameter(torch.zeros(len(skeleton.times) * bones, 3)) if n.pose_correction == "table" else None
        self.network: nn.Sequential | None = None
        if n.pose_correction == "network":
            widths = [self.given_angles.shape[1], *[POSE_WIDTH] * POSE_DEPTH]
            layers = [x for a, b in zip(widths, widths[1:], strict=False) for x in (nn.Linear(a, b), nn.ReLU())]
            last = nn.Linear(widths[-1], 3 * bones)
            nn.init.uniform_(last.weight, -MIN_OUTPUT, MIN_OUTPUT)
            nn.init.zeros_(last.bias)
            self.network = nn.Sequential(*layers, last)

    # Corrections

    @torch.no_grad()
    def begin(self, method: object, data: Scene, seconds: float) -> None:
        """Smooth the given poses; later smoothings take as long, and as many follow as their share of time allows."""
        warn_of_background(data)
        if not self.numbers.pose_smoothing or data.cameras.time is None:
            return
        times = data.cameras.time[data.splits["train"]].unique().to(self.times)
        rows = (self.times[:, None] - times).abs().argmin(0).unique()
        if len(rows) < MIN_MOMENTS:
            return
        self.seen[rows], since = True, time.perf_counter()
        self.quaternions[rows] = smoothed_poses(self.quaternions[rows], self.times[rows])
        count = SMOOTHING_SHARE * seconds / (time.perf_counter() - since)
        self.smoothings += SMOOTHINGS - int(min(count, SMOOTHINGS))

    @torch.no_grad()
    def before_step(self, method: object, step: int, progress: float) -> None:
        """Smooth a table's corrections. Those of a network follow smoothly from the given poses."""
        if self.numbers.pose_smoothing and progress * SMOOTHINGS >= self.smoothings + 1:
            self.smoothings += 1
            if self.turns is not None and self.seen.any() and self.turns.any():
                turns = self.turns.view(len(self.times), -1)
                turns[self.seen], _ = on_splines(turns[self.seen], self.times[self.seen])

    @property
    def given_angles(self) -> Float[Tensor, "moment angle"]:
        """Angles of all given poses: see `angles_of`."""
        return self.angles_of(self.quaternions)

    def angles_of(self, turns: Float[Tensor, "moment bone 4"]) -> Float[Tensor, "moment angle"]:
        """Omega: rotation vectors of joints in their parents from the rest pose, radians, without roots."""
        moved = multiply(self.back.expand_as(turns).flatten(0, 1), turns.flatten(0, 1))
        vectors = rotation_vectors(moved).view(len(turns), -1, 3)
        return vectors[:, [parent >= 0 for parent in self.skeleton.parents]].flatten(1)

    def corrections(self) -> Float[Tensor, "moment bone 3"] | None:
        """Learnt rotation vectors of all joints, radians; None without any. Those of a table have zero mean over
        training times, which would change the rest pose."""
        if self.turns is not None:
            turns = self.turns.view(len(self.times), -1, 3)
            learnt = (turns.detach() != 0).any(-1, keepdim=True)
            mean = turns.detach().sum(0) / learnt.sum(0).clamp_min(1)
            return turns - learnt * mean
        return None if self.network is None else self.network(self.given_angles).view(len(self.times), -1, 3)

    def corrected(self) -> Float[Tensor, "moment bone 4"]:
        """Rotations of joints in their parents, with corrections."""
        turns = self.corrections()
        if turns is None:
            return self.quaternions
        return multiply(self.quaternions.flatten(0, 1), exponential(turns.flatten(0, 1))).view_as(self.quaternions)

    # At moments

    def local(self, times: Float[Tensor, " time"]) -> tuple[Float[Tensor, "time bone 4"], Float[Tensor, "time bone 3"]]:
        """Rotations and positions of joints in their parents at times of the capture."""
        before, after, share = between_moments(self.times, times.to(self.times))
        turns, share = self.corrected(), share[:, None, None]
        first, second = turns[before], turns[after]
        second = torch.where((first * second).sum(-1, keepdim=True) < 0, -second, second)
        return torch.lerp(first, second, share), torch.lerp(self.positions[before], self.positions[after], share)

    def pose_joints(
        self, settings: Mapping[str, Value], times: Float[Tensor, " time"]
    ) -> tuple[Float[Tensor, "time bone 4"], Float[Tensor, "time bone 3"]]:
        """The same under settings: of the capture, or of a user's poses."""
        if (path := str(settings.get("pose", CAPTURED))) == CAPTURED:
            return self.local(times)
        if path == AT_REST:
            home = rigid_inverse(self.home)
            local = local_of(self.skeleton.parents, home).expand(len(times), -1, -1, -1)
            back = self.back * self.back.new_tensor([1, -1, -1, -1])  # the inverse of a unit quaternion
            return back.expand(len(times), -1, -1), local[..., 3]
        clip = clip_of(path, self.frame)
        first, last = self.frame.times or (0.0, 1.0)
        share = (times.cpu() - first) / (last - first)
        turns, places = clip.local(clip.times[0] + share * (clip.times[-1] - clip.times[0]))
        return turns.to(times.device), places.to(times.device)

    def transforms(
        self, turns: Float[Tensor, "time bone 4"], places: Float[Tensor, "time bone 3"]
    ) -> Float[Tensor, "time bone 3 4"]:
        """Transforms of the bones from rest to poses relative to their parents."""
        matrices = to_matrix(turns.flatten(0, 1)).view(len(turns), -1, 3, 3)
        joints = posed(self.skeleton.parents, torch.cat([matrices, places[..., None]], -1))
        return rigid_product(joints, self.home.expand_as(joints))

    def at(self, settings: Mapping[str, Value], time: float) -> Float[Tensor, "bone 3 4"]:
        """Transforms of the bones at a moment under settings."""
        return self.transforms(*self.pose_joints(settings, torch.tensor([time], device=self.times.device)))[0]

    # Learning

    def optimizers(self) -> list[torch.optim.Optimizer]:
        rate = self.numbers.pose_lr
        if self.turns is not None:
            return [PoseAdam([{"name": "bones", "params": [self.turns]}], rate)]
        if self.network is None:
            return []
        return [torch.optim.Adam([{"name": "bones", "params": list(self.network.parameters())}], rate)]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        rate = self.numbers.pose_lr
        return {"bones": falling(rate, FALL * rate, progress) if progress >= self.numbers.pose_from else 0.0}

    @property
    def controls(self) -> tuple[Control, ...]:
        about = "Bones that are shown: of the capture, at rest, or of a file of poses, which `time` then plays."
        pose = Control("pose", CAPTURED, choices=(CAPTURED, AT_REST), files=SUFFIXES, about=about)
        return (*((moment(self.frame.times),) if self.frame.times else ()), pose)


def skeleton_of(frame: Frame) -> Skeleton:
    """The skeleton of a scene. Raises LumigraphError without one."""
    if frame.skeleton is None:
        raise LumigraphError(
            "The scene has no skeleton, and this method moves a body by one; put bones.json beside the photographs, as "
            "docs/people.md says"
        )
    return frame.skeleton


@lru_cache(KEPT_CLIPS)
def _clip(path: Path, changed: int, frame: Frame) -> BoneMotion:
    poses = read_motion(path, skeleton_of(frame), frame.to_source.inverse)
    return BoneMotion(replace(frame, skeleton=poses), BoneNumbers("no"))


def clip_of(path: str, frame: Frame) -> BoneMotion:
    """Poses in a file for the bones of a scene, at its times. Raises LumigraphError for a file without any."""
    file = Path(path).expanduser()
    return _clip(file, file.stat().st_mtime_ns if file.is_file() else 0, frame)


def warn_of_background(data: Scene) -> None:
    """Warn of photographs with a background, which no bone moves and no body shows."""
    for index in evenly(data.splits["train"].tolist(), CHECKED_PHOTOGRAPHS):
        shot = data.photograph(index)
        away = (shot.before(data.frame.background) - torch.tensor(data.frame.background)).abs().amax(-1)
        seen = away > BACKGROUND_DIFFERENCE
        edge = torch.ones_like(seen)
        edge[2:-2, 2:-2] = False
        if shot.mask is None and float(seen[edge].float().mean()) > MIN_BACKGROUND:
            warnings.warn(
                f"{data.source}: photographs show a background around the body, which a body on bones cannot show, so "
                "it spoils colours and scores; give the body's masks (a folder masks) or pictures with alpha, or train "
                "deformable-splatting, which shows both",
                LumigraphWarning,
                stacklevel=2,
            )
            return


def smoothed_poses(
    turns: Float[Tensor, "moment bone 4"], times: Float[Tensor, " moment"]
) -> Float[Tensor, "moment bone 4"]:
    """Unit quaternions of joints, each component on a smoothing spline over time. An exact body keeps its rotations,
    and so do joints that turn too far from moment to moment to tell errors from motion."""
    flips = torch.where((turns[1:] * turns[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).cumprod(0)
    even = torch.cat([turns[:1], turns[1:] * flips])
    fitted, variance = on_splines(even.flatten(1), times)
    degrees = torch.rad2deg(2 * variance.view(turns.shape[1:]).sum(-1).sqrt())[:, None]
    disturbed = (degrees > MIN_POSE_ERROR) & (degrees < MAX_POSE_ERROR)
    if disturbed.float().mean() < MIN_DISTURBED_SHARE:
        return turns
    return torch.where(disturbed, normalize(fitted.view_as(turns), dim=-1), turns)


def on_splines(
    values: Float[Tensor, "moment column"], times: Float[Tensor, " moment"], weights: np.ndarray = SMOOTHING_WEIGHTS
) -> tuple[Float[Tensor, "moment column"], Float[Tensor, " column"]]:
    """Columns on natural cubic smoothing splines (Reinsch 1967), and the variance of the errors that each has lost.

    Of the weights of squared curvature each column has the one of least generalised cross-validation (Wahba 1990,
    section 4.3): large for errors that are independent over time, the smallest for exact values of a smooth motion.
    """
    rows, y = len(times), values.cpu().double().numpy()
    h = (times.diff() / times.diff().median()).cpu().double().numpy()
    second = diags_array([1 / h[:-1], -1 / h[:-1] - 1 / h[1:], 1 / h[1:]], offsets=[0, 1, 2], shape=(rows - 2, rows))
    square = second @ second.T
    curvature = np.stack([np.pad(square.diagonal(k), (0, k)) for k in range(3)])
    overlap = np.stack([(h[:-1] + h[1:]) / 3, np.pad(h[1:-1] / 6, (0, 1)), np.zeros(rows - 2)])  # of hats

    def factor(weight: float) -> np.ndarray:
        return cholesky_banded(overlap + weight * curvature, lower=True)

    def log_determinant(weight: float) -> float:
        return 2 * float(np.log(factor(weight)[0]).sum())

    least, lost, variance = np.full(y.shape[1], np.inf), np.zeros_like(y), np.zeros(y.shape[1])
    for weight in weights:
        errors = weight * (second.T @ cho_solve_banded((factor(weight), True), second @ y))
        upper, lower = (log_determinant(weight * math.exp(step)) for step in (TRACE_STEP, -TRACE_STEP))
        freedom = (upper - lower) / (2 * TRACE_STEP)  # trace of what the spline takes from values, I - A
        found = np.square(errors).sum(0) / freedom
        better = found / freedom < least
        least[better], lost[:, better], variance[better] = (found / freedom)[better], errors[:, better], found[better]
    return torch.from_numpy(y - lost).to(values), torch.from_numpy(variance).to(values)


def exponential(omega: Float[Tensor, "row 3"]) -> Float[Tensor, "row 4"]:
    """Quaternions of rotation vectors; differentiable at zero as well."""
    half = 0.5 * omega.square().sum(-1, keepdim=True).clamp_min(MIN_ANGLE).sqrt()
    return normalize(torch.cat([half.cos(), 0.5 * torch.sinc(half / torch.pi) * omega], -1), dim=-1)


def rotation_vectors(quaternions: Float[Tensor, "row 4"]) -> Float[Tensor, "row 3"]:
    """Rotation vectors of unit quaternions, of angles up to 180 degrees."""
    upright = torch.where(quaternions[:, :1] < 0, -quaternions, quaternions)
    sine = upright[:, 1:].norm(dim=-1, keepdim=True)
    return 2 * torch.atan2(sine, upright[:, :1]) * upright[:, 1:] / sine.clamp_min(1e-12)
