"""NeRF and Mip-NeRF, small: they learn, both looks agree, what saves time keeps the picture, any space will do."""

from __future__ import annotations

import copy
from functools import cache

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.camera.rays import Rays
from lumigraph.components.fields.coordinate_network import CoordinateNetwork
from lumigraph.components.sampling.occupancy import OccupancyMask
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Forward, Frame, Scene
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.views import evaluate
from lumigraph.files.ranges import changed
from lumigraph.method import RayMethod
from lumigraph.methods import mip_nerf, nerf
from lumigraph.metrics import psnr
from lumigraph.run import build
from lumigraph.training import fit
from lumigraph.volume import composite

pytestmark = budget("methods", 24)

SMALL = {
    "depth": 3,
    "hidden_width": 32,
    "skip_layer": 2,
    "coarse_samples": 16,
    "fine_samples": 12,
    "rays_per_step": 128,
}
KINDS = {"nerf": nerf.NeRF, "mip-nerf": mip_nerf.MipNeRF}
QUICK = {"learning_rate": 1.5e-2, "final_learning_rate": 5e-4, "warmup": 0.0}
KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def method(kind: type[RayMethod], frame: Frame | None = None, **options) -> RayMethod:
    config = changed(kind.Config(), **SMALL | QUICK | {"position_frequencies": 6} | options)
    return build(kind, frame or tiny.scene().frame, config, torch.device("cpu"), 0)


@cache
def learnt(kind: type[RayMethod], **options) -> RayMethod:
    """Method that has learnt the tiny scene. Nobody may change it; a test that would takes a copy."""
    made = method(kind, **options)
    fit(made, tiny.scene(), steps=100, show=False, rehearsal=False)
    return made


