"""pixelNeRF against what its paper says, and against geometry."""

from __future__ import annotations

from dataclasses import replace

import pytest
import safetensors.torch
import tiny
import tiny_collection
import torch
from budgets import budget
from torch.nn import functional as F

from lumigraph import methods
from lumigraph.camera import Camera
from lumigraph.camera.lens import Fisheye
from lumigraph.components.fields.kept_photographs import KeptPhotographs, padded
from lumigraph.datasets.collection import Collection
from lumigraph.datasets.scene import Photograph
from lumigraph.errors import LumigraphError
from lumigraph.methods.pixelnerf.networks import PictureEncoder, ResidualNetwork, finer, look_up
from lumigraph.run import build

pytestmark = budget("methods", 10)

CPU = torch.device("cpu")
SMALL = {"widths": (8, 8, 8, 8), "blocks": (1, 1, 1)}


def pixelnerf(**changes):
    kind = methods.find("pixelnerf")
    return build(kind, tiny.scene().frame, replace(kind.smallest(), **changes), CPU, 0).eval()


# The encoder


def test_the_encoder_is_torchvisions_cut_short():
    """Shapes of resnet34's tensors, as torchvision publishes them, and 512 channels at half the resolution."""
    encoder = PictureEncoder(frozen=True)
    shapes = {name: tuple(value.shape) for name, value in encoder.state_dict().items()}
    assert shapes["conv1.weight"] == (64, 3, 7, 7) and shapes["bn1.running_var"] == (64,)
    assert shapes["layer1.2.conv2.weight"] == (64, 64, 3, 3) and "layer1.0.downsample.0.weight" not in shapes
    assert shapes["layer2.0.downsample.0.weight"] == (128, 64, 1, 1) and shapes["layer2.3.bn2.bias"] == (128,)
    assert shapes["layer3.0.conv1.weight"] == (256, 128, 3, 3) and shapes["layer3.5.conv2.weight"] == (256, 256, 3, 3)
    assert not any(name.startswith(("layer3.6", "layer4", "fc")) for name in shapes)
    # the stem and three stages of resnet34 have 8,170,304 numbers that are learnt
    assert sum(p.numel() for p in encoder.parameters()) == 8_170_304
    assert encoder(torch.rand(1, 3, 32, 48)).shape == (1, 16, 24, 512)


@pytest.mark.parametrize("pool", [True, False])
def test_cells_of_every_stage_lie_where_they_are_said_to(pool):
    """Of a picture that is mirrored about a pixel that all stages have a cell on, features are mirrored too, once
    kernels are; so no stage is shifted against another."""
    encoder = PictureEncoder(**SMALL, pool=pool)
    for layer in encoder.modules():
        if isinstance(layer, torch.nn.Conv2d):
            layer.weight.data = 0.5 * (layer.weight.data + layer.weight.data.flip(-1))
    picture = torch.rand(1, 3, 33, 33)
    features = encoder(picture)
    assert features.shape[1:3] == (17, 17)  # cell 8 of the stem, 1 of the third stage, lies on pixel 16
    torch.testing.assert_close(encoder(picture.flip(-1)), features.flip(2), atol=1e-4, rtol=1e-4)


def test_looking_up_a_ramp_gives_where_one_looked():
    """Cell j of half the resolution is centred on pixel 2 j, whose middle is at 2 j + 0.5."""
    rows, columns = torch.meshgrid(torch.arange(9.0), torch.arange(13.0), indexing="ij")
    ramp = torch.stack([2 * columns + 0.5, 2 * rows + 0.5])[None]
    cells = ramp.permute(0, 2, 3, 1)
    pixels = torch.tensor([[[0.5, 0.5], [7.3, 4.9], [24.5, 16.5]]])
    torch.testing.assert_close(look_up(cells, pixels, torch.tensor([[25.0, 17.0]])), pixels)
    outside = look_up(cells, torch.tensor([[[-50.0, 99.0]]]), torch.tensor([[25.0, 17.0]]))
    torch.testing.assert_close(outside, torch.tensor([[[0.5, 16.5]]]))
    torch.testing.assert_close(finer(ramp[:, :, ::2, ::2], 2, ramp.shape[2:]), ramp)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (4, 6)])
