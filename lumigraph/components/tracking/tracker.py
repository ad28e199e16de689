"""Tracker: the frames of a recording in order, their poses, and which of them are keyframes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Annotated, ClassVar, Literal

import torch
from torch import Tensor

from ...datasets.scene import Scene
from ...errors import LumigraphError, LumigraphWarning
from ...files.ranges import Share, between
from ...method import Part
from ..training.shared_points import resected
from .frames import MIN_AGREEMENT, MIN_COMMON, DepthFrame, Moment, order_of
from .loops import FramePlaces, Loops, motion
from .trajectory import CONTRADICTED, KNOWN, LOST, UNEXPLAINED, UNMEASURED, Pose, Trajectory, angle, relative

Iterations = Annotated[int, between(0, 10_000)]
MAX_STEP = 0.4, 0.6  # metres and radians between frames that tracking believes
SLID_ERROR = 0.85  # of the error of an aligned pose, below which the one by features is better
MIN_MATCHES = 10  # features whose points agree on a frame's pose
FAST = 0.02, 0.026  # metres and radians a frame, above which tracking begins with features
MAX_MOTION = 0.05, 0.053  # metres and radians a frame, above which a warning is given
RECENT_FRAMES, JUDGED_FRAMES = 4, 10  # whose motion decides about features, and about the warning
AGREEMENT_KEYFRAMES = 3  # latest keyframes that a frame's depth is compared with
MIN_ON_KEYFRAME = 0.35  # share of points in common with a keyframe that must be on its depth, which hides some
ALIGNMENT_POINTS = 3000  # pixels of a frame that are aligned with the map's surface
ALIGNMENT_ITERATIONS = 12  # Gauss-Newton steps of that


@dataclass(frozen=True)
class TrackingNumbers:
    """A Config's tracking numbers, shared by methods."""

    track: bool = False  # find the poses of frames in order, as `lumigraph track` does; else they are those given
    first_estimate: Literal["velocity", "surface"] = "velocity"  # first pose: by velocity, or aligned with the map
    lost_share: Share = 0.3  # share of explained pixels below which a frame is lost
    close_loops: bool = False  # recognise places by features and correct the path by a pose graph; slower


