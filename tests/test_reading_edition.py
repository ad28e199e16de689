"""The reading edition beside the package: equal rays, weights, footprints and gradients; equal curves of training."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import reading as beside
import torch
from budgets import budget

import lumigraph
from lumigraph import kernels
from lumigraph.camera import Camera, lens
from lumigraph.camera.rays import Rays, Samples
from lumigraph.components.fields.deformation import window
from lumigraph.components.sampling.sampling import inverse_of, stratified
from lumigraph.geometry import rotated, to_matrix
from lumigraph.kernels.octree_cells import Tree, octree_cells, some_rays
from lumigraph.methods.fourier_features import Config, FourierFeatures
from lumigraph.reading import (
    bake,
    camera,
    data,
    deform,
    factors,
    fourier,
    hashgrid,
    lightfield,
    microsplat,
    nerf,
    pose,
    splats,
    stereo,
    surface,
    tsdf,
    volume,
)  # fmt: skip
from lumigraph.volume import composite

pytestmark = budget("methods", 40)

ROOT = Path(lumigraph.__file__).parent.parent
FOLDER = ROOT / "lumigraph" / "reading"
PROGRAMS = sorted(set(FOLDER.glob("*.py")) - {FOLDER / "__init__.py", FOLDER / "data.py"})


def near(a, b, tolerance: float = 1e-5) -> None:
    torch.testing.assert_close(torch.as_tensor(a).double(), torch.as_tensor(b).double(), rtol=tolerance, atol=tolerance)


@pytest.fixture
def chance() -> torch.Generator:
    torch.manual_seed(3)
    return torch.Generator().manual_seed(3)


def some_pose(seed: int = 0, away: float = 3.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    place = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    return camera.look_at(away * place, 0.1 * torch.randn(3, generator=generator))


# The edition


def test_it_is_short_and_whole():
    lines = {path.name: len(path.read_text("utf-8").splitlines()) for path in FOLDER.glob("*.py")}
    assert {path.stem for path in PROGRAMS} == set(beside.NAMES)
    assert max(lines.values()) <= 200 and sum(lines.values()) <= 2000, lines


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_each_file_ends_with_its_place_in_the_package(path):
    text = path.read_text("utf-8")
    end = text[text.index("# In the large one:") :]
    assert all(line.startswith("# ") for line in end.splitlines()) and end.count("\n") <= 6
    named = [x for x in re.findall(r"`([\w/.]+/[\w.]*)`", end)]
    missing = [x for x in named if not any((root / x).exists() for root in (ROOT, ROOT / "lumigraph"))]
    assert named and not missing, missing
    imports = re.findall(r"^\s*(?:from|import) (\S+)", text, re.MULTILINE)
    allowed = {"torch", "numpy", "jaxtyping", "math", "time", "itertools", "collections.abc", "torch.nn.functional"}
    assert {x for x in imports if not x.startswith(".")} <= allowed


# Rays


def test_lenses_and_rays(chance):
    pixels, centre = camera.pixel_centres(12, 8), torch.tensor([6.0, 4.0])
    focal, middle = torch.full((1, 2), 7.0), centre[None]
    plain = lens.Pinhole(focal, middle)
    near(camera.pinhole(pixels, 7.0, centre), plain.unproject(pixels))
    bent = lens.OpenCV(focal, middle, torch.tensor([[0.1, 0.03, 0, 0, 0, 0, 0, 0]]))
    near(camera.radial(pixels, 7.0, centre, 0.1, 0.03), bent.unproject(pixels))
    round_lens = lens.Fisheye(focal, middle, torch.zeros(1, 4))
    near(camera.fisheye(pixels, 7.0, centre), round_lens.unproject(pixels))
    panorama = lens.Equirectangular(torch.tensor([[12.0, 8.0]]))
    near(camera.equirectangular(pixels, 12, 8), panorama.unproject(pixels))
    one = Camera(some_pose()[None], plain, torch.tensor([[12, 8]]))
    origins, directions = camera.pinhole_rays(torch.zeros(8, 12, 3), some_pose(), 7.0)
    rays = one.rays(one.pixels())
    near(origins, rays.origins), near(directions, rays.directions)
    points = torch.rand(9, 3, generator=chance) + torch.tensor([0.0, 0, 1])
    near(camera.project(points, 7.0, centre), plain.project(points)[0])


def test_a_room_is_met_where_its_rays_say(chance):
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=chance), dim=1)
    _, t = camera.room(torch.tensor([[0.0, -0.5, 0.4]]).expand(200, 3), directions)
    points = torch.tensor([0.0, -0.5, 0.4]) + t[:, None] * directions
    wall = (points.abs().amax(1) - 1).abs()
    ball = ((points[:, None] - camera.BALLS[:, :3]).norm(dim=2) - camera.BALLS[:, 3]).abs().amin(1)
    assert float(torch.minimum(wall, ball).max()) < 1e-5 and 5 < int((ball < 1e-5).sum()) < 200


def test_light_fields_meet_the_cameras_that_they_should(chance):
    """Other cameras see a point where the package projects it; and blends are linear."""
    point = torch.tensor([[0.2, -0.1, 1.7]])
    eye, other = torch.tensor([0.04, 0.02]), torch.tensor([-0.08, 0.16])
    middle = torch.full((1, 2), lightfield.SIZE / 2)
    plain = lens.Pinhole(torch.full((1, 2), lightfield.FOCAL), middle)
    own, there = (plain.project(point - torch.tensor([*place, 0.0]))[0][0] for place in (eye, other))
    near(lightfield.pixel_in(other[0], eye[0], own[:1], 1.7), there[:1], 1e-4)
    near(lightfield.pixel_in(other[1], eye[1], own[1:], 1.7), there[1:], 1e-4)
    light = torch.rand(3, 3, lightfield.SIZE, lightfield.SIZE, 3, generator=chance)
    x, y = 1 + (lightfield.SIZE - 2) * torch.rand(2, 40, generator=chance)
    from lumigraph.kernels.blend_views.reference import corners

    (a, b, c, d), (u, v) = corners(light[1, 2], x, y, torch.tensor([lightfield.SIZE] * 2))
    u, v = u[:, None], v[:, None]
    expected = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    near(lightfield.linear(light, torch.tensor(1), torch.tensor(2), y, x), expected)


# Volume rendering


def test_weights_and_composites(chance):
    sigma, delta = 3 * torch.rand(2, 20, 17, generator=chance)
    rgb, t = torch.rand(20, 17, 3, generator=chance), delta.cumsum(1)
    samples = Samples.rows(t - delta, t[:, -1])
    seen = composite(samples, sigma.flatten(), rgb.view(-1, 3), torch.ones(20, 3))
    w = volume.weights(sigma, delta)
    near(w, beside.weights(sigma, delta))
    near(volume.composite(w, rgb), seen.rgb)
    near(volume.expected_depth(w, t - delta / 2), seen.depth)
    near(surface.weights(1 - torch.exp(-sigma * delta)), w)
    near(sum(volume.weights(torch.full((1, 9), 0.7), torch.full((1, 9), 0.2))[0]), volume.slab(0.7, 1.8))


def test_places_along_rays(chance):
    edges = torch.rand(6, 9, generator=chance).sort(1).values
    w = torch.rand(6, 8, generator=chance)
    shares = stratified(6, 5)
    near(nerf.invert(edges, w, shares), inverse_of(edges, w, shares))
    near(nerf.stratified(torch.zeros(6, 1), torch.ones(6, 1), 5, False), shares)
    near(nerf.encode(edges[:, :3], 4), beside.encode(edges[:, :3], 4))
    o, d = camera.pinhole_rays(torch.zeros(5, 5, 3), some_pose(), 9.0)
    rays = Rays(o, d, torch.ones(25))
    for mine, its in zip(nerf.span(o, d), rays.through_box(data.BOX), strict=True):
        near(mine[:, 0], its)


def test_marching_through_occupied_cells(chance, monkeypatch):
    box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    for owner in (hashgrid, nerf):
        monkeypatch.setattr(owner, "BOX", box)
    occupied = torch.rand(1, hashgrid.CELLS, hashgrid.CELLS, hashgrid.CELLS, generator=chance) < 0.3
    o, d = camera.pinhole_rays(torch.zeros(6, 6, 3), some_pose(2), 8.0)
    t, there = hashgrid.march(o, d, occupied[0], 0.07, False)
    enter, leave = nerf.span(o, d)
    start = enter[:, 0]
    kept = kernels.march(o, d, start, leave[:, 0].maximum(start), occupied, torch.zeros(occupied.shape), 0.07)
    assert len(kept) > 50 and there.sum(1).tolist() == kept.ray_starts.diff().tolist()
    near(t[there], kept.t)


def test_tables_planes_and_distances(chance):
    points = torch.rand(50, 3, generator=chance)
    sizes = hashgrid.resolutions(4, 4, 40)
    tables = [torch.randn(min((n + 1) ** 3, 2**10), 2, generator=chance).requires_grad_() for n in sizes]
    g = torch.randn(50, 8, generator=chance)
    both = [f(points, tables, sizes) for f in (hashgrid.encode, beside.hash_encode)]
    near(*both)
    mine, its = (torch.autograd.grad(x, tables, g) for x in both)
    for a, b in zip(mine, its, strict=True):
        near(a, b)
    planes, lines = factors.factors(3, [5, 6, 7], 1.0)
    near(factors.products(points, planes, lines), beside.products(points, planes, lines))
    f, slope = torch.randn(2, 50, generator=chance)
    delta = 0.1 * torch.rand(50, generator=chance)
    near(surface.alphas(f, slope, delta, 20.0), beside.neus_alphas(f, slope, delta, 20.0))


def test_spheres_have_normals(chance):
    """At first f is the distance to a sphere: gradient, eikonal term and zero are known."""
    net = surface.network()
    x = torch.randn(30, 3, generator=chance)
    f, gradient, _ = surface.with_gradient(net, x, False)
    near(f, x.norm(dim=1) - surface.RADIUS)
    near(gradient, torch.nn.functional.normalize(x, dim=1), 1e-4)


# Gaussians


def some_cloud(count: int, generator: torch.Generator) -> splats.Cloud:
    return {
        "means": 0.6 * torch.randn(count, 3, generator=generator),
        "quaternions": torch.randn(count, 4, generator=generator),
        "log_scales": torch.log(0.03 + 0.2 * torch.rand(count, 3, generator=generator)),
        "logits": torch.randn(count, generator=generator),
        "harmonics": 0.4 * torch.randn(count, 4, 3, generator=generator),
    }


def test_footprints(chance):
    cloud = some_cloud(40, chance)
    near(splats.rotations(cloud["quaternions"]), to_matrix(cloud["quaternions"]))
    mine, depths = splats.project(cloud, some_pose(), 20.0, (30, 24))
    its, its_depths = beside.project(cloud, some_pose(), 20.0, (30, 24))
    seen = its[2] > 0
    assert int(seen.sum()) > 20
    for a, b in zip((*mine, depths), (*its, its_depths), strict=True):
        near(a[seen], b[seen], 2e-5)


def test_blending_and_its_gradient(chance):
    """By hand, by the package's rasteriser, and by autograd of the picture."""
    prints, depths = splats.project(some_cloud(60, chance), some_pose(1), 22.0, (37, 21))
    target = torch.rand(21, 37, 3, generator=chance)
    picture, gradients = splats.draw(prints, depths, (37, 21), target)
    its, its_gradients = beside.draw(prints, depths, (37, 21), target)
    near(picture, its)
    leaves = tuple(x.detach().requires_grad_() for x in prints)
    total = torch.zeros(())
    for pixels, i in splats.tiles(leaves, depths, (37, 21)):
        rgb, _ = splats.blend(pixels + 0.5, tuple(x[i] for x in leaves))
        total = total + (rgb - target[pixels[:, 1], pixels[:, 0]]).abs().sum() / target.numel()
    for a, b, c in zip(gradients, its_gradients, torch.autograd.grad(total, leaves), strict=True):
        near(a, b), near(a, c)