def test_looking_up_is_grid_sample(size, generator):
    cells = torch.randn(3, *size, 7, generator=generator, requires_grad=True)
    sizes = 2.0 * torch.tensor([size[::-1]]).expand(3, 2) - 1
    pixels = torch.rand(3, 50, 2, generator=generator) * (sizes[:1] + 4) - 2
    grid = 2 * (pixels - 0.5) / (sizes - 1)[:, None].clamp_min(1) - 1
    expected = F.grid_sample(cells.permute(0, 3, 1, 2), grid[:, None], "bilinear", "border", align_corners=True)
    found, weights = look_up(cells, pixels, sizes), torch.randn(3, 50, 7, generator=generator)
    torch.testing.assert_close(found, expected[:, :, 0].mT)
    one, other = (torch.autograd.grad((x * weights).sum(), cells)[0] for x in (found, expected[:, :, 0].mT))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def test_weights_of_others_are_taken_from_a_file(tmp_path):
    torch.manual_seed(0)
    there, here = PictureEncoder(**SMALL, frozen=True), PictureEncoder(**SMALL, frozen=True)
    there.bn1.running_mean += 0.3
    weights = {**there.state_dict(), "fc.weight": torch.zeros(10, 8), "bn1.num_batches_tracked": torch.tensor(5)}
    safetensors.torch.save_file(weights, tmp_path / "resnet.safetensors")
    torch.save(weights, tmp_path / "resnet.pth")
    picture = torch.rand(2, 3, 16, 16)
    for name in ("resnet.safetensors", "resnet.pth"):
        here.load(tmp_path / name)
        assert torch.equal(here.train()(picture), there.eval()(picture))  # statistics stay as they are
    with pytest.raises(LumigraphError, match="conv1.weight is .8, 3, 7, 7., .* resnet34 with --preset paper"):
        PictureEncoder(frozen=True).load(tmp_path / "resnet.pth")
    del weights["layer2.0.conv1.weight"]
    torch.save(weights, tmp_path / "less.pth")
    with pytest.raises(LumigraphError, match="less.pth lacks layer2.0.conv1.weight"):
        here.load(tmp_path / "less.pth")
    method = pixelnerf(encoder_weights=str(tmp_path / "resnet.pth"), encoder_pool=True)
    method.begin(tiny_collection.collection())
    assert torch.equal(method.encoder.bn1.running_mean, there.bn1.running_mean)


# The network


def test_the_network_is_the_papers():
    """Against equations 4 to 6, written out; features joined before they are looked up or after is the same."""
    torch.manual_seed(0)
    network = ResidualNetwork(5, 7, 16, blocks=3, joined=2, exact=True)
    for block in network.blocks:
        torch.nn.init.normal_(block.outer.weight, std=0.2)
    points, features = torch.randn(2, 11, 5), torch.randn(2, 4, 6, 7)
    pixels, sizes = torch.rand(2, 11, 2) * torch.tensor([11.0, 7.0]), torch.tensor([[11.0, 7.0]]).expand(2, 2)
    found = network(points, look_up(network.prepared(features), pixels, sizes))

    def block(x, number):
        inner, outer = network.blocks[number].inner, network.blocks[number].outer
        return x + F.linear(F.linear(x.relu(), inner.weight, inner.bias).relu(), outer.weight, outer.bias)

    w = look_up(features, pixels, sizes)
    join = network.join.weight.chunk(2), network.join.bias.chunk(2)
    x = F.linear(points, network.first.weight, network.first.bias)
    for k in range(2):
        x = block(x + w @ join[0][k].T + join[1][k], k)
    x = block(x.mean(0), 2)
    torch.testing.assert_close(found, F.linear(x.relu(), network.last.weight, network.last.bias), atol=1e-5, rtol=1e-4)


def test_the_order_of_views_does_not_matter_and_twice_the_same_is_once(monkeypatch):
    monkeypatch.setattr("lumigraph.methods.pixelnerf.BFLOAT16", False)
    method, scene = pixelnerf(), tiny.scene()
    points, directions = torch.rand(40, 3) - 0.5, F.normalize(torch.randn(40, 3), dim=-1)

    def told(*images):
        return method.given(replace(scene, splits={"train": torch.tensor(images)})).field(points, directions)

    for other in (told(5, 1), told(1, 5, 5, 1)):
        for a, b in zip(told(1, 5), other, strict=True):
            torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-4)
    assert not torch.allclose(told(1, 5)[1], told(1)[1])


