"""RegNeRF: cameras between the photographs, smooth depth, how likely a patch is."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera.rays import Rays, Samples
from lumigraph.components.fields.coordinate_field import FrustumField
from lumigraph.components.fields.hash_field import HashField
from lumigraph.components.training.regularizers import (
    near_thickness,
    normalized_distance,
    opacity_entropy,
    patches,
    roughness,
    unseen_cameras,
)
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Forward, Frame
from lumigraph.files.ranges import changed
from lumigraph.geometry import nearest_to_lines, unit
from lumigraph.methods.instant_ngp import Config as NgpConfig
from lumigraph.methods.instant_ngp import InstantNGP
from lumigraph.methods.regnerf import RegNeRF, clipped, field_of, joined
from lumigraph.methods.regnerf.patch_flow import SIDE, PatchFlow, photographed
from lumigraph.readers.views import with_fewer_views
from lumigraph.run import build
from lumigraph.volume import composite

pytestmark = budget("methods")


def chance(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def of_table(config) -> NgpConfig:
    """The numbers of RegNeRF's hash table as Instant-NGP has them."""
    parts = {name: getattr(config, name) for name in ("table", "occupancy", "steps", "proposals", "poses")}
    losses = {"hash_weight_decay": config.hash_weight_decay, "huber_delta": config.huber_delta}
    rate = config.table_learning_rate
    return NgpConfig(**parts, **losses, learning_rate=rate, hidden_width=config.table_width, seed=config.seed)


def test_the_point_nearest_to_lines():
    point = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    origins = torch.randn(5, 3, generator=chance(), dtype=torch.float64)
    found = nearest_to_lines(origins, unit(point - origins), point)
    assert torch.allclose(found, point, atol=1e-9)
    parallel = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(2, 3)
    found = nearest_to_lines(torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64), parallel, point)
    assert found[2] == pytest.approx(0.5)  # along them, the other point says


def test_unseen_cameras_stand_between_and_look_at_the_same():
    scene = tiny.scene()
    cameras = scene.cameras[scene.splits["train"]]
    unseen = unseen_cameras(cameras, 200, chance())
    low, high = cameras.position.amin(0), cameras.position.amax(0)
    assert ((unseen.position >= low) & (unseen.position <= high)).all()
    rotation = unseen.pose[:, :, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).expand(200, 3, 3), atol=1e-5)
    up = unit(-cameras.pose[:, :, 1].mean(0))
    assert ((-rotation[:, :, 1] * up).sum(-1) > 0).all()  # nobody stands on their head
    away = unseen.position.norm(dim=-1)
    missed = torch.linalg.cross(unseen.position, unseen.forward).norm(dim=-1)  # the tiny scene is around the origin
    assert (missed / away).median() < 0.25 and unseen.image_index is None


def test_patches_are_squares_of_pixels_with_wider_cones():
    scene = tiny.scene()
    cameras = unseen_cameras(scene.cameras, 6, chance())
    rays = patches(cameras, 4, (1, 2), chance())
    assert len(rays) == 6 * 16
    for i in range(6):
        one = slice(16 * i, 16 * i + 16)
        points = rays.origins[one] + rays.directions[one]
        xy, valid = cameras[i].project(points)
        xy = xy.view(4, 4, 2)
        assert valid.all()
        step = float(xy[0, 1, 0] - xy[0, 0, 0])
        assert step == pytest.approx(1, abs=1e-3) or step == pytest.approx(2, abs=1e-3)
        assert torch.allclose(xy[:, 1:, 0] - xy[:, :-1, 0], torch.tensor(step), atol=1e-3)
        assert torch.allclose(xy[1:, :, 1] - xy[:-1, :, 1], torch.tensor(step), atol=1e-3)
        narrow = cameras[i].rays(xy.view(-1, 2)).radius
        assert torch.allclose(rays.radius[one], narrow * step, rtol=1e-3)


def test_roughness_counts_what_is_opaque_alone():
    depth = torch.zeros(1, 3, 3)
    depth[0, 1, 1] = 0.5
    opaque, clear = torch.ones(1, 3, 3), torch.ones(1, 3, 3)
    clear[0, 1, 1] = 0
    assert float(roughness(depth, opaque)) == pytest.approx((0.5 + 0.5) / 6)  # 2 of 6 pairs each way
    assert float(roughness(depth, clear)) == 0


