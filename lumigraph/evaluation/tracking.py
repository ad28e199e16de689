"""Trajectories of tracking: files, errors against known poses, a plot of the drift."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from .. import files
from ..components.tracking.frames import MIN_COMMON, order_of
from ..components.tracking.loops import DRIFTED, drift, motion
from ..components.tracking.tracker import Tracker
from ..components.tracking.trajectory import KNOWN, LOSSES, UNKNOWN
from ..datasets.scene import Scene
from ..errors import LumigraphWarning
from ..figures.charts import Series, line_chart, standalone
from ..geometry import evenly
from ..method import Method
from ..metrics import Score, psnr
from ..metrics.trajectory import Poses, TrajectoryErrors, aligned, position_errors, relative_errors, to_tum
from .held_out_poses import TRUE_POSE

MAPPED_VIEWS = 8  # held-out frames at which a map is compared
TRAJECTORY_FILE, TRUTH_FILE, ERRORS_FILE = "trajectory.txt", "truth.txt", "tracking.json"
DRIFT_FILE, PATH_FILE = "drift.svg", "path.svg"
MIN_POSES = 3  # frames that errors are measured on
MAX_STRETCHES = 3  # of lost frames that are named, the longest
MAX_ATE = 0.01  # of the path, beyond which it is called inaccurate
RETURNED_KEYFRAMES = 40  # keyframes, evenly spread, that are compared with earlier ones
MIN_RETURNS = 4  # of them with enough in common with an earlier one, for a judgement
REMEDY = "record more frames a second, or try --close-loops where the camera returns to a place"


@dataclass(frozen=True)
class Tracked:
    """Poses estimated by a method, in the source's frame.

    images:  their numbers in the scene, in the order of exposure; lost: those of frames where tracking failed
    moments: seconds, or frame numbers for a source without times
    truth:   poses of the source; None if unknown
    loops:   pairs of images between which a loop was closed
    """

    images: list[int]
    lost: list[int]
    moments: list[float]
    poses: Poses
    truth: Float[np.ndarray, "pose 3 4"] | None
    loops: list[tuple[int, int]]

    @staticmethod
    def of(method: Any, scene: Scene) -> Tracked:
        """Poses of a method with a `tracker`."""
        state, order = method.tracker.trajectory.state.cpu(), order_of(scene.cameras)
        chosen = order[state[order] == KNOWN]
        cameras = method.refined(scene.cameras[chosen]).transformed(scene.frame.to_source.matrix)
        times = scene.cameras.time
        moments = (order.argsort()[chosen] if times is None else times[chosen]).tolist()
        truth = scene.about.get(TRUE_POSE)
        known = None if truth is None else truth[chosen].double().numpy()
        poses = cameras.pose.double().cpu().numpy()
        loops = [] if method.tracker.loops is None else method.tracker.loops.pairs.tolist()
        lost = [i for i in order.tolist() if int(state[i]) in LOSSES]
        return Tracked(chosen.tolist(), lost, moments, poses, known, loops)

    @property
    def errors(self) -> TrajectoryErrors | None:
        if self.truth is None or len(self.images) < MIN_POSES:
            return None
        return TrajectoryErrors.of(self.poses, self.truth)

    @property
    def drift(self) -> str:
        """Chart of the position's error along the true path, and of the relative error; empty without truth."""
        if self.truth is None or len(self.images) < MIN_POSES:
            return ""
        away, (shift, _) = 100 * position_errors(self.poses, self.truth), relative_errors(self.poses, self.truth)
        steps = np.linalg.norm(np.diff(self.truth[:, :, 3], axis=0), axis=-1)
        path = np.concatenate([[0.0], np.cumsum(steps)]).tolist()
        curves = [
            Series("position, aligned", path, away.tolist()),
            Series("frame to frame", path[1:], (100 * shift).tolist()),
        ]
        return line_chart(curves, "metres of the path", "error, cm", smoothed=False)

    @cached_property
    def map(self) -> str:
        """Chart of the path with its loops, on the plane in which it extends most; beside the true one, if known."""
        if len(self.images) < MIN_POSES:
            return ""
        told = self.truth is not None
        found = (aligned(self.poses, self.truth) if self.truth is not None else self.poses)[:, :, 3]
        middle = found.mean(0)
        plane = np.linalg.svd(found - middle, full_matrices=False)[2][:2].T
        x, y = ((found - middle) @ plane).T
        curves = [Series("found", x.tolist(), y.tolist(), 0)]
        if self.truth is not None:
            u, v = ((self.truth[:, :, 3] - middle) @ plane).T
            curves.insert(0, Series("true", u.tolist(), v.tolist(), 1))
        number = {image: i for i, image in enumerate(self.images)}
        for first, second in self.loops:
            ends = [number[first], number[second]]
            (a, b), (c, d) = x[ends].tolist(), y[ends].tolist()
            name = "loops" if len(curves) == 1 + told else ""
            curves.append(Series(name, [a, 0.5 * (a + b), b], [c, 0.5 * (c + d), d], 2))
        return line_chart(curves, "metres", "metres", smoothed=False, equal=True)