@pytest.mark.parametrize("centred", [True, False])
def test_a_scene_that_is_turned_whole_looks_the_same(centred, monkeypatch):
    """All that the network is told is relative to the cameras; seen from the camera, moving the scene changes nothing
    either."""
    monkeypatch.setattr("lumigraph.methods.pixelnerf.BFLOAT16", False)
    method, scene = pixelnerf(centred=centred), tiny.scene()
    turn = torch.eye(4)
    turn[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    turn[:3, :3] *= torch.linalg.det(turn[:3, :3])
    turn[:3, 3] = 0.0 if centred else torch.tensor([0.1, -0.2, 0.05])
    turned = replace(scene, cameras=scene.cameras.transformed(turn))
    points, directions = torch.rand(40, 3) - 0.5, F.normalize(torch.randn(40, 3), dim=-1)
    moved = points @ turn[:3, :3].T + turn[:3, 3], directions @ turn[:3, :3].T
    here, there = method.given(scene).field(points, directions), method.given(turned).field(*moved)
    for a, b in zip(here, there, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)


# What it keeps


def test_photographs_are_kept_as_bytes_with_any_lens_and_size():
    scene = tiny.scene()
    other = Camera(scene.cameras.pose[:1], Fisheye(torch.full((1, 2), 9.0), torch.full((1, 2), 6.0),
                   torch.zeros(1, 4)), torch.tensor([[12, 10]]))  # fmt: skip
    shots = [scene.photograph(3), Photograph(other, torch.rand(10, 12, 3))]
    kept = KeptPhotographs.of(shots, (1.0, 1.0, 1.0), 4)
    fresh = KeptPhotographs(4)
    for name in ("pixels", "taken"):
        getattr(fresh, name).rows = getattr(kept, name).rows.clone()
    cameras, pictures = fresh.cameras(), fresh.pictures()
    assert torch.equal(cameras[0].pose, shots[0].camera.pose) and cameras.size.tolist() == [[24, 24], [12, 10]]
    point = torch.tensor([[0.1, 0.2, 0.0]])
    torch.testing.assert_close(cameras[1].project(point)[0], other.project(point)[0])
    for picture, shot in zip(pictures, shots, strict=True):
        assert (picture - shot.before((1.0, 1.0, 1.0))).abs().max() <= 0.5 / 255 + 1e-6
    both = padded(pictures)
    assert both.shape == (2, 3, 24, 24) and torch.equal(both[1, :, 20, 5], pictures[1][-1, 5])
    fresh.pixels.rows = fresh.pixels.rows[:-1]
    with pytest.raises(LumigraphError, match="does not fit their pixels"):
        fresh.cameras()
    fresh.taken.rows = torch.zeros(9, dtype=torch.uint8)
    with pytest.raises(LumigraphError, match="cannot be read as JSON"):
        fresh.cameras()


# Learning


def test_rays_go_through_the_object_first_and_no_view_looks_at_itself():
    method, data = pixelnerf(rays_per_member=300, source_views=2), tiny_collection.collection()
    for boxed, least, most in ((0.0, 0.9, 1.0), (0.9, 0.0, 0.8)):
        method.before_step(0, boxed)
        lesson = method.batch(data, torch.Generator().manual_seed(1))
        assert len(lesson) == 300 and 1 <= len(lesson.sources[0]) <= 2
        rays = lesson.batches[0].rays
        through = (rays.origins - (rays.origins * rays.directions).sum(-1, keepdim=True) * rays.directions).norm(dim=-1)
        assert least <= float((through < 0.9).float().mean()) <= most
        for shot in lesson.sources[0]:
            assert (rays.origins - shot.camera.position).norm(dim=-1).min() > 0.1


def test_members_that_are_no_photographs_are_refused():
    import tiny_shapes

    method = pixelnerf()
    with pytest.raises(LumigraphError, match="pixelnerf learns from collections of photographs"):
        method.begin(Collection.of({"one": tiny_shapes.shapes(), "two": tiny_shapes.shapes()}, "shapes"))


def test_without_photographs_it_says_so():
    with pytest.raises(LumigraphError, match="it was given none"):
        pixelnerf().render(tiny.scene().cameras[0])