class Tracker(Part):
    """Tracks the frames of a recording one after another.

    unit:        scene units of a metre
    side:        longer side of frames in pixels, about; 0 for that of photographs
    turn:        number of tracked frames
    is_keyframe: of each image
    """

    moves_cameras: ClassVar[bool] = True
    turn: Tensor
    is_keyframe: Tensor

    def __init__(self, image_count: int, numbers: TrackingNumbers, unit: float, side: int = 0):
        super().__init__()
        self.numbers, self.unit, self.side = numbers, unit, side
        self.trajectory = Trajectory(image_count)
        self.loops, self.places = Loops(unit) if numbers.track and numbers.close_loops else None, FramePlaces()
        if self.loops is not None:
            self.loops.places = self.places
        self.register_buffer("turn", torch.tensor(0))
        self.register_buffer("is_keyframe", torch.zeros(image_count, dtype=torch.bool))
        self.overlap = 1.0  # share of the latest frame's points on the depth of a late keyframe
        self._latest: DepthFrame | None = None
        self._warned = False
        self._held: dict[int, DepthFrame] = {}  # frames of keyframes, read again where a run goes on

    def begin(self, method: object, data: Scene, seconds: float) -> None:
        if "depth" not in data.layers:
            raise LumigraphError(
                f"{data.source} has no depth, which maps of depth cameras are made of; train instant-ngp or "
                "gaussian-splatting, which need none"
            )

    def sequence(self, data: Scene) -> list[int]:
        """Images in order of exposure: all if poses are unknown, else the training ones."""
        order, learnt = order_of(data.cameras).tolist(), set(data.splits["train"].tolist())
        return order if self.numbers.track else [i for i in order if i in learnt]

    def moment(self, data: Scene) -> Moment:
        """The next frame, and the scene."""
        sequence, turn = self.sequence(data), int(self.turn)
        return Moment(data, self.frame(data, sequence[turn]) if turn < len(sequence) else None, sequence[:turn])

    def frame(self, data: Scene, index: int) -> DepthFrame:
        """Load a frame, from memory for a stored keyframe and the last known frame."""
        if self._latest is not None and self._latest.index == index:
            return self._latest
        if index not in self._held:
            like = next(iter(self._held.values()), None)
            return DepthFrame.of(data, index, self.turn.device, like, self.side)
        return self._held[index]

    def load_keyframe(self, data: Scene, index: int) -> DepthFrame:
        """Load a keyframe and store it."""
        if index not in self._held:
            self._held[index] = self.frame(data, index)
        return self._held[index]

    def add_keyframe(self, frame: DepthFrame) -> None:
        self.is_keyframe[frame.index] = True
        self.trajectory.anchor[frame.index] = frame.index
        self._held[frame.index] = frame

    @torch.no_grad()
    def close_loop(self, frame: DepthFrame, data: Scene) -> bool:
        """Search a loop for the latest keyframe, and correct the trajectory. True if one was found and kept."""
        frames = {i: self.load_keyframe(data, i) for i in self.sequence(data) if self.is_keyframe[i]}
        older, poses = [x for x in frames.values() if x.index != frame.index], self.trajectory.poses
        if self.loops is None or not self.loops.find(frame, older, poses):
            return False
        if (closed := self.loops.close(frames, poses)) is None:
            return False
        self.trajectory.place(list(frames), closed)
        return True

    @property
    def keyframes(self) -> list[int]:
        """Image numbers of keyframes, in order of exposure if their numbers are."""
        return self.is_keyframe.nonzero()[:, 0].tolist()

    def follow(
        self,
        frame: DepthFrame,
        moment: Moment,
        find: Callable[[DepthFrame, Pose], Pose],
        explained: Callable[[DepthFrame, Pose], float],
    ) -> float | None:
        """Track the next frame, initialised by constant velocity, the last known pose, then by matched features,
        which come first where the camera moves fast or was lost. Returns the share of its pixels explained by the map,
        or None if tracking is lost: it then keeps the last known pose.

        find: a frame's pose from a first estimate; explained: its share of explained pixels at a pose
        """
        trajectory, data = self.trajectory, moment.scene
        self.turn += 1
        anchor = max(self.keyframes, default=frame.index)
        if not self.numbers.track or not moment.before:
            trajectory.know(frame.index, data.cameras.pose[frame.index].to(self.turn.device), anchor)
            return 1.0
        known = [i for i in moment.before if trajectory.state[i] == KNOWN]
        last, steady = trajectory.poses[known[-1]], moment.before[-1:] == known[-1:]
        smooth = [trajectory.predicted(known[:-3:-1]), last] if steady else [last]
        shift, turn = trajectory.speed(known[-RECENT_FRAMES:])
        fast = not steady or len(known) < RECENT_FRAMES or shift > FAST[0] * self.unit or turn > FAST[1]
        limit = len(moment.before) - moment.before.index(known[-1])  # frames since the last known pose
        by_velocity = (pose for start in smooth if self.plausible(last, pose := find(frame, start), limit))
        by_features = (
            pose
            for start in self.by_features(frame, data, known[-1])
            if self.plausible(last, start, limit)
            for pose in self.closest_first(frame, [find(frame, start), start], data, known[-1])
        )
        reason = LOST if frame.measured.any() else UNMEASURED
        for pose in chain(by_features, by_velocity) if fast else chain(by_velocity, by_features):
            share = explained(frame, pose)
            if share > self.numbers.lost_share and self.agrees(frame, pose, data, known[-1]):
                trajectory.know(frame.index, pose, anchor)
                self._latest = frame
                self.places.keep([*self.keyframes, frame.index])
                self.warn_of_speed([*known, frame.index])
                return share
            if reason != UNMEASURED:
                reason = CONTRADICTED if share > self.numbers.lost_share else UNEXPLAINED
        trajectory.lose(frame.index, last, reason)
        return None

    def by_features(self, frame: DepthFrame, data: Scene, last: int) -> Iterator[Pose]:
        """Poses by features matched with the latest keyframe and the last known frame, then with keyframes that look
        alike."""
        older = self.keyframes

        def matches(others: Iterable[DepthFrame]) -> Iterator[tuple[Tensor, Tensor]]:
            for other in others:
                points, bearings = self.places.of(other).matched_points(self.places.of(frame))
                pose = self.trajectory.poses[other.index].cpu()
                yield points @ pose[:, :3].T + pose[:, 3], bearings

        def groups() -> Iterator[Iterable[DepthFrame]]:
            yield (self.frame(data, i) for i in dict.fromkeys([*older[-1:], last]))
            yield from (
                [x] for x in self.places.alike(frame, [self.load_keyframe(data, i) for i in older[:-1] if i != last])
            )

        for group in groups():
            points, bearings = (torch.cat(x) for x in zip(*matches(group), strict=True))
            if (found := resected(points, bearings, MIN_MATCHES)) is not None:
                yield found.to(self.trajectory.poses)

    def closest_first(self, frame: DepthFrame, poses: list[Pose], data: Scene, last: int) -> list[Pose]:
        """A pose aligned with the map and the one by features; the latter first where its error against the last known
        frame and the latest keyframe is clearly smaller: before a bare wall a map lets a pose slide."""
        others = [self.frame(data, i) for i in dict.fromkeys([last, *self.keyframes[-1:]])]
        at = {x.index: self.trajectory.poses[x.index] for x in others}
        aligned, own = (sum(frame.compared(x, motion(at[x.index], p)).error for x in others) for p in poses)
        return poses if own >= SLID_ERROR * aligned else poses[::-1]

    @torch.no_grad()
    def agrees(self, frame: DepthFrame, pose: Pose, data: Scene, last: int) -> bool:
        """True if measured points of a frame lie on the depth of the last known frame, and are not in front of that of
        the keyframe with most points in common: no error of the map can spoil these. Also where they share too little.
        Stores the largest share of points that lie on a late keyframe's depth."""
        latest = [self.frame(data, last), *(self.load_keyframe(data, i) for i in self.keyframes[-AGREEMENT_KEYFRAMES:])]
        steady, *keyframes = (frame.compared(x, motion(self.trajectory.poses[x.index], pose)) for x in latest)
        self.overlap = max((x.near for x in keyframes), default=1.0)
        most = max(keyframes, key=lambda x: x.common, default=steady)
        on_it = most.near > MIN_ON_KEYFRAME * most.common and most.near > MIN_AGREEMENT * (most.near + most.front)
        return (steady.common < MIN_COMMON or steady.agrees) and (most.common < MIN_COMMON or on_it)

    def warn_of_speed(self, known: list[int]) -> None:
        """Warn once, of motion beyond the range of tracking in ten frames."""
        shift, turn = self.trajectory.speed(known[-JUDGED_FRAMES:])
        fast = shift > MAX_MOTION[0] * self.unit or turn > MAX_MOTION[1]
        if self._warned or len(known) < JUDGED_FRAMES or not fast:
            return
        self._warned = True
        warnings.warn(
            f"The camera moves by {100 * shift / self.unit:.2g} cm and {math.degrees(turn):.2g} degrees a frame "
            f"(median of {JUDGED_FRAMES}), where tracking is made for {100 * MAX_MOTION[0]:.0f} cm and "
            f"{math.degrees(MAX_MOTION[1]):.0f} degrees; record more frames, or move more slowly, if some are lost",
            LumigraphWarning,
            stacklevel=2,
        )

    def plausible(self, last: Pose, pose: Pose, frames: int) -> bool:
        """True for a motion plausible for a hand-held camera within so many frames."""
        turn, shift = relative(last, pose)
        return float(shift.norm()) < frames * MAX_STEP[0] * self.unit and float(angle(turn)) < frames * MAX_STEP[1]
