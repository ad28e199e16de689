"""Open captures: samples lie where a grid proposes, and what makes fog costs something."""

import math

import numpy as np
import pytest
import torch
from numba import njit

from lumigraph.camera.rays import Look, Rays, Samples
from lumigraph.components.fields.spaces import NDC, Contraction
from lumigraph.components.sampling.proposal import Proposal, Proposed, edges_of, excess_of, proposal_loss
from lumigraph.components.sampling.samplers import AIR_WEIGHT, MIN_WEIGHT, ProposalNumbers, ProposalSampler
from lumigraph.components.training.regularizers import depth_loss, distortion_loss, scale_gradients
from lumigraph.datasets.scene import Forward
from lumigraph.kernels.sample_proposals.cpu import cube_root, exponential
from lumigraph.method import Field
from lumigraph.volume import composite

AHEAD = Forward(((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)), (1.0, 1.0), 1.0)
SPACES = {"contracted": Contraction(0.1, 30.0), "forward": NDC(AHEAD, 0.1)}


def rays(count: int = 5) -> Rays:
    across = torch.linspace(-0.2, 0.2, count)
    directions = torch.nn.functional.normalize(torch.stack([across, across / 2, torch.ones(count)], -1), dim=-1)
    return Rays(torch.zeros(count, 3), directions, torch.full((count,), 1e-3))


@pytest.fixture(params=SPACES)
def proposal(request):
    return Proposal(SPACES[request.param], 48, 32, 8)


def test_intervals_join_from_near_to_far(proposal):
    found = proposal.sample(rays(), torch.rand(5, 2))
    t_start, t_end = (x.view(5, 8) for x in (found.samples.t_start, found.samples.t_end))
    near, far = proposal.space.interval(rays())
    torch.testing.assert_close(t_start[:, 1:], t_end[:, :-1])
    torch.testing.assert_close(t_start[:, 0], near)
    torch.testing.assert_close(t_end[:, -1], far, rtol=1e-3, atol=1e-3)
    assert (found.samples.length > 0).all()


def test_samples_lie_where_places_are_known(proposal):
    known = rays().at(torch.full((5,), 2.5))
    before = proposal.sample(rays()).samples
    proposal.begin(known)
    after = proposal.sample(rays()).samples

    def nearest(samples: Samples) -> torch.Tensor:
        return (samples.t.view(5, 8) - 2.5).abs().sort(-1).values[:, :4].mean()

    assert nearest(after) < 0.3 < nearest(before)


def test_a_new_grid_looks_everywhere_whatever_it_holds(proposal):
    proposal.begin(rays().at(torch.full((5,), 2.5)))
    proposal.anneal(0.0)
    even = proposal.sample(rays()).edges
    torch.testing.assert_close(even, edges_of(8, torch.full((5,), 0.5)), atol=1e-4, rtol=0)


def test_the_grid_learns_what_it_overlooked(proposal):
    """Weight at one place: gradient descent on the loss alone makes the grid propose it."""
    with torch.no_grad():
        proposal.grid.values.fill_(-3.0)
    adam = torch.optim.Adam([proposal.grid.values], 0.3)
    generator = torch.Generator().manual_seed(0)
    losses = []
    for _ in range(60):
        found = proposal.sample(rays(), torch.rand(5, 2, generator=generator))
        there = (found.samples.t_start <= 2.5) & (found.samples.t_end > 2.5)
        loss = proposal_loss(found, there.float())
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.2 * losses[0]
    assert ((proposal.sample(rays()).samples.t - 2.5).abs().view(5, 8).median(-1).values < 1.0).all()


def test_nothing_is_overlooked_within_a_bound():
    proposal = Proposal(SPACES["contracted"], 16, 32, 8)
    found = proposal.sample(rays())
    whole = found.weights.sum(-1, keepdim=True).expand(5, 8).flatten()
    assert float(proposal_loss(found, 0 * whole)) == 0
    assert float(proposal_loss(found, 2 * whole)) > 0


