"""Nerfies: screw motions, codes of moments, the elastic loss and slices against geometry and PyTorch's functions."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.components.fields.spaces import Contraction, Space, space_of
from lumigraph.datasets.scene import Frame
from lumigraph.files.ranges import changed
from lumigraph.geometry import rotated
from lumigraph.methods.nerfies import Nerfies
from lumigraph.methods.nerfies.elastic import elastic_loss, geman_mcclure, log_singular_square, symmetric_eigenvalues
from lumigraph.methods.nerfies.warp import MomentCodes, MotionField, moved, unmoved, window

pytestmark = budget("methods", 6)
FRAME = Frame(times=(0.0, 4.0), image_count=5)
BOX, OPEN = space_of(FRAME), Contraction(0.1, 30.0)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def motion_field(motion="se3", space: Space = BOX) -> MotionField:
    torch.manual_seed(1)
    field = MotionField(space, motion, 4, 2, (3, 16, 2), 0.5)
    field.before_step(None, 0, 1.0)
    for parameter in field.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return field


def test_a_screw_motion_is_the_matrix_exponential():
    points, motion = random(40, 3), torch.cat([random(40, 3, seed=1), random(40, 3, seed=2)], 1)
    motion[:5, :3] = 0
    motion[5:10, :3] *= 1e-5
    r, v = motion.split(3, 1)
    twist = torch.zeros(40, 4, 4, dtype=torch.float64)
    twist[:, :3, :3] = torch.stack([torch.linalg.cross(r, e.expand_as(r)) for e in torch.eye(3).double()], -1)
    twist[:, :3, 3] = v
    expected = torch.linalg.matrix_exp(twist) @ torch.cat([points, torch.ones(40, 1)], 1)[..., None]
    torch.testing.assert_close(moved(points, motion), expected[:, :3, 0], atol=1e-9, rtol=0)
    torch.testing.assert_close(unmoved(moved(points, motion), motion), points, atol=1e-9, rtol=0)
    torch.testing.assert_close(moved(points, v), points + v)


def test_no_motion_has_finite_gradients():
    motion = torch.zeros(2, 6, requires_grad=True)
    moved(random(2, 3).float(), motion).square().sum().backward()
    assert motion.grad.isfinite().all() and motion.grad.any()


def test_eigenvalues_are_those_of_lapack():
    a = random(200, 3, 3)
    a = a.mT @ a
    a[:3] = torch.eye(3) * torch.tensor([1.0, 2.0, 0.0])[:, None, None]
    expected = torch.linalg.eigvalsh(a).flip(-1)  # the closed form has the root of double precision where two are close
    torch.testing.assert_close(symmetric_eigenvalues(a), expected, atol=1e-5, rtol=1e-7)


def test_the_elastic_loss_and_its_gradient_are_those_of_the_singular_values():
    jacobian = torch.eye(3) + 10.0 ** torch.linspace(-5, -0.5, 100)[:, None, None] * random(100, 3, 3)  # nearly rigid
    mine, theirs = (jacobian.clone().requires_grad_() for _ in range(2))
    square = log_singular_square(mine)
    expected = torch.linalg.svdvals(theirs).log().square().sum(-1)
    torch.testing.assert_close(square, expected, atol=1e-12, rtol=1e-5)
    square.sum().backward()
    expected.sum().backward()
    torch.testing.assert_close(mine.grad, theirs.grad, atol=1e-6, rtol=1e-3)


def test_a_rigid_motion_costs_nothing_and_has_no_gradient():
    turn = rotated(torch.eye(3).expand(4, 3, 3).reshape(-1, 3), torch.randn(4, 1, 3).expand(4, 3, 3).reshape(-1, 3))
    jacobian = turn.view(4, 3, 3).clone().requires_grad_()
    loss = elastic_loss(jacobian, 0.03)
    loss.sum().backward()
    assert loss.max() < 1e-6 and jacobian.grad.abs().max() < 1e-2
    double = (2 * torch.eye(3))[None].requires_grad_()  # all singular values are 2
    log_singular_square(double).sum().backward()
    torch.testing.assert_close(double.grad[0], math.log(2) * torch.eye(3))
    assert float(geman_mcclure(torch.tensor(1e9), 0.03)) == pytest.approx(2)


@pytest.mark.parametrize(("motion", "space"), [("se3", BOX), ("translation", BOX), ("se3", OPEN)])
def test_the_jacobian_is_the_derivative_of_the_motion_and_can_be_learnt(motion, space):
    field, points, code = (
        motion_field(motion, space).double(),
        (2 if space is OPEN else 0.5) * random(20, 3),
        random(20, 2),
    )
    jacobian = field.jacobian(points, code)
    weights = window(field.bands, field.alpha)

    def exact(x):
        return moved(x, field.network.differentiable(space.warp(x), code, weights))

    step = 1e-7
    for axis in range(3):
        offset = step * torch.eye(3).double()[axis]
        difference = (exact(points + offset) - exact(points - offset)) / (2 * step)
        torch.testing.assert_close(jacobian[..., axis], difference, atol=1e-5, rtol=1e-5)
    elastic_loss(jacobian, 0.03).sum().backward()
    assert all(p.grad.isfinite().all() for p in field.parameters() if p.grad is not None)
    assert field.network.last.weight.grad.any()
    expected, quick = exact(points).detach(), field.float()(points.float(), code.float())
    single = field.jacobian(points.float(), code.float())
    torch.testing.assert_close(single.detach().double(), jacobian.detach(), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(quick.detach().double(), expected, atol=0.03, rtol=0.03)  # in bfloat16


def test_points_are_followed_through_the_canonical_scene():
    """Two moments between which all turns as one: points go where the turn takes them."""
    method = Nerfies(FRAME, replace(Nerfies.smallest(), appearance_code=0))
    network = method.network.motion.network
    for parameter in network.parameters():
        parameter.data.zero_()
    network.last.bias.data += torch.tensor([0.0, 0.0, 0.4, 0.1, 0.0, 0.0])
    points = random(10, 3).float()
    torch.testing.assert_close(method.follow(points, 0.0, 3.0), points, atol=1e-5, rtol=0)
    code = method.moment_codes(torch.full((10,), 1.0))
    motion = method.network.motion
    torch.testing.assert_close(
        motion.inverse(motion(points, code), code, torch.zeros(10, 3)), points, atol=1e-4, rtol=0
    )


def test_octaves_join_one_after_another():
    assert window(4, torch.tensor(0.0)).tolist() == [0, 0, 0, 0]
    torch.testing.assert_close(window(4, torch.tensor(1.5)), torch.tensor([1, 0.5, 0, 0]))
    field = motion_field()
    field.before_step(None, 0, 0.25)
    assert float(field.alpha) == 2.0


def test_codes_are_those_of_training_moments_and_interpolated_between():
    scene = tiny.scene()
    times = torch.tensor([0.0, 1, 1, 2, 4, 4, 0, 1, 2, 4, 0, 1]).float()
    scene = replace(scene, cameras=replace(scene.cameras, time=times), frame=replace(scene.frame, times=(0.0, 4.0)))
    codes = MomentCodes(scene.frame, 3)
    codes.begin(None, scene, math.inf)
    assert codes.moments[:4].tolist() == [0, 1, 2, 4] and codes.moments[4:].isinf().all()
    found = codes(torch.tensor([-1.0, 0.0, 1.0, 1.5, 3.0, 4.0, 9.0]))
    c = codes.codes
    torch.testing.assert_close(found, torch.stack([c[0], c[0], c[1], (c[1] + c[2]) / 2, (c[2] + c[3]) / 2, c[3], c[3]]))
    waves = MomentCodes(scene.frame, 4, waves=True)
    waves.begin(None, scene, math.inf)
    half = 0.5 * torch.tensor([[0.0, 1, 0, 1], [1, 0, 0, -1], [0, -1, 0, 1]])  # at the first, middle and last moment
    torch.testing.assert_close(waves.codes[[0, 2, 3]].detach(), half, atol=1e-6, rtol=0)
    assert [control.name for control in codes.controls] == ["time"] and MomentCodes(Frame(), 3).controls == ()


@pytest.mark.parametrize("field", ["hash", "network"])
def test_both_canonical_scenes_deform_and_are_sliced(field):
    small = changed(Nerfies.smallest(), depth=3, skip_layer=2, position_frequencies=3, coarse_samples=8, fine_samples=8)
    for slices in (0, 2):
        method = Nerfies(FRAME, changed(small, field=field, rays_per_step=64, slice_dimensions=slices))
        for parameter in method.parameters():
            parameter.data += 0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(2))
        points = random(30, 3).float().clamp(-0.9, 0.9)
        early, late = (method.given(time=t).density(points) for t in (0.0, 4.0))
        assert not torch.allclose(early, late)
        assert torch.allclose(early, method.density(points))
        method.eval()
        camera = tiny.scene().cameras[0]
        pictures = [method.given(time=t).render(camera).rgb for t in (0.0, 4.0)]
        assert not torch.allclose(*pictures, atol=1e-3)
        moment = replace(camera, time=torch.tensor([4.0]))
        torch.testing.assert_close(method.render(moment).rgb, pictures[1])


def test_later_moments_and_levels_join_while_the_budget_is_spent():
    scene = tiny.scene()
    scene = replace(scene, cameras=replace(scene.cameras, time=torch.arange(12).float()))
    scene = replace(scene, frame=replace(scene.frame, times=(0.0, 11.0)))
    base = Nerfies.smallest()
    config = changed(base, table_annealing=0.5, growth=0.5)
    method, points = Nerfies(scene.frame, config), 2 * torch.rand(20, 3) - 1
    last = []
    for progress in (0.0, 0.25, 0.5):
        method.progress = progress
        method.before_step(0, progress)
        last.append(float(method.batch(scene, torch.Generator().manual_seed(0)).rays.time.max()))
        encoded = method.network.canonical.encode(points).view(20, base.backbone.table.levels, -1)
        assert bool(encoded[:, -1].any()) == (progress == 0.5) and encoded[:, 0].any()
    assert last == [1.0, 6.0, 11.0]  # a tenth of the capture, 0.55 of it, and all


def test_background_points_that_move_cost():
    method = Nerfies(FRAME, Nerfies.smallest())
    method.background_points = random(50, 3).float()
    motion, chance = method.network.motion, torch.Generator().manual_seed(0)
    still = method.restlessness(motion, chance).item()
    motion.network.last.bias.data += 0.1
    assert still < 0.5 < 1.9 < method.restlessness(motion, chance).item()
