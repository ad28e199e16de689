"""The lumigraph, view interpolation and light fields: their equations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph import kernels
from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.components.image_based.depth import completed, depth_camera
from lumigraph.components.image_based.surface import consensus
from lumigraph.components.image_based.warping import behind, soft_splat
from lumigraph.datasets.images import ImageStore
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.export.light_field import grid_of, quilt, write_light_field
from lumigraph.methods.lumigraph import Lumigraph
from lumigraph.methods.view_interpolation import ViewInterpolation
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene
from lumigraph.readers.views import with_fewer_views

pytestmark = budget("methods", 8)


@pytest.fixture(scope="module")
def photographed() -> Lumigraph:
    method = Lumigraph(tiny.scene().frame, Lumigraph.smallest())
    method.begin(tiny.scene())
    return method.eval()


def test_a_photograph_is_shown_exactly(photographed):
    """Epipole consistency: at its camera a photograph alone counts, whatever the surface."""
    scene = tiny.scene()
    for geometry in ("measured", "plane"):
        method = Lumigraph(scene.frame, replace(Lumigraph.smallest(), geometry=geometry)).eval()
        method.begin(scene)
        for i in scene.splits["train"].tolist()[:3]:
            shown = method.render(scene.cameras[i])
            truth = scene.photograph(i).before(scene.frame.background)
            solid = shown.opacity > 0
            assert float((shown.rgb - truth)[solid].abs().max()) < 2e-3, geometry
            assert solid.float().mean() > 0.1


def test_weights_are_continuous_in_the_camera(photographed):
    """Colours move by little as a camera moves by little, also where the nearest photographs change."""
    first = tiny.scene().cameras[4]
    steps = torch.linspace(0, 1.0, 41)
    pictures = []
    for angle in steps:
        turn = torch.tensor([[angle.cos(), -angle.sin(), 0.0], [angle.sin(), angle.cos(), 0.0], [0.0, 0.0, 1.0]])
        camera = replace(first, pose=turn @ first.pose)
        ball = camera.rays(torch.tensor([[12.0, 12.0]])).at(torch.tensor([2.4]))
        tables = photographed.views.tables
        given = tables.pictures, torch.full_like(tables.depths, 2.5), tables.sizes, tables.poses, tables.lenses
        weights = 0.05, 0.0, 0.5, 0.08
        pictures.append(kernels.blend_views(ball, camera.position, 32.0, *given, 3, *weights)[0])
    moves = torch.cat(pictures).diff(dim=0).norm(dim=-1)
    assert float(moves.max()) < 6 * float(moves.mean()) + 1e-3


def three_photographs(angles: list[float]) -> tuple:
    """A red, a green and a blue photograph that see a point at angles from the new camera's ray."""
    poses = torch.eye(3, 4).repeat(3, 1, 1)
    poses[:, 0, 3] = -torch.tensor(angles).tan()
    pictures = torch.zeros(3, 4, 4, 3, dtype=torch.uint8)
    for i in range(3):
        pictures[i, ..., i] = 255
    lenses = torch.zeros(3, 13)
    lenses[:, :2], lenses[:, 2:4], lenses[:, 12] = 1.0, 2.0, 50.0
    depths = (1 / torch.tensor(angles).cos())[:, None, None].expand(3, 4, 4).clone()
    point, eye = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3)
    return point, eye, 1.0, pictures, depths, torch.full((3, 4), 4), poses, lenses


def test_weights_of_one_point():
    """Buehler's equation: two photographs of three, the third's penalty the threshold."""
    angles = [0.1, 0.2, 0.4]
    found, seen = kernels.blend_views(*three_photographs(angles), 2, 0.0, 0.0, 1.0, 0.01)
    penalty = [2 * math.sin(a / 2) for a in angles]
    weights = torch.tensor([(1 - p / penalty[2]) / p for p in penalty[:2]])
    torch.testing.assert_close(found[0, :2], weights / weights.sum(), atol=1e-4, rtol=0)
    assert float(found[0, 2]) == 0 and float(seen) == 1


