"""The equations of GANcraft and of its painter (methods/gancraft)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny_world
import torch
from budgets import budget
from PIL import Image

from lumigraph import methods
from lumigraph.camera.rays import Rays
from lumigraph.datasets.world import LABELS
from lumigraph.errors import LumigraphError
from lumigraph.methods.gancraft import BlockGrid, bordered
from lumigraph.methods.gancraft.landscapes import STYLES
from lumigraph.methods.gancraft.networks import BORDER, FIRST_DENSITY, NeuralRenderer, StyleEncoder, divergence, drawn
from lumigraph.methods.gancraft.spade import Adversary, LabelPainter, channels

pytestmark = budget("methods", 6)
GRASS, STONE = LABELS.index("grass"), LABELS.index("stone")


def gancraft(**changes):
    kind = methods.find("gancraft")
    world = tiny_world.world()
    method = kind(world.frame, replace(kind.smallest(), **changes))
    method.begin(world)
    return method.eval()


def slabs() -> BlockGrid:
    """Grass at 1 <= z < 2, air, stone from z = 4 to 7."""
    labels = torch.zeros(1, 5, 6, 7, dtype=torch.uint8)
    labels[..., 1], labels[..., 4:] = GRASS, STONE
    return BlockGrid.of(labels)


def ray(origin, direction) -> Rays:
    direction = torch.nn.functional.normalize(torch.tensor([direction]), dim=-1)
    return Rays(torch.tensor([origin]), direction, torch.full((1,), 0.01))


def test_samples_lie_in_blocks_and_end_after_a_way_through_them():
    world, up = slabs(), ray((2.5, 2.5, -3.03), (0.0, 0.0, 1.0))
    samples = world.sampled(up, 0.125, 3.0, None)
    z = -3.03 + samples.t
    assert set(world.label_at(torch.stack([0 * z + 2.5, 0 * z + 2.5, z], -1)).tolist()) == {GRASS, STONE}
    assert float(samples.length.sum()) == pytest.approx(3.0, abs=0.13)
    assert 1 < float(z.min()) < 1.125 and 5.8 < float(z.max()) < 6.2  # a block of grass, two of stone
    slanted = world.sampled(ray((2.5, 2.5, 1.0001), (1.0, 0.0, 0.2)), 0.05, 10.0, None)
    assert float(slanted.length.sum()) == pytest.approx(math.hypot(2.5, 0.5), abs=0.06)  # to the border
    assert len(world.sampled(ray((2.5, 2.5, 3.0), (1.0, 0.0, 0.0)), 0.1, 3.0, None)) == 0  # in the air between


def test_features_agree_at_the_corners_that_blocks_share():
    """Corners of two slabs; features go on from one block to its neighbour, and end at the air."""
    world = slabs()
    assert len(world.corners) == 6 * 7 * (2 + 4)
    field = gancraft().field_network
    field.values = torch.nn.Parameter(torch.randn(len(world.corners), 4, generator=torch.Generator().manual_seed(0)))
    sides = torch.tensor([[3 - 1e-5, 2.3, 4.4], [3 + 1e-5, 2.3, 4.4]]) / world.size
    style = torch.ones(1, 8)
    density, colour = field(sides, world.nodes, torch.tensor([STONE, STONE]), style)
    torch.testing.assert_close(colour[0], colour[1], atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(density[0], density[1], atol=1e-3, rtol=1e-3)
    other, _ = field(sides[:1], world.nodes, torch.tensor([GRASS]), style)
    assert (other - density[0]).abs().max() > 1e-4  # the label counts, too


def test_a_pixel_sees_nine_by_nine_features():
    renderer = NeuralRenderer(3, 6, 4)
    features = torch.randn(1, 3, 21, 21, requires_grad=True)
    renderer(features, torch.randn(1, 4))[0, :, 10, 10].sum().backward()
    y, x = features.grad[0].abs().sum(0).nonzero().unbind(-1)
    assert (y.min(), y.max(), x.min(), x.max()) == (10 - BORDER, 10 + BORDER, 10 - BORDER, 10 + BORDER)


def test_a_ray_in_the_air_shows_the_sky_and_its_colour_needs_no_place():
    method, style = gancraft(), torch.randn(1, 8)
    rays = Rays(
        torch.tensor([[3.0, 0, 0], [3.0, 1, 0], [3.0, 0, 0]]),
        torch.tensor([[1.0, 0, 0]] * 2 + [[-1.0, 0, 0]]),
        torch.ones(3),
    )
    features, depth, opacity = method.features_of(rays, style)
    torch.testing.assert_close(features[0], features[1])
    torch.testing.assert_close(features[:1], method.sky(rays.directions[:1], style))
    assert depth[:2].isinf().all() and (opacity[:2] == 0).all()
    # The ball of blocks begins between 0.5 and 0.6; the last ray meets it.
    assert 3 - 0.65 < float(depth[2].detach()) < 3 and 0 < float(opacity[2].detach()) < 1


def test_light_is_composited_front_to_back():
    """With constant density sigma and feature c, a ray of way s has f = (1 - exp(-sigma s)) c + exp(-sigma s) b."""
    method = gancraft(sample_depth=1.0, samples_per_block=16)
    with torch.no_grad():
        for layer in (method.field_network.density, method.field_network.out):
            layer.weight.zero_()
        method.field_network.density.bias.fill_(0.3)
        method.field_network.out.bias.fill_(0.25)
        method.behind.fill_(-0.5)
    sigma = float(torch.nn.functional.softplus(torch.tensor(0.3 + math.log(math.expm1(FIRST_DENSITY)))))
    rays = Rays(torch.tensor([[3.0, 0.1, 0.1]]), torch.tensor([[-1.0, 0, 0]]), torch.ones(1))
    features, _, opacity = method.features_of(rays, torch.zeros(1, 8))
    assert float(opacity) == pytest.approx(1 - math.exp(-sigma), abs=0.02)
    torch.testing.assert_close(features, (opacity * 0.25 - (1 - opacity) * 0.5)[:, None].expand(1, 4))


def test_a_picture_has_no_border_of_its_own():
    """Rays around a picture keep the renderer's padding out of it: a part equals the same part of the whole."""
    method, code = gancraft(), torch.randn(1, 2)
    camera = tiny_world.world().cameras[1]
    whole, _, _ = method.picture(camera.rays(bordered(0, 0, 24, 24)), (24, 24), code)
    part, _, _ = method.picture(camera.rays(bordered(5, 7, 10, 8)), (10, 8), code)
    torch.testing.assert_close(part, whole[..., 7:15, 5:15], atol=1e-4, rtol=1e-4)


