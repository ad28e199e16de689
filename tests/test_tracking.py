"""Trajectories, their errors and files, recordings without poses, and alignment of a frame with a surface."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from budgets import budget

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.components.tracking.alignment import aligned
from lumigraph.components.tracking.frames import DepthFrame, Moment
from lumigraph.components.tracking.loops import KeyframePlace, Loops, motion
from lumigraph.components.tracking.tracker import Tracker, TrackingNumbers
from lumigraph.components.tracking.trajectory import (
    CONTRADICTED,
    KNOWN,
    LOST,
    Trajectory,
    apply_twists,
    relative,
    rigid,
)
from lumigraph.components.training.shared_points import Seen, resected
from lumigraph.datasets.scene import Scene
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.tracking import Followed, Tracked, drifted
from lumigraph.metrics.trajectory import TrajectoryErrors, position_errors, relative_errors, to_tum
from lumigraph.readers.capture import Capture, PixelPlane, Shot
from lumigraph.readers.unposed import Unposed
from lumigraph.readers.unposed import unposed as without_poses

pytestmark = budget("methods", 6)


def walk(count: int = 20, seed: int = 0) -> np.ndarray:
    """Poses on a crooked path."""
    random = torch.Generator().manual_seed(seed)
    steps = 0.1 * torch.randn(count, 6, generator=random).double()
    pose, poses = torch.eye(3, 4, dtype=torch.float64)[None], []
    for step in steps:
        pose = apply_twists(pose, step[None])
        poses.append(pose[0])
    return torch.stack(poses).numpy()


def under(poses: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    return np.concatenate([rotation @ poses[:, :, :3], (poses[:, :, 3] @ rotation.T + shift)[:, :, None]], -1)


def test_errors_ignore_the_frame_of_the_world():
    truth = walk()
    turn = apply_twists(torch.eye(3, 4, dtype=torch.float64)[None], torch.tensor([[0.4, -0.7, 1.1, 0, 0, 0]]).double())
    there = under(truth, turn[0, :, :3].numpy(), np.array([3.0, -2.0, 1.0]))
    found = TrajectoryErrors.of(there, truth)
    assert found.ate < 1e-12 and found.rpe < 1e-12 and found.rpe_degrees < 1e-5
    assert found.path == pytest.approx(np.linalg.norm(np.diff(truth[:, :, 3], axis=0), axis=-1).sum())


def test_a_wrong_scale_is_an_error():
    """Umeyama's alignment without scale: positions of twice the size are off by their distance from the middle."""
    truth = walk()
    double = truth.copy()
    double[:, :, 3] *= 2
    away = truth[:, :, 3] - truth[:, :, 3].mean(0)
    np.testing.assert_allclose(position_errors(double, truth), np.linalg.norm(away, axis=-1), atol=1e-9)


