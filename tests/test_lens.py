"""Every lens: its pixels and directions invert one another, and its conventions are the ones written down."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pycolmap
import pytest
import torch

from lumigraph.camera import Camera
from lumigraph.camera.lens import (
    Division,
    EnhancedUnified,
    Equirectangular,
    FieldOfView,
    Fisheye,
    Lens,
    Mixed,
    OmnidirectionalStereo,
    OpenCV,
    Pinhole,
    RadialThinPrism,
    ThinPrism,
    stretch,
)
from lumigraph.readers.colmap import read_lens

CAMERAS, RAYS = 64, 4096
FOX = [0.0578421, -0.0805099, -0.000980296, 0.00015575, 0.0, 0.0, 0.0, 0.0]  # a telephone's, OpenCV's order


def uniform(generator, low, high, *shape):
    return low + (high - low) * torch.rand(*shape, generator=generator)


def random_lens(kind: str, generator: torch.Generator) -> tuple[Lens, torch.Tensor]:
    """A batch of lenses of one kind, and the sizes of their pictures."""
    size = uniform(generator, 300, 2000, CAMERAS, 2).round()
    centre = size / 2 + uniform(generator, -20, 20, CAMERAS, 2)
    long_focal = size.amax(-1, keepdim=True) * uniform(generator, 0.5, 2, CAMERAS, 1)
    focal = long_focal * uniform(generator, 0.97, 1.03, CAMERAS, 2)
    if kind == "pinhole":
        return Pinhole(focal, centre), size
    if kind == "fox":
        return OpenCV(focal.clamp_min(0.7 * size.amax(-1, keepdim=True)), centre, torch.tensor([FOX] * CAMERAS)), size
    if kind == "opencv":
        spread = torch.tensor([0.05, 0.02, 2e-3, 2e-3, 0.005, 0.02, 0.01, 0.002])
        return OpenCV(focal, centre, spread * uniform(generator, -1, 1, CAMERAS, 8)), size
    if kind == "fisheye":
        spread = torch.tensor([0.05, 0.01, 0.004, 0.001])
        return Fisheye(focal, centre, spread * uniform(generator, -1, 1, CAMERAS, 4)), size
    if kind == "wide fisheye":  # the picture's corners lie 110 degrees off the axis
        coefficients = uniform(generator, -1, 1, CAMERAS, 4) * torch.tensor([0.02, 0.002, 5e-4, 5e-5])
        corner = (size.norm(dim=-1) / 2 + 40) / stretch(torch.tensor(math.radians(110)), coefficients.unbind(-1))[0]
        return Fisheye(corner[:, None].repeat(1, 2), centre, coefficients), size
    if kind == "thin prism":
        spread = torch.tensor([0.05, 0.01, 0.004, 0.001, 5e-3, 5e-3, 5e-3, 5e-3])
        return ThinPrism(focal, centre, spread * uniform(generator, -1, 1, CAMERAS, 8)), size
    if kind == "radial thin prism":
        spread = torch.tensor([0.05, 0.01, 0.004, 0.001, 2e-4, 1e-5, 5e-3, 5e-3, 5e-3, 1e-3, 5e-3, 1e-3])
        return RadialThinPrism(focal, centre, spread * uniform(generator, -1, 1, CAMERAS, 12)), size
    if kind == "field of view":
        return FieldOfView(focal, centre, uniform(generator, 0, 1.2, CAMERAS, 1)), size
    if kind == "enhanced unified":
        alpha, beta = uniform(generator, 0, 1, CAMERAS, 1), uniform(generator, 0.5, 2, CAMERAS, 1)
        return EnhancedUnified(focal, centre, alpha, beta), size
    if kind == "division":
        return Division(focal, centre, uniform(generator, -0.3, 0.2, CAMERAS, 1)), size
    if kind == "equirectangular":
        return Equirectangular(size), size
    if kind == "part of a sphere":
        return Equirectangular(size * 1.5, size * uniform(generator, 0.3, 0.7, CAMERAS, 2)), size
    assert kind == "stereo"
    return OmnidirectionalStereo(size, offset=uniform(generator, -0.04, 0.04, CAMERAS, 1)), size


SPHERES = ["equirectangular", "part of a sphere", "stereo"]
KINDS = [
    "pinhole",
    "opencv",
    "fox",
    "fisheye",
    "wide fisheye",
    "thin prism",
    "radial thin prism",
    "field of view",
    "division",
    "enhanced unified",
    *SPHERES,
]


def random_pixels(size, generator):
    """Pixel centres, and the camera of each."""
    index = torch.randint(len(size), (RAYS,), generator=generator)
    return (uniform(generator, 0, 1, RAYS, 2) * size[index]).floor() + 0.5, index


@pytest.mark.parametrize("kind", KINDS)
def test_project_inverts_unproject(kind, generator):
    lens, size = random_lens(kind, generator)
    pixels, index = random_pixels(size, generator)
    directions = lens.unproject(pixels, index)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(RAYS), rtol=0, atol=1e-6)
    points = directions * uniform(generator, 0.1, 100, RAYS, 1)
    begin = lens.origins(pixels, index)
    found, valid = lens.project(points if begin is None else points + begin, index)
    assert valid.all() and (begin is None) == (kind != "stereo")
    off = found - pixels
    if kind in SPHERES:  # columns meet at the poles: count pixels of the equator
        off[:, 0] *= directions[:, [0, 2]].norm(dim=-1)
    assert off.abs().max() < 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_one_camera_needs_no_index(kind, generator):
    lens, size = random_lens(kind, generator)
    pixels, _ = random_pixels(size[:1], generator)
    index = torch.zeros(RAYS, dtype=torch.int64)
    assert torch.equal(lens.unproject(pixels), lens.unproject(pixels, index))
    for short, long in zip(
        lens.project(lens.unproject(pixels)), lens.project(lens.unproject(pixels), index), strict=True
    ):
        assert torch.equal(short, long)
    assert lens.origins(pixels) is None or torch.equal(lens.origins(pixels), lens.origins(pixels, index))


@pytest.mark.parametrize("kind", KINDS)
def test_solid_angle_is_what_neighbouring_pixels_span(kind, generator):
    lens, size = random_lens(kind, generator)
    lens, size = lens._map(torch.Tensor.double), size.double()
    pixels, index = random_pixels(size, generator)
    pixels = pixels.double()
    directions = lens.unproject(pixels, index)
    analytic = lens.solid_angle(pixels, directions, index)
    measured = Lens.solid_angle(lens, pixels, directions, index)  # the definition, by differences
    away_from_poles = directions[:, [0, 2]].norm(dim=-1) > 0.2
    torch.testing.assert_close(analytic[away_from_poles], measured[away_from_poles], rtol=2e-3, atol=0)
    assert (analytic > 0).all()


def test_a_sphere_of_pixels_covers_the_sphere():
    lens = Equirectangular(torch.tensor([[64.0, 32.0]]))
    y, x = torch.meshgrid(torch.arange(32) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 2)
    total = lens.solid_angle(pixels, lens.unproject(pixels)).sum().item()
    assert total == pytest.approx(4 * math.pi, rel=1e-3)


def test_pinhole_by_hand():
    lens = Pinhole(torch.tensor([[100.0, 200.0]]), torch.tensor([[50.0, 40.0]]))
    pixels, valid = lens.project(torch.tensor([[0.0, 0.0, 2.0], [1.0, 1.0, 2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]]))
    assert pixels[:2].tolist() == [[50, 40], [100, 140]]
    assert valid.tolist() == [True, True, False, False]
    assert pixels.isfinite().all()


def test_opencv_by_hand():
    """One point through OpenCV's published formula, term by term."""
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion = [0.1, -0.05, 0.01, -0.02, 0.03, 0.02, 0.01, -0.01]
    lens = OpenCV(torch.tensor([[300.0, 310.0]]), torch.tensor([[160.0, 120.0]]), torch.tensor([distortion]))
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = 300 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 160
    v = 310 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 120
    pixels, valid = lens.project(torch.tensor([[2 * x, 2 * y, 2.0]]))
    torch.testing.assert_close(pixels, torch.tensor([[u, v]]))
    assert valid.all()


