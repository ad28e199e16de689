"""Articulated splatting and HumanNeRF: skinning and its inverse, weights, corrections, poses of a user, motions."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import tiny
import torch
from bodies import BEND, bent, frame, skeleton
from budgets import budget
from scipy.interpolate import make_smoothing_spline

from lumigraph.camera import Camera
from lumigraph.components.skinning import bone_motion
from lumigraph.components.skinning.bone_motion import (
    BoneMotion,
    BoneNumbers,
    exponential,
    on_splines,
    rotation_vectors,
    smoothed_poses,
    warn_of_background,
)
from lumigraph.components.skinning.weight_volume import WeightNumbers, WeightVolume, distance
from lumigraph.datasets.scene import Photograph, Scene
from lumigraph.datasets.skeleton import BonePose, rigid_inverse, rigid_product
from lumigraph.errors import LumigraphError
from lumigraph.exchange.bones import write_bones
from lumigraph.figures import ramp
from lumigraph.gaussians.cloud import BAND_0
from lumigraph.geometry import multiply, rotated, to_matrix
from lumigraph.methods.articulated_splatting import ArticulatedSplatting
from lumigraph.methods.articulated_splatting.contact import bodies_of, contact_map, gaps
from lumigraph.methods.articulated_splatting.skinned_cloud import skinned
from lumigraph.methods.humannerf import HumanNeRF
from lumigraph.methods.humannerf.fields import NonRigidNumbers, NonRigidOffset

pytestmark = budget("methods", 6)
KINDS = (ArticulatedSplatting, HumanNeRF)
SHARP = WeightNumbers(48, 0, 1e-2, 0.1)


def moves(angle: float) -> torch.Tensor:
    return rigid_product(bent(angle), rigid_inverse(bent(0.0))).float()


def test_rotation_vectors_and_quaternions_are_inverses():
    omega = 0.9 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    omega[0] = 0
    torch.testing.assert_close(rotation_vectors(exponential(omega)), omega, atol=1e-4, rtol=1e-4)
    x = torch.tensor([[0.0, 1.0, 2.0]]).expand(20, 3)
    turned = (to_matrix(exponential(omega)) @ x[:, :, None])[:, :, 0]
    torch.testing.assert_close(turned, rotated(x, omega), atol=1e-4, rtol=1e-4)


def test_bones_at_moments_and_between():
    motion = BoneMotion(frame(), BoneNumbers("no"))
    found = motion.transforms(*motion.local(torch.tensor([1.0, 2.0, 3.0])))
    torch.testing.assert_close(found, torch.stack([moves(a) for a in (0.0, BEND / 2, BEND)]), atol=1e-5, rtol=0)


def test_a_correction_turns_a_joint_in_its_parent():
    motion = BoneMotion(frame(), BoneNumbers("table"))
    turns = motion.turns.data.view(2, 2, 3)  # moment, bone
    turns[0, 1, 0], turns[1, 1, 0] = BEND, -BEND
    (found,) = motion.transforms(*motion.local(torch.tensor([1.0])))
    torch.testing.assert_close(found, moves(BEND), atol=1e-5, rtol=0)
    turns[:, 1, 0] += 0.3  # a mean is another body at rest
    torch.testing.assert_close(motion.transforms(*motion.local(torch.tensor([1.0])))[0], found, atol=1e-5, rtol=0)
    network = BoneMotion(frame(), BoneNumbers("network"))
    torch.testing.assert_close(network.corrected(), network.quaternions, atol=1e-3, rtol=0)  # hardly any at first


def test_poses_lose_their_noise_and_exact_ones_stay():
    """Two joints that swing, one of them through the quaternion's change of sign, 5 degrees off at every moment."""
    moments = torch.linspace(0, 1, 60)
    angle = torch.stack([0.6 * (7 * moments).sin(), 2.5 + 1.5 * moments], 1)
    exact = exponential(torch.nn.functional.pad(angle[..., None], (0, 2)).flatten(0, 1)).view(60, 2, 4)
    exact[30:] *= -1
    axes = torch.nn.functional.normalize(torch.randn(120, 3), dim=-1)
    noisy = multiply(exact.flatten(0, 1), exponential(math.radians(5) * axes)).view(60, 2, 4)
    found, same = (smoothed_poses(turns, 0.1 * moments) for turns in (noisy, exact))

    def error(turns: torch.Tensor) -> torch.Tensor:
        return 2 * torch.rad2deg((turns * exact).sum(-1).abs().clamp_max(1).acos())

    assert error(found).mean() < 2.1 and torch.equal(same, exact)


