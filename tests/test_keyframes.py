"""Paths that a person made: through every keyframe in time, smooth, saved and read again, nonsense refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch
from budgets import budget

from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError
from lumigraph.files import write_json
from lumigraph.geometry import to_matrix
from lumigraph.paths.keyframes import CameraPath, Keyframe

pytestmark = budget("exports")


def double(values: list[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.double)


def keyframe(pose: torch.Tensor, fov: float, seconds: float) -> Keyframe:
    return Keyframe(tuple(map(tuple, pose.tolist())), fov, seconds)


def random_path(loop: bool = False, count: int = 6, seed: int = 0, **about) -> CameraPath:
    """Keyframes anywhere, at uneven times, on whole frames of 30 per second."""
    generator = torch.Generator().manual_seed(seed)
    rotation = to_matrix(torch.randn(count, 4, generator=generator, dtype=torch.double))
    position = torch.randn(count, 3, 1, generator=generator, dtype=torch.double)
    fov = 30 + 60 * torch.rand(count, generator=generator)
    seconds = torch.randint(5, 60, (count,), generator=generator).cumsum(0) / 30
    poses = torch.cat([rotation, position], -1)
    keys = [keyframe(p, f, t) for p, f, t in zip(poses, fov.tolist(), seconds.tolist(), strict=True)]
    return CameraPath(tuple(keys), loop, **about)


def similarity(scale: float = 2.5) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.double)
    matrix[:3, :3] = scale * to_matrix(torch.tensor([[0.3, -0.5, 0.7, 0.2]], dtype=torch.double))[0]
    matrix[:3, 3] = torch.tensor([1.0, -2.0, 0.5])
    return matrix


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_passes_its_keyframes_when_it_should(loop, count):
    path = random_path(loop, count)
    pose, fov = path.at(torch.tensor([key.seconds for key in path.keyframes]))
    wanted = torch.tensor([key.pose for key in path.keyframes], dtype=torch.double)
    torch.testing.assert_close(pose, wanted, atol=1e-9, rtol=0)
    torch.testing.assert_close(fov, torch.tensor([key.fov for key in path.keyframes], dtype=torch.double))


@pytest.mark.parametrize("loop", [False, True])
def test_neither_the_camera_nor_its_velocity_jumps(loop):
    path = random_path(loop)
    begin, step = path.keyframes[0].seconds, 1e-4

    def velocity(at: torch.Tensor) -> torch.Tensor:
        (before, wide), (after, wider) = path.at(at - step / 2), path.at(at + step / 2)
        return torch.cat([(after - before).flatten(1), (wider - wide)[:, None]], -1) / step

    knots = double([key.seconds for key in path.keyframes[1:-1]])
    if loop:
        knots = torch.cat([knots, double([path.keyframes[-1].seconds])])
    jump = (velocity(knots + step) - velocity(knots - step)).norm(dim=-1)
    assert jump.max() < 0.02 * velocity(knots + step).norm(dim=-1).max()
    if loop:  # and from the end into the beginning
        end = velocity(double([begin + path.duration - step]))
        assert (end - velocity(double([begin + step]))).norm() < 0.02 * end.norm()
        first, last = path.at(double([begin, begin + path.duration]))[0]
        torch.testing.assert_close(first, last, atol=1e-9, rtol=0)


@pytest.mark.parametrize("loop", [False, True])
def test_every_pose_is_rigid_and_every_angle_possible(loop):
    path = random_path(loop)
    pose, fov = path.at(path.keyframes[0].seconds + path.duration * torch.linspace(0, 1, 500))
    rotation = pose[:, :, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(500, 3, 3), atol=1e-9, rtol=0)
    assert (torch.linalg.det(rotation) > 0.99).all() and (fov > 0).all() and (fov < 180).all()


def test_a_turn_on_the_spot_is_even_and_takes_the_shorter_way():
    keys = []
    for i in range(8):  # once around and a half, 80 degrees each: no shorter way to confuse
        angle = math.radians(80 * i)
        c, s = math.cos(angle), math.sin(angle)
        keys.append(Keyframe(((c, 0.0, s, 1.0), (0.0, 1.0, 0.0, 2.0), (-s, 0.0, c, 3.0)), 50.0, float(i)))
    pose, fov = CameraPath(tuple(keys)).at(torch.linspace(0, 7, 701, dtype=torch.double))
    trace = (pose[1:, :, :3] * pose[:-1, :, :3]).sum((1, 2))
    turned = torch.acos(((trace - 1) / 2).clamp(-1, 1)).rad2deg()
    assert turned.sum() == pytest.approx(560, abs=1) and turned.max() < 1.3 * turned.min()
    torch.testing.assert_close(pose[:, :, 3], torch.tensor([1.0, 2.0, 3.0]).double().expand(701, 3))
    torch.testing.assert_close(fov, torch.full((701,), 50.0).double())


def test_even_times_on_a_line_give_an_even_pace():
    keys = [keyframe(torch.eye(3, 4) + i * torch.eye(4)[3], 40.0, 2.0 * i) for i in range(4)]
    pose, _ = CameraPath(tuple(keys)).at(torch.linspace(0, 6, 61))
    torch.testing.assert_close(pose[:, 0, 3], torch.linspace(0, 3, 61).double(), atol=1e-6, rtol=0)


def test_a_camera_that_should_wait_waits():
    path = random_path(count=4)
    a, b, c, d = path.keyframes
    waiting = CameraPath((a, b, replace(b, seconds=c.seconds), replace(d, seconds=c.seconds + 1)))
    pose, _ = waiting.at(torch.linspace(b.seconds, c.seconds, 50))
    torch.testing.assert_close(pose, pose[:1].expand(50, 3, 4), atol=1e-6, rtol=0)


def test_cameras_stand_in_the_scenes_frame_and_show_the_angle():
    path, source_from_scene = random_path(), similarity()
    frame = Frame(source_from_scene=tuple(map(tuple, source_from_scene.tolist())))
    cameras = path.cameras(frame, (64, 48))
    assert len(cameras) == round(path.duration * 30) + 1
    back = cameras.transformed(source_from_scene).pose
    for key in path.keyframes:
        at = round((key.seconds - path.keyframes[0].seconds) * 30)
        torch.testing.assert_close(back[at], torch.tensor(key.pose), atol=1e-4, rtol=0)
        top, bottom = cameras[at].lens.unproject(torch.tensor([[32.0, 0.0], [32.0, 48.0]]))
        assert math.degrees(math.acos(float(top @ bottom))) == pytest.approx(key.fov, abs=0.01)
    assert cameras.size.unique(dim=0).tolist() == [[64, 48]] and cameras.pose.dtype == torch.float32


def test_a_number_of_frames_spreads_over_the_whole_path():
    for loop in (False, True):
        path = random_path(loop)
        cameras = path.cameras(Frame(), (8, 8), 11)
        assert len(cameras) == 11
        torch.testing.assert_close(cameras.pose[0], torch.tensor(path.keyframes[0].pose), atol=1e-5, rtol=0)
        step = path.duration / (11 if loop else 10)
        expected, _ = path.at(torch.tensor([path.keyframes[0].seconds + 7 * step], dtype=torch.double))
        torch.testing.assert_close(cameras.pose[7], expected[0].float(), atol=1e-5, rtol=0)
    assert len(random_path(count=1).cameras(Frame(), (8, 8))) == 1
    with pytest.raises(LumigraphError, match="cannot have 0 frames"):
        path.cameras(Frame(), (8, 8), 0)


def test_what_is_saved_is_read_again_to_the_bit(tmp_path):
    for loop in (False, True):
        path = random_path(loop, fps=24.0)
        path.save(tmp_path / "path.json")
        assert CameraPath.load(tmp_path / "path.json") == path


def test_a_films_own_json_is_a_path_too(tmp_path):
    """The same flight through another run of the capture, in another frame."""
    first = Frame(source_from_scene=tuple(map(tuple, similarity().tolist())))
    second = Frame(source_from_scene=tuple(map(tuple, similarity(0.7).tolist())))
    cameras = random_path(count=3).cameras(first, (64, 48))
    about = {"fps": 30.0, "size": [64, 48], "source_from_scene": first.source_from_scene}
    write_json(tmp_path / "film.json", {**about, "lens": cameras.lens.to_json(), "poses": cameras.pose.tolist()})
    again = CameraPath.load(tmp_path / "film.json").cameras(second, (64, 48))
    assert len(again) == len(cameras)
    there, here = cameras.transformed(similarity()), again.transformed(similarity(0.7))
    torch.testing.assert_close(here.pose, there.pose, atol=1e-4, rtol=0)
    torch.testing.assert_close(again.lens.focal, cameras.lens.focal, rtol=1e-4, atol=0)


def with_key(**change):
    return lambda data: data["keyframes"][2].update(change)


NONSENSE = {
    "an old version": (lambda data: data.update(format="lumigraph camera path 0"), "no camera path"),
    "empty": (lambda data: data.update(keyframes=[]), "no keyframe"),
    "no list": (lambda data: data.update(keyframes=7), "keyframes is 7, and should be `array`"),
    "missing": (lambda data: data.pop("keyframes"), "lacks `keyframes`"),
    "a strange key": (with_key(zoom=2), "nothing is known of 'zoom'"),
    "not a number": (with_key(fov=math.nan), "cannot be read as JSON"),
    "words": (with_key(seconds="soon"), "seconds is 'soon', and should be `float`"),
    "scaled": (with_key(pose=[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]), "keyframe 3 has a pose that is no rotation"),
    "mirrored": (with_key(pose=[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "no rotation"),
    "too small a pose": (with_key(pose=[[1, 0, 0], [0, 1, 0], [0, 0, 1]]), "length 4, got 3"),
    "infinitely far": (with_key(pose=[[1, 0, 0, math.inf], [0, 1, 0, 0], [0, 0, 1, 0]]), "cannot be read as JSON"),
    "too wide": (with_key(fov=200), "sees 200 degrees"),
    "no angle": (with_key(fov=0), "sees 0 degrees"),
    "back in time": (with_key(seconds=0.0), "keyframe 3 is at 0 s, not after"),
    "endless": (with_key(seconds=1e12), "seconds is 1000000000000.0, and should be from -1e9 to 1e9"),
    "no fps": (lambda data: data.update(fps=0), "fps is 0, and should be from 0.001 to 1,000"),
    "fps of words": (lambda data: data.update(fps="many"), "fps is 'many', and should be `float`"),
    "loop of words": (lambda data: data.update(loop="no"), "loop is 'no', and should be `bool`"),
}


@pytest.mark.parametrize("what", NONSENSE)
def test_nonsense_ends_in_one_sentence(what, tmp_path):
    change, words = NONSENSE[what]
    random_path().save(tmp_path / "path.json")
    data = json.loads((tmp_path / "path.json").read_text())
    change(data)
    (tmp_path / "path.json").write_text(json.dumps(data))
    with pytest.raises(LumigraphError, match=words) as caught:
        CameraPath.load(tmp_path / "path.json")
    assert str(caught.value).startswith(str(tmp_path / "path.json")) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "7", '"orbit"', "\x00\xff", "{}", '{"poses": 1}'])
def test_other_files_end_in_one_sentence(text, tmp_path):
    (tmp_path / "path.json").write_text(text, encoding="latin-1")
    with pytest.raises(LumigraphError, match=r"path\.json"):
        CameraPath.load(tmp_path / "path.json")
    with pytest.raises(LumigraphError, match="does not exist"):
        CameraPath.load(tmp_path / "nothing.json")
