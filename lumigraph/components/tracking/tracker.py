"""Tracker: the frames of a recording in order, their poses, and which of them are keyframes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor

from ...datasets.scene import Scene
from ...errors import LumigraphError
from ...files.ranges import Share, between
from ...method import Part
from .frames import DepthFrame, Moment, order_of
from .loops import Loops
from .trajectory import KNOWN, Pose, Trajectory, relative

Iterations = Annotated[int, between(0, 10_000)]
MAX_STEP = 0.3, 0.35  # metres and radians between frames that tracking believes
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
        self.loops = Loops(unit) if numbers.track and numbers.close_loops else None
        self.register_buffer("turn", torch.tensor(0))
        self.register_buffer("is_keyframe", torch.zeros(image_count, dtype=torch.bool))
        self._held: dict[int, DepthFrame] = {}  # frames of keyframes, read again where a run goes on

    def begin(self, method: Any, data: Scene, seconds: float) -> None:
        if self.numbers.track and "depth" not in data.layers:
            raise LumigraphError(
                f"{data.source} has no depth, which tracking needs; train with the poses of its photographs"
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
        """Load a frame, from memory for a stored keyframe."""
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
    def close_loop(self, frame: DepthFrame, data: Scene, chance: torch.Generator) -> bool:
        """Search a loop for the latest keyframe, and correct the trajectory. True if one was found."""
        keyframes = [i for i in self.sequence(data) if self.is_keyframe[i]]
        older = [self.load_keyframe(data, i) for i in keyframes if i != frame.index]
        if self.loops is None or not self.loops.find(frame, older, chance):
            return False
        self.trajectory.place(keyframes, self.loops.closed(keyframes, self.trajectory.poses[keyframes]))
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
        """Track the next frame, initialised by constant velocity, then by the last known pose. Returns the share of its
        pixels explained by the map, or None if tracking is lost: it then keeps the last known pose.

        find: a frame's pose from a first estimate; explained: its share of explained pixels at a pose
        """
        trajectory = self.trajectory
        self.turn += 1
        anchor = max(self.keyframes, default=frame.index)
        if not self.numbers.track or not moment.before:
            trajectory.know(frame.index, moment.scene.cameras.pose[frame.index].to(self.turn.device), anchor)
            return 1.0
        known = [i for i in moment.before if trajectory.state[i] == KNOWN][::-1]
        last = trajectory.poses[known[0]]
        steady = moment.before[-1:] == known[:1]
        for start in [trajectory.predicted(known[:2]), last] if steady else [last]:
            pose = find(frame, start)
            share = explained(frame, pose)
            if share > self.numbers.lost_share and self.plausible(last, pose):
                trajectory.know(frame.index, pose, anchor)
                return share
        trajectory.lose(frame.index, last)
        return None

    def plausible(self, last: Pose, pose: Pose) -> bool:
        """True for a motion plausible for a hand-held camera between two frames."""
        turn, shift = relative(last, pose)
        angle = torch.arccos(((turn.trace() - 1) / 2).clamp(-1, 1))
        return float(shift.norm()) < MAX_STEP[0] * self.unit and float(angle) < MAX_STEP[1]