@pytest.mark.parametrize("weight", [1e-3, 1.0, 1e3])
def test_splines_are_scipys_of_the_same_weight(weight):
    generator = np.random.default_rng(0)
    times = torch.from_numpy(generator.uniform(0.2, 3, 80).cumsum())
    times = times / times.diff().median()
    values = torch.from_numpy(generator.normal(size=(80, 6)).cumsum(0))
    found, variance = on_splines(values, times, np.array([weight]))
    expected = make_smoothing_spline(times.numpy(), values.numpy(), lam=weight)(times.numpy())
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)
    influence = make_smoothing_spline(times.numpy(), np.eye(80), lam=weight)(times.numpy())
    lost = ((values.numpy() - expected) ** 2).sum(0) / (80 - np.trace(influence))
    np.testing.assert_allclose(variance.numpy(), lost, rtol=1e-5)


def test_cross_validation_finds_the_error_and_a_straight_line():
    """White errors of deviation 2 on a slow wave, and on a constant."""
    times = torch.linspace(0, 1, 200).double()
    exact = torch.stack([10 * (4 * times).sin(), 0 * times + 3], 1)
    noise = 2 * torch.randn(200, 2, generator=torch.Generator().manual_seed(1)).double()
    found, variance = on_splines(exact + noise, times)
    assert ((found - exact).square().mean(0).sqrt() < 0.6).all()
    assert ((variance.sqrt() - 2).abs() < 0.3).all()


