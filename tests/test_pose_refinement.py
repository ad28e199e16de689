"""Poses that are learnt: their gradients, the order in which details join, frames that agree, held-out photographs."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from PIL import Image
from test_house import ROOT
from test_paper_presets import NAMES

from lumigraph import methods
from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.components.clouds.initialization import random_cloud
from lumigraph.components.clouds.moved_cloud import seen_from
from lumigraph.components.fields.encodings import FrequencyEncoding
from lumigraph.components.training.photometric import Exposure
from lumigraph.components.training.pose_refinement import PoseRefinement, seen_places
from lumigraph.components.training.schedules import BEGINS, ENDS, INITIAL_BANDS, band_weights
from lumigraph.datasets.alignment import aligning, moves
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation import held_out_poses as held_out_module
from lumigraph.evaluation.halves import judged_by_halves, left_half
from lumigraph.evaluation.held_out_poses import HeldOutPoses, colour_error, held_out_poses, pose_scores
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.files.ranges import changed, holds
from lumigraph.gaussians.splatting import splat, view_of
from lumigraph.geometry import Similarity
from lumigraph.method.capabilities import RefinesPoses, can
from lumigraph.opening import open_scene
from lumigraph.readers.capture import Shot
from lumigraph.readers.oddities import about_fold
from lumigraph.run import build
from lumigraph.sfm.doctor import of_folds
from lumigraph.training.verdict import cameras_moved

pytestmark = budget("methods", 10)

CPU = torch.device("cpu")
SMALL = {"nerf": {"position_frequencies": 3, "bfloat16": False}, "mip-nerf": {"bfloat16": False}, "instant-ngp": {}}


def refining(name: str, **config):
    kind = methods.find(name)
    return build(kind, tiny.scene().frame, changed(kind.smallest(), refine_cameras=True, **config), CPU, 0)


def slopes(value, twist: torch.nn.Parameter, image: int, step: float) -> torch.Tensor:
    """Central differences of a function of what is learnt of one photograph's pose."""
    found = []
    for i in range(6):
        ends = []
        for way in (1, -1):
            with torch.no_grad():
                twist[image, i] += way * step
                ends.append(float(value()))
                twist[image, i] -= way * step
        found.append((ends[0] - ends[1]) / (2 * step))
    return torch.tensor(found)


def test_poses_are_a_capability_that_is_a_submodule():
    """`inspect.getattr_static`, by which `isinstance` looks for a protocol's values, does not see submodules."""
    method = refining("instant-ngp")
    assert "poses" in method._modules and can(method, RefinesPoses)
    method.poses = None
    assert not can(method, RefinesPoses) and not can(tiny.method(), RefinesPoses)
    assert not can(type(method), RefinesPoses)


# Gradients


@pytest.mark.parametrize("name", SMALL)
def test_a_field_tells_where_rays_should_go(name):
    """What the network says along a photograph's rays, by central differences in its pose."""
    method = refining(name, **SMALL[name])
    if name == "instant-ngp":
        method.network.table.data.uniform_(-0.1, 0.1, generator=torch.Generator().manual_seed(0))
    camera, t = tiny.scene().cameras[1], torch.linspace(2.5, 3.5, 8)
    rays = camera.rays(camera.pixels()[::7])

    def value() -> torch.Tensor:
        seen = method.poses(rays)
        points = seen.origins[:, None] + t[:, None] * seen.directions[:, None]
        _, rgb = method.field(points.reshape(-1, 3), seen.directions.repeat_interleave(len(t), 0))
        return (rgb.double() * torch.arange(1, 4)).sum()

    with torch.no_grad():
        method.poses.twist[1] = torch.tensor([0.01, -0.02, 0.015, 0.02, 0.01, -0.01])
    (found,) = torch.autograd.grad(value(), method.poses.twist)
    expected = slopes(value, method.poses.twist, 1, 1e-5)
    assert found[0].abs().max() == 0 and expected.norm() > 1
    assert (found[1] - expected).norm() < 0.1 * expected.norm()  # across kinks of ReLUs and cells


