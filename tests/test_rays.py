"""Rays, Samples and Rendering: what they hand out is what was put in."""

from __future__ import annotations

import pytest
import torch

from lumigraph.camera.rays import Rays, Rendering, Samples


def some_rays(count: int) -> Rays:
    generator = torch.Generator().manual_seed(count)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    index = torch.arange(count)
    return Rays(torch.randn(count, 3, generator=generator), directions, torch.rand(count), index.float(), index)


def test_points_along_rays():
    rays = Rays(torch.tensor([[1.0, 2, 3]]), torch.tensor([[0.0, 0, 1]]), torch.ones(1))
    assert rays.at(torch.tensor([4.0])).tolist() == [[1, 2, 7]]


@pytest.mark.parametrize("pick", [slice(2, 5), torch.tensor([4, 0, 4]), torch.arange(7) % 2 == 0])
def test_some_of_the_rays(pick):
    rays = some_rays(7)
    some = rays[pick]
    assert torch.equal(some.image_index, torch.arange(7)[pick])
    assert torch.equal(some.origins, rays.origins[pick]) and torch.equal(some.directions, rays.directions[pick])
    assert torch.equal(some.radius, rays.radius[pick]) and torch.equal(some.time, rays.time[pick])
    assert len(some) == len(some.origins)


def test_what_rays_lack_stays_lacking():
    bare = Rays(torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2))[:1].to("cpu")
    assert bare.time is None and bare.image_index is None


def test_samples_find_their_rays():
    """Rays 0, 2 and 3 own two, three and one samples; rays 1 and 4 none."""
    start = torch.tensor([1.0, 2, 1, 2, 3, 7])
    samples = Samples(start, start + torch.tensor([1.0, 1, 1, 1, 2, 4]), torch.tensor([0, 2, 2, 5, 6, 6]))
    assert len(samples) == 6
    assert samples.ray_index.tolist() == [0, 0, 2, 2, 2, 3]
    assert samples.t.tolist() == [1.5, 2.5, 1.5, 2.5, 4, 9]
    assert samples.length.tolist() == [1, 1, 1, 1, 2, 4]
    rays = some_rays(5)
    points, directions = samples.along(rays)
    for i, ray in enumerate([0, 0, 2, 2, 2, 3]):
        torch.testing.assert_close(points[i], rays.origins[ray] + samples.t[i] * rays.directions[ray])
        assert torch.equal(directions[i], rays.directions[ray])


def test_no_samples_and_no_rays():
    assert Samples(torch.zeros(0), torch.zeros(0), torch.zeros(4, dtype=torch.int64)).ray_index.shape == (0,)
    assert Samples(torch.zeros(0), torch.zeros(0), torch.zeros(1, dtype=torch.int64)).ray_index.shape == (0,)


def some_rendering(count: int) -> Rendering:
    values = torch.arange(float(count))
    return Rendering(
        values[:, None].expand(count, 3), values + 1, values / count, {"normal": values[:, None] + torch.eye(3)[0]}
    )


def test_a_rendering_takes_the_picture_s_shape():
    picture = some_rendering(12).reshape(3, 4)
    assert picture.rgb.shape == (3, 4, 3) and picture.depth.shape == picture.opacity.shape == (3, 4)
    assert picture.extra["normal"].shape == (3, 4, 3)
    assert (
        picture.rgb[2, 1, 0] == 9 and picture.depth[2, 1] == 10 and picture.extra["normal"][2, 1].tolist() == [10, 9, 9]
    )
    flat = picture.reshape(12)
    assert torch.equal(flat.rgb, some_rendering(12).rgb) and torch.equal(
        flat.extra["normal"], some_rendering(12).extra["normal"]
    )


def test_renderings_join_in_order():
    whole, parts = some_rendering(10), [some_rendering(10)]
    first, second = (
        Rendering(*(x[part] for x in (whole.rgb, whole.depth, whole.opacity)), {"normal": whole.extra["normal"][part]})
        for part in (slice(0, 4), slice(4, 10))
    )
    joined = Rendering.cat([first, second])
    for name in ("rgb", "depth", "opacity"):
        assert torch.equal(getattr(joined, name), getattr(parts[0], name))
    assert torch.equal(joined.extra["normal"], whole.extra["normal"])


def test_extras_are_added_not_replaced():
    first = some_rendering(2)
    second = first.with_extra(feature=torch.zeros(2, 5))
    assert set(second.extra) == {"normal", "feature"} and set(first.extra) == {"normal"}
    assert set(second.cpu().extra) == {"normal", "feature"}


def test_shapes_at_the_door_are_executed():
    with pytest.raises(Exception, match="directions"):
        Rays(torch.zeros(2, 3), torch.zeros(3, 3), torch.zeros(2))
    with pytest.raises(Exception, match="t_end"):
        Samples(torch.zeros(2), torch.zeros(3), torch.zeros(2, dtype=torch.int64))
    with pytest.raises(Exception, match="depth"):
        Rendering(torch.zeros(4, 5, 3), torch.zeros(5, 4), torch.zeros(4, 5))
