"""Splats from photographs that differ, and from few: light of each, what moves, what nobody saw well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from test_gaussian_splatting import new
from test_gaussians import cloud
from test_nerf_w import two_lights

from lumigraph import kernels
from lumigraph.color.blending import over
from lumigraph.components.clouds.appearance import (
    MIN_SPREAD,
    fit_colours,
    mean_skies,
    recoloured,
    recoloured_harmonics,
    sky,
    sky_harmonics,
    sky_loss,
)
from lumigraph.components.clouds.cloud import (
    MIN_VIEWS,
    VIEW_BITS,
    view_count,
    with_view,
    zero_unobserved_sh,
)
from lumigraph.components.clouds.tidying import (
    MAX_ANISOTROPY,
    MAX_SCALE,
    NEAR_ZONE,
    camera_distance,
    clamped_scales,
    near_camera,
)
from lumigraph.components.training import photometric
from lumigraph.components.training.photometric import spread_of_light
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Photograph
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation.halves import judged_by_halves, left_half
from lumigraph.evaluation.views import evaluate
from lumigraph.files.ranges import changed
from lumigraph.methods.gaussian_splatting import GaussianSplatting
from lumigraph.methods.gaussian_splatting.robust_mask import BINS, INLIER_SHARE, RobustMask, RobustNumbers, inliers
from lumigraph.run import Run, build
from lumigraph.training import fit

pytestmark = [budget("methods", 10), pytest.mark.filterwarnings("ignore:The cloud stops growing")]


def code(seed: int = 0) -> torch.Tensor:
    return 0.1 * torch.randn(12, generator=torch.Generator().manual_seed(seed))


# The light of each photograph


def test_harmonics_change_as_their_colours_do(generator):
    """From every side: 1/2 + Y h' = (I + A)(1/2 + Y h) + b."""
    harmonics, directions = torch.randn(5, 16, 3, generator=generator), torch.randn(5, 3, generator=generator)
    basis = kernels.spherical_harmonics(torch.nn.functional.normalize(directions, dim=-1), 4)

    def colours(h):
        return 0.5 + torch.einsum("nk,nkc->nc", basis, h)

    one, other = colours(harmonics), colours(recoloured_harmonics(harmonics, code()))
    matrix, offset = torch.eye(3) + code()[:9].view(3, 3), code()[9:]
    torch.testing.assert_close(other, one @ matrix.T + offset, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(recoloured(one, torch.ones(5), code()), other, atol=1e-5, rtol=1e-5)
    assert torch.equal(recoloured_harmonics(harmonics, torch.zeros(12))[:, 1:], harmonics[:, 1:])


@pytest.fixture(scope="module")
def taught():
    scene, (method, _) = two_lights(), new(appearance="yes", robust="no")
    fit(method, scene, steps=150, show=False, rehearsal=False)
    return method.eval(), scene


def test_the_light_is_learnt_and_found_on_left_halves(taught):
    """Held-out photographs, some of them a third as bright, come out in their own light."""
    method, scene = taught
    assert judged_by_halves(method) and not judged_by_halves(method.given(appearance="average"))
    average, halves = (evaluate(x, scene) for x in (method.given(appearance="average"), method))
    assert halves.psnr > average.psnr + 2, (halves.psnr, average.psnr)
    assert not method.appearance.codes.codes[scene.splits["test"]].any()
    shot = scene.photograph(0)
    blank = replace(shot, rgb=torch.where(left_half(shot).mask[..., None], shot.rgb, 0.5))
    found = method.given(left_half(shot)).render(shot.camera).rgb
    assert torch.equal(found, method.given(left_half(blank)).render(shot.camera).rgb)


def test_a_told_light_shows_in_pictures_and_in_the_cloud(taught):
    method, scene = taught
    dim, bright = (method.given(appearance=i) for i in (1, 2))
    camera, average = scene.cameras[2], method.render(scene.cameras[2])
    dark, light = (x.render(camera) for x in (dim, bright))
    there = average.opacity > 0.9
    assert dark.rgb[there].mean() < 0.6 * light.rgb[there].mean()
    assert torch.equal(dark.opacity, light.opacity)
    assert torch.equal(method.given(dim_shot := scene.photograph(1)).given(appearance=1).render(camera).rgb, dark.rgb)
    assert torch.allclose(method.given(dim_shot).render(camera).rgb, dark.rgb, atol=0.15)
    plain = new()[0]
    plain.cloud.replace(dim.gaussians())
    apart, changed_by = ((x - dark.rgb)[there].abs().mean() for x in (plain.render(camera).rgb, average.rgb))
    assert apart < 0.25 * changed_by  # but where a colour is cut at 0


def test_the_light_of_a_picture_is_found(generator):
    """Where the photograph is the picture in some light, it is that light, although a tenth is hidden."""
    rgb, opacity = torch.rand(500, 3, generator=generator), torch.ones(500)
    target = recoloured(rgb, opacity, code())
    target[:50] = 0.5

    at = rgb, opacity, target
    torch.testing.assert_close(fit_colours(torch.zeros(12), *at), code(), atol=0.02, rtol=0)
    nothing = (x[:0] for x in at)
    assert torch.equal(fit_colours(code(), *nothing), code())


def test_each_photograph_has_a_sky_of_its_own():
    """In the open: behind a cloud that is hardly there. A held-out one is found on pixels that are to be trusted."""
    scene = tiny.scene()
    scene = replace(scene, frame=replace(scene.frame, reach=2.0, has_alpha=False))
    kind = GaussianSplatting
    method = build(kind, scene.frame, changed(kind.smallest(), appearance="yes"), torch.device("cpu"), 0)
    even = mean_skies(scene)
    shown = sky(even[1], scene.cameras[1])
    assert torch.allclose(shown, scene.photograph(1).rgb.mean((0, 1)).expand_as(shown), atol=1e-5)
    assert not even[scene.splits["test"]].any()
    with torch.no_grad():
        method.cloud.opacities.fill_(-20)
        method.appearance.codes.codes[1, 12:] = torch.randn(27, generator=torch.Generator().manual_seed(0)) / 9
        method.appearance.codes.codes[1, 12] += 0.5 / 0.28209479
    camera = scene.cameras[2]
    weather = sky(method.appearance.codes.codes[1, 12:].detach(), camera).clamp(0, 1)
    assert weather.std() > 0.05
    assert torch.allclose(method.eval().given(appearance=1).render(camera).rgb, weather, atol=1e-4)
    below = torch.zeros(weather.shape[:2], dtype=torch.bool)
    below[:, : below.shape[1] // 2] = True
    shot = Photograph(camera, weather, None, below)
    with torch.no_grad():
        method.appearance.codes.codes[1, 12:] *= 0.5  # what the search begins with
    found = method.given(shot).render(camera).rgb
    assert (found - weather).abs().mean() < 0.25 * (method.render(camera).rgb - weather).abs().mean()


def test_a_sky_learns_from_what_a_mask_leaves_out_where_nothing_stands():
    shot = tiny.scene().photograph(1)
    height, width = shot.rgb.shape[:2]
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[:, : width // 2] = True
    opacity = torch.zeros(height, width, requires_grad=True)
    behind = (shot.rgb + 0.1).requires_grad_()
    loss = sky_loss(behind, replace(shot, mask=mask), opacity)
    assert float(loss) == pytest.approx(0.1 * float((~mask).float().mean()), rel=1e-4)
    loss.backward()
    assert opacity.grad is None and not behind.grad[mask].any() and (behind.grad[~mask] > 0).all()
    assert float(sky_loss(behind, replace(shot, mask=mask), torch.ones(height, width))) == 0
    assert float(sky_loss(behind, replace(shot, mask=None), opacity)) == 0


def test_a_sky_that_no_pixel_sees_stays_as_it_was(generator):
    """A pixel in a hundred that it shines through sways it little."""
    start = torch.cat([torch.zeros(12), torch.randn(27, generator=generator)])
    rgb, opacity = torch.rand(500, 3, generator=generator), torch.ones(500)
    opacity[:5] = 0.5

    rgb, behind = rgb * opacity[:, None], sky_harmonics(tiny.scene().cameras[0]).view(-1, 9)[:500]
    target = over(recoloured(rgb, opacity, start), opacity, behind @ start[12:].view(9, 3))
    target[:5] = torch.tensor([1.0, 0.0, 1.0])
    told = fit_colours(start, rgb, opacity, target, behind)
    assert (told - start)[12:].abs().max() < 0.2


def test_without_it_nothing_is_told():
    method, _ = new()
    assert not method.appearance.is_active and method.controls == ()
    assert Photograph not in method.takes and not judged_by_halves(method)
    with pytest.raises(LumigraphError, match="cannot be given a Photograph"):
        method.given(tiny.scene().photograph(0))


def test_resuming_is_exact(tmp_path):
    config = {"appearance": "yes", "robust": "yes"}
    (a, straight), (b, broken) = new(tmp_path / "a", **config), new(tmp_path / "b", **config)
    fit(a, tiny.scene(), straight, steps=40, show=False, rehearsal=False)
    fit(b, tiny.scene(), broken, steps=40, pause_at=25, show=False, rehearsal=False)
    fit(broken.new_method(), tiny.scene(), Run(broken.folder), steps=40, show=False, rehearsal=False)
    expected, actual = straight.method().state_dict(), Run(broken.folder).method().state_dict()
    assert expected["appearance.codes.codes"].any() and expected["robust_mask.histogram"].any()
    assert expected["cloud.view_bits"].any()
    for name in expected:
        assert torch.equal(expected[name], actual[name]), name


def test_photographs_of_one_light_are_told_from_others(generator, monkeypatch):
    """By the stops between neighbours that show the same places: two_lights has photographs a third as bright. Its
    cameras stand 40 degrees apart, from where shading differs too."""
    same, lit = tiny.scene(), two_lights()
    where = 0.6 * torch.nn.functional.normalize(torch.randn(1000, 3, generator=generator), dim=-1)
    assert spread_of_light(same) is None
    assert spread_of_light(replace(lit, points=where)) is None
    monkeypatch.setattr(photometric, "MAX_ANGLE", 90.0)
    assert spread_of_light(replace(same, points=where)) < MIN_SPREAD / 2
    assert spread_of_light(replace(lit, points=where)) > MIN_SPREAD
    method, _ = new()
    with pytest.warns(LumigraphWarning, match="differ by"):
        method.appearance.begin(method, replace(lit, points=where), torch.inf)
    assert method.appearance.is_active and judged_by_halves(method)


# What moves


def by_definition(error: np.ndarray, threshold: float) -> np.ndarray:
    """Equations 6 to 9 of Sabour 2023, pixel by pixel."""
    height, width = error.shape
    small = error <= threshold
    smooth = np.array(
        [
            [small[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].mean() >= 0.5 for x in range(width)]
            for y in range(height)
        ]
    )
    out = small | smooth
    for y in range(0, height, 8):
        for x in range(0, width, 8):
            if smooth[max(y - 4, 0) : y + 12, max(x - 4, 0) : x + 12].mean() >= 0.6:
                out[y : y + 8, x : x + 8] = True
    return out


@pytest.mark.parametrize("size", [(24, 40), (21, 30), (5, 7)])
def test_inliers_are_those_of_the_paper(size, generator):
    error = torch.rand(*size, generator=generator)
    error[: size[0] // 2, : size[1] // 2] += 0.6
    expected = by_definition(error.numpy(), 0.7)
    assert np.array_equal(inliers(error, 0.7).numpy(), expected)
    assert size == (5, 7) or 0 < expected.mean() < 1


def test_the_threshold_follows_the_errors(generator):
    mask, error = RobustMask(RobustNumbers()), torch.rand(40, 50, generator=generator)
    assert inliers(error, mask.threshold).all()
    mask.record(error)
    assert mask.threshold == pytest.approx(float(error.quantile(INLIER_SHARE)), abs=2 / BINS)
    for _ in range(200):
        mask.record(0.1 * error)
    assert mask.threshold == pytest.approx(float(0.1 * error.quantile(INLIER_SHARE)), abs=2 / BINS)
    empty = torch.cat([0.1 * error, torch.zeros(400, 50)])  # pixels without an error say nothing
    mask.record(empty)
    assert mask.threshold == pytest.approx(float(0.1 * error.quantile(INLIER_SHARE)), abs=2 / BINS)


def test_what_passed_before_photographs_is_left_out():
    """A dark sheet before the ball, elsewhere on three photographs of nine: the cloud takes up less of it."""
    scene = tiny.scene()
    pictures = [tiny.picture(pose) for pose in scene.cameras.pose]
    sheets = {1: (slice(4, 18), slice(6, 18)), 3: (slice(5, 19), slice(7, 18)), 6: (slice(6, 20), slice(8, 18))}
    for i, place in sheets.items():
        pictures[i] = pictures[i].copy()
        pictures[i][place] = (0, 30, 0, 255)
    spoilt = replace(scene, images=ImageStore.from_arrays(pictures))
    scores = {}
    for robust in ("no", "yes"):
        method, _ = new(robust=robust, opacity_reset_interval=1000)
        fit(method, spoilt, steps=150, show=False, rehearsal=False)
        scores[robust] = evaluate(method, scene).psnr
    assert scores["yes"] > scores["no"] + 0.3, scores


# What few photographs see


def test_views_are_counted_as_sets(generator):
    bits = torch.zeros(6, dtype=torch.int64)
    sets = [set() for _ in range(6)]
    for image in (0, 3, 3, 40, 61, 62, 100):
        seen = torch.rand(6, generator=generator) < 0.5
        bits = with_view(bits, torch.tensor([image]), seen)
        for i in seen.nonzero()[:, 0].tolist():
            sets[i].add(image % VIEW_BITS)
    assert view_count(bits).tolist() == [len(x) for x in sets]
    assert view_count(torch.tensor([(1 << VIEW_BITS) - 1])).tolist() == [VIEW_BITS]


def test_unobserved_harmonics_are_zero(generator):
    counts = 0, MIN_VIEWS[1] - 1, MIN_VIEWS[1], MIN_VIEWS[4] - 1, MIN_VIEWS[4], VIEW_BITS
    harmonics = torch.randn(len(counts), 16, 3, generator=generator)
    before = harmonics.clone()
    # bits are set from the highest down, so that each count has other bits than a number as large
    zero_unobserved_sh(harmonics, torch.tensor([sum(1 << VIEW_BITS - 1 - k for k in range(n)) for n in counts]))
    kept = [1, 1, 4, 4, 16, 16]
    for row, count in enumerate(kept):
        assert torch.equal(harmonics[row, :count], before[row, :count]) and not harmonics[row, count:].any()


def test_giants_and_needles_are_confined():
    some = cloud(4)
    sizes = torch.tensor([[5.0, 4.0, 0.1], [0.9, 0.01, 0.001], [0.008, 1e-5, 1e-5], [0.2, 0.1, 0.05]])
    found = clamped_scales(replace(some, log_scales=sizes.log()), torch.full((4,), 2.0), 1.0).exp()
    expected = sizes.clone()
    expected[0, :2] = 2 * MAX_SCALE
    expected[1, 0] = MAX_ANISOTROPY * 0.01
    torch.testing.assert_close(found, expected)


def test_nothing_hangs_near_camera():
    distance = torch.tensor([0.5, 1.5, 1.5, NEAR_ZONE + 0.1])
    assert near_camera(distance, torch.tensor([9, 2, 3, 0]), 1.0).tolist() == [True, True, False, False]
    positions, means = torch.randn(7, 3), torch.randn(5, 3)
    expected = (means[:, None] - positions).norm(dim=-1).amin(-1)
    torch.testing.assert_close(camera_distance(means, positions), expected)


RULES = ("prune_near", "limit_scale", "limit_anisotropy", "observed_harmonics")


@pytest.mark.parametrize("rule", [None, *RULES])
def test_each_rule_is_an_option(rule):
    """A Gaussian before a lens, a giant, a needle, and harmonics that few photographs determine: each rule changes one
    of these, and no rule none."""
    method, _ = new(**({rule: True} if rule else {}))
    fit(method, tiny.scene(), steps=1, show=False, rehearsal=False)
    method.drawn.fill_(100)
    cloud, camera = method.cloud, tiny.scene().cameras[1]
    with torch.no_grad():
        cloud.view_bits.fill_(1)
        cloud.means[:3] = torch.stack([camera.position[0], torch.zeros(3), torch.zeros(3)])
        cloud.log_scales[:3] = torch.tensor([[0.01] * 3, [9.0, 9.0, 0.1], [0.5, 0.01, 0.01]]).log()
        cloud.harmonics[:, 1:] = 1.0
        before = cloud.gaussians().log_scales.clone()
        method.bands = 2
        step = method.step_on(tiny.scene().photograph(1), 1)
        step.due = True
        method.tidying.finish(step)
    scales = cloud.log_scales.detach()
    found = {"prune_near": len(cloud) < len(before), "observed_harmonics": not cloud.harmonics[:, 1:].any()}
    if len(cloud) == len(before):
        limits = (scales[1:3] != before[1:3]).any(1).tolist()
        found |= dict(zip(("limit_scale", "limit_anisotropy"), limits, strict=True))
    assert [name for name, changed in found.items() if changed] == ([rule] if rule else [])


def test_a_sheet_before_a_training_camera_goes():
    method, _ = new(prune_near=True)
    scene = tiny.scene()
    camera = scene.cameras[1]
    fit(method, scene, steps=1, show=False, rehearsal=False)
    method.drawn.fill_(2 * len(scene.splits["train"]))
    with torch.no_grad():
        method.cloud.means[0] = camera.position[0] + 0.5 * scene.frame.near * camera.forward[0]
        before = len(method.cloud)
        step = method.step_on(scene.photograph(1), 1)
        step.due = True
        method.tidying.finish(step)
        method.follow_rebuilds()
    assert len(method.cloud) == before - 1 == len(method.cloud.view_bits)
    assert len(method.cloud) == len(method.density_control.positional_gradient_sum)
    assert float(camera_distance(method.cloud.means, scene.cameras.position).min()) > scene.frame.near
