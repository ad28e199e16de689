"""RawNeRF: its loss, what it takes from photographs, how light becomes a picture, and what is compared."""

from dataclasses import replace

import av
import numpy as np
import pytest
import tiny
import torch

from lumigraph.camera.rays import Rendering
from lumigraph.color.srgb import linear_from_srgb, srgb_from_linear
from lumigraph.components.training.development import decoded, encoded, exposed, toned, white
from lumigraph.datasets.scene import Batch
from lumigraph.evaluation.views import evaluate, in_light
from lumigraph.export.film import exr, film
from lumigraph.export.options import FilmOptions
from lumigraph.files.ranges import changed
from lumigraph.methods.rawnerf import RawNeRF, layers_of, through_lens
from lumigraph.opening import open_scene
from lumigraph.readers.numbers import kind_of, read_numbers
from lumigraph.training import fit


@pytest.fixture(scope="module")
def night():
    return open_scene("procedural:night,size=24,views=6")


@pytest.fixture(scope="module")
def begun(night):
    method = RawNeRF(night.frame, replace(RawNeRF.smallest(), epsilon=1e-3))
    method.begin(night)
    return method


def batch_of(scene, mosaic, filters, images):
    rays = scene.sample_rays(len(mosaic), torch.Generator().manual_seed(0)).rays
    extra = {"mosaic": torch.tensor(mosaic), "filter": torch.tensor(filters)}
    return Batch(replace(rays, image_index=torch.tensor(images)), torch.zeros(len(mosaic), 3), None, extra)


@pytest.mark.parametrize("delta", [0.0, 1.0])
def test_the_loss_is_the_papers_on_the_colour_that_was_measured(delta, night, begun, monkeypatch):
    """Eq. 4: the square of the relative error, also where that is above 1; with a delta, its tangent beyond that."""
    values = [[0.2, 0.3, 0.4], [0.5, 0.02, 0.1], [3.0, 3.0, 3.0], [3.0, 3.0, 3.0], [0.02, 0.02, 0.02]]
    light = torch.tensor(values, requires_grad=True)
    seen = Rendering(light, torch.ones(5), torch.ones(5), {"moments": torch.zeros(5, 2)})
    monkeypatch.setattr(begun, "light_and_spread", lambda look: seen)
    monkeypatch.setattr(begun, "config", replace(begun.config, huber_delta=delta))
    longest = int(night.splits["train"][night.about["exposure"][night.splits["train"]].argmax()])
    batch = batch_of(night, [0.1, -0.001, 1.2, 0.9, 0.5], [0, 1, 2, 2, 0], [longest] * 5)
    found = begun.loss(batch, 0)["relative"]
    found.backward()
    # A full sensor says no more than that there was enough light, so the third one is right.
    scale = torch.tensor([0.2, 0.02, 1.0, 3.0, 0.02]) + 1e-3  # it is no variable
    error = torch.tensor([0.2 - 0.1, 0.02 + 0.001, 1 - 1.2, 3.0 - 0.9, 0.02 - 0.5]) / scale
    expected, slope = error.square(), 2 * error / scale
    assert float(error[4]) < -20
    if delta:
        expected[4], slope[4] = 2 * delta * error[4].abs() - delta**2, -2 * delta / scale[4]
    torch.testing.assert_close(found.detach(), expected.mean())
    slope[2] = 0
    gradient = torch.zeros(5, 3)
    gradient[torch.arange(5), torch.tensor([0, 1, 2, 2, 0])] = slope / 5
    torch.testing.assert_close(light.grad, gradient)


def test_exposures_are_known_and_what_they_lack_is_learnt(night, begun):
    exposure = night.about["exposure"]
    torch.testing.assert_close(begun.exposure, exposure)
    rays = batch_of(night, [0.1] * len(night), [0] * len(night), list(range(len(night)))).rays
    method = begun.given()
    scale = method.scale(rays)
    torch.testing.assert_close(scale, exposure[:, None].expand(-1, 3))
    with torch.no_grad():
        method.log_scale.fill_(0.1)
    try:
        expected = exposure[:, None] * torch.where(exposure < 1, np.e**0.1, 1.0)[:, None]
        torch.testing.assert_close(method.scale(rays), expected.expand(-1, 3))
    finally:
        method.log_scale.data.zero_()


def test_the_background_is_exposed_with_what_is_before_it(night):
    """Before a colour other than black a photograph that shows nothing else measures it by its exposure, and
    development shows it as it is; behind alpha it is put in afterwards."""
    frame = replace(night.frame, background=(0.2, 0.5, 0.8))
    method = RawNeRF(frame, replace(RawNeRF.smallest(), epsilon=1e-3))
    method.begin(replace(night, frame=frame))
    batch = batch_of(night, [0.1] * len(night), [0] * len(night), list(range(len(night))))
    behind = method.light_behind(batch)
    per_second = behind / method.exposure[:, None]
    assert method.exposure.min() < 0.1
    torch.testing.assert_close(per_second, per_second[:1].expand(len(night), 3))
    torch.testing.assert_close(method.linear(per_second)[:1], decoded(torch.tensor([[0.2, 0.5, 0.8]])))
    photographs = replace(batch, alpha=torch.zeros(len(night)), extra={})
    torch.testing.assert_close(method.light_behind(photographs), decoded(method.background))


def test_unknown_exposures_become_gains(night):
    blind = replace(night, about={k: v for k, v in night.about.items() if k not in ("exposure", "brightness")})
    method = RawNeRF(night.frame, RawNeRF.smallest())
    method.begin(blind)
    assert (method.exposure == 1).all() and method.free.sum() == len(night) - 1
    assert len(method.group.unique()) == len(night) and method.brightness > 1