def test_the_loop_sums_excess_as_the_definition_does(generator):
    """Loss and gradient, with edges that coincide with those of bins and others."""
    bins, edges = (edges_of(n, torch.rand(6, generator=generator)) for n in (16, 7))
    edges[0] = bins[0, ::2][:8]
    edges[0, -1] = 1
    found = (0.2 * torch.rand(6, 16, generator=generator)).requires_grad_()
    weights = torch.rand(6, 7, generator=generator)
    samples = Samples.rows(edges[:, :-1], edges[:, -1])
    loss = proposal_loss(Proposed(samples, edges, bins, found), weights.flatten())
    expected = excess_of(*(x.double() for x in (found, bins, edges, weights))).mean()
    torch.testing.assert_close(loss.double(), expected)
    gradients = (torch.autograd.grad(x, found)[0] for x in (loss, expected))
    torch.testing.assert_close(*gradients, atol=1e-6, rtol=1e-5)


def test_weight_in_one_place_is_not_spread():
    samples = Samples.rows(torch.linspace(1, 3, 9)[:-1].expand(2, 8), torch.full((2,), 3.0))
    one, two = torch.zeros(2, 8), torch.zeros(2, 8)
    one[:, 3] = 1
    two[:, 0] = two[:, 7] = 0.5
    assert distortion_loss(samples, one.flatten()) < 0.3 * distortion_loss(samples, two.flatten())


def test_rays_should_end_where_something_is_known_to_be():
    samples = Samples.rows(torch.linspace(1, 3, 9)[:-1].expand(3, 8), torch.full((3,), 3.0))
    weights = torch.zeros(3, 8)
    weights[0, 3], weights[1, 7] = 1, 1  # at 1.75 to 2, behind that, and nowhere
    found = depth_loss(samples, weights.flatten(), torch.full((3,), 1.8), 1e-3)
    torch.testing.assert_close(found, torch.tensor(2 / 3))


def test_what_is_near_is_learnt_slowly():
    samples = Samples(torch.tensor([0.0, 1.0, 4.0]), torch.tensor([1.0, 1.5, 5.0]), torch.tensor([0, 3]))
    density, rgb = torch.ones(3, requires_grad=True), torch.ones(3, 3, requires_grad=True)
    sum(x.sum() for x in scale_gradients(samples.t, density, rgb)).backward()
    torch.testing.assert_close(density.grad, torch.tensor([0.25, 1.0, 1.0]))
    torch.testing.assert_close(rgb.grad, torch.tensor([0.25, 1.0, 1.0])[:, None].expand(3, 3))


class Formula(Field):
    """A field by a formula of density; colours of positions, and the number of samples that got one."""

    def __init__(self, formula):
        super().__init__()
        self.formula, self.coloured = formula, []

    def geometry(self, points, code=None):
        return self.formula(points), 5 * points

    def colour(self, features, directions, code=None):
        self.coloured.append(len(features))
        return features.sin().square()


def sampler() -> ProposalSampler:
    return ProposalSampler(SPACES["contracted"], ProposalNumbers(), 1024)


def test_rays_end_at_places_that_are_known_until_half_of_the_budget_is_spent():
    made, generator = sampler(), torch.Generator().manual_seed(0)
    made.surface, made.surface_from = torch.tensor([[0.0, 0.0, 2.0]]), torch.zeros(1, 3)
    made.before_step(None, 0, 0.1)

    def wall(place: float):
        return lambda points: 30.0 * (points.norm(dim=-1) > place)

    errors = []
    for place in (2.0, 1.0):
        (found,) = made.sample(rays(), Formula(wall(place)), generator=generator)
        errors.append(float(made.terms(wall(place), found, generator)["depth"]))
    assert errors[0] < 0.8 * errors[1]
    made.before_step(None, 0, 0.9)
    assert not {"depth", "air"} & made.terms(wall(1.0), found, generator).keys()