def test_a_cloud_tells_where_its_camera_should_go():
    """A picture through the refined camera, by central differences in its pose."""
    scene = tiny.scene()
    cloud = random_cloud(scene.frame, 30, 0, torch.Generator().manual_seed(0))
    scales = cloud.log_scales + torch.tensor([0.5, -0.5, 0.0])
    cloud = replace(cloud, log_scales=scales, opacities=cloud.opacities + 2)  # whose cut edges are faint beside them
    poses = PoseRefinement(len(scene))
    weights = torch.rand(tiny.SIZE, tiny.SIZE, 3, generator=torch.Generator().manual_seed(1))

    def value() -> torch.Tensor:
        moved, camera = seen_from(poses, cloud, scene.cameras[2])
        return (splat(moved, view_of(camera), 1).rgb * weights).double().sum()

    with torch.no_grad():
        poses.twist[2] = torch.tensor([0.02, -0.01, 0.03, 0.01, 0.02, -0.02])
    (found,) = torch.autograd.grad(value(), poses.twist)
    expected = slopes(value, poses.twist, 2, 2e-4)
    assert expected.norm() > 1 and (found[2] - expected).norm() < 0.05 * expected.norm()


def test_a_step_moves_the_picture_equally_far_whichever_way():
    """In the coordinates that are learnt, and not in radians and scene units."""
    scene = tiny.scene()
    poses = PoseRefinement(len(scene))

    def motion(axis: int) -> float:
        """How far, in radians, the directions towards places of the scene move, root mean square."""
        camera = scene.cameras[0]
        rays, t = seen_places(camera, scene.frame)
        places = (rays.origins[:, None] + t[..., None] * rays.directions[:, None]).reshape(-1, 3)
        with torch.no_grad():
            poses.twist.zero_()
            poses.twist[0, axis] = 1e-3
        there = poses.refined(camera)
        before, after = (
            torch.nn.functional.normalize((places - c.position) @ c.pose[0, :, :3], dim=-1) for c in (camera, there)
        )
        return float((after - before).square().sum(-1).mean().sqrt()) / 1e-3

    raw = [motion(i) for i in range(6)]
    poses.choose_axes(scene.cameras, scene.frame)
    even = [motion(i) for i in range(6)]
    assert max(raw) / min(raw) > 2 and max(even) / min(even) < 1.6 and 0.3 < min(even) and max(even) < 1.1


# Coarse to fine


def test_bands_join_one_after_another():
    first, middle, last = (band_weights(8, progress) for progress in (0.0, (BEGINS + ENDS) / 2, 1.0))
    assert first.tolist() == [1.0] * int(8 * INITIAL_BANDS) + [0.0] * int(8 - 8 * INITIAL_BANDS)
    assert (middle.diff() <= 0).all() and middle[4] == 1 and middle[5:].tolist() == [0.0] * 3
    assert last.tolist() == [1.0] * 8
    alpha = 2.5  # from 1 to 4 of 4 bands
    progress = BEGINS + (alpha - 1) / 3 * (ENDS - BEGINS)
    torch.testing.assert_close(band_weights(4, progress), torch.tensor([1.0, 1.0, 0.5, 0.0]), atol=1e-6, rtol=0)


def test_waves_and_levels_are_weighted_in_their_order():
    encoding, points = FrequencyEncoding(3, 4), torch.rand(5, 3)
    plain, weighted = encoding(points), encoding(points, torch.tensor([1.0, 0.5, 0.0, 0.0]))
    assert torch.equal(weighted[:, :9], plain[:, :9]) and torch.equal(weighted[:, 9:15], 0.5 * plain[:, 9:15])
    assert (weighted[:, 15:] == 0).all()
    method = refining("instant-ngp")
    method.network.table.data.uniform_(0.1, 1, generator=torch.Generator().manual_seed(0))
    width = method.config.table.features_per_level
    method.before_step(0, 0.0)
    coarse = method.network.encode(points - 0.5)
    assert (coarse[:, :width] != 0).all() and (coarse[:, width:] == 0).all()
    method.poses.progress.fill_(1.0)
    assert (method.network.encode(points - 0.5) != 0).all() and method.poses.weights(4) is None


def test_a_method_that_refines_nothing_has_no_weights_and_one_rate():
    plain = build(methods.find("nerf"), tiny.scene().frame, methods.find("nerf").smallest(), CPU, 0)
    assert plain.poses is None and isinstance(plain.learning_rate(0, 0.5), float)
    rates = [refining("nerf").learning_rates(0, progress)["poses"] for progress in (0.0, 0.2, 1.0)]
    assert rates[0] < 0.05 * rates[1] and rates[2] < 0.1 * rates[1]