def test_it_begins_at_the_light_there_is_and_develops_as_the_camera_did(night, begun):
    assert layers_of(night) == ("mosaic", "filter")
    assert float(begun.brightness) == pytest.approx(50)  # of the longest exposure
    assert float(begun.network.level.exp()) == pytest.approx(0.002, rel=0.9)
    shot = night.photograph(int(night.splits["train"][0]), layers=("radiance",))
    truth = shot.extra["radiance"]
    camera = torch.linalg.solve(begun.srgb_from_camera, truth.reshape(-1, 3).T).T / begun.gains / begun.brightness
    torch.testing.assert_close(begun.linear(camera), truth.reshape(-1, 3), atol=1e-4, rtol=1e-3)


def test_it_learns_night_from_noise(night):
    method = RawNeRF(night.frame, changed(RawNeRF.smallest(), refine_cameras=False, epsilon=1e-3))
    fresh = evaluate(method, night).psnr
    fit(method, night, steps=60, show=False, rehearsal=False)
    found = evaluate(method, night)
    assert found.psnr > fresh + 2 and "without noise" in found.protocol["colours"]


def test_light_is_developed_as_controls_say():
    light = torch.tensor([[0.001, 0.18, 0.9], [0.0, 0.0025, 1.0]])
    np.testing.assert_allclose(encoded(light), srgb_from_linear(light.numpy()), atol=1e-6)
    torch.testing.assert_close(decoded(encoded(light)), light, atol=1e-6, rtol=1e-5)
    np.testing.assert_allclose(decoded(light), linear_from_srgb(light.numpy()), atol=1e-6)
    torch.testing.assert_close(exposed(light, 2, 6500), 4 * light)
    red, _, blue = exposed(torch.ones(3), 0, 3200)
    assert blue > 1.3 > 0.7 > red  # daylight looks blue to whom lamplight is white
    assert white(2000)[0] > white(4000)[0] > white(9000)[0] and white(2000)[2] < white(9000)[2]
    ramp = torch.linspace(0, 8, 200)[:, None].expand(-1, 3)
    for curve in ("srgb", "filmic", "linear"):
        shown = toned(ramp, curve)
        assert (shown.diff(dim=0) >= 0).all() and shown.min() == 0 and shown.max() <= 1
    assert toned(torch.full((1, 3), 1.2), "filmic").max() < 1  # highlights keep their shape


def test_rays_through_a_lens_meet_in_the_focus(night):
    camera = night.cameras[1]
    plain = camera.rays(camera.pixels())
    forward = camera.pose[0, :, 2]
    meeting = plain.at(0.7 / (plain.directions @ forward))
    origins = []
    for rays in through_lens(camera, 0.2, 0.7, 12):
        off = (meeting - rays.origins) - ((meeting - rays.origins) * rays.directions).sum(
            -1, keepdim=True
        ) * rays.directions
        assert off.norm(dim=-1).max() < 1e-5
        assert (((rays.origins - plain.origins) @ forward).abs() < 1e-5).all()
        origins.append(rays.origins - plain.origins)
    places = torch.stack(origins)
    assert places.norm(dim=-1).max() <= 0.1 and places.mean(0).norm(dim=-1).max() < 0.02
    assert all(
        torch.equal(a.origins, b.origins)
        for a, b in zip(*(through_lens(camera, 0.2, 0.7, 2) for _ in "ab"), strict=True)
    )


def test_a_focus_blurs_what_is_elsewhere(night, begun):
    camera = tiny.scene().cameras[1]
    sharp, told = begun.render(camera), begun.given(aperture=0.3, focus=2.0).render(camera)
    torch.testing.assert_close(begun.given(aperture=0.0).render(camera).rgb, sharp.rgb)
    assert torch.equal(told.depth, sharp.depth) and (told.rgb != sharp.rgb).any()
    assert torch.equal(told.rgb, begun.given(aperture=0.3, focus=2.0).render(camera).rgb)


def test_light_is_compared_up_to_a_factor_and_an_offset():
    truth = torch.rand(20, 24, 3, generator=torch.Generator().manual_seed(0))
    light = 0.1 + torch.tensor([0.5, 0.8, 0.3]) * truth
    seen = Rendering(torch.zeros_like(truth), truth[..., 0], truth[..., 0], {"radiance": light})
    rgb, picture = in_light(seen, truth)
    torch.testing.assert_close(rgb, picture, atol=1e-4, rtol=0)
    torch.testing.assert_close(picture, encoded(truth))
    plain, _ = in_light(replace(seen, rgb=encoded(light), extra={}), truth)
    torch.testing.assert_close(plain, picture, atol=1e-3, rtol=0)


def test_frames_are_written_as_light(night, begun, tmp_path):
    film(begun, night.cameras[:2], tmp_path / "film.mp4", FilmOptions(pictures="exr"))
    path = tmp_path / "film" / "0001.exr"
    assert kind_of(path).linear and kind_of(path).size == (24, 24)
    np.testing.assert_array_equal(read_numbers(path), begun.render(night.cameras[1]).extra["radiance"].numpy())
    light = torch.tensor([[[-1.0, 0.0, 1e5]]]).expand(3, 5, 3)
    (tmp_path / "x.exr").write_bytes(exr(light))
    with av.open(str(tmp_path / "x.exr")) as container:
        assert next(container.decode(video=0)).format.name.startswith("gbrpf32")
    np.testing.assert_array_equal(read_numbers(tmp_path / "x.exr"), light.numpy())