def test_motion_of_too_few_moments_is_no_error():
    """A joint that jumps by a radian from moment to moment keeps its rotations beside one that is smoothed."""
    moments = torch.arange(40.0)
    jumps = torch.randn(40, generator=torch.Generator().manual_seed(3))
    angle = torch.stack([0.2 * (0.1 * moments).sin(), jumps], 1)
    turns = exponential(torch.nn.functional.pad(angle[..., None], (0, 2)).flatten(0, 1))
    axes = torch.nn.functional.normalize(torch.randn(80, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    noisy = multiply(turns, exponential(math.radians(5) * axes)).view(40, 2, 4)
    found = smoothed_poses(noisy, moments)
    assert not torch.equal(found[:, 0], noisy[:, 0]) and torch.equal(found[:, 1], noisy[:, 1])


def test_smooth_poses_begin_a_run_and_are_kept(monkeypatch):
    """Smoothing changes moments of photographs alone."""
    monkeypatch.setattr(bone_motion, "warn_of_background", lambda data: None)
    angles = BEND * torch.tensor([0.0, 0.2, 0.1, 0.3, 0.2, 0.4, 0.3, 0.5])
    moving = replace(
        skeleton(), times=tuple(map(float, range(8))), poses=tuple(BonePose.of(bent(float(a))) for a in angles)
    )
    motion = BoneMotion(replace(frame(), skeleton=moving), BoneNumbers("table", pose_smoothing=True))
    before, seen = motion.quaternions.clone(), torch.arange(8) < 6
    data = Mock(Scene, cameras=Mock(Camera, time=torch.arange(7.0)), splits={"train": torch.arange(6)})
    motion.begin(None, data, math.inf)
    assert (motion.quaternions[seen] - before[seen]).abs().max() > 1e-3
    assert torch.equal(motion.quaternions[~seen], before[~seen])
    assert "quaternions" in motion.state_dict()
    given, turns = motion.quaternions.clone(), motion.turns.data.view(8, 2, 3)
    turns[seen] = torch.randn(6, 2, 3, generator=torch.Generator().manual_seed(0))
    learnt = turns.clone()
    motion.before_step(None, 5, 0.05)
    assert torch.equal(turns, learnt)
    motion.before_step(None, 10, 0.1)  # the first of the later ones: corrections alone
    assert torch.equal(motion.quaternions, given) and turns[seen].diff(dim=0).norm() < learnt[seen].diff(dim=0).norm()
    hurried = BoneMotion(replace(frame(), skeleton=moving), BoneNumbers("table", pose_smoothing=True))
    hurried.begin(None, data, 1e-3)  # no time for more
    assert hurried.smoothings == 10


@pytest.mark.parametrize(("colour", "alpha", "masked"), [(0.6, False, False), (0.6, True, False), (0.6, False, True)])
def test_a_background_around_a_body_is_said(colour, alpha, masked):
    """Opaque pictures with colours up to the edge are; those with alpha or masks are not."""
    camera = tiny.scene(2).photograph(0).camera
    width, height = camera.size[0].tolist()
    picture = torch.full((height, width, 3), colour)
    mask = torch.zeros(height, width, dtype=torch.bool) if masked else None
    shot = Photograph(camera, picture, torch.zeros(height, width) if alpha else None, mask)
    scene = Mock(spec=Scene, splits={"train": torch.arange(3)}, frame=frame(), source="a walk")
    scene.photograph.return_value = shot
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_background(scene)
    assert [str(x.message)[:34] for x in said] == ["a walk: photographs show a backgro"] * (not alpha and not masked)


def test_weights_begin_at_the_nearest_bone_and_sum_to_one():
    volume = WeightVolume(frame(), SHARP)
    points = torch.tensor([[0.0, 0.0, -0.3], [0.02, 0.0, 0.2], [0.0, 0.03, 0.0]])
    weights = volume(points)
    torch.testing.assert_close(weights.sum(1), torch.ones(3))
    assert weights[0, 0] > 0.95 and weights[1, 1] > 0.95 and 0.2 < weights[2, 0] < 0.8
    far = volume(torch.tensor([[0.8, 0.0, -0.35], [0.8, 0.0, 0.35]]))  # twelve deviations away from all bones
    assert far[0, 0] > 0.95 and far[1, 1] > 0.95
    coded = WeightVolume(frame(), replace(SHARP, weight_code=4))
    torch.testing.assert_close(coded.weights(), volume.weights(), atol=1e-3, rtol=1e-2)
    away = distance(torch.tensor([[1.0, 0, 0.5], [0, 0, 2.0]]), torch.zeros(1, 3), torch.tensor([[0, 0, 1.0]]))
    torch.testing.assert_close(away, torch.tensor([1.0, 1.0]))


def test_one_bone_moves_its_gaussians_rigidly():
    cloud = ArticulatedSplatting(frame(), ArticulatedSplatting.smallest()).cloud.gaussians()
    weights = torch.zeros(len(cloud), 2)
    weights[:, 1] = 1
    found, (_, upper) = skinned(cloud, weights, moves(BEND)), moves(BEND)
    torch.testing.assert_close(found.means, cloud.means @ upper[:, :3].T + upper[:, 3])
    expected = upper[:, :3] @ to_matrix(cloud.quaternions)
    torch.testing.assert_close(to_matrix(found.quaternions), expected, atol=1e-5, rtol=0)
    still = skinned(cloud, torch.full((len(cloud), 2), 0.5), moves(0.0))
    torch.testing.assert_close(still.means, cloud.means)


def test_inverse_skinning_leads_back_to_rest():
    method = HumanNeRF(frame(), replace(HumanNeRF.smallest(), weights=SHARP)).eval()
    rest = torch.tensor([[0.01, 0.0, -0.3], [0.0, 0.02, 0.2], [0.0, 0.0, 0.18]])
    upper = moves(BEND)[1]
    posed = torch.cat([rest[:1], rest[1:] @ upper[:, :3].T + upper[:, 3]])
    field = method.posed(torch.tensor([1.0, 3.0]))
    found, body = field.at_rest(posed, torch.ones(3, dtype=torch.long))
    torch.testing.assert_close(found, rest, atol=1e-2, rtol=0)
    assert (body > 0.5).all()
    _, nobody = field.at_rest(rest[1:], torch.ones(2, dtype=torch.long))  # where the upper half was
    assert (nobody < 0.05).all()


def test_density_without_gradients_is_the_same():
    method = HumanNeRF(frame(), HumanNeRF.smallest()).eval()
    method.network.offset.alpha.fill_(1.0)
    field = method.posed(torch.tensor([1.0, 3.0]))
    points = 0.8 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.4
    rows = (torch.arange(200) % 2)[:, None].float()
    with torch.no_grad():
        quick = field.density(points, rows)
    torch.testing.assert_close(quick, field.geometry(points, rows)[0].detach(), atol=2e-3, rtol=1e-3)


def test_the_offset_joins_over_its_share_of_the_budget():
    offset = NonRigidOffset(3, NonRigidNumbers(2, 8, 1, 2, 0.1, 0.5, 1e-3))
    points, angles = torch.rand(5, 3), torch.rand(5, 3)
    torch.nn.init.ones_(offset.network.last.bias)
    offset.before_step(None, 0, 0.05)
    torch.testing.assert_close(offset(points, angles), points)
    offset.before_step(None, 0, 0.9)
    assert float(offset.alpha) == offset.numbers.nonrigid_frequencies
    assert not torch.allclose(offset(points, angles), points)


@pytest.mark.parametrize("kind", KINDS)
def test_poses_of_a_user(kind, tmp_path):
    method, camera = kind(frame(), kind.smallest()).eval(), tiny.scene().cameras[0]
    if kind is HumanNeRF:
        method.network.canonical.density_network.weights[-1].data[0] += 1.0  # something to see
    angles, bones = tmp_path / "angles.json", tmp_path / "bones.json"
    angles.write_text(json.dumps({"format": "lumigraph bones 1", "angles": {"upper": [90.0, 0.0, 0.0]}}))
    write_bones(bones, replace(skeleton(), times=(7.0,), poses=skeleton().poses[1:]))
    last = method.given(time=3.0).render(camera).rgb
    at_rest = method.given(pose="rest", time=3.0)
    torch.testing.assert_close(at_rest.bones.at(at_rest.settings, 3.0), moves(0.0), atol=1e-5, rtol=0)
    for path in (angles, bones):
        posed = method.given(pose=str(path))
        torch.testing.assert_close(posed.bones.at(posed.settings, 1.0), moves(BEND), atol=1e-5, rtol=0)
        if kind is ArticulatedSplatting:
            torch.testing.assert_close(posed.render(camera).rgb, last, atol=1e-4, rtol=0)
    with pytest.raises(LumigraphError, match="does not exist"):
        method.given(pose=str(tmp_path / "nothing.json"))
    with pytest.raises(LumigraphError, match="is no choice"):
        method.given(pose="dance")
    write_bones(bones, replace(skeleton(), names=("a", "b")))
    with pytest.raises(LumigraphError, match="has no bone of this character"):
        method.given(pose=str(bones))


@pytest.mark.parametrize("kind", KINDS)
def test_a_scene_without_a_skeleton_is_refused(kind):
    with pytest.raises(LumigraphError, match="no skeleton.*put bones.json"):
        kind(replace(frame(), skeleton=None), kind.smallest())


def test_a_motion_is_played_in_spans():
    method = ArticulatedSplatting(frame(), ArticulatedSplatting.smallest()).eval()
    method.skin.weights.volume.data += 0.1
    played = method.moving(2.0)
    for share in (0.0, 0.5, 0.98):
        now = method.given(time=1 + 2 * share).gaussians()
        there = played.at(2.0 * share)
        assert len(there) == len(now)
        size = now.log_scales.exp().amax()
        assert torch.cdist(now.means, there.means).amin(1).max() < 0.5 * size


def test_contact_is_where_two_bodies_are_close():
    assert bodies_of((-1, 0, 1, -1, 3, 0)).tolist() == [0, 0, 0, 1, 1, 0]
    cloud = ArticulatedSplatting(frame(), ArticulatedSplatting.smallest()).cloud.gaussians()[:4]
    means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0.5], [0.0, 0.3, 0.0]])
    opacities = torch.tensor([9.0, 9.0, 9.0, -9.0])  # the last one is not solid
    cloud = replace(cloud, means=means, log_scales=torch.full((4, 3), 0.1).log(), opacities=opacities)
    found = gaps(cloud, torch.tensor([0, 0, 1, 1]))
    torch.testing.assert_close(found, torch.tensor([0.3, 1.25**0.5 - 0.2, 0.3, 0.1]))
    shown = contact_map(cloud, torch.tensor([0, 0, 1, 1]), 0.35)
    touching, away = (0.5 + BAND_0 * shown.harmonics[i, 0] for i in (0, 1))
    torch.testing.assert_close(
        torch.stack([touching, away]), ramp(torch.tensor([1.0, (3 - (1.25**0.5 - 0.2) / 0.35) / 2]))
    )