def test_codes_are_drawn_from_the_encoder_s_distribution():
    mean, log_variance = torch.zeros(4, 3), torch.zeros(4, 3)
    assert float(divergence(mean, log_variance)) == 0
    assert float(divergence(mean + 1, log_variance)) == pytest.approx(0.5)
    codes = drawn(torch.full((5000, 1), 2.0), torch.full((5000, 1), math.log(9.0)), torch.Generator().manual_seed(0))
    assert float(codes.mean()) == pytest.approx(2, abs=0.15) and float(codes.std()) == pytest.approx(3, abs=0.15)
    mean, _ = StyleEncoder(16, 4, 5)(torch.rand(2, 3, 40, 30))
    assert mean.shape == (2, 5)


def test_the_most_frequent_label_counts_within_a_window():
    labels = torch.full((1, 12, 12), GRASS)
    labels[0, 4, 4], labels[0, :, 8:] = STONE, STONE
    smooth = channels(labels, len(LABELS), 5)
    assert (smooth.sum(1) == 1).all()
    assert smooth[0, GRASS, 4, 4] == 1 and smooth[0, STONE, :, 9:].all() and smooth[0, GRASS, :, :7].all()
    assert channels(labels, len(LABELS))[0, STONE, 4, 4] == 1


def test_the_painter_follows_labels_and_style_and_the_adversary_compares_labels():
    torch.manual_seed(0)
    painter, adversary = LabelPainter(len(LABELS), 2, [8, 8, 4], 4, 8, 4), Adversary(len(LABELS), 4)
    maps = channels(torch.stack([torch.full((16, 16), GRASS), torch.full((16, 16), STONE)]), len(LABELS))
    codes = torch.tensor([[1.0, -1.0]])
    one, other, restyled = painter(maps[:1], codes), painter(maps[1:], codes), painter(maps[:1], -codes)
    assert one.shape == (1, 3, 16, 16) and (one - other).abs().mean() > 1e-3 and (one - restyled).abs().mean() > 1e-3
    assert adversary(one, maps[:1]).shape == adversary(one, maps[1:]).shape
    assert (adversary(one, maps[:1]) - adversary(one, maps[1:])).abs().max() > 1e-4


def test_style_is_a_name_a_mixture_or_a_picture(tmp_path):
    method = gancraft()
    method.styles.copy_(torch.randn(method.styles.shape, generator=torch.Generator().manual_seed(1)))
    first, second = list(STYLES)[:2]
    a, b, half = (method.given(style=value).shown_code for value in (first, second, f"{first}:{second}:0.5"))
    torch.testing.assert_close(half, (a + b) / 2)
    picture = np.random.default_rng(0).integers(0, 255, (32, 48, 3), np.uint8)
    Image.fromarray(picture).save(tmp_path / "dusk.png")
    code = method.given(style=str(tmp_path / "dusk.png")).shown_code
    expected, _ = method.encoder(torch.from_numpy(picture).float().movedim(-1, 0)[None] / 127.5 - 1)
    torch.testing.assert_close(code, expected, atol=1e-4, rtol=1e-4)
    with pytest.raises(LumigraphError):
        method.given(style="nowhere.png").shown_code  # noqa: B018
    with pytest.raises(LumigraphError, match="summer"):
        method.given(style="midnight")


def test_codes_of_pictures_differ_from_the_start_and_change_what_is_painted():
    """Codes that are all noise are never used: the first steps teach a painter to leave them out."""
    torch.manual_seed(0)
    painter = LabelPainter(len(LABELS), 8, [48, 24, 12], 12, 64, 8)
    colours = 2 * torch.rand(6, 3, 1, 1) - 1
    pictures = (colours + 0.1 * torch.randn(6, 3, 64, 64)).clamp(-1, 1)
    mean, log_variance = painter.encoder(pictures)
    assert mean.std(0).mean() > 0.2 * (0.5 * log_variance).exp().mean()  # 0.3 to 0.8; with PyTorch's weights 0.05
    labels = channels(torch.randint(len(LABELS), (1, 16, 16)), len(LABELS))
    change = painter(labels, torch.randn(1, 8)) - painter(labels, torch.randn(1, 8))
    assert change.abs().mean() > 0.01  # 0 where a normalisation takes the style away