@dataclass(frozen=True)
class Followed:
    """Frames that tracking has seen, and those that it followed. sentence: where and why others were lost, or empty"""

    frames: int
    known: int
    sentence: str

    def __str__(self) -> str:
        return f"{self.known} of {self.frames} frames ({100 * self.known / max(self.frames, 1):.0f} %)"

    @staticmethod
    def of(method: Any, scene: Scene) -> Followed:
        state, names = method.tracker.trajectory.state.tolist(), scene.names
        seen = [i for i in order_of(scene.cameras).tolist() if state[i] != UNKNOWN]
        lost = [list(some) for known, some in groupby(seen, lambda i: state[i] == KNOWN) if not known]
        found = Followed(len(seen), len(seen) - sum(map(len, lost)), "")
        if not lost:
            return found
        named = sorted(sorted(lost, key=len, reverse=True)[:MAX_STRETCHES], key=lambda x: seen.index(x[0]))
        parts = [
            f"{names[x[0]]}{f' to {names[x[-1]]}' if len(x) > 1 else ''}, where {LOSSES[state[x[0]]]}" for x in named
        ]
        more = f"; and {len(lost) - len(named)} shorter times" if len(lost) > len(named) else ""
        return replace(
            found,
            sentence=f"Tracking followed {found} and lost the camera at {'; at '.join(parts)}{more}; lost frames have "
            "no pose and are not mapped, and errors are those of the others; record more frames where it turns or "
            "moves fast, and less of plain walls",
        )


def inaccurate(found: Tracked, names: Sequence[str]) -> str:
    """Sentence for a path whose error is above MAX_ATE of its length; empty for another, or without truth."""
    errors = found.errors
    if errors is None or errors.ate <= MAX_ATE * errors.path:
        return ""
    assert found.truth is not None
    worst = names[found.images[int(position_errors(found.poses, found.truth).argmax())]]
    return (
        f"The path that was found is off by {100 * errors.ate:.2g} cm, {100 * errors.ate / errors.path:.2g} % of its "
        f"length, and by {100 * errors.largest:.2g} cm at {worst}; {REMEDY}"
    )


@torch.no_grad()
def drifted(tracker: Tracker, scene: Scene) -> str:
    """Sentence, without true poses, on keyframes whose depth contradicts that of earlier ones; empty if few do."""
    names, poses = scene.names, tracker.trajectory.poses
    chosen = evenly([i for i in tracker.sequence(scene) if tracker.is_keyframe[i]], RETURNED_KEYFRAMES)
    keyframes, found = [tracker.load_keyframe(scene, i) for i in chosen], []
    for k, frame in enumerate(keyframes):
        common = [frame.compared(x, motion(poses[x.index], poses[frame.index])).common for x in keyframes[: k // 2]]
        if max(common, default=0.0) >= MIN_COMMON:
            older = keyframes[common.index(max(common))]
            found.append((drift(frame, older, poses), names[frame.index], names[older.index]))
    if len(found) < MIN_RETURNS or (middle := sorted(found)[len(found) // 2][0]) < DRIFTED:
        return ""
    worst, seen_again, before = max(found)
    return (
        f"The path has drifted: where it returns, {100 * middle:.0f} % of a keyframe's points (median) are where an "
        f"earlier one saw nothing, and {100 * worst:.0f} % of {seen_again} beside {before}; {REMEDY}"
    )


def tracks(method: Method) -> bool:
    """True for a method that tracks poses: see `lumigraph track`."""
    tracking = getattr(method.config, "tracking", None)
    return bool(tracking is not None and tracking.track)


@torch.no_grad()
def mapping_scores(method: Any, scene: Scene) -> list[Score]:
    """PSNR and error of depth of a map, at held-out frames from the poses that were found; empty if none was found.

    The error is the mean of |depth - measured depth| along rays, where both are known.
    """
    state = method.tracker.trajectory.state.cpu()
    held_out = [i for i in scene.splits.get("test", torch.tensor([])).tolist() if state[i] == KNOWN]
    psnrs, errors = [], []
    method.eval()
    for index in evenly(held_out, MAPPED_VIEWS):
        shot = scene.photograph(index, ["depth"])
        seen, measured = method.render(method.refined(shot.camera)).cpu(), shot.extra["depth"]
        psnrs.append(psnr(seen.rgb.clamp(0, 1), shot.before(scene.frame.background)))
        error = (seen.depth - measured).abs()
        errors.append(float(error[error.isfinite()].mean()) * scene.frame.to_source.scale)
    if not psnrs:
        return []
    return [
        Score("held-out PSNR", float(np.mean(psnrs)), "dB", "higher", 2),
        Score("depth L1", 100 * float(np.mean(errors)), "cm", "lower", 2),
    ]


def write_tracking(
    run: Any, method: Method, scene: Scene, figures: dict[str, float], mapped: Sequence[Score] = ()
) -> Tracked:
    """Write RUN/trajectory.txt and, where poses are known, truth.txt, the errors and the plot of the drift.

    figures: further ones for tracking.json; mapped: scores of the map
    """
    found = Tracked.of(method, scene)
    files.write_bytes(run.folder / TRAJECTORY_FILE, to_tum(found.moments, found.poses).encode(), ours=True)
    followed = Followed.of(method, scene)
    about: dict[str, Any] = {"frames": len(scene), "known": len(found.images)} | figures
    about |= {"share": len(found.images) / len(scene), "lost": [scene.names[i] for i in found.lost]}
    tracker: Any = method.tracker
    fault = drifted(tracker, scene) if found.truth is None else inaccurate(found, scene.names)
    about["warnings"] = [sentence for sentence in (followed.sentence, fault) if sentence]
    for sentence in about["warnings"]:
        warnings.warn(sentence, LumigraphWarning, stacklevel=2)
    if found.map:
        files.write_bytes(run.folder / PATH_FILE, standalone(found.map), ours=True)
    if (errors := found.errors) is not None:
        assert found.truth is not None
        files.write_bytes(run.folder / TRUTH_FILE, to_tum(found.moments, found.truth).encode(), ours=True)
        files.write_bytes(run.folder / DRIFT_FILE, standalone(found.drift), ours=True)
    scores = [*([] if errors is None else errors.scores), *mapped]
    if scores:
        about["scores"] = [score.to_json() for score in scores]
    files.write_json(run.folder / ERRORS_FILE, about)
    return found