@pytest.mark.parametrize(
    ("kind", "model"), [("opencv", "FULL_OPENCV"), ("fox", "FULL_OPENCV"), ("fisheye", "OPENCV_FISHEYE")]
)
def test_colmap_means_the_same(kind, model, generator):
    """The same parameters in COLMAP's own code put points on the same pixels."""
    lens, size = random_lens(kind, generator)
    points = torch.randn(50, 3, generator=generator) * torch.tensor([0.3, 0.3, 0.2]) + torch.tensor([0.0, 0.0, 2.0])
    for i in range(8):
        width, height = size[i].int().tolist()
        parameters = torch.cat([lens.focal[i], lens.centre[i], lens.distortion[i]]).double().numpy()
        theirs = pycolmap.Camera(model=model, width=width, height=height, params=parameters)
        expected = torch.from_numpy(theirs.img_from_cam(points.double().numpy()))
        torch.testing.assert_close(lens[i].project(points)[0].double(), expected, atol=2e-3, rtol=0)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("THIN_PRISM_FISHEYE", [310, 300, 322, 241, 0.05, -0.02, 0.003, -0.002, 0.01, 0.001, 0.004, -0.003]),
        (
            "RAD_TAN_THIN_PRISM_FISHEYE",
            [310, 300, 322, 241, -0.026, 0.095, -0.064, 9e-3, 3e-3, -6e-4, 1e-3, -2e-3, -3e-3, 1e-3, 2e-3, -1e-3],
        ),
        ("EUCM", [310, 300, 322, 241, 0.6, 1.1]),
        ("EUCM", [310, 300, 322, 241, 0.3, 0.8]),
        ("EUCM", [310, 300, 322, 241, 0.0, 1.0]),
        ("FOV", [310, 300, 322, 241, 0.9]),
        ("FOV", [310, 300, 322, 241, 0.0]),
        ("DIVISION", [310, 300, 322, 241, -0.2]),
        ("DIVISION", [310, 300, 322, 241, 0.1]),
        ("SIMPLE_DIVISION", [300, 322, 241, -0.3]),
    ],
)
def test_rare_lenses_of_colmap(model, parameters, generator):
    """Read from COLMAP's cameras, they put points on the same pixels, and pixels on the same rays."""
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=parameters)
    lens = read_lens(theirs, Path())
    points = torch.randn(500, 3, generator=generator) * torch.tensor([0.7, 0.6, 0.1]) + torch.tensor([0.0, 0.0, 1.0])
    found, valid = lens.project(points)
    expected = torch.from_numpy(theirs.img_from_cam(points.double().numpy()))
    inside = ((expected > 0) & (expected < torch.tensor([640, 480]))).all(1)
    assert valid[inside].all() and inside.sum() > 100
    torch.testing.assert_close(found[inside].double(), expected[inside], atol=1e-3, rtol=0)
    rays = lens.unproject(expected[inside].float())
    back = torch.from_numpy(theirs.cam_from_img(expected[inside].numpy()))
    torch.testing.assert_close((rays[:, :2] / rays[:, 2:]).double(), back, atol=2e-5, rtol=2e-5)