def test_a_scene_of_two_bodies_can_show_contact():
    two = replace(skeleton(), parents=(-1, -1))
    method = ArticulatedSplatting(replace(frame(), skeleton=two), ArticulatedSplatting.smallest()).eval()
    camera = tiny.scene().cameras[0]
    assert {control.name for control in method.controls} >= {"time", "pose", "show"}
    assert not torch.equal(method.given(show="contact").render(camera).rgb, method.render(camera).rgb)
    assert set(method.body_of(method.filtered()).tolist()) == {0, 1}


def test_a_body_of_one_bone_begins_around_it():
    """First places reach a share of the way to the next body, for nothing tells the size of its own."""
    alone = replace(skeleton(), parents=(-1, -1))
    method = ArticulatedSplatting(replace(frame(), skeleton=alone), ArticulatedSplatting.smallest())
    means = method.skin.first_means(2000, torch.Generator().manual_seed(0))
    joints = alone.rest.matrices[:, :, 3].float()
    nearest = torch.cdist(means, joints)
    torch.testing.assert_close(means.std(0)[:2], torch.full((2,), 0.25 * 0.4), rtol=0.1, atol=0)
    assert float((nearest[:, 0] < nearest[:, 1]).float().mean()) == pytest.approx(0.5, abs=0.05)