def test_hidden_photographs_do_not_count():
    """The nearest photograph sees another surface before the point, so the next one gives the colour."""
    given = list(three_photographs([0.1, 0.2, 0.4]))
    given[4][0] = 0.5
    found, _ = kernels.blend_views(*given, 1, 0.0, 1e4, 0.01, 0.01)
    torch.testing.assert_close(found, torch.tensor([[0.0, 1.0, 0.0]]))


def test_surfaces_are_where_the_ball_is(photographed):
    camera = tiny.scene().cameras[4]
    shown, truth = photographed.render(camera).depth, tiny.ball(camera.pose[0])[0]
    both = truth.isfinite() & shown.isfinite()
    assert float((shown - truth)[both].abs().median()) < 0.02
    assert len(photographed.views.tables.grids) <= 4  # of the photographs near it alone


def test_the_nearest_supported_surface_is_seen():
    distance = torch.tensor([2.0, 2.01, 1.0, 5.0])[:, None, None]
    seen = consensus(distance, torch.tensor([1.0, 1.0, 0.1, 1.0])[:, None, None])
    assert float(seen) == pytest.approx(2.005)  # 1.0 has too little support, 5.0 is behind


def test_filled_depth_continues_a_plane():
    """A plane, on which 1 / z is linear, is its own harmonic continuation."""
    lens = Pinhole(torch.full((1, 2), 30.0), torch.full((1, 2), 16.0))
    camera = Camera(torch.eye(3, 4)[None], lens, torch.tensor([[32, 32]]))
    x, y = camera.pixels().view(32, 32, 2).unbind(-1)
    inverse = 0.5 + 0.004 * x + 0.002 * y
    depth = 1 / inverse * (camera.rays(camera.pixels()).directions[:, 2].view(32, 32) ** -1)
    known = depth.clone()
    known[10:20, 8:22] = torch.nan
    photograph = replace(tiny.scene().photograph(0), camera=camera, rgb=torch.full((32, 32, 3), 0.5), alpha=None)
    found = completed(known, photograph, depth_camera(camera, 32), 0.5)
    assert float((found.distance / depth - 1).abs().max()) < 0.01
    assert found.confidence[15, 15] < found.confidence[2, 2] == 1


def test_soft_splatting_shows_the_nearer_point():
    places = torch.tensor([[1.5, 1.5], [1.5, 1.5], [2.75, 2.5]])
    values = torch.tensor([[1.0], [0.0], [0.5]])
    found, cover = soft_splat(places, values, torch.tensor([0.0, -8.0, -300.0]), (4, 4), 1.0)
    assert float(found[1, 1, 0]) == pytest.approx(1 / (1 + math.exp(-8)), abs=1e-4)
    assert cover[2].tolist() == pytest.approx([0, 0, 0.75, 0.25]) and float(found[2, 3, 0]) == pytest.approx(0.5)


def test_holes_take_the_background():
    values = torch.cat([torch.full((8, 3), 1.0), torch.zeros(8, 2), torch.full((8, 3), 4.0)], 1)
    filled = behind(values[..., None], values, values > 0)[..., 0]
    torch.testing.assert_close(filled[:, 3:], torch.full((8, 5), 4.0))
    assert torch.equal(filled[:, :3], values[:, :3])


def test_a_sheared_camera_keeps_its_focal_plane():
    camera = tiny.scene().cameras[0]
    aside = camera.sheared(0.3, -0.2, 2.5)
    pixels = camera.pixels()
    rays = camera.rays(pixels)
    plane = rays.at(2.5 / (rays.directions @ camera.forward[0]))
    torch.testing.assert_close(aside.project(plane)[0], pixels, atol=1e-3, rtol=0)


def test_focus_and_aperture(photographed):
    camera = tiny.scene().cameras[4]
    sharp = photographed.render(camera).rgb
    near = photographed.given(focus=2.4, aperture=0.3).render(camera).rgb
    far = photographed.given(focus=6.0, aperture=0.3).render(camera).rgb
    middle = (slice(9, 15), slice(9, 15))
    assert float((near - sharp)[middle].abs().mean()) < float((far - sharp)[middle].abs().mean())