# Frames


def some_cameras() -> Camera:
    return tiny.scene().cameras


def test_alignment_finds_a_known_similarity():
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.2], [0.3, 0.0, -0.5], [-0.2, 0.5, 0.0]]))
    known = Similarity.make(1.3, turn, torch.tensor([0.4, -0.2, 0.1]))
    there = some_cameras().transformed(known.matrix)
    found = aligning(some_cameras(), there)
    torch.testing.assert_close(found.matrix, known.matrix, atol=1e-5, rtol=0)
    apart = moves(some_cameras(), there, tiny.scene().frame)
    assert apart.largest[0] < 1e-2 and apart.largest[1] < 1e-3


def test_alignment_of_cameras_on_a_line_is_told_by_their_directions():
    line = some_cameras()[:4]
    pose = line.pose[:1].repeat(4, 1, 1)
    pose[:, :, 3] = torch.linspace(0, 1, 4)[:, None] * torch.tensor([1.0, 0.5, 0.0])
    line = replace(line, pose=pose)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, -2.0], [0.0, 2.0, 0.0]]))
    known = Similarity.make(0.5, turn, torch.ones(3))
    torch.testing.assert_close(aligning(line, line.transformed(known.matrix)).matrix, known.matrix, atol=1e-5, rtol=0)


def test_moves_are_those_of_single_cameras():
    method, cameras = refining("instant-ngp"), some_cameras()
    with torch.no_grad():
        method.poses.twist[5] = torch.tensor([0.0, math.radians(3), 0.0, 0.0, 0.0, 0.04])
    moved = cameras_moved(method, cameras)
    assert moved.turned.argmax() == 5 and 2.4 < moved.largest[0] < 3.01 and moved.median[0] < 0.5
    assert moved.shifted.argmax() == 5 and 1.2 < moved.largest[1] < 2.05
    plain = build(
        methods.find("instant-ngp"), method.frame, changed(methods.find("instant-ngp").Config(), levels=2), CPU, 0
    )
    assert cameras_moved(plain, cameras) is None and held_out_poses(plain, tiny.scene()) is None


def test_true_poses_of_a_jittered_scene_are_known():
    off = open_scene("procedural:still-life,size=16,views=12,jitter_poses=2")
    method = refining("instant-ngp")
    method.poses = PoseRefinement(len(off))
    rotation, position = pose_scores(method, off)
    assert 1.5 < rotation.value < 2.2 and 1.3 < position.value < 2.2 and pose_scores(method, tiny.scene()) == []
    given, true = off.cameras.pose, off.about["true_pose"]  # the scene's frame is the source's
    omega = torch.stack([axis_angle(b @ a.T) for a, b in zip(given[:, :, :3], true[:, :, :3], strict=True)])
    with torch.no_grad():
        method.poses.twist.copy_(torch.cat([omega, true[:, :, 3] - given[:, :, 3]], -1))
    assert max(score.value for score in pose_scores(method, off)) < 0.02


def axis_angle(rotation: torch.Tensor) -> torch.Tensor:
    skew = (rotation - rotation.T) / 2
    axis = torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    return axis * (axis.norm().clamp_min(1e-9).asin() / axis.norm().clamp_min(1e-9))


HELD_OUT = 4


def misplaced(background=(1.0, 1.0, 1.0), **config):
    """A cloud, and its own pictures, one of which is said to be taken from 1.5 degrees and 1 % away; its true pose."""
    scene = tiny.made(8, 32, 40.0)
    scene = replace(scene, frame=replace(scene.frame, background=background))
    kind = methods.find("gaussian-splatting")
    config = changed(kind.smallest(), refine_cameras=True, sh_degree=0, **config)
    method = build(kind, scene.frame, config, CPU, 0).eval()
    cloud = random_cloud(scene.frame, 100, 0, torch.Generator().manual_seed(0))
    method.cloud.replace(replace(cloud, means=0.6 * cloud.means, opacities=cloud.opacities + 4))
    pictures = [method.render(scene.cameras[i]).rgb for i in range(len(scene))]
    return method, said_of(scene, pictures), scene.cameras[HELD_OUT].pose