def test_the_flow_is_a_density():
    """Its log is that of a standard normal of what it makes of a patch, and of how much it stretches patches there."""
    flow = PatchFlow()
    for parameter in flow.parameters():
        parameter.data = 0.1 * torch.randn(parameter.shape, generator=chance(len(parameter)))
    flow.whiten.copy_(torch.diag(torch.linspace(0.5, 2, 192)))
    flow.stretched.copy_(flow.whiten.diagonal().log().sum())
    flow = flow.double()
    patch = torch.rand(1, SIDE, SIDE, 3, generator=chance(), dtype=torch.float64)

    def code(x):
        x = (x - flow.mean) @ flow.whiten
        for coupling in flow.couplings:
            x, _ = coupling(x)
        return x

    x = patch.flatten(1)
    jacobian = torch.autograd.functional.jacobian(code, x)[0, :, 0]
    expected = 0.5 * code(x).square().sum() + 96 * math.log(2 * math.pi) - torch.linalg.slogdet(jacobian)[1]
    assert float(flow(patch)) == pytest.approx(float(expected) / 192)


def test_it_tells_photographs_from_noise(monkeypatch):
    from lumigraph.methods.regnerf import patch_flow

    monkeypatch.setattr(patch_flow, "PATCHES", 1024)
    flow, scene = PatchFlow(), tiny.scene()
    flow.learn(scene, 60, chance())
    assert not any(p.requires_grad for p in flow.parameters())
    known = photographed(scene, chance(1))
    shuffled = known.flatten(1)[:, torch.randperm(192, generator=chance(2))].view_as(known)
    assert flow(known).median() < flow(shuffled).median() - 0.5


def test_the_flow_learns_from_patches_before_random_colours(monkeypatch):
    """Of photographs with alpha: a transparent one is of any colour, the same in all of a patch."""
    from lumigraph.methods.regnerf import patch_flow

    monkeypatch.setattr(patch_flow, "PATCHES", 2048)
    scene = tiny.scene()
    clear = ImageStore.from_arrays([np.zeros((tiny.SIZE, tiny.SIZE, 4), np.uint8)] * len(scene))
    known = photographed(replace(scene, images=clear), chance()).flatten(1, 2)
    assert torch.equal(known, known[:, :1].expand_as(known))
    deviation = 12**-0.5  # of uniform numbers in [0, 1]
    torch.testing.assert_close(known[:, 0].mean(0), torch.full((3,), 0.5), atol=0.05, rtol=0)
    torch.testing.assert_close(known[:, 0].std(0), torch.full((3,), deviation), atol=0.02, rtol=0)


def test_matter_of_the_background_s_colour_is_seen_in_unobserved_patches():
    """White matter before white is likely; before one random colour for each patch it has another colour than air."""
    scene = tiny.scene()
    method = build(RegNeRF, scene.frame, RegNeRF.smallest(), torch.device("cpu"), 0)
    unseen = method.batch(scene, chance()).unseen
    assert torch.equal(method._behind_patches(unseen, False, chance()), torch.ones(2 * SIDE**2, 3))
    behind = method._behind_patches(unseen, True, chance()).view(2, SIDE**2, 3)
    assert torch.equal(behind, behind[:, :1].expand_as(behind)) and not torch.equal(behind[0], behind[1])


def test_a_flow_stops_when_its_seconds_are_over(monkeypatch):
    from lumigraph.methods.regnerf import patch_flow

    monkeypatch.setattr(patch_flow, "PATCHES", 256)
    short, long = PatchFlow(), PatchFlow()
    short.learn(tiny.scene(), 5, chance(), seconds=0.0)
    long.learn(tiny.scene(), 5, chance())
    last = [flow.couplings[0].network[-1].weight.abs().max() for flow in (short, long)]
    assert last[0] == 0 < last[1]


@pytest.mark.parametrize("field", ["network", "hash"])
def test_a_step_learns_from_patches_nobody_photographed(field):
    scene = tiny.scene()
    config = changed(RegNeRF.smallest(), field=field, samples_per_step=2048, levels=4, log2_hashmap_size=11)
    method = build(RegNeRF, scene.frame, config, torch.device("cpu"), 0)
    method.begin(scene)
    method.before_step(0, 0.0)
    batch = method.batch(scene, chance())
    assert batch.unseen is not None and len(batch.unseen) == 2 * SIDE**2
    terms = method.loss(batch, 0)
    assert {"smoothness", "likelihood"} <= terms.keys()
    (terms["smoothness"] + terms["likelihood"]).backward()
    moved = [p for p in method.network.parameters() if p.grad is not None and p.grad.any()]
    assert moved and all(p.grad is None for p in method.flow.parameters())