def some_rays(count: int = 64) -> Rays:
    camera = tiny.scene().cameras[2]
    return camera.rays(camera.pixels()[:: 576 // count][:count])


@KIND
@pytest.mark.parametrize(
    "options", [{}, {"occupancy_resolution": 16, "coarse_loss_weight": 0.0}], ids=["paper", "quick"]
)
def test_it_learns_held_out_views(kind, options):
    if kind is nerf.NeRF and options:
        options = options | {"networks": 1, "transmittance_threshold": 1e-3}
    before, after = (evaluate(x, tiny.scene()).psnr for x in (method(kind, **options), learnt(kind, **options)))
    assert after > max(before, 9) + 6  # 6.3 to 9.0 after 90 steps


@KIND
def test_the_last_look_is_the_picture(kind):
    made = method(kind).eval()
    rays, background = some_rays(), torch.ones(1, 3)
    coarse, fine = made.looks(rays)
    assert [coarse.name, fine.name] == ["coarse", "fine"]
    assert len(fine.samples) > len(coarse.samples) * 12 / 16 - 1
    seen = made.render_rays(rays, background)
    torch.testing.assert_close(composite(fine.samples, fine.density, fine.rgb, background).rgb, seen.rgb)


def test_the_fine_look_of_nerf_holds_the_coarse_places_too():
    """Section 5.2: the union of both sets is evaluated by the fine network."""
    coarse, fine = (look.samples for look in method(nerf.NeRF).looks(some_rays(8)))
    first, second = coarse.t_start.view(8, 16), fine.t_start.view(8, 28)
    assert (second.diff(dim=1) >= 0).all()
    for a, b in zip(first, second, strict=True):
        assert torch.isin(a, b).all()


@KIND
def test_samples_go_where_the_first_look_found_something(kind):
    """With a network that knows of a thin shell alone, most fine samples lie near it."""
    made = method(kind, bfloat16=False, coarse_samples=24, fine_samples=16).eval()
    found = lambda x: 60 * ((x.norm(dim=-1) - 0.5).abs() < 0.05).float()  # noqa: E731

    class Shell(CoordinateNetwork):
        def forward(self, encoded, seen):
            return self.density(encoded), torch.zeros(len(encoded), 3)

        def density(self, encoded):
            sine, cosine = encoded[:, :3], encoded[:, 3:6]
            x = torch.atan2(sine, cosine) / (torch.pi if kind is nerf.NeRF else 1)
            return found(x) - 30 * (kind is mip_nerf.MipNeRF)

    for field in (made.network, made.network.coarse):
        if field:
            field.network = Shell(1, 1, 2, 2)
    middle = Rays(torch.tensor([[0.0, 0.0, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([1e-3]))
    _, fine = made.looks(middle)
    near = (fine.samples.t - 2.5).abs() < 0.15
    assert float(near.float().mean()) > (0.4 if kind is nerf.NeRF else 0.6)


@KIND
def test_skipping_empty_space_keeps_the_picture(kind):
    """A grid of what a trained network says, added afterwards: where nothing is, not asking changes nothing."""
    made, camera = copy.deepcopy(learnt(kind)), tiny.scene().cameras[0]
    everywhere = made.render(camera).rgb
    rays = camera.rays(camera.pixels())
    asked = made.sampler.sample(rays, made.network)[-1].evaluated
    made.sampler.empty = empty = OccupancyMask(32, 1e-4)
    for seed in range(6):
        empty.grid.update(made.density, 1e-4, torch.Generator().manual_seed(seed), decay=1.0)
    assert 0 < empty.grid.share < 0.8
    skipping = made.render(camera).rgb
    assert made.sampler.sample(rays, made.network)[-1].evaluated < 0.9 * asked
    assert psnr(skipping.clamp(0, 1), everywhere.clamp(0, 1)) > 40


@KIND
def test_gradients_reach_every_weight(kind):
    made, scene = method(kind).train(), tiny.scene()
    terms = made.loss(made.batch(scene, torch.Generator().manual_seed(0)), 0)
    assert terms.keys() == {"fine", "coarse"}
    torch.stack(list(terms.values())).sum().backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all() and parameter.grad.any(), name


def wall(reach: float, forward: bool) -> Scene:
    """A coloured wall, photographed from places side by side."""
    count, size = 9, 16
    y, x = torch.meshgrid(torch.linspace(-0.3, 0.3, 3), torch.linspace(-0.3, 0.3, 3), indexing="ij")
    pose = torch.eye(3, 4).repeat(count, 1, 1)
    pose[:, 0, 3], pose[:, 1, 3] = x.flatten(), y.flatten()
    lens = Pinhole(torch.full((count, 2), 16.0), torch.full((count, 2), size / 2))
    cameras = Camera(pose, lens, torch.full((count, 2), size), image_index=torch.arange(count))
    pictures = []
    for camera in (cameras[i] for i in range(count)):
        rays = camera.rays(camera.pixels())
        hit = rays.at(2.0 / rays.directions[:, 2])
        rgb = 0.5 + 0.4 * torch.stack(
            [(3 * hit[:, 0]).sin(), (3 * hit[:, 1]).sin(), (2 * hit[:, :2].sum(-1)).sin()], -1
        )
        pictures.append((rgb.clamp(0, 1) * 255).byte().view(size, size, 3).numpy())
    look = Forward(((1.0, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)), (2.0, 2.0), 1.0) if forward else None
    frame = Frame(reach=reach, near=0.5, image_count=count, forward=look)
    split = {"train": torch.tensor([0, 1, 2, 3, 5, 6, 7, 8]), "test": torch.tensor([4])}
    return Scene(cameras, ImageStore.from_arrays(pictures), frame, split, [str(i) for i in range(count)], "in memory")


@KIND
@pytest.mark.parametrize("forward", [True, False], ids=["ndc", "contracted"])
def test_it_learns_in_every_space(kind, forward):
    scene = wall(4.0, forward)
    made = method(kind, scene.frame)
    for field in (made.network, made.network.coarse or made.network):
        field.noise = 0.0
    fit(made, scene, steps=120, show=False, rehearsal=False)
    evaluation = evaluate(made, scene)
    assert evaluation.psnr > 20
    seen = made.render(scene.cameras[4])
    assert (seen.opacity > 0.5).float().mean() > 0.6 and seen.depth[seen.opacity > 0.5].isfinite().all()
    assert float(1 / seen.depth.median()) == pytest.approx(1 / 2.0, abs=0.35)


@KIND
def test_density_of_points_is_what_rays_integrate(kind):
    """The optical thickness of a short way is density times length, whatever the space."""
    frame = wall(4.0, True).frame
    made = method(kind, frame).eval()
    look = made.looks(Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([1e-2])))[1]
    points = torch.stack([0 * look.samples.t_start, 0 * look.samples.t_start, look.samples.t_start], -1)
    ratio = made.network.space.along(
        Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1)), look.samples
    )
    if kind is nerf.NeRF:
        raw = made.network.density_at(made.network.space.warp(points))
        torch.testing.assert_close(look.density, raw * ratio, rtol=2e-2, atol=1e-4)
    assert made.density(points).shape == (len(points),) and (made.density(points) >= 0).all()


def test_mip_nerf_sees_less_detail_through_wider_cones():
    """The same point, seen from a wide cone and a narrow one: what the network is told has faded."""
    made = method(mip_nerf.MipNeRF)
    p, wide = torch.tensor([[0.3, 0.1, -0.2]]), torch.full((1, 3), 0.3)
    narrow = made.network.encode_position(p, torch.zeros(1, 3)).abs()
    faded = made.network.encode_position(p, wide).abs()
    assert (faded <= narrow + 1e-6).all()
    assert float(faded[:, -6:].max()) < 1e-6 < float(narrow[:, -6:].max())


def test_two_networks_need_a_loss_each():
    with pytest.raises(LumigraphError, match="--networks 2 with --coarse-loss-weight 0"):
        method(nerf.NeRF, coarse_loss_weight=0.0)
