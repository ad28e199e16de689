"""A path that drifts: what is said without true poses, and what closing loops does to it.

    python benchmarks/drift.py RECORDING [--every 5] [--side 160]

RECORDING has depth and poses, as for `lumigraph track`. Every fifth frame is a keyframe at its true pose, but for an
error of each motion from one to the next: normal, and half as much again in one direction. Nothing is mapped.
Written for each size of the error: ATE, the sentence, and ATE and loops after they were closed.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from lumigraph.commands.track import tracked_downscale
from lumigraph.components.tracking.frames import DepthFrame
from lumigraph.components.tracking.loops import motion
from lumigraph.components.tracking.tracker import Tracker, TrackingNumbers
from lumigraph.components.tracking.trajectory import apply_twists, moved, relative, rigid
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.held_out_poses import TRUE_POSE
from lumigraph.evaluation.tracking import drifted
from lumigraph.metrics.trajectory import TrajectoryErrors
from lumigraph.opening import open_scene

DRIFTS = (0.0, 0.0), (0.0004, 0.002), (0.001, 0.004), (0.002, 0.008)  # radians and metres a keyframe


def true_poses(data: Scene) -> Tensor:
    """Poses of the recording, scene units, from the first camera of the scene on."""
    truth, unit = data.about[TRUE_POSE].double(), 1 / data.frame.to_source.scale
    steps = [relative(truth[0], pose) for pose in truth]
    first = data.cameras.pose[0].double()
    return torch.stack([moved(first, turn, unit * shift) for turn, shift in steps])


def drifting(truth: Tensor, turn: float, shift: float, seed: int) -> Tensor:
    """Poses with an error of each motion. turn: radians; shift: scene units"""
    chance, size = torch.Generator().manual_seed(seed), torch.tensor([turn] * 3 + [shift] * 3).double()
    along, found = 0.5 * size * torch.randn(6, generator=chance), [truth[0]]
    for first, second in zip(truth[:-1], truth[1:], strict=True):
        error = size * torch.randn(6, generator=chance) + along
        step = apply_twists(motion(first, second)[None], error[None])[0]
        found.append(moved(found[-1], step[:, :3], step[:, 3]))
    return rigid(torch.stack(found)).float()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recording")
    parser.add_argument("--every", type=int, default=5, help="frames from one keyframe to the next")
    parser.add_argument("--side", type=int, default=160, help="longer side of frames, pixels")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    data = open_scene(given.recording, unposed={}, downscale=tracked_downscale(given.recording, None))
    unit = 1 / data.frame.to_source.scale
    truth = true_poses(data)[:: given.every]
    images, places = range(0, len(data), given.every), None
    held: dict[int, DepthFrame] = {}
    for turn, shift in DRIFTS:
        tracker = Tracker(len(data), TrackingNumbers(track=True, close_loops=True), unit, given.side)
        assert tracker.loops is not None
        tracker._held, tracker.loops.places = held, places or tracker.loops.places  # read and described once
        places, poses = tracker.loops.places, drifting(truth, turn, shift * unit, given.seed)
        for image, pose in zip(images, poses, strict=True):
            tracker.trajectory.know(image, pose, image)
            tracker.add_keyframe(tracker.frame(data, image))
        said = drifted(tracker, data) or "nothing is said"
        tracker.is_keyframe.fill_(False)
        for k, image in enumerate(images):
            if k:
                step = motion(poses[k - 1], poses[k])
                before = tracker.trajectory.poses[images[k - 1]]
                tracker.trajectory.know(image, moved(before, step[:, :3], step[:, 3]), image)
            tracker.add_keyframe(tracker.frame(data, image))
            tracker.close_loop(tracker.frame(data, image), data)
        paths = poses, tracker.trajectory.poses[list(images)]
        errors = [100 * TrajectoryErrors.of(x.double().numpy(), truth.numpy()).ate / unit for x in paths]
        loops = f"{len(tracker.loops.pairs)} loops closed"
        print(f"{1000 * shift:.0f} mm a keyframe: ATE {errors[0]:.2f} cm, {said}; {errors[1]:.2f} cm, {loops}")


if __name__ == "__main__":
    main()