@pytest.mark.parametrize("by", ["depth", "flow"])
def test_views_are_interpolated(by):
    scene = tiny.scene()
    method = ViewInterpolation(scene.frame, replace(ViewInterpolation.smallest(), by=by)).eval()
    method.begin(scene)
    i = int(scene.splits["train"][2])
    truth = scene.photograph(i).before(scene.frame.background)
    assert float(psnr(method.render(scene.cameras[i]).rgb, truth)) > (30 if by == "depth" else 24)


def test_a_light_field_opens_as_a_scene(photographed, tmp_path):
    """Written with its cameras, and named as in the Stanford archive, by which it opens without them too."""
    camera, frame = tiny.scene().cameras[4], tiny.scene().frame
    write_light_field(tmp_path / "grid", photographed, camera, 3, 0.1, 3.0, frame)
    scene = open_scene(tmp_path / "grid")
    grid = grid_of(camera, 3, 3, 0.1, 3.0)
    positions = scene.frame.to_source.points(scene.cameras.position.double())
    expected = torch.cat([one.position for row in grid for one in row]).double()
    torch.testing.assert_close(positions, expected, atol=1e-4, rtol=0)
    (tmp_path / "grid" / "transforms.json").unlink()
    again = open_scene(tmp_path / "grid")
    apart = again.frame.to_source.points(again.cameras.position.double())
    names = {name: apart[i] for i, name in enumerate(again.names)}
    steps = [names[f"out_0{a}_0{b}_{0.1 * (a - 1):.6f}_{0.1 * (b - 1):.6f}"] for a, b in ((0, 0), (0, 2), (2, 0))]
    assert (steps[1] - steps[0]).norm() == pytest.approx(0.2) and (steps[2] - steps[0]).norm() == pytest.approx(0.2)
    sheet = quilt(photographed, camera, 2, 2, 0.1, 3.0)
    assert sheet.size == (2 * tiny.SIZE, 2 * tiny.SIZE)


@pytest.mark.parametrize("fault", ["plain walls", "one place"])
def test_photographs_without_depth_are_named(fault):
    """A warning, and a plane instead: pictures are shown all the same."""
    scene = tiny.scene()
    if fault == "plain walls":
        white = [np.full((tiny.SIZE, tiny.SIZE, 3), 200, np.uint8) for _ in scene.names]
        scene = replace(scene, images=ImageStore.from_arrays(white), frame=replace(scene.frame, has_alpha=False))
    else:
        cameras = scene.cameras[torch.zeros(len(scene.names), dtype=torch.int64)]
        scene = replace(scene, cameras=replace(cameras, image_index=torch.arange(len(cameras))))
    method = Lumigraph(scene.frame, replace(Lumigraph.smallest(), geometry="stereo")).eval()
    with pytest.warns(LumigraphWarning, match=r"no depth in .*; a plane stands for the scene"):
        method.begin(scene)
    assert method.render(scene.cameras[0]).rgb.isfinite().all()


def test_a_single_photograph_needs_a_plane():
    scene = with_fewer_views(tiny.scene(), 1)
    with pytest.raises(LumigraphError, match="stereo needs two"):
        Lumigraph(scene.frame, replace(Lumigraph.smallest(), geometry="stereo")).begin(scene)


def test_silhouettes_give_depth():
    """The visual hull of the ball, which needs no matching, holds the ball, and little else at its middle."""
    scene = tiny.scene()
    method = Lumigraph(scene.frame, replace(Lumigraph.smallest(), geometry="hull")).eval()
    method.begin(scene)
    shown, truth = method.render(scene.cameras[4]).depth, tiny.ball(scene.cameras[4].pose[0])[0]
    both = truth.isfinite() & shown.isfinite()
    assert float(((shown - truth)[both] < 0.05).float().mean()) > 0.95
    assert both[truth.isfinite()].float().mean() > 0.95 and float((shown - truth)[12, 12].abs()) < 0.4
    with pytest.raises(LumigraphError, match="no visual hull"):
        bare = replace(scene, frame=replace(scene.frame, has_alpha=False))
        Lumigraph(bare.frame, replace(Lumigraph.smallest(), geometry="hull")).begin(bare)