def test_refinement_keeps_the_budget_and_drops_what_is_faint(chance):
    cloud = some_cloud(50, chance)
    cloud["logits"][:5] = -9.0
    slopes = torch.zeros(50)
    slopes[[1, 7, 8]] = torch.tensor([9.0, 2.0, 1.0])
    cloud["log_scales"][7], cloud["log_scales"][8] = math.log(0.5), math.log(0.01)
    grown = splats.refine(cloud, slopes)
    bright, pulled = 45, 50 // 3
    assert len(grown["means"]) == bright + pulled and float(grown["logits"].sigmoid().min()) > splats.PRUNE_OPACITY
    sizes = grown["log_scales"].exp()
    assert int((sizes[:, 0] - 0.5 / splats.SPLIT_FACTOR).abs().lt(1e-5).sum()) == 2  # both halves
    assert int((sizes[:, 0] - 0.01).abs().lt(1e-6).sum()) == 2  # the small one and its clone


def test_flat_gaussians(chance):
    image = torch.rand(19, 26, 3, generator=chance).numpy()
    cloud = microsplat.random_cloud(image, 30)
    cloud["angle"], cloud["log_scale"] = (
        cloud["angle"] * 1.7,
        cloud["log_scale"] + np.linspace(-0.5, 0.5, 60).reshape(30, 2),
    )
    target = image.reshape(-1, 3) * 0.5
    (picture, gradient), (its, its_gradient) = (f(cloud, 26, 19, target) for f in (microsplat.draw, beside.draw_flat))
    near(picture, its)
    for name, values in gradient.items():
        near(values / 10, its_gradient[name] / 10, 2e-5)
    step = 1e-6
    for name in ("log_scale", "angle"):  # of which the package has no gradient
        more, less = ({**cloud, name: cloud[name] + x} for x in (step, -step))
        errors = [0.5 * ((microsplat.draw(x, 26, 19)[0] - target) ** 2).sum() for x in (more, less)]
        assert gradient[name].sum() == pytest.approx((errors[0] - errors[1]) / (2 * step), rel=0.02, abs=0.02)


