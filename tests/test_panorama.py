"""Panoramas and omnidirectional stereo: compared with what is known exactly, from methods of both kinds."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from budgets import budget
from PIL import Image

from lumigraph.camera import Camera
from lumigraph.camera.lens import Equirectangular, OmnidirectionalStereo, Pinhole
from lumigraph.camera.rays import Rendering
from lumigraph.commands.cli import main
from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError
from lumigraph.exchange import write_gaussians
from lumigraph.export import panorama as panoramas
from lumigraph.export.panorama import (
    columns_at_once,
    level_camera,
    panorama,
    save_sphere,
    sphere,
    standpoint,
    stereo_pair,
    surrounding_distances,
    top_bottom,
)
from lumigraph.files.ranges import changed
from lumigraph.gaussians import Gaussians
from lumigraph.geometry import look_at
from lumigraph.method import RayMethod
from lumigraph.methods import find
from lumigraph.metrics import psnr

pytestmark = budget("exports", 8)

NORTH = torch.tensor([0.0, 1.0, 0.0])
HERE = torch.tensor([0.1, -0.2, 0.05])


class Known(RayMethod):
    """A field that needs no learning. `flat` makes it one that sees flat pictures only."""

    def __init__(self, flat: bool = False):
        super().__init__(Frame(), None)
        self.none = torch.nn.Parameter(torch.zeros(0))
        self.any_lens = not flat
        self.cameras: list[Camera] = []

    def render(self, camera):
        self.cameras.append(camera)
        assert self.any_lens or type(camera.lens) is Pinhole
        return super().render(camera)

    def batch(self, scene, generator): ...
    def loss(self, batch, step): ...
    def optimizers(self): ...


class Hall(Known):
    """Inside a box of half-sizes 1.2, 1.5, 0.9: the colour is a smooth pattern of the place where a ray meets it."""

    half = torch.tensor([1.2, 1.5, 0.9])

    def render_rays(self, rays, background):
        # Distance to each pair of walls, the near ones first.
        directions = torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
        t = ((directions.sign() * self.half - rays.origins) / directions).amin(-1)
        rgb = 0.5 + 0.4 * torch.sin(3 * rays.at(t) + torch.tensor([0.0, 1.0, 2.0]))
        return Rendering(rgb, t, torch.ones_like(t))


class Directions(Known):
    """The colour is the direction; nothing is near."""

    def render_rays(self, rays, background):
        nothing = torch.zeros(len(rays))
        return Rendering(0.5 + 0.5 * rays.directions, nothing + torch.inf, nothing)


def dots() -> torch.Tensor:
    """Ten places around `HERE`, from near to far, low to high, in all directions."""
    k = torch.arange(10)
    azimuth, height = 0.3 + 0.2 * math.pi * k, torch.tensor([0.0, 0.5, -0.4, 0.1, -0.7, 0.3, 0.0, 0.7, -0.2, 0.4])
    distance = 0.8 + 0.05 * ((3 * k) % 10)  # from the vertical axis
    return HERE + torch.stack([distance * azimuth.cos(), distance * azimuth.sin(), height], -1)


class Dots(Known):
    """Small white balls in the dark, their edges as soft as pixels."""

    def render_rays(self, rays, background):
        towards = dots()[:, None] - rays.origins
        t = (towards * rays.directions).sum(-1)
        away = (towards - t[..., None] * rays.directions).norm(dim=-1)
        covered = ((0.02 - away) / (2 * rays.radius * t) + 0.5).clamp(0, 1) * (t > 0)
        opacity, which = covered.max(0)
        depth = torch.where(opacity > 0, t.gather(0, which[None])[0], torch.inf)
        return Rendering(opacity[:, None].expand(-1, 3), depth, opacity)


def cloud() -> Gaussians:
    """The same dots as Gaussians."""
    means = dots()
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).expand(10, 4),
        torch.full((10, 3), math.log(0.01)),
        torch.full((10,), 6.0),
        torch.full((10, 1, 3), 0.5 / 0.28209479),
    )


def splatted():
    kind = find("gaussian-splatting")
    method = kind(Frame(near=0.05), changed(kind.Config(), sh_degree=0))
    method.cloud.replace(cloud())
    return method.eval()


@pytest.fixture
def one_thread():
    """For hundreds of tiny pictures: with company on the machine, handing each out to threads takes longer than it."""
    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    yield
    torch.set_num_threads(before[0])
    numba.set_num_threads(before[1])


def test_the_sphere_lies_as_it_should():
    """North in the middle, east to the right of it, up on top."""
    seen = panorama(Directions(), HERE, NORTH, 256)
    assert seen.rgb.shape == (128, 256, 3)
    places = {(64, 128): (0, 1, 0), (64, 192): (1, 0, 0), (64, 64): (-1, 0, 0), (0, 9): (0, 0, 1), (127, 9): (0, 0, -1)}
    for (row, column), direction in places.items():
        torch.testing.assert_close(2 * seen.rgb[row, column] - 1, torch.tensor(direction).float(), atol=0.03, rtol=0)
    south = 2 * seen.rgb[64, [0, 255]] - 1
    assert (south[:, 1] < -0.99).all() and south[0, 0] < 0 < south[1, 0]


def test_bands_of_rows_make_the_same_picture(monkeypatch):
    method = Hall()
    whole = panorama(method, HERE, NORTH, 64)
    monkeypatch.setattr(panoramas, "PIXELS_PER_CHUNK", 64 * 5)
    bands = panorama(method, HERE, NORTH, 64)
    assert len(method.cameras) == 1 + 7
    torch.testing.assert_close(bands.rgb, whole.rgb, atol=1e-5, rtol=0)
    torch.testing.assert_close(bands.depth, whole.depth, atol=1e-5, rtol=0)


@pytest.mark.parametrize("width", [256, 90])
def test_flat_pictures_make_the_same_sphere(width, one_thread):
    exact, flat = (panorama(Hall(kind), HERE, NORTH, width) for kind in (False, True))
    assert psnr(flat.rgb, exact.rgb) > (60 if width == 256 else 48)
    assert ((flat.depth / exact.depth - 1).abs()).max() < 0.05 and flat.opacity.min() > 0.9999
    nothing = panorama(Directions(True), HERE, NORTH, 64)
    assert torch.isinf(nothing.depth).all() and (nothing.opacity == 0).all()


def test_flat_pictures_that_disagree_fade_into_each_other(one_thread):
    """As Gaussians do that are drawn in another order from picture to picture."""

    class Moody(Hall):
        def render(self, camera):
            seen = super().render(camera)
            return Rendering(torch.full_like(seen.rgb, len(self.cameras) % 2), seen.depth, seen.opacity)

    seen = panorama(Moody(True), HERE, NORTH, 256).rgb[..., 0]
    steps = torch.cat([seen.diff(dim=0).abs().flatten(), (seen - seen.roll(1, 1)).abs().flatten()])
    assert seen.min() == 0 and seen.max() == 1 and steps.max() < 0.1


def test_flat_pictures_make_the_same_stereo_pair(one_thread):
    r, near = 0.05, 0.8
    for side in (-1, 1):
        lens = OmnidirectionalStereo(torch.tensor([[128.0, 64.0]]), offset=torch.tensor([[side * r]]))
        camera = level_camera(HERE, NORTH, lens)
        exact = sphere(Hall(), camera, "exact")
        flat = sphere(Hall(True), camera, "flat", columns_at_once(r, near))
        plain = panorama(Hall(), HERE, NORTH, 128)
        assert psnr(flat.rgb, exact.rgb) > 45 > 35 > psnr(plain.rgb, exact.rgb)


def level_distances(pair: tuple[Rendering, Rendering], interpupillary: float) -> torch.Tensor:
    """Of the ten dots from the vertical axis between the eyes, measured by nothing but the two pictures."""
    height, width = pair[0].depth.shape
    lens = Equirectangular(torch.tensor([[width, height]]).float())
    middle, _ = level_camera(HERE, NORTH, lens).project(dots())
    found = []
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    for at in middle:
        columns, (left, right) = [], (eye.rgb[..., 0] for eye in pair)
        for light in (left, right):
            across = torch.remainder(x - at[0] + width / 2, width) - width / 2
            weight = light * (across.abs() < width / 24) * ((y - at[1]).abs() < height / 12)
            assert weight.sum() > 3
            columns.append((weight * across).sum() / weight.sum())
        disparity = 2 * math.pi * (columns[0] - columns[1]) / width
        found.append(0.5 * interpupillary / torch.sin(disparity / 2))  # sin theta = r / R, to either side
    return torch.stack(found)


@pytest.mark.parametrize(("make", "width", "apart"), [(Dots, 1024, 0.08), (splatted, 512, 0.1)])
def test_disparity_at_ten_points_tells_their_distance(make, width, apart, one_thread):
    """Within 2 %, whether rays or flat pictures make the pair."""
    pair = stereo_pair(make(), HERE, NORTH, width, apart, 0.8)
    truth = (dots() - HERE)[:, :2].norm(dim=-1)
    off = (level_distances(pair, apart) / truth - 1).abs()
    assert off.max() < 0.02, off
    assert top_bottom(*pair).shape == (width, width, 3)
    assert torch.equal(top_bottom(*pair)[: width // 2], pair[0].rgb)  # the left eye on top
    eyes_exchanged = level_distances((pair[1], pair[0]), apart)
    assert (eyes_exchanged < 0).all()


def test_what_is_around_sets_the_distance_between_the_eyes():
    near, middle = surrounding_distances(Hall(), torch.zeros(3), NORTH)
    assert 0.9 <= near < 1.0 and 1.1 < middle < 1.4
    with pytest.raises(LumigraphError, match="Nothing is around"):
        surrounding_distances(Directions(), HERE, NORTH)


def test_nearer_things_take_more_flat_pictures():
    assert columns_at_once(0.03, 3.0) == 20 > columns_at_once(0.03, 1.0) == 6 > columns_at_once(0.03, 0.1) == 1
    assert columns_at_once(0.0, 1.0) == 32


def ring(inward: bool) -> Camera:
    angle = torch.arange(9) * (2 * math.pi / 9)
    out = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1).double()
    position = torch.cat([2 * out, torch.tensor([[0.3, 0.1, 0.0]]).double()])  # one stands in the middle
    gaze = torch.cat([-out if inward else out, out[:1]])
    pose = look_at(position, gaze, torch.tensor([0.0, 0.0, 1.0]).double()).float()
    return Camera(pose, Pinhole(torch.ones(10, 2), torch.ones(10, 2)), torch.full((10, 2), 2))


def test_where_to_stand():
    scale = torch.diag(torch.tensor([4.0, 4.0, 4.0, 1.0]))
    scale[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    frame = Frame(source_from_scene=tuple(map(tuple, scale.tolist())))
    place, heading, words = standpoint(ring(False), frame)
    torch.testing.assert_close(place, torch.tensor([0.3, 0.1, 0.0]))
    assert words.startswith("2.2 2.4 3,") and "camera in the middle" in words
    place, heading, words = standpoint(ring(True), frame, (1.0, -2.0, 3.0))
    torch.testing.assert_close(place, torch.tensor([0.0, -1.0, 0.0]))
    assert heading[1] > 0.9 and abs(heading[0]) < 0.2  # towards what all look at
    with pytest.raises(LumigraphError, match="not finite"):
        standpoint(ring(True), frame, (math.nan, 0.0, 0.0))


def metadata(image: Image.Image) -> dict[str, str]:
    """What a picture's XMP says in Google's schema."""
    text = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp")
    if text is None:
        return {}
    schema = "{http://ns.google.com/photos/1.0/panorama/}"
    tags = ElementTree.fromstring(text.decode() if isinstance(text, bytes) else text).iter()
    return {tag.tag.removeprefix(schema): tag.text or "" for tag in tags if tag.tag.startswith(schema)}


def test_pictures_say_that_they_are_spheres(tmp_path):
    rgb = torch.rand(32, 64, 3, generator=torch.Generator().manual_seed(0))
    for name in ("a.png", "a.jpg"):
        save_sphere(tmp_path / name, rgb, whole=True)
        with Image.open(tmp_path / name) as image:
            said = metadata(image)
            assert image.size == (64, 32)
        assert said["ProjectionType"] == "equirectangular" and said["UsePanoramaViewer"] == "True"
        assert (said["FullPanoWidthPixels"], said["CroppedAreaImageHeightPixels"]) == ("64", "32")
        save_sphere(tmp_path / name, rgb, whole=False)
        with Image.open(tmp_path / name) as image:
            assert not metadata(image)
    with pytest.raises(LumigraphError, match=r"a\.tif should end in \.png or \.jpg"):
        save_sphere(tmp_path / "a.tif", rgb, whole=True)


def test_the_commands_on_a_run(ball_run, tmp_path, capsys):
    command = ["export", "panorama", str(ball_run.folder), str(tmp_path / "around.jpg"), "--size", "128"]
    assert main(command) == 0
    assert "the camera in the middle of all" in capsys.readouterr().out
    with Image.open(tmp_path / "around.jpg") as image:
        assert image.size == (128, 64) and metadata(image)["FullPanoWidthPixels"] == "128"
        middle = np.asarray(image)[32:52, 56:72].astype(float)
    assert middle.std() > 10  # the ball is ahead
    command = ["export", "stereo", str(ball_run.folder), str(tmp_path / "pair.png"), "--size", "128"]
    assert main([*command, "--from", "1.5", "0", "0", "--interpupillary", "0.1"]) == 0
    said = capsys.readouterr().out
    assert "0.1 apart" in said and "1.5 0 0, as asked" in said
    with Image.open(tmp_path / "pair.png") as image:
        assert image.size == (128, 128)


def test_the_commands_on_a_splat_file(tmp_path, capsys, one_thread):
    write_gaussians(tmp_path / "dots.ply", cloud())
    place = [str(x) for x in HERE.tolist()]
    for what, size in (("panorama", (128, 64)), ("stereo", (128, 128))):
        output = tmp_path / f"{what}.png"
        assert main(["export", what, str(tmp_path / "dots.ply"), str(output), "--size", "128", "--from", *place]) == 0
        with Image.open(output) as image:
            assert image.size == size and np.asarray(image).max() > 60
    assert "apart; half of all is nearer than" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["panorama", "{run}", "{new}.tif"], "should end in"),
        (["panorama", "{run}", "{new}.png", "--size", "101"], "101 pixels wide"),
        (["stereo", "{run}", "{new}.png", "--size", "20"], "--size cannot be 20"),
        (["stereo", "{run}", "{new}.png", "--interpupillary", "0"], "--interpupillary cannot be 0"),
        (["stereo", "{run}", "{new}.png", "--interpupillary", "9"], "do not fit"),
        (["panorama", "{new}", "{new}.png"], "new"),
    ],
)
def test_what_cannot_be_ends_in_one_sentence(arguments, words, ball_run, tmp_path, capsys):
    places = {"run": str(ball_run.folder), "new": str(tmp_path / "new")}
    assert main(["export", *(x.format(**places) for x in arguments)]) == 2
    errors = [x for x in capsys.readouterr().err.splitlines() if not x.startswith("Looking around: ")]
    assert len(errors) == 1 and words in errors[0]
    assert not list(Path(tmp_path).iterdir())


def test_json_of_a_stereo_camera():
    lens = OmnidirectionalStereo(torch.tensor([[64.0, 32.0]]), offset=torch.tensor([[-0.03]]))
    assert json.loads(json.dumps(lens.to_json()))["kind"] == "omnidirectionalstereo"
