"""How a cloud learns and how its number changes: the lazy optimiser, both strategies, the filter, the beginning."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget
from test_gaussians import NAMES, cloud

from lumigraph import kernels, methods
from lumigraph.components.clouds.adaptive import AdaptiveDensity, AdaptiveNumbers
from lumigraph.components.clouds.cloud import Cloud, CloudAdam
from lumigraph.components.clouds.density_control import MIN_CAP, PRUNE_OPACITY, RefineNumbers
from lumigraph.components.clouds.error_density import ErrorDensity
from lumigraph.components.clouds.initialization import initial_cloud, nearest_distance
from lumigraph.components.training.row_optimizers import adam_rate
from lumigraph.errors import LumigraphError
from lumigraph.files.ranges import changed
from lumigraph.geometry import to_matrix
from lumigraph.methods.gaussian_splatting.mcmc import MarkovChain, McmcNumbers, sample_by, shared_out
from lumigraph.methods.gaussian_splatting.mip_filter import FILTER_VARIANCE, convolved, sampling_interval
from lumigraph.run import build

pytestmark = budget("methods")


def learn(some: Cloud, rate: float = 0.01) -> CloudAdam:
    """An optimizer of a cloud, which took one step, so that every moment is there."""
    some.optimizer = CloudAdam([{"params": [getattr(some, name)], "lr": rate} for name in NAMES])
    stepped(some)
    return some.optimizer


def stepped(some: Cloud) -> None:
    """Take one step."""
    for name in NAMES:
        getattr(some, name).grad = torch.ones_like(getattr(some, name))
    some.optimizer.step()
    some.optimizer.zero_grad()


def adaptive(count: int, threshold: float) -> AdaptiveDensity:
    return AdaptiveDensity(RefineNumbers(), AdaptiveNumbers(densify_grad_threshold=threshold), count)


EVERY_ADDITION = {
    "gaussian-splatting": {
        "objects": "yes",
        "filter_3d": True,
        "few_views": "yes",
        "robust": "yes",
        "appearance": "yes",
    },
    "deformable-splatting": {"nodes": 20},
    "planar-splatting": {"appearance": "yes"},
}


@pytest.mark.parametrize("name", EVERY_ADDITION)
def test_all_additions_follow_a_cloud_that_grows_and_is_pruned_in_one_step(name, monkeypatch):
    """The cloud is doubled, then loses a part, before anything else has seen it; next time in the other order."""
    scene, kind = tiny.scene(), methods.find(name)
    if name == "deformable-splatting":
        scene = replace(scene, frame=replace(scene.frame, times=(0.0, 1.0)))
    config = changed(kind.smallest(), **EVERY_ADDITION[name])
    method = build(kind, scene.frame, config, torch.device("cpu"), 0)
    method.begin(scene)
    optimizers, generator, counts = method.optimizers(), torch.Generator().manual_seed(0), []

    def grow(step):
        some = step.learnt
        before, count = some.means.detach().clone(), len(some)
        some.rebuild(torch.arange(count).repeat(2), torch.arange(2 * count) >= count)
        assert torch.equal(some.means[count:], before)

    def prune(step):
        keep = torch.rand(len(step.learnt), generator=generator) < 0.7
        step.learnt.prune(keep)
        counts.append(len(step.learnt))

    held = [
        (part, x)
        for part in method.additions
        for x in getattr(part, "grows", ())
        if len(getattr(part, x)) == len(method.cloud)
    ]
    assert len(held) >= {"gaussian-splatting": 3, "deformable-splatting": 4, "planar-splatting": 2}[name]
    for number, changes in enumerate([(grow, prune), (prune, grow), (grow, prune)]):
        for part, change in zip((method.density_control, method.tidying), changes, strict=True):
            monkeypatch.setattr(part, "finish", change)
        method.before_step(number, 0.2 + 0.3 * number)
        terms = method.loss(method.batch(scene, generator), number)
        for optimizer in optimizers:
            optimizer.zero_grad()
        sum(terms.values()).backward()
        for optimizer in optimizers:
            optimizer.step()
        method.after_step(number)
        assert {len(getattr(part, x)) for part, x in held} == {len(method.cloud)}
    assert len(counts) == 3 and method.render(scene.cameras[0]).rgb.isfinite().all()


def test_where_everything_moves_it_is_adam(generator):
    start = torch.randn(7, 5, generator=generator)
    a, b = torch.nn.Parameter(start.clone()), torch.nn.Parameter(start.clone())
    lazy, plain = CloudAdam([{"params": [a], "lr": 0.02}]), torch.optim.Adam([b], lr=0.02, eps=1e-15)
    for _ in range(5):
        a.grad = torch.randn(7, 5, generator=generator)
        b.grad = a.grad.clone()
        lazy.step()
        plain.step()
    torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("columns", [None, [1.0, 0.5, 0.05]])
def test_a_gpu_moves_the_same_rows_as_far(columns, generator):
    gpu = pytest.importorskip("lumigraph.kernels._row_optimizers", exc_type=ImportError)
    start, device = torch.randn(900, 3, generator=generator), "cuda" if torch.cuda.is_available() else "cpu"
    p = torch.nn.Parameter(start.clone())
    optimizer = CloudAdam([{"params": [p], "lr": 0.02, "columns": columns}])
    theirs = [start.clone(), *torch.zeros(2, 900, 3), torch.zeros(900)]
    theirs, factors = [x.to(device) for x in theirs], torch.tensor(columns or [1.0] * 3, device=device)
    for t in range(1, 9):
        gradient = torch.randn(900, 3, generator=generator) * (torch.rand(900, 1, generator=generator) < 0.4)
        p.grad = gradient.clone()
        optimizer.step()
        rate = adam_rate(optimizer.param_groups[0], t)
        gpu.cloud_adam(theirs[0], gradient.to(device), *theirs[1:], factors, float(t), rate, (0.9, 0.999), 1e-15)
    ours = p.detach(), *(optimizer.state[p][name] for name in ("mean", "square", "last"))
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b.cpu(), rtol=1e-4, atol=1e-6)


def test_a_row_seen_now_and_then_goes_as_far_as_adam_would_take_it():
    """A row with a gradient in every 20th step: the same as Adam, which moves it in all of them, in the end."""
    a, b = torch.nn.Parameter(torch.zeros(1, 2)), torch.nn.Parameter(torch.zeros(1, 2))
    ours, plain = CloudAdam([{"params": [a], "lr": 0.01}]), torch.optim.Adam([b], lr=0.01, eps=1e-15)
    for step in range(1, 400):
        gradient = torch.tensor([[1.0, -3.0]]) if step % 20 == 0 else torch.zeros(1, 2)
        a.grad, b.grad = gradient, gradient.clone()
        ours.step()
        plain.step()
    torch.testing.assert_close(a, b, rtol=0.05, atol=0)


def test_rows_without_gradient_stay_and_columns_have_their_own_rates(generator):
    p = torch.nn.Parameter(torch.zeros(3, 2))
    optimizer = CloudAdam([{"params": [p], "lr": 0.1, "columns": [1.0, 0.5]}])
    p.grad = torch.tensor([[1.0, 1.0], [0.0, 0.0], [0.0, 3.0]])
    optimizer.step()
    torch.testing.assert_close(p.detach(), torch.tensor([[-0.1, -0.05], [0.0, 0.0], [0.0, -0.05]]))
    assert optimizer.state[p]["last"].tolist() == [1, 0, 1]
    assert (optimizer.state[p]["mean"][1] == 0).all()


def test_rebuilding_takes_moments_along(generator):
    some = Cloud(cloud(6))
    optimizer = learn(some)
    means, square = some.means.detach().clone(), optimizer.state[some.means]["square"].clone()
    some.rebuild(torch.tensor([5, 0, 0]), torch.tensor([False, False, True]))
    assert len(some) == 3 and torch.equal(some.means.detach(), means[[5, 0, 0]])
    assert torch.equal(optimizer.state[some.means]["square"][:2], square[[5, 0]])
    assert (optimizer.state[some.means]["square"][2] == 0).all()
    stepped(some)  # and it goes on moving what it now holds
    assert not torch.equal(some.means.detach(), means[[5, 0, 0]])


def test_small_ones_are_cloned_large_ones_split_and_faint_ones_go(generator):
    some = Cloud(cloud(4))
    with torch.no_grad():
        some.log_scales[:] = torch.tensor([0.001, 0.5, 0.01, 0.01]).log()[:, None]
        some.opacities[:] = torch.tensor([0.5, 0.5, 0.5, PRUNE_OPACITY / 2]).logit()
    before = some.gaussians().means.detach().clone()
    control = adaptive(4, 0.5)
    learn(some, rate=0.0)
    gradient = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.1, 0.1], [9.0, 9.0]])
    control.record(gradient, torch.ones(4, dtype=torch.bool), (2, 2))
    assert not control.refine(some, 1.0, 100, generator)
    assert len(some) == 5 and torch.equal(some.source, torch.tensor([0, 1, 2, 0, 1]))
    means, scales = some.means.detach(), some.log_scales.detach().exp()[:, 0]
    assert torch.equal(means[0], before[0]) and torch.equal(means[3], before[0])  # the clone lies upon its original
    assert torch.equal(means[2], before[2])
    for half in (1, 4):  # both halves are smaller, and elsewhere
        assert not torch.equal(means[half], before[1]) and scales[half].item() == pytest.approx(0.5 / 1.6)


def test_a_cloud_grows_no_further_than_it_may_and_says_so(generator):
    some = Cloud(cloud(10))
    with torch.no_grad():
        some.opacities[:] = 0.0
    control = adaptive(10, 0.5)
    learn(some)
    with torch.no_grad():
        some.log_scales[:] = -9.0
    control.record(torch.arange(10.0)[:, None].repeat(1, 2), torch.ones(10, dtype=torch.bool), (2, 2))
    strongest = some.means.detach()[[8, 9]].clone()
    assert control.refine(some, 1.0, 12, generator)
    assert len(some) == 12 and torch.equal(some.means.detach()[10:], strongest)


@pytest.mark.parametrize("ramp", [False, True])
def test_a_cap_may_rise_over_the_budget_and_need_not_be(ramp, monkeypatch):
    from lumigraph.components.clouds import density_control

    monkeypatch.setattr(density_control, "room_for", lambda size, device: 10_000)
    some = Cloud(cloud(10))
    for most, caps in (110, (10, 60, 110)), (0, (10, 5010, 10_010)):
        control = AdaptiveDensity(RefineNumbers(most, cap_ramp=ramp, refine_until=0.5), AdaptiveNumbers(), 10)
        control.initial_count.fill_(10)
        found = [control.current_cap(some, progress) for progress in (0.0, 0.25, 0.5)]
        assert found == (list(caps) if ramp else [caps[-1]] * 3)


@pytest.mark.parametrize(
    ("numbers", "steps", "cap"),
    [
        (RefineNumbers(500_000, gaussians_per_step=15.0), 1000, MIN_CAP),
        (RefineNumbers(500_000, gaussians_per_step=15.0), 20_000, 300_000),
        (RefineNumbers(500_000, gaussians_per_step=15.0), 100_000, 500_000),
        (RefineNumbers(50_000, gaussians_per_step=15.0), 20_000, 50_000),
        (RefineNumbers(500_000), 1000, 500_000),
    ],
)
def test_a_cap_may_follow_the_budget(numbers, steps, cap, monkeypatch):
    from lumigraph.components.clouds import density_control

    monkeypatch.setattr(density_control, "room_for", lambda size, device: 1_000_000)
    control = AdaptiveDensity(numbers, AdaptiveNumbers(), 10)
    assert control.allowed(steps) == control.max_count(Cloud(cloud(10)), steps) == cap
    assert control.current_cap(Cloud(cloud(10)), 0.5, steps) == cap


@pytest.mark.parametrize("strategy", ["mcmc", "error"])
def test_what_grows_to_its_cap_needs_one(strategy):
    kind = methods.find("gaussian-splatting")
    with pytest.raises(LumigraphError, match="--max-gaussians"):
        build(kind, tiny.scene().frame, kind.Config(strategy=strategy), torch.device("cpu"), 0)


def test_opacity_is_reset_for_all_but_the_faint():
    some, control = Cloud(cloud(20)), adaptive(20, 1.0)
    optimizer = learn(some)
    control.reset_opacity(some)
    assert (some.opacities.sigmoid() <= 2 * PRUNE_OPACITY + 1e-6).all()
    assert (optimizer.state[some.opacities]["mean"] == 0).all()


@pytest.mark.parametrize("copies", [2, 3, 7])
def test_copies_together_look_as_the_one_did(copies):
    """On the axis through the centre exactly in opacity; over the whole footprint in light, which eq. 10 preserves."""
    one = cloud(1)
    few = shared_out(one, torch.tensor([copies]))
    x = torch.linspace(-40, 40, 80_001, dtype=torch.float64)

    def row(gaussians, n):
        """Opacity of n copies along a line, in deviations of the original."""
        width = float((gaussians.log_scales - one.log_scales)[0, 0].double().exp())
        each = float(gaussians.opacities.double().sigmoid()) * torch.exp(-0.5 * (x / width) ** 2)
        return 1 - (1 - each) ** n

    before, after = row(one, 1), row(few, copies)
    assert abs(after.max() - before.max()) < 1e-5
    assert abs(after.sum() / before.sum() - 1) < 1e-4


def test_the_dead_move_to_the_living_and_new_ones_join(generator):
    some = Cloud(cloud(12))
    with torch.no_grad():
        some.opacities[:] = torch.tensor([0.9] * 4 + [PRUNE_OPACITY / 5] * 8).logit()
    learn(some, rate=0.0)
    living = some.means.detach()[:4].clone()
    MarkovChain(RefineNumbers(), McmcNumbers()).refine(some, 15, generator)
    assert len(some) == 15
    distance = (some.means.detach()[:, None] - living).norm(dim=-1).amin(1)
    assert (distance == 0).all() and (some.opacities.sigmoid() > PRUNE_OPACITY).all()


def test_noise_moves_the_transparent_and_leaves_the_opaque(generator):
    some = Cloud(cloud(40))
    with torch.no_grad():
        some.opacities[:20], some.opacities[20:] = torch.tensor(0.9).logit(), torch.tensor(0.001).logit()
    before = some.means.detach().clone()
    MarkovChain(RefineNumbers(), McmcNumbers()).explore(some, 1e-4, generator)
    moved = (some.means.detach() - before).norm(dim=-1)
    assert (moved[:20] == 0).all() and (moved[20:] > 0).all()


def test_sampling_follows_the_weights(generator):
    drawn = sample_by(torch.tensor([0.0, 1.0, 3.0, 0.0]), 20_000, generator)
    share = torch.bincount(drawn, minlength=4) / 20_000
    torch.testing.assert_close(share, torch.tensor([0.0, 0.25, 0.75, 0.0]), rtol=0, atol=0.02)


def test_a_filtered_cloud_keeps_its_light():
    """The 3-D filter convolves: wider, and fainter by as much (opacity times the root of the determinant stays)."""
    some = cloud(30)
    wider = convolved(some, torch.full((30,), 0.1))
    torch.testing.assert_close((2 * wider.log_scales).exp(), (2 * some.log_scales).exp() + FILTER_VARIANCE * 0.01)
    for a in (some, wider):
        a_light = a.opacities.sigmoid() * a.log_scales.sum(-1).exp()
        torch.testing.assert_close(a_light, some.opacities.sigmoid() * some.log_scales.sum(-1).exp(), rtol=1e-4, atol=0)


def test_the_sampling_interval_is_depth_over_focal_length():
    scene = tiny.scene()
    interval = sampling_interval(torch.zeros(1, 3), scene.cameras, 0.1)
    torch.testing.assert_close(interval, torch.tensor([tiny.DISTANCE / tiny.FOCAL]), rtol=1e-4, atol=0)


def test_a_cloud_without_points_begins_inside_the_silhouettes(generator):
    begun = initial_cloud(tiny.scene(), "random", 500, 1000, 2, generator)
    assert len(begun) == 500 and begun.degree == 2
    away = begun.means.norm(dim=-1)  # the ball has a radius of 0.6 and a pixel 0.1; of the box 38 % lie within 0.9
    assert (away < 0.9).float().mean() > 0.9


def test_a_cloud_with_points_begins_at_them(generator):
    from dataclasses import replace

    points = torch.randn(50, 3, generator=generator) * 0.3
    colours = torch.randint(0, 256, (50, 3), generator=generator).byte()
    begun = initial_cloud(replace(tiny.scene(), points=points, point_colours=colours), "sparse", 500, 40, 1, generator)
    assert len(begun) == 40  # no more than may be
    which = torch.cdist(begun.means, points).argmin(1)
    assert torch.equal(begun.means, points[which])
    seen = begun.harmonics[:, 0] * 0.28209479 + 0.5
    torch.testing.assert_close(seen, colours[which].float() / 255, rtol=0, atol=1e-5)


def test_nearest_distances():
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.0, 2.0, 0]])
    expected = torch.tensor([(1 + 4) / 2, (1 + 5) / 2, (4 + 5) / 2]).sqrt()
    torch.testing.assert_close(nearest_distance(points), expected)
    assert nearest_distance(points[:1]).tolist() == [1.0]


def by_error(count: int) -> ErrorDensity:
    return ErrorDensity(RefineNumbers(), AdaptiveNumbers(), count)


@pytest.mark.parametrize("measured", [False, True])
def test_a_gaussian_explains_its_share_of_the_error_and_nothing_else_changes(measured):
    """The followed gradient is sum_p w_i(p) error(p), with weights of the derivative of grey harmonics; other gradients
    are those without it, where depth is measured as well."""
    scene, kind = tiny.scene(), methods.find("gaussian-splatting")
    depth = {"depth_weight": 0.5} if measured else {}
    found = {}
    for strategy in ("error", "adaptive"):
        config = changed(kind.smallest(), strategy=strategy, refine_cameras=False, **depth)
        method = build(kind, scene.frame, config, torch.device("cpu"), 0)
        method.begin(scene)
        method.progress = 0.3
        method.before_step(3, method.progress)
        batch = method.batch(scene, torch.Generator().manual_seed(1))
        sum(method.loss(batch, 3).values()).backward()
        found[strategy] = method, {name: getattr(method.cloud, name).grad for name in NAMES}
    for name in NAMES:
        torch.testing.assert_close(found["error"][1][name], found["adaptive"][1][name], rtol=1e-5, atol=1e-8)
    method, step = found["error"][0], found["error"][0].current
    assert found["adaptive"][0].current.explained is None and ("measured" in step.terms) == measured
    error = (step.rgb - step.target).detach().abs().mean(-1)
    weights, seen = torch.zeros(len(method.cloud), 3, requires_grad=True), step.picture
    footprints = seen.centres.detach(), seen.conics.detach(), seen.opacities.detach()
    grey, _, _ = kernels.rasterize(*footprints, weights, seen.depths.detach(), seen.tiles, seen.stop)
    (grey[..., 0] * error).sum().backward()
    torch.testing.assert_close(step.explained.grad, weights.grad[:, 0] / error.numel(), rtol=1e-4, atol=1e-9)
    assert (step.explained.grad > 0).sum() > 20


def test_the_largest_errors_are_divided_up_to_the_cap_and_faint_ones_go(generator):
    some = Cloud(cloud(6))
    with torch.no_grad():
        some.opacities[:] = torch.tensor([0.5] * 5 + [PRUNE_OPACITY / 2]).logit()
    learn(some, rate=0.0)
    control = by_error(6)
    control.explained += torch.tensor([0.1, 3.0, 0.2, 2.0, 0.0, 9.0])
    assert control.refine(some, 1.0, 7, generator)
    assert torch.equal(some.source, torch.tensor([0, 1, 2, 3, 4, 1, 3])) and not control.explained.any()
    learn(some, rate=0.0)
    control.explained = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert not control.refine(some, 1.0, 100, generator)  # what explains no error stays whole
    assert len(some) == 8


def test_two_halves_keep_place_variance_and_faint_opacity(generator):
    """Both have the centre and, along each axis, the variance of the one that was divided; the pair lets as much light
    through a thin one as before, along the line of the centres."""
    some = Cloud(cloud(30))
    with torch.no_grad():
        some.opacities[:] = torch.tensor(0.02).logit()
    before = some.gaussians()[:]
    learn(some, rate=0.0)
    control = by_error(30)
    control.explained += 1
    control.refine(some, 1.0, 60, generator)
    one, two = some.gaussians()[:30], some.gaussians()[30:]
    torch.testing.assert_close((one.means + two.means) / 2, before.means, rtol=0, atol=1e-5)
    offset = (to_matrix(before.quaternions).mT @ (one.means - before.means)[:, :, None])[:, :, 0]
    torch.testing.assert_close(
        offset.square() + (2 * one.log_scales).exp(), (2 * before.log_scales).exp(), rtol=1e-3, atol=0
    )
    longest = before.log_scales.argmax(-1, keepdim=True)
    shrunk = (one.log_scales - before.log_scales).gather(1, longest)
    torch.testing.assert_close(shrunk, torch.full_like(shrunk, 0.5 * torch.tensor(0.5).log().item()))
    assert (one.log_scales <= before.log_scales + 1e-6).all()
    torch.testing.assert_close(2 * one.opacities.sigmoid() * 0.5**0.5, torch.full((30,), 0.02), rtol=0.02, atol=0)
