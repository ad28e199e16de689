"""Bodies on bones: skeletons, their files, skinned glTF, characters in the tracer, ZJU-MoCap."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from bodies import BEND, bent, skeleton, write_bar
from budgets import budget
from PIL import Image

from lumigraph.datasets.skeleton import (
    Skeleton,
    between_moments,
    disturbed,
    local_of,
    posed,
    retargeted,
    rigid_inverse,
    rigid_product,
    turned_joints,
)
from lumigraph.errors import LumigraphError
from lumigraph.exchange.bones import read_bones, read_motion, write_bones
from lumigraph.exchange.skinned_gltf import read_character, subdivided
from lumigraph.geometry import Similarity, to_matrix
from lumigraph.opening import open_scene, read_capture
from lumigraph.readers.pickled import load_pickled
from lumigraph.synthetic import scenes
from lumigraph.synthetic.shapes import triangle_of
from lumigraph.synthetic.skinned import THICKNESS, SkinnedBody
from lumigraph.synthetic.world import hierarchy

pytestmark = budget("capture", 10)


def test_local_and_posed_joints_are_inverses():
    parents = (-1, 0, 1, 1, 0)
    turns = to_matrix(torch.randn(5, 4, generator=torch.Generator().manual_seed(0)).double())
    places = torch.randn(5, 3, 1, generator=torch.Generator().manual_seed(1)).double()
    joints = torch.cat([turns, places], -1)
    torch.testing.assert_close(posed(parents, local_of(parents, joints)), joints)
    torch.testing.assert_close(rigid_product(joints, rigid_inverse(joints)), torch.eye(3, 4).double().expand(5, 3, 4))


def test_a_skeleton_in_another_frame_moves_the_same_points():
    turn = to_matrix(torch.tensor([[0.8, 0.2, -0.4, 0.3]]).double())[0]
    frame = Similarity.make(2.5, turn, torch.tensor([1.0, -2.0, 0.5]))
    before, after = skeleton(), skeleton().transformed(frame)

    def carried(one: Skeleton, point: torch.Tensor) -> torch.Tensor:
        move = rigid_product(one.poses[1].matrices, rigid_inverse(one.rest.matrices))[1]
        return move[:, :3] @ point + move[:, 3]

    point = torch.tensor([0.1, 0.2, 0.3]).double()
    torch.testing.assert_close(frame.points(carried(before, point)), carried(after, frame.points(point)))


def test_moments_between_poses():
    before, after, share = between_moments(torch.tensor([1.0, 2.0, 4.0]), torch.tensor([0.0, 2.0, 3.0, 9.0]))
    assert before.tolist() == [0, 1, 1, 1] and after.tolist() == [1, 2, 2, 2] and share.tolist() == [0, 0, 0.5, 1]


def test_disturbed_bones_keep_their_length_and_turn_as_far_as_they_should():
    parents, joints = (-1, 0), bent(0.3).numpy()
    found = disturbed(parents, joints, 5.0, np.random.default_rng(0))
    turn = np.linalg.inv(local_of(parents, torch.from_numpy(joints))[:, :, :3].numpy())
    moved = turn @ local_of(parents, torch.from_numpy(found))[:, :, :3].numpy()
    angles = np.degrees(np.arccos((np.trace(moved, axis1=1, axis2=2) - 1) / 2))
    np.testing.assert_allclose(angles, 5.0, atol=1e-6)
    assert np.linalg.norm(found[1, :, 3] - found[0, :, 3]) == pytest.approx(0.4)


def test_a_file_of_bones_comes_back_and_moves_the_same_bones(tmp_path):
    path = tmp_path / "bones.json"
    write_bones(path, skeleton())
    assert read_bones(path) == skeleton()
    found = read_motion(path, replace(skeleton(), times=(0.0,), poses=skeleton().poses[:1]), Similarity.make(1.0))
    assert found.times == (1.0, 3.0)
    torch.testing.assert_close(found.track(), skeleton().track())


def test_joint_angles_turn_joints(tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(json.dumps({"format": "lumigraph bones 1", "angles": {"upper": [90.0, 0.0, 0.0]}}))
    found = read_motion(path, skeleton(), Similarity.make(1.0))
    torch.testing.assert_close(found.poses[0].matrices, bent(BEND))
    with pytest.raises(LumigraphError, match="turns 'tail', and there are lower, upper"):
        turned_joints(skeleton(), {"tail": (0.0, 0.0, 1.0)}, path)


@pytest.mark.parametrize(
    "change, sentence",
    [
        ({"rest": None}, "a skeleton without its bind pose"),
        ({"format": "bones"}, "does not say 'lumigraph bones 1'"),
        ({"parents": [1, -1]}, "lower comes before its parent"),
        ({"names": ["upper", "upper"]}, "called 'upper'"),
        ({"times": [3.0, 1.0]}, "do not rise"),
        ({"times": [1.0]}, "1 times and 2 poses"),
        ({"rest": {"positions": [[0, 0, 0]], "rotations": [[1, 0, 0, 0]]}}, "rest has 1 positions"),
    ],
)
def test_files_that_hold_no_skeleton(tmp_path, change, sentence):
    path = tmp_path / "bones.json"
    write_bones(path, skeleton())
    said = {key: value for key, value in (json.loads(path.read_text()) | change).items() if value is not None}
    path.write_text(json.dumps(said))
    with pytest.raises(LumigraphError, match=sentence):
        read_bones(path)


def test_bones_beside_photographs_are_in_the_scenes_frame(tmp_path):
    folder = tiny.write_blender(tmp_path / "ball")
    write_bones(folder / "bones.json", replace(skeleton(), times=(0.0,), poses=skeleton().poses[1:]))
    frame = open_scene(folder).frame
    assert frame.skeleton is not None
    expected = frame.to_source.inverse.points(bent(BEND)[:, :, 3])
    torch.testing.assert_close(frame.skeleton.poses[0].matrices[:, :, 3], expected)
    write_bones(folder / "bones.json", skeleton())
    with pytest.raises(LumigraphError, match="the bones have 2 moments, and photographs have none"):
        open_scene(folder)


def test_a_skinned_mesh_bends_with_its_bones(tmp_path):
    body = read_character(write_bar(tmp_path / "bar.glb"))
    assert body.skeleton.names == ("lower", "upper") and body.skeleton.parents == (-1, 0)
    np.testing.assert_allclose(body.weights.sum(1), 1)  # the file's sum to a half
    assert (body.colours == [255, 0, 0]).all()
    np.testing.assert_allclose(body.skinned(body.pose(0, 0.0)), body.vertices, atol=1e-6)
    np.testing.assert_allclose(body.vertices[4], [-0.2, 0, 1], atol=1e-6)  # +y of the file is up
    bent_over = body.skinned(body.pose(0, 1.0 - 1e-6))
    np.testing.assert_allclose(bent_over[4], [-0.2, -1, 0], atol=1e-4)  # towards +z of the file, -y here
    np.testing.assert_allclose(bent_over[0], [-0.2, 0, -1], atol=1e-4)
    half = body.skinned(body.pose(0, 0.5))
    np.testing.assert_allclose(half[4], [-0.2, -math.sin(BEND / 2), math.cos(BEND / 2)], atol=1e-4)
    assert len(subdivided(body, 16).faces) == 16
    other = retargeted(body.clip(0), skeleton(), "bar")
    assert other.times == (0.0, 1.0)
    lengths = [(pose.matrices[1, :, 3] - pose.matrices[0, :, 3]).norm() for pose in other.poses]
    torch.testing.assert_close(torch.stack(lengths), torch.full((2,), 0.4).double())


@pytest.mark.parametrize(
    "change, sentence",
    [
        (lambda about: about["skins"][0].pop("inverseBindMatrices"), "a skeleton without a bind pose"),
        (lambda about: about["nodes"][0].pop("skin"), "holds no character"),
        (lambda about: about["skins"][0].update(joints=[1]), "2 bind poses of 1 joints"),
        (lambda about: about["nodes"][2].update(scale=[1.0, 2.0, 1.0]), "animates the scale of bones"),
        (lambda about: about["meshes"][0]["primitives"][0]["attributes"].pop("WEIGHTS_0"), "lack WEIGHTS_0"),
    ],
)
def test_skinned_meshes_that_cannot_be_read(tmp_path, change, sentence):
    with pytest.raises(LumigraphError, match=sentence):
        read_character(write_bar(tmp_path / "bar.glb", change))


def test_plates_of_a_skinned_mesh_are_those_of_its_triangles(tmp_path):
    body = SkinnedBody(write_bar(tmp_path / "bar.glb"))
    pose = body.pose(0.1)
    world, vertices = body.world(pose), body.skinned(pose)
    for row in (0, 7, 100):
        shape, rotation, position = triangle_of(vertices[body.faces[row]], THICKNESS)
        plate = world.arrays.objects[row]
        np.testing.assert_allclose(plate["size"][:3], shape.describe()[1], atol=1e-9)
        np.testing.assert_allclose(plate["position"], position, atol=1e-9)
        np.testing.assert_allclose(plate["rotation"], rotation, atol=1e-9)
    _, low, high = body.plates(vertices)
    fresh, fitted = hierarchy(list(zip(low, high, strict=True))), world.arrays.nodes
    np.testing.assert_allclose(fitted["low"][0], fresh["low"][0])  # the whole body
    leaves = fitted["object"] >= 0
    np.testing.assert_allclose(fitted["high"][leaves], high[fitted["object"][leaves]])
    with pytest.raises(LumigraphError, match="does not exist"):
        read_capture("procedural:character,file=nowhere.glb")
    with pytest.raises(LumigraphError, match="needs a skinned mesh"):
        read_capture("procedural:character")


def test_the_walker_is_where_its_bones_say():
    stage = scenes.stage("walker", size=24, views=8)
    assert stage.skeleton is not None and stage.moving is not None
    bones = stage.skeleton
    train = stage.cameras["train"]
    row = bones.times.index(float(train.time[3]))
    move = rigid_product(bones.poses[row].matrices, rigid_inverse(bones.rest.matrices))
    rest, posed_world = scenes.scene("walker").Walker(), stage.moving(float(train.time[3]))
    home = rest.world(rest.skeleton.rest.matrices.numpy())
    for thing, moved in zip(home.objects, posed_world.objects, strict=True):
        bone = move[bones.names.index(thing.name)].numpy()
        np.testing.assert_allclose(bone[:, :3] @ thing.pose.position + bone[:, 3], moved.pose.position, atol=1e-6)
    low, high = posed_world.bounds()
    assert (low >= stage.bounds[0]).all() and (high <= stage.bounds[1]).all()


def test_only_bones_of_training_moments_are_disturbed():
    exact, off = (scenes.stage("walker", size=24, views=8, jitter_bones=n).skeleton for n in (0, 5))
    assert exact.times == off.times and exact.rest == off.rest
    learnt = set(scenes.stage("walker", size=24, views=8).cameras["train"].time.tolist())
    for time, a, b in zip(exact.times, exact.poses, off.poses, strict=True):
        assert (a == b) == (time not in learnt)


# ZJU-MoCap


def write_zju(folder, frames: int = 2):
    """Two cameras and so many frames of a body at rest that is shifted by half a unit."""
    poses = tiny.poses(2).double().numpy()
    turns = np.stack([pose[:, :3].T for pose in poses])
    shifts = np.stack([-1000 * turn @ pose[:, 3:] for turn, pose in zip(turns, poses, strict=True)])
    size = tiny.SIZE
    lens = np.array([[tiny.FOCAL, 0, size / 2], [0, tiny.FOCAL, size / 2], [0, 0, 1]])
    names = [[f"Camera_B{k + 1}/{30 * i:06d}.jpg" for k in range(2)] for i in range(frames)]
    cams = {"K": [lens] * 2, "D": [np.zeros((5, 1))] * 2, "R": list(turns), "T": list(shifts)}
    folder.mkdir()
    np.save(folder / "annots.npy", np.array({"cams": cams, "ims": [{"ims": x} for x in names]}, dtype=object))
    for kind in ("new_params", "lbs", "mask/Camera_B1", "mask/Camera_B2", "Camera_B1", "Camera_B2"):
        (folder / kind).mkdir(parents=True)
    for i, row in enumerate(names):
        for k, name in enumerate(row):
            pixels = tiny.picture(tiny.poses(2)[k])
            Image.fromarray(pixels[..., :3]).save(folder / name)
            Image.fromarray(pixels[..., 3] // 255).save((folder / "mask" / name).with_suffix(".png"))
        pose = {"poses": np.zeros((1, 72)), "Rh": np.zeros((1, 3)), "Th": np.array([[0.5, 0, 0]])}
        pose["poses"][0, 3] = 0.2 * i
        np.save(folder / "new_params" / f"{30 * i}.npy", np.array(pose, dtype=object))
    parents = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
    joints = np.random.default_rng(0).normal(0, 0.2, (24, 3))
    np.save(folder / "lbs" / "joints.npy", joints)
    np.save(folder / "lbs" / "parents.npy", parents)
    return joints


def test_zju_mocap_without_a_body_model(tmp_path):
    joints = write_zju(tmp_path / "zju")
    capture = read_capture(tmp_path / "zju")
    assert [shot.split for shot in capture.shots] == ["train", "test"] * 2
    np.testing.assert_allclose(capture.shots[1].pose, tiny.poses(2)[1], atol=1e-6)
    bones = capture.skeleton
    assert bones is not None and bones.times == (0.0, 30.0) and len(bones) == 24
    torch.testing.assert_close(bones.rest.matrices[:, :, 3], torch.from_numpy(joints) + torch.tensor([0.5, 0, 0]))
    torch.testing.assert_close(bones.poses[0].matrices, bones.rest.matrices)
    turned = local_of(bones.parents, bones.poses[1].matrices)[1, :, :3]
    assert math.acos((float(turned.trace()) - 1) / 2) == pytest.approx(0.2)
    pixels = capture.shots[0].image()
    assert pixels.shape == (tiny.SIZE, tiny.SIZE, 4) and set(np.unique(pixels[..., 3])) == {0, 255}
    (tmp_path / "zju" / "lbs" / "joints.npy").unlink()
    with pytest.raises(LumigraphError, match="a skeleton without a bind pose.*copy the folder lbs"):
        read_capture(tmp_path / "zju")


class Evil:
    def __reduce__(self):
        return os.mkdir, ("ran",)


def test_a_pickle_that_names_anything_but_arrays_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("evil.npy", np.array({"cams": Evil()}, dtype=object))
    with pytest.raises(LumigraphError, match="mkdir, which is no array"):
        load_pickled(tmp_path / "evil.npy")
    assert not (tmp_path / "ran").exists()
    np.save("plain.npy", np.zeros(3))
    with pytest.raises(LumigraphError, match="it holds numbers"):
        load_pickled(tmp_path / "plain.npy")