# Depth


def test_stereo(chance):
    left, right = (255 * torch.rand(2, 14, 24, generator=chance)).round()
    costs = stereo.census_costs(left, right, 6)
    sides = left.byte(), right.byte()
    everywhere = torch.ones(14, 24, dtype=torch.bool)
    its = kernels.census_cost(*sides, everywhere, everywhere, 0, 6).int()
    x = torch.arange(24)[:, None] - torch.arange(6)
    inside = (x >= 0).expand(14, 24, 6)
    grey = torch.stack([(left - right.roll(d, 1)).abs() // 2 for d in range(6)], -1).clamp(max=10).int()
    assert torch.equal(costs[inside].int(), (its - grey)[inside])  # the package adds the difference of greys
    near(stereo.disparity(costs), beside.disparity(costs))
    one, other = some_pose(1), some_pose(2)
    R = stereo.shared_rotation(one, other)
    (
        near(R.T @ R, torch.eye(3)),
        near(R.T @ (other[:, 3] - one[:, 3])[:, None] / (other - one)[:, 3].norm(), [[1.0], [0], [0]]),
    )


def test_fusion(chance, monkeypatch):
    monkeypatch.setattr(tsdf, "VOXEL", 1 / 12)
    monkeypatch.setattr(tsdf, "TRUNCATION", 1 / 4)
    points, shape = tsdf.voxel_centres()
    assert math.prod(shape) == len(points)
    mine = its = tsdf.empty(len(points))
    for seed in range(3):
        view = some_pose(seed, 3.2)
        _, d = camera.pinhole_rays(torch.zeros(40, 40, 3), view, 60.0)
        depth = (3.1 + 0.2 * torch.sin(4 * d[:, 0])).view(40, 40)  # no edges, of which either has a rule of its own
        rgb = torch.rand(40, 40, 3, generator=chance)
        mine, its = (f(x, points, depth, rgb, view, 60.0) for f, x in ((tsdf.fuse, mine), (beside.fuse, its)))
    assert float(mine[1].max()) == 3 and 0.05 < float((mine[1] > 0).float().mean())
    near(mine[0], its[0], 1e-4), near(mine[1], its[1])
    shown = (mine[1] > 0) & (mine[0].abs() < 0.99)
    near(mine[2][shown], its[2][shown], 1e-4)


# Poses, motion, octrees


def test_twists(chance):
    omega = torch.randn(3, generator=chance)
    vectors = torch.randn(7, 3, generator=chance)
    near(vectors @ pose.exponential(omega).T, rotated(vectors, omega.expand(7, 3)))
    near(torch.autograd.functional.jacobian(pose.exponential, torch.zeros(3))[2, 1], [1.0, 0, 0])
    turned = pose.moved(some_pose(), torch.tensor([0.0, 0.1, 0.0, 1.0, 0, 0]))
    assert pose.angle(turned, some_pose()) == pytest.approx(math.degrees(0.1), rel=1e-3)


def test_motion_begins_smooth_and_small(chance):
    for alpha in (0.0, 1.3, 3.0):
        near(deform.window(3, alpha), window(3, torch.tensor(alpha)))
    dx = deform.displacement(deform.network(), torch.rand(20, 3), torch.rand(20))
    assert 0 < float(dx.detach().abs().max()) < 0.01


def test_octrees(chance):
    depth = 4
    middle = torch.cartesian_prod(*[torch.arange(16)] * 3)[:, :]
    cells = middle[((middle - 7.5).norm(dim=1) < 6.6) & (middle[:, 2] < 8)]  # half of a ball
    sigma = torch.where(cells[:, 0] < 8, 5.0, 9.0 + cells[:, 1])  # one side alike, the other not
    k = torch.zeros(len(cells), 4, 3)
    children, merged, _ = bake.tree(cells, sigma, k, depth)
    assert (children < 0).sum() < len(cells)
    value, size = bake.leaf(children, cells, depth)
    assert bool((value < 0).all()) and set(size.tolist()) == {1, 2, 4}
    assert float((merged[-1 - value] - sigma)[cells[:, 0] < 8].abs().max()) < 1e-5
    o, d = some_rays(60, chance)
    side = float((data.BOX[1] - data.BOX[0]).max())
    rows, lengths = bake.march(children, data.BOX[0] + side * o, d, depth)
    tree = Tree(children.int(), torch.zeros(0, dtype=torch.int32), len(merged), depth)
    its = octree_cells(o, d, tree, merged)
    expected = torch.zeros(60).index_add(0, its.samples.ray_index, merged[its.rows] * its.samples.length * side)
    found = torch.where(rows >= 0, merged[rows.clamp_min(0)] * lengths, 0).sum(1)
    assert float(expected.max()) > 5
    near(found, expected, 5e-3)  # steps of 1e-4 cells carry a ray over each wall
    d = torch.nn.functional.normalize(torch.randn(6, 3, generator=chance), dim=1)
    near(bake.harmonics(d), kernels.spherical_harmonics(d, 2))
    coefficients = torch.randn(5, 4, 3, generator=chance) * 0.5
    rgb = (bake.harmonics(d) @ coefficients).sigmoid()
    near(bake.project(rgb, d), coefficients, 1e-3)


# Training


def small_rays() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rays of four small pictures of a ball, and their colours."""
    parts = []
    for seed in range(4):
        view = some_pose(seed, 3.2)
        o, d = camera.pinhole_rays(torch.zeros(16, 16, 3), view, 24.0)
        b = (o * d).sum(1)
        hit = (b * b - o.square().sum(1) + 0.2) > 0
        parts.append((o, d, torch.where(hit[:, None], 0.5 + 0.4 * d, 1.0)))
    o, d, rgb = (torch.cat(x) for x in zip(*parts, strict=True))
    enter, leave = nerf.span(o, d)
    met = (enter < leave)[:, 0]
    return o[met], d[met], rgb[met]


def losses_of(name: str, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Loss of each step of a program at test size: from what `item` is asked."""
    torch.manual_seed(0)
    program = beside.module(name)
    noted: list[float] = []
    item = torch.Tensor.item
    with monkeypatch.context() as patch:
        backward = torch.Tensor.backward
        patch.setattr(
            torch.Tensor, "backward", lambda x, *a, **k: (noted.append(item(x.detach())), backward(x, *a, **k))[1]
        )
        if name == "nerf":
            program.train(program.network(), *small_rays(), steps=12)
        elif name == "surface":
            program.train(program.network(), *small_rays(), steps=8)
        else:
            program.train(program.field(), *small_rays(), steps=12)
    return noted


@pytest.mark.parametrize("name", ["nerf", "hashgrid", "factors", "surface"])
def test_the_same_curve_with_the_package_s_functions(name, monkeypatch):
    """From one seed, with the reading edition's functions and with the package's kernels, within 1 %."""
    for size, value in {"RAYS": 64, "CELLS": 16, "ENTRIES": 2**10, "FINEST": 40, "NODES": 20}.items():
        for owner in (beside.module(name), hashgrid):
            monkeypatch.setattr(owner, size, value, raising=False)
    own = losses_of(name, monkeypatch)
    for place, function in beside.ENGINES[name].items():
        owner, attribute = place.split(".")
        monkeypatch.setattr(beside.module(owner), attribute, function)
    its = losses_of(name, monkeypatch)
    assert len(own) >= 8 and (name == "surface" or sum(own[-4:]) < sum(own[:4]))  # whose rate only begins to rise
    np.testing.assert_allclose(own, its, rtol=0.01)


def test_the_same_curve_of_splats_and_of_a_flat_picture(chance, monkeypatch):
    images, poses = torch.rand(2, 20, 20, 3, generator=chance), torch.stack([some_pose(0), some_pose(1)])
    curves = []
    for swap in (False, True):
        if swap:
            for place in ("splats.project", "splats.draw", "microsplat.draw"):
                owner, attribute = place.split(".")
                monkeypatch.setattr(beside.module(owner), attribute, beside.ENGINES[owner][place])
        torch.manual_seed(0)
        cloud = some_cloud(30, torch.Generator().manual_seed(1))
        curves.append(
            (splats.train(cloud, images, poses, 20.0, steps=15)[1], microsplat.fit(images[0].numpy(), 25, 12)[1])
        )
    for own, its in zip(*curves, strict=True):
        assert own[-1] < own[0]
        np.testing.assert_allclose(own, its, rtol=0.01)


def test_the_same_curve_as_the_method_of_fourier_features(monkeypatch):
    """The method's network with its own weights, taught by `fourier.train`, and by the method's own optimizer."""
    from lumigraph.datasets.scene import Frame

    method = FourierFeatures(
        Frame(), Config(frequencies=16, layers=4, hidden_width=24, scale=3.0, exact=True, learning_rate=3e-3)
    )
    B = method.encoding.frequencies
    net = fourier.network(32, 24)
    linear = [x for x in net if isinstance(x, torch.nn.Linear)]
    for own, its in zip(linear, method.layers, strict=True):
        own.load_state_dict({"weight": its.weight.detach().clone(), "bias": its.bias.detach().clone()})
    places = camera.pixel_centres(16, 16) / 16
    colours = 0.5 + 0.4 * (20 * places @ torch.rand(2, 3)).sin()
    near(net(fourier.gamma(places, B)), method.paint(places))
    monkeypatch.setattr(fourier, "PIXELS", 64)
    torch.manual_seed(5)
    own = fourier.train(net, B, places, colours, steps=12)
    torch.manual_seed(5)
    (optimizer,), its = method.optimizers(), []
    for _ in range(12):
        chosen = torch.randint(len(places), (64,))
        loss = (method.paint(places[chosen]) - colours[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        its.append(float(loss.detach()))
    assert own[-1] < own[0]
    np.testing.assert_allclose(own, its, rtol=0.01)


def test_a_picture_is_written_whole(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data.save("two", torch.zeros(4, 3, 3), torch.ones(4, 5, 3))
    from PIL import Image

    assert [x.name for x in tmp_path.iterdir()] == ["reading-two.png"]
    with Image.open("reading-two.png") as picture:
        assert picture.width / picture.height == 2


def test_programs_open_procedural_photographs():
    images, poses, focal = data.photographs("train", "procedural:still-life,size=16,views=2")
    depth = data.layer("depth", "train", "procedural:still-life,size=16,views=2")
    assert images.shape == (2, 16, 16, 3) and poses.shape == (2, 3, 4) and focal == pytest.approx(24.6, rel=0.01)
    assert depth.shape == images.shape[:3] and 2 < float(depth[depth.isfinite()].mean()) < 5
    assert data.psnr(images, images + 0.1) == pytest.approx(20, abs=1e-3)


def test_pages_say_how_long_the_programs_are():
    """The number in each "Read it in N lines" is the file's, and each program has a page that says it."""
    found = {}
    for page in (ROOT / "docs").rglob("*.md"):
        for lines, name in re.findall(r"\[Read it in (\d+) lines\]\([./]*reading\.md#(\w+)\)", page.read_text("utf-8")):
            assert int(lines) == len((FOLDER / f"{name}.py").read_text("utf-8").splitlines()), page
            found[name] = page
    assert set(found) == set(beside.NAMES) - {"camera"}