def said_of(scene: Scene, pictures: list[torch.Tensor]) -> Scene:
    """A scene of other pictures, of which one has a wrong pose."""
    poses = PoseRefinement(len(scene))
    with torch.no_grad():
        poses.twist[HELD_OUT] = torch.tensor([0.015, -0.02, 0.005, 0.01, -0.01, 0.015])
    images = ImageStore.from_arrays([np.uint8(255 * x.clamp(0, 1).numpy() + 0.5) for x in pictures])
    frame = replace(scene.frame, has_alpha=False)
    return replace(scene, cameras=poses.refined(scene.cameras), images=images, frame=frame)


def with_picture(scene: Scene, change) -> Scene:
    """The scene with the held-out picture changed."""
    pictures = [scene.images[i] for i in range(len(scene))]
    pictures[HELD_OUT] = change(pictures[HELD_OUT].clone())
    return replace(scene, images=ImageStore.from_arrays([x.numpy() for x in pictures]))


def distance(camera: Camera, true: torch.Tensor) -> float:
    return float((camera.pose - true).norm())


def test_a_held_out_photograph_is_found_on_its_left_half():
    """The method stays as it is, and the right half, which is compared, says nothing."""
    method, said, true = misplaced()
    before = {name: x.clone() for name, x in method.state_dict().items()}
    found = HeldOutPoses(method, said)
    camera = found.camera(HELD_OUT)
    assert distance(camera, true) < 0.15 * distance(said.cameras[HELD_OUT], true)
    assert all(torch.equal(x, before[name]) for name, x in method.state_dict().items())
    assert all(x.requires_grad and x.grad is None for x in method.cloud.parameters())
    assert torch.equal(found.camera(1).pose, said.cameras[1].pose)

    def spoilt(picture: torch.Tensor) -> torch.Tensor:
        picture[:, 16:] = 255 - picture[:, 16:]
        return picture

    assert torch.equal(HeldOutPoses(method, with_picture(said, spoilt)).camera(HELD_OUT).pose, camera.pose)


def test_nothing_of_a_left_half_leaves_a_pose_where_the_others_moved():
    method, said, _ = misplaced()
    images = ImageStore.from_arrays(
        [said.images[i].numpy() for i in range(8)], [np.tile(np.arange(32) >= 16, (32, 1))] * 8
    )
    found = HeldOutPoses(method, replace(said, images=images))
    assert torch.equal(found.camera(HELD_OUT).pose, found.moved_along[HELD_OUT].pose)


def test_a_pose_is_found_by_colours_alone():
    """Neither the dropout for few photographs nor the mask of what moved has a say, as at the end of training."""
    method, said, _ = misplaced(few_views="yes", robust="yes")
    assert method.few_views.active and method.progress == 1
    with torch.no_grad():
        method.robust_mask.histogram[:20] = 1  # errors beyond a hundredth would be left out
    plain, _, _ = misplaced()
    cameras = [HeldOutPoses(one, said).camera(HELD_OUT) for one in (method, plain)]
    assert torch.equal(cameras[0].pose, cameras[1].pose)