def test_the_loss_of_the_network_is_the_release_s():
    """Colours summed over channels, eq. 6 without a half, falling weights, and a tenth of both on the coarse pass."""
    scene = tiny.scene()
    config = changed(RegNeRF.smallest(), likelihood_weight=0.0, depth_settling=0.5, depth_weight_start=400.0)
    method = build(RegNeRF, scene.frame, config, torch.device("cpu"), 0)
    method.progress = 0.125
    method.before_step(0, 0.125)
    batch = replace(method.batch(scene, chance()), alpha=None)
    terms = method.loss(batch, 3)
    passes = method.sampler.sample(joined(batch.rays, batch.unseen), method.network, generator=method.random(3))
    assert [each.name for each in passes] == ["coarse", "fine"] and set(terms) == {
        *("coarse", "fine", "smoothness", "coarse smoothness")
    }
    weights = {"coarse": (0.1, 0.1, "coarse smoothness"), "fine": (1.0, 300 + 0.1 / 4, "smoothness")}
    for each in passes:
        look, (colour, depth, name) = each.look(method.network), weights[each.name]
        distance = normalized_distance(look.samples.t)[:, None]
        seen = composite(look.samples, look.density, look.rgb, method.background, places=distance)
        error = (seen.rgb[: len(batch)] - batch.rgb).square().sum() / len(batch)
        torch.testing.assert_close(terms[each.name], colour * error)
        opacity = seen.opacity[len(batch) :].detach().view(-1, SIDE, SIDE)
        place = seen.extra["places"][len(batch) :, 0].view(-1, SIDE, SIDE) / opacity.clamp_min(1e-3)
        pairs = [
            opacity[p, i, j] * opacity[p, i + di, j + dj] * (place[p, i, j] - place[p, i + di, j + dj]) ** 2
            for di, dj in ((0, 1), (1, 0))
            for p in range(2)
            for i in range(SIDE - di)
            for j in range(SIDE - dj)
        ]
        torch.testing.assert_close(terms[name], depth * torch.stack(pairs).sum() / (2 * SIDE * (SIDE - 1)))


def test_half_transparent_patches_of_objects_cost_their_entropy():
    """Sun 2022, eq. 13: log 2 at an opacity of a half, none at 0 or 1; open captures are opaque everywhere."""
    a = torch.tensor([0.0, 0.5, 1.0, 0.1])
    expected = (math.log(2) - 0.1 * math.log(0.1) - 0.9 * math.log(0.9)) / 4
    assert float(opacity_entropy(a)) == pytest.approx(expected, rel=1e-4)
    scene, config = tiny.scene(), changed(RegNeRF.smallest(), opacity_weight=0.5, likelihood_weight=0.0)
    for frame, there in (scene.frame, True), (replace(scene.frame, reach=4.0, has_alpha=False), False):
        method = build(RegNeRF, frame, config, torch.device("cpu"), 0)
        method.before_step(0, 1.0)
        terms = method.loss(method.batch(scene, chance()), 0)
        assert ("opacity" in terms) == there
        if there:
            assert 0 < float(terms["opacity"].detach()) <= 0.5 * math.log(2)


def test_noise_is_added_to_densities_in_training_alone():
    scene = tiny.scene()
    method = build(RegNeRF, scene.frame, RegNeRF.smallest(), torch.device("cpu"), 0)
    points, before = torch.rand(500, 3, generator=chance()), method.network.noise
    plain, noisy = (method.network.density_at(points, generator=x) for x in (None, chance()))
    raw = [x.expm1().log() + 1 for x in (plain, noisy)]  # of the shifted softplus
    assert before == 1.0 and float((raw[1] - raw[0]).detach().std()) == pytest.approx(1.0, abs=0.1)
    assert torch.equal(method.density(points), method.density(points))


def test_gradients_are_clipped_by_value_and_by_norm():
    weight = torch.nn.Parameter(torch.zeros(4))
    optimizer = clipped(torch.optim.SGD([weight], lr=1.0), 0.1)
    weight.grad = torch.tensor([5.0, -5.0, 0.05, 0.0])
    optimizer.step()
    limited = torch.tensor([0.1, -0.1, 0.05, 0.0])
    torch.testing.assert_close(-weight.detach(), limited * 0.1 / limited.norm())


def test_a_table_has_numbers_of_its_own():
    """It learns five times as fast as a network, the networks behind it are smaller, and a plain CPU has it unasked."""
    config = RegNeRF.preset(torch.device("cpu"))
    assert config.field == "auto" and RegNeRF.preset(torch.device("cuda")).field == "network"
    table, network = of_table(config), config
    known = InstantNGP.preset(torch.device("cpu"))
    assert (table.learning_rate, table.hidden_width) == (known.learning_rate, known.hidden_width) == (2e-2, 32)
    assert (network.learning_rate, network.hidden_width) == (4e-3, 128)
    assert table == known  # all of them
    assert table.proposals == config.proposals