def test_the_relative_error_is_of_motions_not_of_places():
    """One step of 3 cm and 2 degrees too much in the middle of a path: one pair is wrong, all others are right."""
    truth = walk()
    found, extra = truth.copy(), np.eye(4)
    angle = math.radians(2)
    extra[:3, :3] = [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    extra[2, 3] = 0.03
    for i in range(10, 20):  # all later poses: Q_9 E Q_9^-1 Q_i
        a, b = (np.vstack([truth[k], [0, 0, 0, 1]]) for k in (9, i))
        found[i] = (a @ extra @ np.linalg.inv(a) @ b)[:3]
    shift, turn = relative_errors(found, truth)
    assert (shift > 1e-9).sum() == 1 and turn[9] == pytest.approx(2) and turn.max() == turn[9]


def test_a_line_of_tum_is_moment_position_quaternion():
    pose = np.array([[[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]])  # a quarter turn about z
    comment, line = to_tum([1.5], pose).splitlines()
    assert comment.startswith("#")
    numbers = [float(x) for x in line.split()]
    assert numbers[:4] == [1.5, 1, 2, 3]
    assert np.abs(numbers[4:]) == pytest.approx([0, 0, math.sqrt(0.5), math.sqrt(0.5)]) and numbers[6] * numbers[7] > 0


def test_frames_move_along_with_their_keyframe():
    trajectory = Trajectory(4)
    poses = torch.from_numpy(walk(4)).float()
    for i, anchor in enumerate((0, 0, 2, 2)):
        trajectory.know(i, poses[i], anchor)
    before = [relative(trajectory.poses[a], trajectory.poses[b]) for a, b in ((0, 1), (2, 3))]
    others = trajectory.poses[:2].clone()
    trajectory.correct(torch.tensor([2]), torch.tensor([[0.1, 0, -0.2, 0.3, 0.1, 0]]))
    after = [relative(trajectory.poses[a], trajectory.poses[b]) for a, b in ((0, 1), (2, 3))]
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)
    assert torch.equal(trajectory.poses[:2], others) and not torch.allclose(trajectory.poses[2], poses[2], atol=0.1)


def test_velocity_is_constant():
    trajectory, step = Trajectory(3), torch.tensor([[0.02, -0.01, 0.03, 0.1, 0.0, 0.05]])
    first = rigid(torch.from_numpy(walk(1)).float())
    trajectory.know(0, first[0], 0)
    trajectory.know(1, apply_twists(first, step)[0], 0)
    guess = trajectory.predicted([1, 0])
    turn, shift = relative(trajectory.poses[0], trajectory.poses[1])
    again, further = relative(trajectory.poses[1], guess)
    torch.testing.assert_close((again, further), (turn, shift), atol=1e-5, rtol=0)
    trajectory.lose(1, trajectory.poses[0])
    assert torch.equal(trajectory.predicted([1, 0]), trajectory.poses[1])
    assert trajectory.state.tolist() == [KNOWN, LOST, 0]


@pytest.mark.parametrize("colours", [0.0, 0.05])
def test_alignment_finds_the_motion(colours):
    """A corner of three planes, whose colours vary: rotation and shift are found from points on it. With two planes
    alone, colours find the shift along both. The prior holds so large a motion back by 0.0046 and 0.0023."""
    chance = torch.Generator().manual_seed(0)
    points = torch.rand(3000, 3, generator=chance)
    planes = 2 if colours else 3
    points[torch.arange(3000), torch.arange(3000) % planes] = 0.0

    def field(at):
        outside = at[:, :planes]
        wave = (5 * at).sin().mean(-1)
        return outside.amin(-1) / 0.3, 0.5 + 0.4 * wave[:, None].expand(-1, 3)

    truth = rigid(apply_twists(torch.eye(3, 4)[None], torch.tensor([[0.03, -0.05, 0.02, 0.04, -0.03, 0.02]])))[0]
    rgb = field(points)[1] * 0.8 + 0.05  # another exposure
    local = (points - truth[:, 3]) @ truth[:, :3]
    found = aligned(field, torch.eye(3, 4), local, rgb, torch.full((3000,), 0.03), colours, 100.0, 25)
    turn, shift = relative(truth, found.pose)
    assert shift.norm() < 2.5e-3 and (turn - torch.eye(3)).norm() < 5e-3 and found.share > 0.99


def corner(count: int, seed: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) + torch.tensor([-0.5, -0.5, 1.5])


def place(points: torch.Tensor, pose: torch.Tensor, descriptors: torch.Tensor) -> KeyframePlace:
    """Points of the world as features of a camera at a pose."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    bearings = torch.nn.functional.normalize(local, dim=-1)
    return KeyframePlace(Seen(bearings, descriptors), local, torch.zeros(4))


def test_a_place_is_recognised_by_a_motion_that_its_points_agree_on():
    """A third of the points are wrong. The motion is exact; two places of other things have none."""
    chance = torch.Generator().manual_seed(0)
    points = corner(90, 1)
    descriptors = torch.nn.functional.normalize(torch.randn(90, 128, generator=chance), dim=-1)
    first, second = (torch.from_numpy(pose).float() for pose in walk(9)[[0, 8]])
    one, other = place(points, first, descriptors), place(points, second, descriptors)
    one.points[:20] += 0.3
    one.points[20:30] = torch.nan
    found = resected(*one.matched_points(other), 25)
    assert found is not None
    torch.testing.assert_close(found, motion(first, second), atol=1e-4, rtol=0)
    assert resected(*one.matched_points(place(corner(90, 2), second, descriptors)), 25) is None


@pytest.mark.parametrize("metres", [0.0, 0.1, 0.25])
def test_depth_of_few_levels_is_as_uncertain_as_their_distance(metres):
    """Levels 10 or 25 cm apart, as of eight bits or less; and depth of millimetres, whose deviation is a sensor's."""
    pose = steps(1, (0.0,) * 6)[0]
    exact = in_room(0, pose)
    axis = exact.rays.directions[:, 2]
    step = metres or 0.001
    frame = replace(exact, depth=(exact.depth * axis / step).round() * step / axis)
    if metres:
        assert float((frame.step / metres - 1).abs().quantile(0.9)) < 0.01
        assert float(frame.deviation.median()) == pytest.approx(max(metres / 12**0.5, 0.01), rel=0.05)
    else:
        assert not frame.step.any() and float(frame.deviation.max()) < 0.03
    moved = torch.cat([pose[:, :3], pose[:, 3:] + torch.tensor([[0.05], [0.0], [0.02]])], 1)
    other = in_room(1, moved)
    assert frame.compared(other, motion(moved, pose)).agrees


@pytest.mark.parametrize("lost", [[], [3], [2, 3, 7]])
def test_where_the_camera_was_lost_is_said(lost):
    state = torch.full((10,), KNOWN)
    state[lost] = CONTRADICTED
    state[9] = 0  # not tracked yet
    method = SimpleNamespace(tracker=SimpleNamespace(trajectory=SimpleNamespace(state=state)))
    lens = Pinhole(torch.ones(10, 2), torch.ones(10, 2))
    cameras = Camera(torch.eye(3, 4).repeat(10, 1, 1), lens, SIZE.repeat(10, 1))
    found = Followed.of(method, Mock(spec=Scene, cameras=cameras, names=[f"f{i}" for i in range(10)]))
    assert str(found) == f"{9 - len(lost)} of 9 frames ({100 * (9 - len(lost)) / 9:.0f} %)"
    places = {0: "", 1: "at f3, where its depth contradicts", 3: "at f2 to f3, where its depth contradicts"}
    assert places[len(lost)] in found.sentence and bool(found.sentence) == bool(lost)


def test_a_loop_spreads_the_drift():
    """Twenty poses around a circle, each step turned and shifted a little too far. One loop from the last to the first
    brings the largest error down to a part of the drift, and a wrong loop beside it does little harm."""
    angle = torch.arange(20) * (2 * math.pi / 20)
    turn = apply_twists(
        torch.eye(3, 4).repeat(20, 1, 1), torch.stack([0 * angle, -angle, 0 * angle, *3 * [0 * angle]], -1)
    )
    truth = torch.cat([turn[:, :, :3], torch.stack([angle.cos(), 0 * angle, angle.sin()], -1)[:, :, None]], -1)
    drifted = [truth[0]]
    for i in range(19):
        step = apply_twists(motion(truth[i], truth[i + 1])[None], torch.tensor([[0.0, 0.01, 0, 0.01, 0.005, 0]]))[0]
        last = drifted[-1]
        drifted.append(torch.cat([last[:, :3] @ step[:, :3], (last[:, :3] @ step[:, 3] + last[:, 3])[:, None]], -1))
    poses, loops = torch.stack(drifted), Loops(1.0)
    loops.pairs, loops.motions = torch.tensor([[0, 38]]), motion(truth[0], truth[19])[None]
    images = list(range(0, 40, 2))
    found = loops.closed(images, poses)
    before, after = (float((x[:, :, 3] - truth[:, :, 3]).norm(dim=-1).max()) for x in (poses, found))
    assert before > 0.2 and after < 0.4 * before and torch.equal(found[0], poses[0])
    loops.pairs = torch.cat([loops.pairs, torch.tensor([[10, 30]])])
    loops.motions = torch.cat([loops.motions, torch.eye(3, 4)[None]])
    wrong = loops.closed(images, poses)
    assert float((wrong[:, :, 3] - truth[:, :, 3]).norm(dim=-1).max()) < 0.6 * before


ROOM = 1.5  # metres from its middle to its walls


def in_room(index: int, pose: torch.Tensor, blank: bool = False) -> DepthFrame:
    """A frame inside a cube whose walls have squares of random grey."""
    camera = Camera(torch.eye(3, 4)[None], Pinhole(torch.tensor([[150.0, 150.0]]), torch.tensor([[80.0, 60.0]])), SIZE)
    rays = camera.rays(camera.pixels())
    towards = rays.directions @ pose[:, :3].T
    depth = ((ROOM * towards.sign() - pose[:, 3]) / towards).amin(-1)
    cell = ((pose[:, 3] + depth[:, None] * towards) / 0.13 + 0.01).floor()
    grey = (torch.sin(cell @ torch.tensor([12.9898, 78.233, 37.719])) * 43758.5).frac().abs() * (not blank)
    return DepthFrame(index, camera, rays, grey[:, None].repeat(1, 3), depth, None, (160, 120))


SIZE = torch.tensor([[160, 120]])


def steps(count: int, motion: tuple[float, ...]) -> list[torch.Tensor]:
    pose = rigid(apply_twists(torch.eye(3, 4)[None], torch.tensor([[0.2, 0.5, 0.1, 0, 0, 0]])))
    poses = [pose[0]]
    for _ in range(count - 1):
        pose = rigid(apply_twists(pose, torch.tensor([motion])))
        poses.append(pose[0])
    return poses


def tracker_of(frames: list[DepthFrame], first: torch.Tensor) -> tuple[Tracker, Scene]:
    """A tracker with these frames in memory, and the scene that knows the first pose alone."""
    tracker = Tracker(len(frames), TrackingNumbers(track=True), 1.0)
    tracker._held = {frame.index: frame for frame in frames}
    return tracker, Mock(spec=Scene, cameras=SimpleNamespace(pose=first.repeat(len(frames), 1, 1)))


def test_a_pose_is_checked_by_the_depth_of_keyframes():
    first, second, aside = *steps(2, (0.03, 0.05, 0, 0.05, 0, 0.04)), steps(2, (0, 2.0, 0, 0, 0, 0))[1]
    frames = [in_room(0, first), in_room(1, second), in_room(2, aside), in_room(3, second)]
    frames[1].depth[::3] = torch.nan
    tracker, scene = tracker_of(frames, first)
    tracker.trajectory.know(0, first, 0)
    tracker.add_keyframe(frames[0])
    assert tracker.agrees(frames[1], second, scene, 0) and tracker.overlap > 0.7
    wrong = torch.cat([second[:, :3], second[:, 3:] + 0.15], 1)
    assert not tracker.agrees(frames[1], wrong, scene, 0)
    assert tracker.agrees(frames[2], aside, scene, 0) and tracker.overlap < 0.3  # nothing in common is no fault
    tracker.trajectory.know(1, wrong, 0)  # a drift that the last frame shares
    assert not tracker.agrees(replace(frames[1], index=3), wrong, scene, 1)


def test_a_pose_that_slid_along_a_wall_comes_second():
    """Depth of a wall does not determine the shift along it; colours beside the last frame do."""
    first, second = steps(2, (0.0, 0.02, 0.0, 0.04, 0.01, 0.0))
    frames = [in_room(0, first), in_room(1, second)]
    tracker, scene = tracker_of(frames, first)
    tracker.trajectory.know(0, first, 0)
    slid = torch.cat([second[:, :3], second[:, 3:] + 0.06 * second[:, :1]], 1)
    for poses in ([slid, second], [second, slid]):
        assert tracker.closest_first(frames[1], poses, scene, 0)[0] is second


def test_a_loop_is_found_where_the_path_says_so():
    """Two keyframes of one place whose thumbnails differ, with eleven of another place between them."""
    here, beside = steps(2, (0.03, 0.05, 0, 0.05, 0, 0.04))
    away = steps(2, (0, 2.0, 0, 0, 0, 0))[1]
    frames = [in_room(0, here), *(in_room(i, away) for i in range(1, 12)), in_room(12, beside)]
    loops, poses = Loops(1.0), torch.stack([here, *[away] * 11, beside])
    loops.places.alike = lambda frame, others: []  # type: ignore[method-assign]
    off = torch.cat([beside[:, :3], beside[:, 3:] + 0.1], 1)  # a drift
    assert loops.find(frames[12], frames[:12], torch.cat([poses[:12], off[None]]))
    assert loops.pairs.tolist() == [[0, 12]]
    torch.testing.assert_close(loops.motions[0], motion(here, beside), atol=0.02, rtol=0)


def test_a_loop_that_does_not_help_is_refused():
    """The same keyframes where the path has not drifted; and where it has, but poses of the pose graph fit worse: the
    path stays, and the loop is forgotten."""
    here, beside = steps(2, (0.03, 0.05, 0, 0.05, 0, 0.04))
    away = steps(2, (0, 2.0, 0, 0, 0, 0))[1]
    frames = [in_room(0, here), *(in_room(i, away) for i in range(1, 12)), in_room(12, beside)]
    loops, poses = Loops(1.0), torch.stack([here, *[away] * 11, beside])
    loops.places.alike = lambda frame, others: []  # type: ignore[method-assign]
    assert not loops.find(frames[12], frames[:12], poses)
    drifted = poses.clone()
    drifted[:, :, 3] += 0.1 * torch.arange(13)[:, None] / 12
    held = {frame.index: frame for frame in frames}
    assert loops.find(frames[12], frames[:12], drifted)
    closed = loops.close(held, drifted)
    assert closed is not None and float((closed - poses)[12, :, 3].norm()) < 0.06 and len(loops.pairs) == 1
    assert loops.find(frames[12], frames[:12], drifted) and len(loops.pairs) == 2
    loops.closed = lambda keyframes, p: p + torch.arange(13)[:, None, None] * 0.1  # type: ignore[method-assign]
    assert loops.close(held, drifted) is None and len(loops.pairs) == len(loops.motions) == 1


def test_features_find_a_fast_camera_that_the_map_does_not():
    """10 cm and 5 degrees a frame, and a map that accepts and spoils all poses: each frame is found to 2 cm. A frame
    without features is lost and has no pose; the next one is found again."""
    poses = steps(5, (0.05, 0.06, 0.02, 0.08, 0.02, -0.05))
    frames = [in_room(i, pose, blank=i == 2) for i, pose in enumerate(poses)]
    tracker, scene = tracker_of(frames, poses[0])
    off = torch.cat([torch.zeros(3, 3), torch.full((3, 1), 0.4)], 1)
    for i, frame in enumerate(frames):
        moment = Moment(scene, frame, list(range(i)))
        share = tracker.follow(frame, moment, lambda seen, pose: pose + off, lambda seen, pose: 1.0)
        tracker.add_keyframe(frame) if i == 0 else None
        assert (share is None) == (i == 2)
    apart = (tracker.trajectory.poses[:, :, 3] - torch.stack(poses)[:, :, 3]).norm(dim=-1)
    assert float(apart[[0, 1, 3, 4]].max()) < 0.02 and tracker.trajectory.state[2] == LOST


@pytest.mark.parametrize("metres", [0.01, 0.07])
def test_fast_motion_is_said_once(metres):
    poses = steps(12, (0.0, 0.0, 0.0, metres, 0.0, 0.0))
    tracker, _ = tracker_of([], poses[0])
    tracker.trajectory = Trajectory(12)
    for i, pose in enumerate(poses):
        tracker.trajectory.know(i, pose, 0)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for count in range(1, 12):
            tracker.warn_of_speed(list(range(count)))
    assert [str(x.message)[:38] for x in said] == ["The camera moves by 7 cm and 0 degrees"] * (metres > 0.05)


@pytest.mark.parametrize("metres", [0.0, 0.01, 0.15])
def test_a_drift_is_said_without_true_poses(metres):
    """Ten keyframes before a wall, ten that turn around, ten before the wall again, whose poses are off: by 15 cm along
    its normal the path contradicts itself, by one it is within the sensor's error."""
    there = steps(10, (0.0, 0.02, 0.0, 0.02, 0.0, 0.0))
    poses = torch.stack([*there, *steps(10, (0.0, 0.6, 0.0, 0.0, 0.0, 0.0)), *there])
    frames = [in_room(i, pose) for i, pose in enumerate(poses)]
    tracker, scene = tracker_of(frames, poses[0])
    poses[20:, :, 3] -= metres * poses[20:, :, 2]
    for frame, pose in zip(frames, poses, strict=True):
        tracker.trajectory.know(frame.index, pose, frame.index)
        tracker.add_keyframe(frame)
    scene.names, tracker.sequence = [f"f{i}" for i in range(30)], lambda data: list(range(30))  # type: ignore[method-assign]
    said = drifted(tracker, scene)
    assert said.startswith("The path has drifted") == bool(said) == (metres > 0.1)


def test_a_path_is_drawn_to_one_scale_with_its_loops():
    circle = torch.arange(20) * (2 * math.pi / 20)
    poses = np.concatenate(
        [np.eye(3)[None].repeat(20, 0), np.stack([circle.cos(), circle * 0, circle.sin()], -1)[:, :, None]], -1
    )
    drawn = Tracked(list(range(20)), [], list(range(20)), poses, poses, [(0, 19), (3, 12)]).map
    assert drawn.count("<path class='bold") == 4 and drawn.count(">loops<") == 1
    places = np.array(
        [[float(x) for x in pair.split()] for pair in drawn.split("bold c0' d='M")[1].split("'")[0].split("L")]
    )
    across, down = np.ptp(places, axis=0)
    assert across == pytest.approx(down, rel=0.02)


def recording(depth: np.ndarray | None) -> Capture:
    lens, poses = Pinhole(torch.tensor([[20.0, 20.0]]), torch.tensor([[8.0, 6.0]])), walk(12)
    planes = {} if depth is None else {"depth": PixelPlane(depth, "z-depth", 1e-3, unknown=(0,))}
    picture = np.zeros((12, 16, 3), np.uint8)
    return Capture(
        "a recording", [Shot(f"{i}", p, lens, (16, 12), picture, planes=planes) for i, p in enumerate(poses)]
    )


def test_a_recording_without_poses_begins_at_the_first():
    depth = np.full((12, 16), 2000, np.uint16)
    depth[0] = 0
    found = without_poses(recording(depth), Unposed())
    assert all((shot.pose == found.shots[0].pose).all() for shot in found.shots) and found.shots[0].split == "train"
    np.testing.assert_allclose(found.shots[5].about["true_pose"], walk(12)[5], atol=1e-9)
    assert found.bounds is not None
    low, high = np.array(found.bounds)
    np.testing.assert_allclose(high - low, 2 * 1.5 * 2.0)
    np.testing.assert_allclose(0.5 * (low + high), walk(12)[0, :, 3])
    assert len(without_poses(recording(depth), Unposed(frames=5, extent=3.0)).shots) == 5


@pytest.mark.parametrize(("depth", "told"), [(None, "no depth"), (1, "millimetres"), (0, "measured no depth")])
def test_faults_of_a_recording_are_told(depth, told):
    plane = None if depth is None else np.full((12, 16), 2_000_000 * depth, np.uint32)
    with pytest.raises(LumigraphError, match=told):
        without_poses(recording(plane), Unposed())


def test_some_frames_without_depth_are_named():
    capture = recording(np.full((12, 16), 2000, np.uint16))
    shots = [*capture.shots[:3], replace(capture.shots[3], planes={}), *capture.shots[4:]]
    with pytest.raises(LumigraphError, match="no depth for 3"):
        without_poses(replace(capture, shots=shots), Unposed())
