"""Neural Volumes: compositing, the mixture of affine maps, codes and backgrounds against their equations."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera.rays import Rays
from lumigraph.errors import LumigraphError
from lumigraph.geometry import to_matrix
from lumigraph.methods.neural_volumes import NeuralVolumes
from lumigraph.methods.neural_volumes.networks import (
    GROWTH_SCALE,
    SHIFT_SCALE,
    TURN_SCALE,
    AffineMixture,
    Decoded,
    divergence,
    lattice,
    opacity_prior,
    opacity_roughness,
)

pytestmark = budget("methods", 5)


def rig_scene():
    """The ball, photographed at three moments by four cameras that stand still."""
    ball = tiny.scene()
    pose = ball.cameras.pose[torch.arange(12) % 4]
    cameras = replace(ball.cameras, time=torch.arange(12) // 4 * 1.0, pose=pose)
    splits = {"train": torch.tensor([i for i in range(12) if i % 4]), "test": torch.tensor([0, 4, 8])}
    return replace(ball, cameras=cameras, frame=replace(ball.frame, times=(0.0, 2.0)), splits=splits)


def begun(**numbers) -> NeuralVolumes:
    method = NeuralVolumes(rig_scene().frame, replace(NeuralVolumes.smallest(), **numbers))
    method.begin(rig_scene())
    return method


def test_opacity_adds_up_along_a_ray_to_one_at_most():
    method = begun(samples=200, affines=0)
    origins = torch.tensor([[-3.0, 0.0, 0.0]]).expand(2, 3)
    rays = Rays(origins, torch.tensor([[1.0, 0, 0]]).expand(2, 3), torch.full((2,), 1e-3))
    code = torch.zeros(1, method.config.code)
    method.decoder.whole.requires_grad_(False)
    for layer in (method.decoder.whole.turn, method.decoder.whole.growth, method.decoder.whole.shift):
        layer[-1].weight.zero_()
    for density, expected in ((0.2, 0.4), (0.4, 0.8), (3.0, 1.0)):  # over two units
        volume = torch.full((8, 8, 8, 4), density)
        volume[..., :3] = 0.25
        light, opacity, depth = method.march(rays, Decoded(code, volume, None))
        torch.testing.assert_close(opacity, torch.full((2,), expected), atol=5e-3, rtol=0)
        torch.testing.assert_close(light, 0.25 * opacity[:, None].expand(2, 3))
        reach = min(2.0, 1 / density)
        torch.testing.assert_close(depth, torch.full((2,), 2 + 0.5 * reach), atol=0.02, rtol=0)


def test_one_affine_map_is_that_map_whatever_its_weights():
    torch.manual_seed(0)
    warp, code = AffineMixture(4, 1, 6, 8), torch.randn(1, 4)
    quaternion = torch.tensor([[1.0, 0, 0, 0]]) + TURN_SCALE * warp.maps.turn(code)
    growth, shift = (GROWTH_SCALE * warp.maps.growth(code)).exp(), SHIFT_SCALE * warp.maps.shift(code)
    places = lattice(6).view(-1, 3)
    expected = growth * ((places - shift) @ to_matrix(quaternion)[0].T)
    torch.testing.assert_close(warp(code).view(-1, 3), expected, atol=1e-5, rtol=0)


def test_affine_maps_mix_by_weights_in_the_template():
    torch.manual_seed(0)
    warp, code = AffineMixture(4, 3, 6, 8), torch.randn(1, 4)
    moved = warp.maps(code, lattice(6)).view(3, -1, 3)
    with torch.no_grad():
        warp.weights[-1].weight.zero_()
        warp.weights[-1].bias.copy_(torch.tensor([0.0, 1.0, 2.0]).repeat_interleave(6**3))
    share = torch.tensor([0.0, 1.0, 2.0]).softmax(0)
    torch.testing.assert_close(warp(code).view(-1, 3), (share[:, None, None] * moved).sum(0), atol=1e-5, rtol=0)


def test_priors_are_those_of_their_distributions():
    mean, log_deviation = torch.randn(1, 8), 0.3 * torch.randn(1, 8)
    own = torch.distributions.Normal(mean, log_deviation.exp())
    expected = torch.distributions.kl_divergence(own, torch.distributions.Normal(0.0, 1.0)).mean()
    torch.testing.assert_close(divergence(mean, log_deviation), expected)
    sides = torch.tensor([0.0, 1.0]), torch.tensor([0.5]), torch.tensor([0.2])
    clear, half, fifth = (float(opacity_prior(x)) for x in sides)
    assert clear == pytest.approx(0, abs=1e-6) and 0 < fifth < half
    flat, rough = torch.ones(4, 4, 4, 4), torch.rand(4, 4, 4, 4)
    assert float(opacity_roughness(flat)) == pytest.approx(1e-5**0.5) and float(opacity_roughness(rough)) > 0.1


def test_pictures_of_the_same_cameras_are_encoded_at_each_moment():
    scene, method = rig_scene(), begun()
    assert method.rig.times.tolist() == [0, 1, 2] and method.rig.pictures.shape == (3, 3, 3, 8, 8)
    chosen = {(i, k): method.rig.pictures[i, k].float() for i in range(3) for k in range(3)}
    for (i, k), picture in chosen.items():
        means = torch.stack([scene.photograph(4 * i + j).before(scene.frame.background).mean() for j in (1, 2, 3)])
        assert float((means - picture.mean() / 255).abs().min()) < 0.02
        assert k == 0 or not torch.equal(picture, chosen[i, k - 1])


def test_codes_interpolate_between_moments():
    method = begun()
    first, second = (method.encoded(i)[0] for i in (1, 2))
    torch.testing.assert_close(method.code_at(1.25), 0.75 * first + 0.25 * second)
    torch.testing.assert_close(method.code_at(2.0), second)
    torch.testing.assert_close(method.code_at(0.0), method.encoded(0)[0])
    assert [control.name for control in method.controls] == ["time"]


def test_a_decoded_volume_is_kept_until_a_weight_changes():
    method = begun()
    with torch.no_grad():
        toward = torch.tensor([0.0, 0.0, 1.0])
        held = method.volume_at(1.0, toward)
        assert method.volume_at(1.0, toward) is held and method.volume_at(0.5, toward) is not held
        held = method.volume_at(1.0, toward)
        method.encoder.mean.weight.mul_(1.5)
        assert not torch.equal(method.volume_at(1.0, toward)[0], held[0])


def test_one_camera_alone_is_refused():
    scene = rig_scene()
    walking = replace(scene.cameras, time=torch.arange(12).float())
    with pytest.raises(LumigraphError, match="no camera photographs every moment; train nerfies or nsff"):
        NeuralVolumes(scene.frame, NeuralVolumes.smallest()).begin(replace(scene, cameras=walking))
    alone = replace(scene, splits={"train": torch.tensor([1, 5, 9]), "test": torch.tensor([0])})
    with pytest.raises(LumigraphError, match="1 camera photographs every moment"):
        NeuralVolumes(scene.frame, NeuralVolumes.smallest()).begin(alone)


def test_each_camera_sees_its_own_background():
    scene = rig_scene()
    opaque = replace(scene.frame, has_alpha=False)
    method = NeuralVolumes(opaque, NeuralVolumes.smallest())
    method.begin(replace(scene, frame=opaque))
    backgrounds = method.backgrounds
    side = backgrounds.pictures.shape[-1]
    ramp = torch.linspace(0, 1, side).expand(side, side)
    with torch.no_grad():
        backgrounds.pictures[1] = torch.stack([ramp, ramp.T, 0 * ramp])
        backgrounds.pictures[2] = 0.5
    camera = scene.cameras[5]  # the camera of photograph 1, at the next moment
    found = backgrounds.colours(camera.rays(camera.pixels()), method.background).view(tiny.SIZE, tiny.SIZE, 3)
    expected = torch.linspace(0, 1, tiny.SIZE)
    torch.testing.assert_close(found[12, :, 0], expected, atol=0.02, rtol=0)
    torch.testing.assert_close(found[:, 12, 1], expected, atol=0.02, rtol=0)
    other, held_out = (scene.cameras[i].rays(scene.cameras[i].pixels()) for i in (6, 4))
    grey = torch.full((tiny.SIZE**2, 3), 0.5)
    torch.testing.assert_close(backgrounds.colours(other, method.background), grey)
    mean = backgrounds.pictures[[1, 2, 3]].mean((0, 2, 3))
    torch.testing.assert_close(backgrounds.colours(held_out, method.background)[0], mean)


def test_colours_depend_on_the_camera_alone_where_views_count():
    method = begun(view_dependence=True)
    code = method.code_at(1.0)
    (a, _), (b, _) = (method.decoder(code, torch.tensor(d)) for d in ([1.0, 0, 0], [0.0, 1, 0]))
    assert torch.equal(a[..., 3], b[..., 3]) and not torch.allclose(a[..., :3], b[..., :3])
    terms = method.train().loss(method.batch(rig_scene(), torch.Generator().manual_seed(0)), 0)
    assert all(term.isfinite() for term in terms.values())
    torch.stack(list(terms.values())).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in method.parameters())


def test_what_cannot_be_seen_is_not_looked_up():
    """A body in a corner, warped: what is looked up near it is what is looked up everywhere."""
    method, places = begun(), lattice(21).view(-1, 3)
    with torch.no_grad():
        volume = torch.rand(16, 16, 16, 4)
        volume[..., 3] = 0
        volume[8:14, 8:14, 8:14, 3] = 20
        everywhere = method.volume_at(1.0, torch.tensor([0.0, 0.0, 1.0]))._replace(volume=volume, rough=None)
        there = method.decoder.with_rough(everywhere)
        alpha, rgb = method.decoder.look_up(everywhere, places)
        found, colour = method.decoder.look_up(there, places)
    torch.testing.assert_close(found, alpha, atol=0.1, rtol=0)
    torch.testing.assert_close(colour[found > 0], rgb[found > 0])
    assert int((found == 0).sum()) > len(places) // 2