def test_a_dark_photograph_is_found_in_any_light():
    """A third as bright as the average of the others, before black. Plain errors would move its camera off."""
    method, said, true = misplaced(appearance="yes", background=(0.0, 0.0, 0.0))
    dark = with_picture(said, lambda picture: picture // 3)
    off = distance(said.cameras[HELD_OUT], true)
    assert judged_by_halves(method)
    assert distance(HeldOutPoses(method, dark).camera(HELD_OUT), true) < 0.25 * off
    assert distance(HeldOutPoses(method.given(appearance="average"), dark).camera(HELD_OUT), true) > off


def test_colours_are_compared_up_to_light(generator):
    seen = torch.rand(100, 3, generator=generator)
    light = seen * torch.tensor([0.3, 0.5, 0.2]) + torch.tensor([0.1, 0.0, 0.3])
    assert colour_error(seen, light, lit=True) < 1e-12 < 0.01 < colour_error(seen, light)
    assert colour_error(seen, 1 - seen, lit=True) == pytest.approx(float(seen.var(0, unbiased=False).mean()))


def test_codes_are_found_from_refined_cameras(monkeypatch):
    """Codes of training photographs are found from refined cameras, those of held-out ones from cameras found."""
    scene = tiny.scene()
    kind = methods.find("instant-ngp")
    config = changed(kind.smallest(), refine_cameras=True, exposure_correction="yes")
    method, seen = build(kind, scene.frame, config, CPU, 0).eval(), []
    with torch.no_grad():
        method.poses.twist[scene.splits["train"]] = 0.05
    monkeypatch.setattr(held_out_module, "STEPS", 2)
    given = Exposure.adapted
    monkeypatch.setattr(Exposure, "adapted", lambda *told: seen.append(told[2].camera.pose) or given(*told))
    evaluate(method, scene, EvaluationOptions("train", 1))
    assert torch.equal(seen[-1], method.refined(scene.cameras[1]).pose) and not torch.equal(
        seen[-1], scene.cameras[1].pose
    )
    found = HeldOutPoses(method, scene).camera(0)
    evaluate(method, scene, EvaluationOptions(views=1))
    assert torch.equal(seen[-1], found.pose)


@pytest.mark.parametrize("name", [x for x in methods.available() if holds(methods.find(x).Config(), "refine_cameras")])
def test_every_method_that_refines_cameras_is_evaluated_with_its_poses(name):
    """A method that offers --refine-cameras exposes its poses, and its colours have a gradient in them."""
    scene, kind = tiny.scene(), methods.find(name)
    plain, method = (
        build(kind, scene.frame, changed(kind.smallest(), refine_cameras=refine), CPU, 0).eval()
        for refine in (False, True)
    )
    assert held_out_poses(plain, scene) is None and held_out_poses(method, scene) is not None
    poses = PoseRefinement(len(scene))
    pairs = method.colour_pairs(left_half(scene.photograph(0)))
    (gradient,) = torch.autograd.grad(colour_error(*pairs(poses, torch.Generator().manual_seed(0))), [poses.twist])
    assert gradient[0].isfinite().all() and gradient[0].any() and not gradient[1:].any()


def test_the_page_lists_the_methods_that_refine_cameras():
    page = (ROOT / "docs" / "pose-refinement.md").read_text("utf-8")
    (listed,) = re.findall(r"(?m)^(`.+`) have it\.", page)
    assert set(re.findall(r"`([\w-]+)`", listed)) == {
        name for name in NAMES if holds(methods.find(name).Config(), "refine_cameras")
    }


# Captures


def photographed(folder, poses: np.ndarray, seen: np.ndarray) -> list[Shot]:
    """Photographs of a panorama: each shows the part that its number in `seen` says."""
    chance = np.random.default_rng(0)
    panorama = np.kron(chance.integers(0, 255, (2, 30)), np.ones((12, 12))).astype(np.uint8)
    shots = []
    for i, place in enumerate(seen):
        Image.fromarray(panorama[:, 4 * place : 4 * place + 24]).save(folder / f"{i}.png")
        lens = Pinhole(torch.tensor([[30.0, 30.0]]), torch.tensor([[12.0, 12.0]]))
        shots.append(Shot(f"{i}.png", poses[i], lens, (24, 24), {1: folder / f"{i}.png"}))
    return shots


def test_a_capture_is_said_to_be_folded_where_it_leaps_and_its_photographs_do_not(tmp_path):
    walk = tiny.poses(40).numpy()
    folded = walk.copy()
    folded[20:, :, 3] += 8 * walk[20, :, 0]
    steady, leaping = np.arange(40), np.arange(40) + 30 * (np.arange(40) >= 20)
    assert about_fold(photographed(tmp_path, walk, steady), walk) is None
    said = about_fold(photographed(tmp_path, folded, steady), folded)
    assert said is not None and "19.png and 20.png" in said and "folded" in said
    (finding,) = of_folds(photographed(tmp_path, folded, steady), folded, tmp_path)
    assert "19.png and 20.png" in finding.evidence and f"lumigraph capture {tmp_path}" in finding.advice
    assert about_fold(photographed(tmp_path, folded, leaping), folded) is None  # somebody walked there
    shuffled = folded[np.random.default_rng(0).permutation(40)]
    assert about_fold(photographed(tmp_path, shuffled, steady), shuffled) is None  # in no order