def test_few_photographs_of_an_object_are_learnt_by_the_network():
    """Below MIN_TABLE_VIEWS of them; by a table in the open, from more, and where their number is not known."""
    scene, auto = tiny.scene(), changed(RegNeRF.smallest(), field="auto")
    few = with_fewer_views(scene, 3).frame
    assert few == replace(scene.frame, train_count=3)
    assert field_of(few, auto) == "network" == field_of(replace(few, train_count=9), RegNeRF.smallest())
    for frame in replace(few, reach=4.0), with_fewer_views(scene, 9).frame, replace(few, train_count=0):
        assert field_of(frame, auto) == "hash"
    for frame, kind in (few, FrustumField), (replace(few, train_count=9), HashField):
        assert isinstance(RegNeRF(frame, auto).network, kind)


def test_what_plane_sweeps_found_counts_beside_what_is_smooth():
    """In the open a table has a term "depth" of its own."""
    scene = tiny.scene()
    frame = replace(scene.frame, reach=4.0, has_alpha=False)
    config = changed(RegNeRF.smallest(), field="hash", samples_per_step=1024, levels=4, log2_hashmap_size=11)
    method = build(RegNeRF, frame, config, torch.device("cpu"), 0)
    known = SimpleNamespace(points=torch.tensor([[0.0, 0.0, 0.1]]).repeat(8, 1), origins=scene.cameras.position[:8])
    method.sampler.begin_from(SimpleNamespace(surface=known), chance())
    method.before_step(0, 0.0)
    terms = method.loss(method.batch(scene, chance()), 0)
    assert {"depth", "smoothness"} <= terms.keys() and float(terms["depth"].detach()) > 0


def test_samples_spread_from_the_middle():
    scene = tiny.scene()
    method = build(RegNeRF, scene.frame, RegNeRF.smallest(), torch.device("cpu"), 0)
    rays = scene.sample_rays(64, chance()).rays
    for progress, share in (0.0, 0.5), (1.0, 1.0):
        method.before_step(0, progress)
        look = method.sampler.sample(rays, method.network, generator=chance())[0]
        near, far = method.network.space.interval(rays)
        hit = far > near
        start = look.samples.t_start.view(64, -1)[:, 0]
        assert torch.allclose((start - near)[hit], ((1 - share) / 2 * (far - near))[hit], atol=1e-4)


def test_samples_of_forward_facing_captures_spread_from_the_far_plane():
    """Release, llff3.gin: anneal_mid_perc 1, anneal_nearfar_perc 1e-4."""
    look = Forward(((1.0, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)), (2.0, 2.0), 1.0)
    frame = Frame(reach=4.0, near=0.1, forward=look, image_count=4)
    method = build(RegNeRF, frame, changed(RegNeRF.smallest(), annealing=0.5), torch.device("cpu"), 0)
    rays = Rays(torch.zeros(5, 3), torch.tensor([0.0, 0.0, 1.0]).expand(5, 3), torch.full((5,), 1e-3))
    for progress, share in (0.0, 1e-4), (0.25, 0.5), (0.5, 1.0):
        method.before_step(0, progress)
        samples = method.sampler.sample(rays, method.network, generator=chance())[0].samples
        ends = samples.t_start.view(5, -1)[:, 0], samples.t_end.view(5, -1)[:, -1]
        first, last = (1 - 1 / t for t in ends)  # evenly sampled, from 0 at the near plane to 1
        torch.testing.assert_close(last, torch.full((5,), 0.999))
        torch.testing.assert_close(first, 0.999 - share * 0.999 * torch.ones(5), atol=2e-5, rtol=0)


def test_a_table_by_itself_learns_as_instant_ngp_does():
    """Without patches that nobody photographed both have the same loss, before an object and in the open."""
    scene, kept = tiny.scene(), dict(samples_per_step=1024, levels=4, log2_hashmap_size=11, max_resolution=32)
    for frame in scene.frame, replace(scene.frame, reach=4.0, has_alpha=False):
        config = changed(RegNeRF.smallest(), field="hash", unseen_patches=0, likelihood_weight=0.0, **kept)
        method = build(RegNeRF, frame, config, torch.device("cpu"), 0)
        known = build(InstantNGP, frame, replace(of_table(config), exposure_correction="no"), torch.device("cpu"), 0)
        for one in method, known:
            one.before_step(0, 1.0)
        batch = method.batch(scene, chance())
        assert method.loss(batch, 3) == known.loss(batch, 3)