def test_undistorted_opencv_is_a_pinhole(generator):
    lens, size = random_lens("pinhole", generator)
    pixels, index = random_pixels(size, generator)
    same = OpenCV(lens.focal, lens.centre, torch.zeros(CAMERAS, 8))
    torch.testing.assert_close(same.unproject(pixels, index), lens.unproject(pixels, index))


def test_fisheye_sets_the_angle_by_the_distance():
    lens = Fisheye(torch.tensor([[100.0, 100.0]]), torch.tensor([[0.0, 0.0]]), torch.zeros(1, 4))
    angles = torch.tensor([0.0, 0.5, math.pi / 2, 2.5])
    directions = lens.unproject(torch.stack([100 * angles, torch.zeros(4)], -1))
    torch.testing.assert_close(directions, torch.stack([angles.sin(), torch.zeros(4), angles.cos()], -1))
    _, valid = lens.project(directions)
    assert valid.all()  # also behind the camera's plane


def test_equirectangular_conventions():
    lens = Equirectangular(torch.tensor([[400.0, 200.0]]))
    pixels = torch.tensor([[200.0, 100.0], [300.0, 100.0], [100.0, 100.0], [200.0, 0.0], [200.0, 200.0]])
    ahead, right, left, up, down = [0, 0, 1.0], [1.0, 0, 0], [-1.0, 0, 0], [0, -1.0, 0], [0, 1.0, 0]
    expected = torch.tensor([ahead, right, left, up, down])
    torch.testing.assert_close(lens.unproject(pixels), expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(lens.project(expected)[0], pixels, atol=1e-3, rtol=0)


def eyes(half: float = 0.032, width: float = 4000.0) -> tuple[OmnidirectionalStereo, OmnidirectionalStereo]:
    size = torch.tensor([[width, width / 2]])
    return tuple(OmnidirectionalStereo(size, offset=torch.tensor([[side * half]])) for side in (-1, 1))


def test_stereo_rays_are_tangents_of_the_viewing_circle(generator):
    left, right = eyes()
    pixels = uniform(generator, 0, 1, 500, 2) * torch.tensor([4000.0, 2000.0])
    directions = left.unproject(pixels)
    assert torch.equal(directions, right.unproject(pixels))
    apart = right.origins(pixels) - left.origins(pixels)
    torch.testing.assert_close(apart.norm(dim=-1), torch.full((500,), 0.064))
    assert (apart * directions).sum(-1).abs().max() < 1e-6 and (apart[:, 1] == 0).all()  # level, across the gaze
    ahead = torch.tensor([[2000.0, 1000.0], [3000.0, 1000.0]])  # forwards, to the right
    torch.testing.assert_close(right.origins(ahead), torch.tensor([[0.032, 0, 0], [0, 0, -0.032]]), atol=1e-6, rtol=0)


def test_stereo_disparity_is_the_known_formula(generator):
    """sin(theta) = r / R to either side, the same row: Peleg 2001, section 3."""
    left, right = eyes()
    longitude, distance = uniform(generator, -3, 3, 200), uniform(generator, 0.1, 50, 200)
    height = uniform(generator, -3, 3, 200)
    points = torch.stack([distance * longitude.sin(), height, distance * longitude.cos()], -1)
    (in_left, seen), (in_right, _) = left.project(points), right.project(points)
    apart = in_left - in_right
    expected = 2 * torch.asin(0.032 / distance) * 4000 / (2 * math.pi)
    off = torch.remainder(apart[:, 0] - expected + 2000, 4000) - 2000
    assert seen.all() and off.abs().max() < 0.01 and apart[:, 1].abs().max() < 1e-3
    _, seen = left.project(torch.tensor([[0.01, 0.5, 0.02], [0.0, 0.0, 0.0]]))  # within the circle
    assert not seen.any()


def test_stereo_follows_its_world(generator):
    """In a world three times as large the same camera, its eyes further apart, sees the same pixels."""
    matrix = torch.diag(torch.tensor([3.0, 3.0, 3.0, 1.0]))
    lens = Lens.cat([eyes()[0], Pinhole(torch.ones(1, 2), torch.zeros(1, 2))])
    camera = Camera(torch.eye(3, 4).expand(2, 3, 4), lens, torch.tensor([[4000, 2000], [1, 1]]))
    points = torch.randn(100, 3, generator=generator)
    torch.testing.assert_close(camera.transformed(matrix).project(3 * points)[0], camera.project(points)[0])
    index = torch.tensor([0, 1, 0])
    begin = camera.rays(torch.tensor([[2000.0, 1000.0]] * 3), index).origins
    torch.testing.assert_close(begin, torch.tensor([[-0.032, 0, 0], [0, 0, 0], [-0.032, 0, 0]]), atol=1e-7, rtol=0)


@pytest.mark.parametrize("k1", [-0.1, -0.3, -0.6])
def test_a_distortion_that_folds_over(k1):
    """With r (1 + k1 r^2), points beyond r = 1 / sqrt(-3 k1) come back towards the centre: not seen, not looked for."""
    lens = OpenCV(torch.ones(1, 2), torch.zeros(1, 2), torch.tensor([[k1, 0, 0, 0, 0, 0, 0, 0]]))
    fold = (-3 * k1) ** -0.5
    assert lens.fold.item() == pytest.approx(fold, rel=0.01)
    radius = torch.tensor([0.5, 0.9, 0.97, 1.03, 1.2, 1.7]) * fold
    pixels, valid = lens.project(torch.stack([radius, torch.zeros(6), torch.ones(6)], -1))
    assert valid.tolist() == [True, True, True, False, False, False]
    near, seen = lens.project(lens.unproject(pixels[valid]))
    assert seen.all() and (near - pixels[valid]).abs().max() < 1e-5
    # a pixel further out than anything lands: the outermost direction, finite
    outer = lens.unproject(torch.tensor([[3.0, 0.0], [0.0, -50.0]]))
    torch.testing.assert_close(outer[:, :2].norm(dim=-1) / outer[:, 2], lens.fold[0].expand(2))
    assert outer[0, 0] > 0 and outer[1, 1] < 0


def test_fisheye_fold_over():
    lens = Fisheye(torch.ones(1, 2), torch.zeros(1, 2), torch.tensor([[-0.2, 0, 0, 0]]))
    fold = (3 * 0.2) ** -0.5
    assert lens.fold.item() == pytest.approx(fold, abs=0.01)
    angles = torch.tensor([0.5, 0.95, 1.05, 1.5]) * fold
    _, valid = lens.project(torch.stack([angles.sin(), torch.zeros(4), angles.cos()], -1))
    assert valid.tolist() == [True, True, False, False]
    assert lens.unproject(torch.tensor([[5.0, 5.0]])).isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_resized_lenses_see_the_same_directions(kind, generator):
    lens, size = random_lens(kind, generator)
    pixels, index = random_pixels(size, generator)
    scale = uniform(generator, 0.2, 2, CAMERAS, 2)
    small = lens.resized(scale)
    torch.testing.assert_close(
        small.unproject(pixels * scale[index], index), lens.unproject(pixels, index), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("kind", KINDS)
def test_json_keeps_every_bit(kind, generator):
    lens, size = random_lens(kind, generator)
    pixels, index = random_pixels(size, generator)
    again = Lens.from_json(json.loads(json.dumps(lens.to_json())))
    assert type(again) is type(lens)
    assert torch.equal(again.unproject(pixels, index), lens.unproject(pixels, index))
    if kind == "stereo":
        assert torch.equal(again.origins(pixels, index), lens.origins(pixels, index))


def test_no_rays_at_all(generator):
    for kind in KINDS:
        lens, _ = random_lens(kind, generator)
        nothing = torch.zeros(0, dtype=torch.int64)
        assert lens.unproject(torch.zeros(0, 2), nothing).shape == (0, 3)
        assert lens.project(torch.zeros(0, 3), nothing)[0].shape == (0, 2)


def test_lenses_of_several_kinds_in_one_batch(generator):
    lenses = [random_lens(kind, generator)[0][:3] for kind in ["pinhole", "wide fisheye", "opencv"]]
    singles = [lenses[k][i] for i in range(3) for k in range(3)]  # interleaved
    mixed = Lens.cat(singles)
    assert isinstance(mixed, Mixed) and len(mixed) == 9
    pixels = uniform(generator, 0, 300, 900, 2)
    index = torch.randint(9, (900,), generator=generator)
    for batch in (mixed, Lens.from_json(json.loads(json.dumps(mixed.to_json())))):
        directions = batch.unproject(pixels, index)
        found, valid = batch.project(directions, index)
        angles = batch.solid_angle(pixels, directions, index)
        assert valid.all() and (found - pixels).abs().max() < 1e-3
        for i, one in enumerate(singles):
            mine = index == i
            torch.testing.assert_close(directions[mine], one.unproject(pixels[mine]))
            torch.testing.assert_close(angles[mine], one.solid_angle(pixels[mine], directions[mine]))
    assert isinstance(mixed[1], Fisheye) and isinstance(mixed[torch.tensor([0, 3, 6])], Pinhole)
    some = torch.tensor([8, 1, 1, 0])
    where = torch.tensor([0, 1, 2, 3]).repeat_interleave(10)
    torch.testing.assert_close(mixed[some].unproject(pixels[:40], where), mixed.unproject(pixels[:40], some[where]))
    scale = torch.linspace(0.5, 2, 18).reshape(9, 2)
    torch.testing.assert_close(
        mixed.resized(scale).unproject(pixels * scale[index], index), mixed.unproject(pixels, index)
    )


def test_shapes_at_the_door_are_executed():
    """The annotations are more than words: a wrong shape is caught where it enters."""
    with pytest.raises(Exception, match="focal"):
        Pinhole(torch.ones(4, 3), torch.ones(4, 2))
    with pytest.raises(Exception, match="centre"):
        Pinhole(torch.ones(4, 2), torch.ones(5, 2))


@pytest.mark.parametrize("kind", ["opencv", "fox"])
def test_the_quick_loop_agrees_with_the_tensors(kind, generator):
    lens, size = random_lens(kind, generator)
    pixels, index = random_pixels(size, generator)
    exact = OpenCV(*(x.double() for x in (lens.focal, lens.centre, lens.distortion)))
    for which, seen in ((index, pixels), (None, pixels % size[0])):
        directions, truth = lens.unproject(seen, which), exact.unproject(seen.double(), which)
        assert lens._by_loop(seen) and not exact._by_loop(seen.double())
        torch.testing.assert_close(directions.double(), truth, rtol=0, atol=1e-6)
        angle = lens.solid_angle(seen, directions, which)
        torch.testing.assert_close(angle.double(), exact.solid_angle(seen.double(), truth, which), rtol=1e-4, atol=0)