def test_air_between_cameras_is_clear_half_way_to_the_nearest_surface():
    made, generator = sampler(), torch.Generator().manual_seed(0)
    made.surface = torch.tensor([[0.0, 0.0, 2.0]]).expand(64, 3)
    made.surface_from = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]).repeat(32, 1)
    made.before_step(None, 0, 0.1)
    (found,) = made.sample(rays(), Formula(lambda points: 0 * points[:, 0]), generator=generator)

    def air(formula) -> float:
        return float(made.terms(formula, found, generator)["air"]) / AIR_WEIGHT

    assert air(lambda points: 9.0 * (points.norm(dim=-1) > 1.25)) == 0.0  # 0.2 of it aside
    assert air(lambda points: 9.0 * (points.norm(dim=-1) < 0.9)) > 0.7


def test_contraction_loops_as_it_is_written():
    space, points = SPACES["contracted"], 3 * torch.randn(200, 3)
    slow = points.clone().requires_grad_()
    torch.testing.assert_close(space.warp(points), space.warp(slow).detach())
    torch.testing.assert_close(space.stretch(points), space.stretch(slow).detach())


@pytest.mark.parametrize("sharpness", [1.0, 0.4])
def test_proposals_loop_as_they_are_written(proposal, sharpness, generator):
    """Places without gradients are those of `sample`, in the loop and without it."""
    proposal.sharpness = sharpness
    proposal.grid.values.data = 3 * torch.randn(proposal.grid.values.shape, generator=generator)
    some = rays()
    expected = proposal.sample(some).samples
    found = proposal.places(some)
    for ours, theirs in ((found.t_start, expected.t_start), (found.t_end, expected.t_end)):
        torch.testing.assert_close(1 / ours, 1 / theirs.detach(), rtol=2e-3, atol=2e-5)  # as pixels tell distances
    assert len(some) * 8 == len(found)


def test_a_rendering_without_faint_samples_is_that_of_all(generator):
    """Colours that are hardly seen are not evaluated, and the picture stays."""
    made = sampler()
    made.proposal.grid.values.data = 2 * torch.randn(made.proposal.grid.values.shape, generator=generator)

    def density(points):
        return 8 * (3 * points).sin().prod(-1).clamp(min=0) + 20 * (points.norm(dim=-1) > 2.5)

    field, many = Formula(density), rays(200)
    with torch.no_grad():
        (part,) = made.sample(many, field)
        samples = made.proposal.places(many)
        whole = Look("samples", samples, *field(*samples.along(many)))
    looks = part.look(field), whole
    seen, expected = (composite(x.samples, x.density, x.rgb, torch.ones(1, 3)) for x in looks)
    assert field.coloured[1] < 0.8 * field.coloured[0] and len(part.samples) == field.coloured[1]
    torch.testing.assert_close(seen.rgb, expected.rgb, atol=16 * MIN_WEIGHT, rtol=0)
    torch.testing.assert_close(seen.opacity, expected.opacity, atol=16 * MIN_WEIGHT, rtol=0)
    assert (seen.rgb - expected.rgb).square().mean() < 1e-6  # 60 dB


def test_loops_have_exponentials_and_cube_roots_of_their_own():
    x = torch.cat([torch.linspace(-80, 60, 2001), torch.tensor([0.0, -1e-30, -300.0])]).numpy()
    ours, roots = both(x)
    np.testing.assert_allclose(ours[:-1], np.exp(x[:-1].astype(np.float64)), rtol=1e-5)
    assert 0 < ours[-1] < 1e-37
    np.testing.assert_allclose(roots, np.exp(x.clip(-60).astype(np.float64) / 3), rtol=1e-5)


@njit
def both(x):
    """Of numbers x their exponential, and the cube root of e^x."""
    powers, roots = np.empty_like(x), np.empty_like(x)
    for i in range(len(x)):
        powers[i] = exponential(x[i])
        roots[i] = cube_root(np.float32(math.exp(max(x[i], np.float32(-60)))))
    return powers, roots