def test_a_table_grows_finer_and_reaches_farther():
    """At first its coarsest level is there alone, and an object is sampled in the middle of each ray."""
    scene = tiny.scene()
    config = changed(
        RegNeRF.smallest(), field="hash", table_coarse_to_fine=0.5, annealing=0.5, levels=4, log2_hashmap_size=11
    )
    method = build(RegNeRF, scene.frame, config, torch.device("cpu"), 0)
    rays, points = scene.sample_rays(64, chance()).rays, torch.rand(8, 3, generator=chance()) - 0.5
    near, far = method.network.space.interval(rays)
    for progress, share, levels in (0.0, 0.5, 1), (1.0, 1.0, 4):
        method.before_step(0, progress)
        samples = method.sampler.sample(rays, method.network, generator=chance())[0].samples
        aside = ((samples.t - (0.5 * (near + far))[samples.ray_index]) / (far - near)[samples.ray_index]).abs()
        assert 0.35 * share < float(aside.max()) <= 0.5 * share
        encoded = method.network.encode(points).view(8, 4, -1)
        assert encoded.abs().amax((0, 2)).gt(0).tolist() == [i < levels for i in range(4)]


def test_octaves_join_one_after_another():
    """At first the lowest quarter is there alone, in the end all; what was reached is kept with the weights."""
    scene, points = tiny.scene(), torch.rand(8, 3, generator=chance()) - 0.5
    config = changed(RegNeRF.smallest(), coarse_to_fine=0.5, position_frequencies=8)
    method = build(RegNeRF, scene.frame, config, torch.device("cpu"), 0)
    for progress, octaves in (0.0, 2), (0.25, 5), (0.5, 8), (1.0, 8):
        method.before_step(0, progress)
        encoded = method.network.encode(points).view(8, 8, -1)
        assert encoded.abs().amax((0, 2)).gt(0).tolist() == [i < octaves for i in range(8)]
    assert float(method.state_dict()["bands.joined"]) == 1.0
    plain = build(RegNeRF, scene.frame, RegNeRF.smallest(), torch.device("cpu"), 0)
    assert "bands.joined" not in plain.state_dict()


def test_thickness_before_cameras():
    """Samples up to a distance count, the one that it cuts by its share."""
    samples = Samples.rows(torch.tensor([[0.0, 1.0, 3.0], [2.0, 3.0, 4.0]]), torch.tensor([4.0, 5.0]))
    density = torch.tensor([2.0, 3.0, 5.0, 1.0, 1.0, 1.0])
    assert near_thickness(samples, density, torch.tensor([2.0, 1.0])).tolist() == [2.0 * 1 + 3.0 * 1, 0.0]


def test_what_stands_before_cameras_costs():
    """A field of density one everywhere is as thick as the first share of a ray is long."""
    scene = tiny.scene()
    config = changed(RegNeRF.smallest(), occlusion_weight=0.5, occlusion_range=0.25)
    method = build(RegNeRF, scene.frame, config, torch.device("cpu"), 0)
    method.before_step(0, 1.0)
    rays = scene.sample_rays(64, chance()).rays
    look = method.sampler.sample(rays, method.network, generator=chance())[-1].look(method.network)
    look = replace(look, density=torch.ones_like(look.density))
    near, far = method.network.space.interval(rays)
    within = look.samples.t_start.view(64, -1)[:, 0] - near  # the fine look begins somewhere in the first bin
    expected = (0.25 * (far - near) - within).clamp_min(0).mean()
    assert float(method._before_cameras(rays, look)) == pytest.approx(float(expected), rel=1e-3)
    assert float(method.loss(method.batch(scene, chance()), 0)["occlusion"].detach()) > 0


@pytest.mark.parametrize("random_backdrop", [True, False])
def test_the_network_learns_the_open_before_random_colours(random_backdrop, monkeypatch):
    from lumigraph.methods import regnerf

    scene, asked = tiny.scene(), []
    frame = replace(scene.frame, reach=4.0, has_alpha=False)
    config = changed(RegNeRF.smallest(), random_backdrop=random_backdrop)
    method = build(RegNeRF, frame, config, torch.device("cpu"), 0)
    real = regnerf.backdrop
    monkeypatch.setattr(regnerf, "backdrop", lambda *given, opaque: asked.append(opaque) or real(*given, opaque=opaque))
    method.before_step(0, 1.0)
    method.loss(method.batch(scene, chance()), 0)
    assert asked == [random_backdrop]
