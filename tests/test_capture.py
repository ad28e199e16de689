"""Readers agree on one tiny scene written in every layout; faults get one sentence; scenes lie where they should."""

from __future__ import annotations

import json
import math
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from budgets import budget
from captures import (
    FOCAL,
    HEIGHT,
    OPENGL,
    WIDTH,
    WRITERS,
    Tiny,
    look_at,
    write_blender,
    write_colmap,
    write_json,
    write_llff,
    write_nerfstudio,
    write_ngp,
)
from PIL import Image

from lumigraph.camera.lens import Equirectangular, Fisheye, OpenCV, Pinhole
from lumigraph.camera.rays import Rays
from lumigraph.datasets.scene import Scene
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.opening import open_scene
from lumigraph.readers import Capture, Shot, assemble, choose_reader, colmap
from lumigraph.readers.hull import farthest
from lumigraph.readers.normalise import power_of_two
from lumigraph.readers.points import similarity
from lumigraph.readers.up import turn_onto_z

pytestmark = budget("capture", 10)


@pytest.fixture
def tiny():
    return Tiny()


def source_rays(scene: Scene, index: int, pixels: torch.Tensor) -> Rays:
    """Rays in the frame of the source, through pixels of the size that the tiny scene has."""
    camera = scene.cameras.transformed(torch.tensor(scene.frame.source_from_scene))[index]
    scale = camera.size[0] / torch.tensor([WIDTH, HEIGHT])
    return camera.rays(pixels * scale)


def expected_rays(tiny: Tiny, index: int, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    pose = torch.from_numpy(tiny.poses[index])
    plane = (pixels.double() - torch.tensor([WIDTH / 2, HEIGHT / 2])) / FOCAL
    inward = torch.cat([plane, torch.ones(len(plane), 1)], -1)
    directions = inward @ pose[:3, :3].T
    return pose[:3, 3].expand(len(pixels), 3).float(), (directions / directions.norm(dim=-1, keepdim=True)).float()


def number_of(scene: Scene, index: int) -> int:
    return int(Path(scene.names[index]).stem.removeprefix("view_"))


# ------------------------------------------------------------------ readers


@pytest.mark.parametrize("layout", WRITERS)
def test_all_layouts_give_the_same_rays(layout, tiny, tmp_path):
    scene = open_scene(WRITERS[layout](tmp_path, tiny))
    pixels = torch.tensor([[0.5, 0.5], [47.5, 0.5], [20.0, 30.0], [24.0, 18.0]])
    assert len(scene) == len(scene.cameras) == len(scene.images) == scene.frame.image_count == 10
    for i in range(10):
        rays, number = source_rays(scene, i, pixels), number_of(scene, i)
        origins, directions = expected_rays(tiny, number, pixels)
        torch.testing.assert_close(rays.origins, origins, rtol=0, atol=1e-4)
        torch.testing.assert_close(rays.directions, directions, rtol=0, atol=1e-5)
        assert (scene.photograph(i).rgb[..., 2] * 255).round().unique().tolist() == [10 * number]


@pytest.mark.parametrize("layout", ["nerfstudio", "colmap binary", "colmap text"])
def test_points_come_along(layout, tiny, tmp_path):
    scene = open_scene(WRITERS[layout](tmp_path, tiny))
    assert scene.points is not None
    back = torch.tensor(scene.frame.source_from_scene)
    found = (scene.points @ back[:3, :3].T + back[:3, 3]).numpy()
    order, expected = np.lexsort(found.round(3).T), np.lexsort(tiny.points.round(3).T)
    np.testing.assert_allclose(found[order], tiny.points[expected], atol=1e-4)
    assert np.array_equal(scene.point_colours.numpy()[order], tiny.colours[expected])


def test_every_eighth_by_name_is_held_out(tiny, tmp_path):
    scene = open_scene(write_ngp(tmp_path, tiny))
    assert [scene.names[i] for i in scene.splits["test"]] == ["images/view_00.png", "images/view_08.png"]
    assert scene.splits["train"].tolist() == [1, 2, 3, 4, 5, 6, 7, 9]


def test_published_splits_are_kept(tiny, tmp_path):
    scene = open_scene(write_blender(tmp_path / "blender", tiny))
    assert sorted(number_of(scene, i) for i in scene.splits["test"].tolist()) == [0, 1, 2]
    assert sorted(number_of(scene, i) for i in scene.splits["train"].tolist()) == list(range(3, 10))
    lists = {
        "train_filenames": ["images/view_01.png", "images/view_02.png", "images/view_05.png"],
        "test_filenames": ["images/view_04.png"],
        "val_filenames": ["images/view_07.png"],
    }
    scene = open_scene(write_nerfstudio(tmp_path / "nerfstudio", tiny, **lists))
    found = {split: [number_of(scene, i) for i in images.tolist()] for split, images in scene.splits.items()}
    assert found == {"train": [1, 2, 5], "test": [4], "val": [7]}
    del lists["test_filenames"]
    scene = open_scene(write_nerfstudio(tmp_path / "without", tiny, **lists))
    assert [number_of(scene, i) for i in scene.splits["test"].tolist()] == [7]


def test_blender_without_test_views_holds_some_out(tiny, tmp_path):
    (write_blender(tmp_path, tiny) / "transforms_test.json").unlink()
    scene = open_scene(tmp_path)
    assert len(scene) == 7 and scene.splits["test"].tolist() == [0]


def test_a_folder_of_several_layouts_is_read_by_the_most_telling(tiny, tmp_path):
    write_llff(tmp_path, tiny)
    assert choose_reader(tmp_path).__name__.endswith("llff")
    write_colmap(tmp_path, tiny)
    assert choose_reader(tmp_path).__name__.endswith("colmap")
    (tmp_path / "sparse/0/images.bin").unlink()
    assert choose_reader(tmp_path).__name__.endswith("llff")
    write_colmap(tmp_path, tiny)
    write_ngp(tmp_path, tiny)
    assert choose_reader(tmp_path).__name__.endswith("transforms")
    assert choose_reader(tmp_path, "llff").__name__.endswith("llff")


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_colmap_models_are_found_where_programs_leave_them(place, tiny, tmp_path):
    assert len(open_scene(write_colmap(tmp_path, tiny, place=place))) == 10


def test_points_of_a_model_beside_the_poses_are_turned_into_their_frame(tiny, tmp_path):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    other = Tiny()
    other.points = 3 * tiny.points @ turn.T + [5, 6, 7]
    for pose in other.poses:
        pose[:3, :3], pose[:3, 3] = turn @ pose[:3, :3], 3 * turn @ pose[:3, 3] + [5, 6, 7]
    write_colmap(tmp_path, other)
    scene = open_scene(write_ngp(tmp_path, tiny))
    back = torch.tensor(scene.frame.source_from_scene)
    found = (scene.points @ back[:3, :3].T + back[:3, 3]).numpy()
    np.testing.assert_allclose(
        found[np.lexsort(found.round(3).T)], tiny.points[np.lexsort(tiny.points.round(3).T)], atol=1e-3
    )
    for pose in other.poses:  # poses of something else
        pose[:3, 3] = np.random.default_rng(int(1e6 * abs(pose[0, 0]))).normal(size=3)
    write_colmap(tmp_path, other)
    assert open_scene(tmp_path).points is None


def test_missing_files_are_named_once_and_skipped(tiny, tmp_path):
    write_ngp(tmp_path, tiny)
    for number in (3, 7):
        (tmp_path / f"images/view_0{number}.png").unlink()
    with pytest.warns(LumigraphWarning) as caught:
        scene = open_scene(tmp_path)
    (warning,) = [str(w.message) for w in caught]
    assert "2 files" in warning and "view_03.png" in warning and "view_07.png" in warning
    assert scene.warnings == [warning]
    assert [number_of(scene, i) for i in range(len(scene))] == [0, 1, 2, 4, 5, 6, 8, 9]


def test_time_and_fisheye_and_equirectangular_are_read(tiny, tmp_path):
    frames = [{**f, "time": i / 10} for i, f in enumerate(tiny.frames("images/", ".png"))]
    scene = open_scene(write_ngp(tmp_path / "time", tiny, frames=frames))
    torch.testing.assert_close(scene.cameras.time, torch.arange(10) / 10)
    scene = open_scene(write_ngp(tmp_path / "fish", tiny, camera_model="OPENCV_FISHEYE", k1=0.1, k2=0.02))
    assert isinstance(scene.cameras.lens, Fisheye)
    torch.testing.assert_close(scene.cameras.lens.distortion[4], torch.tensor([0.1, 0.02, 0, 0]))
    scene = open_scene(write_ngp(tmp_path / "pano", tiny, camera_model="EQUIRECTANGULAR"))
    assert isinstance(scene.cameras.lens, Equirectangular)
    scene = open_scene(write_ngp(tmp_path / "bent", tiny, k1=0.1, p2=0.01, k4=0.2, k5=0))
    assert isinstance(scene.cameras.lens, OpenCV)
    torch.testing.assert_close(scene.cameras.lens.distortion[0], torch.tensor([0.1, 0, 0, 0.01, 0, 0.2, 0, 0]))


MODELS = {
    "SIMPLE_PINHOLE": [60, 24, 18],
    "PINHOLE": [60, 62, 24, 18],
    "SIMPLE_RADIAL": [60, 24, 18, 0.05],
    "RADIAL": [60, 24, 18, 0.05, -0.02],
    "OPENCV": [60, 62, 24, 18, 0.05, -0.02, 0.003, 0.004],
    "FULL_OPENCV": [60, 62, 24, 18, 0.05, -0.02, 0.003, 0.004, 0.01, 0.02, 0.03, 0.01],
    "SIMPLE_FISHEYE": [60, 24, 18],
    "FISHEYE": [60, 62, 24, 18],
    "SIMPLE_RADIAL_FISHEYE": [60, 24, 18, 0.05],
    "RADIAL_FISHEYE": [60, 24, 18, 0.05, -0.02],
    "OPENCV_FISHEYE": [60, 62, 24, 18, 0.05, -0.02, 0.003, 0.004],
}


def test_colmap_cameras_project_as_colmap_does(tiny, tmp_path):
    known = pycolmap.CameraModelId.__members__
    cameras = [
        pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
        for model, params in MODELS.items()
        if model in known
    ]
    tiny = Tiny(count=len(cameras))
    scene = open_scene(write_colmap(tmp_path, tiny, cameras=cameras))
    inward = np.random.default_rng(0).normal([0, 0, 4], [0.8, 0.6, 0.2], (50, 3))
    for i, camera in enumerate(cameras):
        expected = np.array([camera.img_from_cam(p) for p in inward]).reshape(-1, 2)
        pixels, valid = scene.cameras[i].lens.project(torch.from_numpy(inward).float())
        assert valid.all()
        np.testing.assert_allclose(pixels.numpy(), expected, atol=2e-3)


# ------------------------------------------------------------------ pictures


def one_frame_scene(folder: Path, image: Image.Image, tiny: Tiny, **save) -> Path:
    """The tiny scene with its second picture replaced."""
    write_ngp(folder, tiny)
    image.save(folder / "images/view_01.png", **save)
    return folder


def test_downscale_averages_areas_and_the_lens_follows(tiny, tmp_path):
    scene = open_scene(write_ngp(tmp_path, tiny), downscale=3)
    seen = scene.photograph(4)
    camera, image = seen.camera, seen.rgb
    assert camera.size.tolist() == [[16, 12]]
    torch.testing.assert_close(camera.lens.focal, torch.tensor([[20.0, 20.0]]))
    torch.testing.assert_close(camera.lens.centre, torch.tensor([[8.0, 6.0]]))
    blocks = torch.from_numpy(tiny.pictures[4].reshape(12, 3, 16, 3, 3).mean((1, 3))).float() / 255
    torch.testing.assert_close(image, blocks, rtol=0, atol=0.51 / 255)


def test_odd_sizes_scale_each_axis_by_itself(tiny, tmp_path):
    scene = open_scene(write_ngp(tmp_path, tiny), downscale=5)
    assert scene.cameras.size[0].tolist() == [10, 7]
    torch.testing.assert_close(scene.cameras.lens.focal[0], torch.tensor([60 * 10 / 48, 60 * 7 / 36]))


def test_large_photographs_are_reduced_by_themselves(tmp_path):
    poses = Tiny(count=4).poses
    shots = [
        Shot(str(i), p[:3], Pinhole(torch.tensor([[2000.0, 2000.0]]), torch.tensor([[w / 2, 8.0]])), (w, 16), image)
        for i, (p, w) in enumerate(zip(poses, (2201, 1650, 1321, 1320), strict=True))
        for image in [np.zeros((16, w, 3), np.uint8)]
    ]
    assert assemble(Capture("x", shots)).cameras.size.tolist() == [[1100, 8], [1100, 11], [1100, 13], [1320, 16]]


def test_reduced_folders_are_used_where_they_fit(tiny, tmp_path):
    write_colmap(tmp_path, tiny)
    marked = Tiny()
    for times in (2, 4):
        for picture in marked.pictures:
            picture[..., 0] = times
        marked.write_images(tmp_path / f"images_{times}", times)
    for downscale, red, width in ((1, None, 48), (2, 2, 24), (4, 4, 12), (8, 4, 6), (3, None, 16), (6, 2, 8)):
        seen = open_scene(tmp_path, downscale=downscale).photograph(2)
        image = seen.rgb
        assert seen.camera.size[0, 0] == width
        assert red is None or (image[..., 0] * 255).round().unique().tolist() == [red]
        assert red is not None or len(image[..., 0].unique()) == width


def test_a_neighbouring_capture_is_no_reduced_folder(tiny, tmp_path):
    """room and room_2 are two captures, even where photographs lie beside their model."""
    for name in ("room", "room_2"):
        write_colmap(tmp_path / name, tiny, place=".")
        for picture in (tmp_path / name / "images").iterdir():
            picture.rename(tmp_path / name / picture.name)
        (tmp_path / name / "images").rmdir()
    for picture in (tmp_path / "room_2").glob("*.png"):
        Image.new("RGB", (24, 18), (255, 0, 0)).save(picture)
    scene = open_scene(tmp_path / "room", downscale=2)
    assert (scene.photograph(3).rgb[..., 2] * 255).round().unique().tolist() == [30]


def test_asking_for_more_pixels_than_there_are_is_said(tiny, tmp_path):
    with pytest.warns(LumigraphWarning, match="24x18 instead of 48x36"):
        scene = open_scene(write_llff(tmp_path, tiny), downscale=1)
    assert scene.cameras.size[0].tolist() == [24, 18]
    torch.testing.assert_close(scene.cameras.lens.focal[0], torch.tensor([30.0, 30.0]))


def test_reduced_images_under_other_names_go_by_their_order(tiny, tmp_path):
    write_colmap(tmp_path, tiny)
    renamed = Tiny()
    renamed.names = [f"image{i:03d}.png" for i in range(10)]
    renamed.write_images(tmp_path / "images_2", 2)
    scene = open_scene(tmp_path, downscale=2)
    assert [int((scene.photograph(i).rgb[..., 2] * 255).round().mean()) for i in range(10)] == list(range(0, 100, 10))


def turned(picture: np.ndarray) -> tuple[Image.Image, Image.Exif]:
    """A picture stored lying on its side, with the note that says how to turn it upright."""
    exif = Image.Exif()
    exif[0x0112] = 6  # turn a quarter clockwise to see it upright
    return Image.fromarray(np.rot90(picture).copy()), exif


def test_exif_turns_pictures_whose_lens_knows_them_upright(tiny, tmp_path):
    image, exif = turned(tiny.pictures[1])
    scene = open_scene(one_frame_scene(tmp_path, image, tiny, exif=exif))
    assert np.array_equal(scene.images[1], tiny.pictures[1])


def test_exif_is_passed_over_where_the_lens_knows_pictures_as_stored(tiny, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    scene = open_scene(one_frame_scene(tmp_path, Image.fromarray(tiny.pictures[1]), tiny, exif=exif))
    assert np.array_equal(scene.images[1], tiny.pictures[1])


def test_exif_turns_pictures_where_no_size_is_stated(tiny, tmp_path):
    write_blender(tmp_path, tiny)
    image, exif = turned(tiny.pictures[4])
    image.save(tmp_path / "all/view_04.png", exif=exif)
    scene = open_scene(tmp_path)
    index = next(i for i in range(10) if number_of(scene, i) == 4)
    assert np.array_equal(scene.images[index], tiny.pictures[4])


def test_a_plain_change_of_scale_is_followed(tiny, tmp_path):
    scene = open_scene(one_frame_scene(tmp_path, Image.new("RGB", (24, 18)), tiny))
    assert scene.cameras.size[1].tolist() == [24, 18] and scene.cameras.size[0].tolist() == [48, 36]
    torch.testing.assert_close(scene.cameras.lens.focal[1], torch.tensor([30.0, 30.0]))


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (Image.new("L", (48, 36), 77), [77, 77, 77]),
        (Image.fromarray(np.full((36, 48), 257 * 80, np.uint16)), [80, 80, 80]),
        (Image.new("RGB", (48, 36), (9, 8, 7)).quantize(4), [9, 8, 7]),
        (Image.new("1", (48, 36), 1), [255, 255, 255]),
        (Image.new("LA", (48, 36), (50, 100)), [50, 50, 50, 100]),
        (Image.new("RGBA", (48, 36), (1, 2, 3, 4)), [1, 2, 3, 4]),
    ],
    ids=["grey", "16 bits", "palette", "1 bit", "grey and alpha", "alpha"],
)
@pytest.mark.filterwarnings("ignore:colours is there for 1 of 10")
def test_all_kinds_of_pixels_are_read(image, expected, tiny, tmp_path):
    scene = open_scene(one_frame_scene(tmp_path, image, tiny))
    assert scene.images[1].reshape(-1, len(expected)).unique(dim=0).tolist() == [expected]
    assert scene.frame.has_alpha == (len(expected) == 4)


def test_alpha_weighs_colours_when_areas_are_averaged(tiny, tmp_path):
    pixels = np.zeros((36, 48, 4), np.uint8)
    pixels[:, ::2] = [200, 100, 0, 255]  # every other column opaque, the others black and clear
    scene = open_scene(one_frame_scene(tmp_path, Image.fromarray(pixels), tiny), downscale=2)
    assert scene.images[1].reshape(-1, 4).unique(dim=0).tolist() in ([[200, 100, 0, 128]], [[199, 99, 0, 128]])


def test_masked_pixels_are_never_drawn(tiny, tmp_path, generator):
    mask = np.zeros((36, 48), np.uint8)
    mask[10:20, 5:25] = 255
    frames = [{**f, "mask_path": "mask.png"} for f in tiny.frames("images/", ".png")]
    write_ngp(tmp_path, tiny, frames=frames)
    Image.fromarray(mask).save(tmp_path / "mask.png")
    scene = open_scene(tmp_path)
    assert np.array_equal(scene.images.mask(3), mask > 0)
    drawn = scene.images.draw(2000, scene.splits["train"], generator)
    assert (drawn.xy >= torch.tensor([5, 10])).all() and (drawn.xy <= torch.tensor([25, 20])).all()
    half = open_scene(tmp_path, downscale=2)
    assert half.images.mask(0).nonzero().aminmax(dim=0).min.tolist() == [5, 3]  # a pixel half masked is masked
    assert half.images.trusted_pixels.tolist() == [5 * 9] * 10


def test_colmap_masks_are_found(tiny, tmp_path):
    write_colmap(tmp_path, tiny)
    (tmp_path / "masks").mkdir()
    mask = np.zeros((36, 48), np.uint8)
    mask[3:] = 255
    Image.fromarray(mask).save(tmp_path / "masks/view_02.png.png")
    scene = open_scene(tmp_path)
    assert scene.images.trusted_pixels.tolist() == [48 * 36] * 2 + [48 * 33] + [48 * 36] * 7


def test_a_matrix_for_each_frame(tiny, tmp_path):
    folder = write_ngp(tmp_path, tiny, fl_x=None, fl_y=None, cx=None, cy=None)
    whole = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(whole["frames"]):
        frame["intrinsic_matrix"] = [[30.0 + i, 0, 11.5, 0], [0, 32, 8.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    write_json(folder / "transforms.json", whole)
    lens = open_scene(folder).cameras.lens
    assert lens.focal[2].tolist() == [32, 32] and lens.centre[2].tolist() == [11.5, 8.5]


@pytest.mark.parametrize(
    ("name", "lines", "cloud"),
    [
        ("scan.txt", ["0.1 0.2 0.3"] * 20, True),
        ("scan.csv", ["x,y,z,r,g,b", *["0.1,0.2,0.3,4,5,6"] * 20], True),
        ("path.txt", ["1.5 0 0 0 0 0 0 1"] * 20, False),  # a trajectory
        ("matrix.txt", ["1 0 0 0"] * 4, False),
        ("notes.txt", ["taken in the garden"] * 20, False),
    ],
)
def test_tables_of_points_are_known(name, lines, cloud, tmp_path):
    (tmp_path / name).write_text("\n".join([*lines, ""]))
    with pytest.raises(LumigraphError, match="is a cloud of points" if cloud else "no camera poses|is a file"):
        open_scene(tmp_path / name)


def test_the_black_around_a_fisheyes_circle_is_not_learnt(tiny, tmp_path):
    scene = open_scene(write_ngp(tmp_path, tiny, camera_model="OPENCV_FISHEYE", fl_x=9, fl_y=9, k1=-0.08))
    lens = scene.cameras.lens
    # theta (1 - 0.08 theta^2) stops growing where 3 * 0.08 theta^2 = 1
    theta = math.sqrt(1 / 0.24)
    radius = 9 * theta * (1 - 0.08 * theta**2)
    y, x = np.mgrid[:36, :48] + 0.5
    away = np.hypot(x - 24, y - 18)
    trusted = scene.images.mask(0).numpy()
    assert trusted[away < radius - 1].all() and not trusted[away > radius + 1].any()
    assert isinstance(lens, Fisheye)


# ------------------------------------------------------------------ where a scene lies


def ball_capture(alpha: bool, centre: np.ndarray, radii: np.ndarray, count: int = 24, colour: int = 255) -> Capture:
    """Pictures of an ellipsoid from a dome of cameras; colour: the plain background where there is no alpha."""
    size, focal = 96, 140.0
    shots = []
    for i in range(count):
        turn, lift = 2.4 * i, math.radians(10 + 70 * i / count)
        away = np.array([math.cos(turn) * math.cos(lift), math.sin(turn) * math.cos(lift), math.sin(lift)])
        pose = look_at(centre + 5 * away * radii.max() / 1.2, centre)
        lens = Pinhole(torch.tensor([[focal, focal]]), torch.tensor([[size / 2, size / 2]]))
        y, x = np.mgrid[:size, :size] + 0.5
        rays = np.stack([(x - size / 2) / focal, (y - size / 2) / focal, np.ones_like(x)], -1) @ pose[:3, :3].T / radii
        origin = (pose[:3, 3] - centre) / radii
        a, b, c = (rays**2).sum(-1), rays @ origin, origin @ origin - 1
        hit = b * b > a * c
        pixels = np.full((size, size, 3), colour, np.uint8)
        pixels[hit] = [180, 90, 20]
        if alpha:
            pixels = np.concatenate([pixels, np.where(hit, 255, 0).astype(np.uint8)[..., None]], -1)
        shots.append(Shot(f"{i:03d}", pose[:3], lens, (size, size), pixels))
    return Capture("balls", shots)


@pytest.mark.parametrize(("alpha", "colour"), [(True, 0), (False, 255), (False, 30)])
def test_an_object_fills_the_scene(alpha, colour):
    centre, radii = np.array([3.0, -2.0, 1.0]), np.array([0.5, 1.0, 0.7])
    scene = assemble(ball_capture(alpha, centre, radii, colour=colour))
    frame = scene.frame
    assert frame.reach == 1 and frame.has_alpha == alpha
    np.testing.assert_allclose(frame.background, [1.0] * 3 if alpha else [colour / 255] * 3)
    matrix = np.array(frame.source_from_scene)
    low, high = (matrix[:3, :3] @ np.array(c) + matrix[:3, 3] for c in frame.bounds)
    assert (low <= centre - radii).all() and (high >= centre + radii).all()  # nothing is cut off
    np.testing.assert_allclose(high - low, 2 * radii, rtol=0.12)
    assert np.abs(frame.bounds).max() == pytest.approx(1, abs=1e-6)
    # A ray begins before it meets the object.
    assert 0 < frame.near < (scene.cameras.position.norm(dim=-1) - 1.0).min()


def test_a_hole_the_colour_of_the_background_does_not_shrink_an_object():
    whole, holed = (ball_capture(False, np.zeros(3), np.ones(3)) for _ in range(2))
    for shot in holed.shots:
        assert isinstance(shot.image, np.ndarray)
        shot.image[40:56, 30:66] = 255
    assert assemble(holed).frame == assemble(whole).frame


def cloud_capture(
    poses: list[np.ndarray], points: np.ndarray, similarity: np.ndarray | None = None, focal: float = 50.0, **hints
) -> Capture:
    similarity = np.eye(4) if similarity is None else similarity
    scale = np.cbrt(np.linalg.det(similarity[:3, :3]))
    random = np.random.default_rng(0)
    image = random.integers(0, 255, (40, 60, 3), dtype=np.uint8)
    lens = Pinhole(torch.tensor([[focal, focal]]), torch.tensor([[30.0, 20.0]]))
    shots = []
    for i, pose in enumerate(poses):
        moved = similarity @ pose
        moved[:3, :3] /= scale
        shots.append(Shot(f"{i:03d}", moved[:3], lens, (60, 40), image))
    moved = points @ similarity[:3, :3].T + similarity[:3, 3]
    return Capture("cloud", shots, moved, np.zeros(points.shape, np.uint8), np.full(len(points), 3), **hints)


def orbit(count: int = 30, radius: float = 3.0, height: float = 1.5) -> list[np.ndarray]:
    angles = 2 * math.pi * np.arange(count) / count
    return [look_at(np.array([radius * math.cos(a), radius * math.sin(a), height]), np.zeros(3)) for a in angles]


def outdoors() -> np.ndarray:
    """A thing at the origin, ground around it, and far hills."""
    random = np.random.default_rng(0)
    thing = random.normal(0, 0.3, (2000, 3))
    ground = np.stack([*random.uniform(-6, 6, (2, 1500)), np.full(1500, -0.8)], -1)
    direction = random.normal(size=(500, 2))
    hills = 40 * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    return np.concatenate([thing, ground, np.concatenate([hills, random.uniform(0, 5, (500, 1))], -1)])


def test_an_unbounded_capture_is_centred_on_what_is_looked_at():
    points = outdoors()
    frame = assemble(cloud_capture(orbit(), points)).frame
    matrix = np.linalg.inv(np.array(frame.source_from_scene))
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(seen[:2000].mean(0)).max() < 0.2 and (np.abs(seen[:2000]).max(-1) < 1).mean() > 0.97
    assert frame.bounds == ((-1.0,) * 3, (1.0,) * 3)
    assert (np.abs(seen).max(-1) < frame.reach).mean() > 0.985 and 16 <= frame.reach <= 64
    position = np.array([matrix[:3, :3] @ p[:3, 3] + matrix[:3, 3] for p in orbit()])
    nearest = np.linalg.norm(seen[:, None] - position, axis=-1).min()
    assert 1e-3 <= frame.near < nearest


def test_a_room_seen_from_inside_is_held_whole():
    random = np.random.default_rng(0)
    walls = random.uniform(-1, 1, (4000, 3))
    side = random.integers(0, 3, 4000)
    walls[np.arange(4000), side] = np.sign(walls[np.arange(4000), side])
    walls *= [4, 3, 1.5]
    angles = 2 * math.pi * np.arange(24) / 24
    outward = [np.array([math.cos(a), math.sin(a), 0]) for a in angles]
    frame = assemble(cloud_capture([look_at(0.5 * d, 2 * d) for d in outward], walls)).frame
    matrix = np.linalg.inv(np.array(frame.source_from_scene))
    seen = walls @ matrix[:3, :3].T + matrix[:3, 3]
    assert (np.abs(seen).max(-1) < frame.reach).mean() > 0.985 and frame.reach <= 4
    assert np.abs(matrix[:3, :3] @ np.zeros(3) + matrix[:3, 3]).max() < 0.5
    assert 0.5 < frame.near / matrix[0, 0] < 1.25  # the nearest wall is 2.5 from the cameras that look at it


def test_cameras_that_look_the_same_way_see_the_box_in_front_of_them():
    random = np.random.default_rng(0)
    poses = [look_at(np.array([x, 0.0, z]), np.array([x, 10.0, z])) for x in (-1, 0, 1) for z in (-1, 0, 1)]
    points = random.uniform([-4, 8, -3], [4, 12, 3], (3000, 3))
    frame = assemble(cloud_capture(poses, points)).frame
    matrix = np.linalg.inv(np.array(frame.source_from_scene))
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    assert (np.abs(seen).max(-1) < 1).mean() > 0.9 and frame.reach <= 2
    assert frame.near / matrix[0, 0] == pytest.approx(0.4 * 8, rel=0.2)


def test_without_points_the_axes_tell_where_to_look():
    capture = cloud_capture(orbit(), outdoors())
    frame = assemble(Capture("x", capture.shots)).frame
    centre = np.array(frame.source_from_scene)[:3, 3]
    assert np.abs(centre).max() < 0.05 and frame.reach == 16
    assert assemble(Capture("x", capture.shots, reach=6.0)).frame.reach == 4
    assert assemble(Capture("x", capture.shots, reach=0.5)).frame.reach == 16  # photographs show what is around
    assert 0.01 < frame.near < 1


@pytest.mark.parametrize("points", [True, False])
def test_the_sources_own_frame_does_not_matter(points):
    """Scaled, turned and carried off, the same capture becomes the same scene, up to a turn about the vertical."""
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    matrix = np.eye(4)
    matrix[:3, :3] = 250 * turn * np.linalg.det(turn)
    matrix[:3, 3] = [5e5, -4e6, 300.0]
    captures = [cloud_capture(orbit(), outdoors()), cloud_capture(orbit(), outdoors(), matrix)]
    if not points:
        captures = [Capture("x", capture.shots) for capture in captures]
    one, other = (assemble(capture) for capture in captures)
    assert one.frame.reach == other.frame.reach and one.frame.near == pytest.approx(other.frame.near, rel=1e-2)
    for scene in (one, other):
        assert scene.cameras.pose.dtype == torch.float32
    distances = [torch.cdist(s.cameras.position, s.cameras.position) for s in (one, other)]
    close = 0.02 if points else 1e-3  # a turned box holds some other points
    torch.testing.assert_close(*distances, rtol=close, atol=close)
    heights = [s.cameras.position[:, 2] for s in (one, other)]
    torch.testing.assert_close(*heights, rtol=0, atol=close)
    back = np.array(other.frame.source_from_scene) @ np.append(other.cameras.position[7].double().numpy(), 1)
    np.testing.assert_allclose(back[:3], captures[1].shots[7].pose[:, 3], atol=0.05)


def test_the_cameras_up_becomes_z():
    y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for turn in (np.eye(3), y_up, turn_onto_z(np.array([0.6, 0, 0.8]))):
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        scene = assemble(cloud_capture(orbit(), outdoors(), matrix))
        up = -scene.cameras.pose[:, :, 1].mean(0)
        torch.testing.assert_close(up / up.norm(), torch.tensor([0.0, 0.0, 1.0]), rtol=0, atol=1e-3)


def test_cameras_that_all_look_down_are_above():
    random = np.random.default_rng(0)
    spots = np.stack([*random.uniform(-5, 5, (2, 20)), np.full(20, -8.0)], -1)
    ups = [np.array([math.cos(a), math.sin(a), 0]) for a in random.uniform(0, 6.3, 20)]
    poses = [look_at(spot, spot + [0, 0, 1], up) for spot, up in zip(spots, ups, strict=True)]
    points = random.uniform([-6, -6, -0.2], [6, 6, 0.2], (2000, 3))
    scene = assemble(cloud_capture(poses, points))
    assert scene.points is not None and scene.cameras.position[:, 2].min() > scene.points[:, 2].max()


def test_alpha_without_an_end_is_no_object():
    """Cameras that look one way cannot tell how deep something is; the capture is open, before white."""
    capture = ball_capture(True, np.zeros(3), np.ones(3))
    poses = [np.concatenate([np.eye(3), [[0.02 * i], [0], [-5]]], -1) for i in range(len(capture.shots))]
    shots = [replace(shot, pose=pose) for shot, pose in zip(capture.shots, poses, strict=True)]
    frame = assemble(Capture("x", shots)).frame
    assert frame.background == (1.0, 1.0, 1.0) and frame.has_alpha and frame.reach > 1


def test_llff_takes_the_bend_of_its_lens_from_the_model_beside_it(tiny, tmp_path):
    """As COLMAP writes its camera; another one's, of another focal length, counts for nothing."""
    write_llff(tmp_path, tiny)
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True)
    for focal, bend in ((FOCAL, -0.25), (1.1 * FOCAL, 0.0)):
        camera = struct.pack("<QiiQQ4d", 1, 1, 2, WIDTH, HEIGHT, focal, WIDTH / 2, HEIGHT / 2, -0.25)
        (model / "cameras.bin").write_bytes(camera)
        lens = open_scene(tmp_path).cameras.lens[0]
        assert isinstance(lens, OpenCV) == bool(bend)
        assert not bend or lens.distortion[0].tolist() == [bend] + 7 * [0]


def test_llff_depths_bound_a_capture_without_points(tiny, tmp_path):
    frame = open_scene(write_llff(tmp_path, tiny)).frame
    half = np.linalg.norm(np.array(frame.source_from_scene)[:3, 0])
    assert frame.near * half == pytest.approx(0.4 * 2.0)
    distance = np.median([np.linalg.norm(pose[:3, 3]) for pose in tiny.poses])
    assert frame.reach == power_of_two((6.0 + distance) / half)


def test_what_a_source_knows_of_itself_is_kept():
    hints = {"bounds": ((1.0, 1.0, 1.0), (5.0, 3.0, 2.0)), "reach": 7.0, "near": 0.1, "background": (0.2, 0.3, 0.4)}
    frame = assemble(cloud_capture(orbit(), outdoors(), **hints)).frame
    np.testing.assert_allclose(frame.bounds, [[-1, -0.5, -0.25], [1, 0.5, 0.25]])
    assert frame.reach == 4 and frame.near == pytest.approx(0.05) and frame.background == (0.2, 0.3, 0.4)
    np.testing.assert_allclose(frame.source_from_scene, [[2, 0, 0, 3], [0, 2, 0, 2], [0, 0, 2, 1.5], [0, 0, 0, 1]])


def test_images_may_be_made_when_asked(tiny):
    made = []

    def make(i):
        made.append(i)
        return tiny.pictures[i]

    lens = Pinhole(torch.tensor([[FOCAL, FOCAL]]), torch.tensor([[24.0, 18.0]]))
    shots = [Shot(str(i), p[:3], lens, (48, 36), lambda i=i: make(i)) for i, p in enumerate(tiny.poses)]
    scene = assemble(Capture("made", shots))
    assert sorted(made) == list(range(10)) and np.array_equal(scene.images[6], tiny.pictures[6])


def test_small_pieces():
    assert [power_of_two(x) for x in (0.1, 1, 1.01, 4, 5, 1e9)] == [1, 1, 2, 4, 8, 64]
    assert farthest(np.array([[0.0, 0, 0], [1, 0, 0], [9, 0, 0], [4, 0, 0]]), 3) == [0, 2, 3]
    for up in np.random.default_rng(0).normal(size=(5, 3)):
        turn = turn_onto_z(up / np.linalg.norm(up))
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(turn @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
    assert similarity(np.zeros((3, 3)), np.ones((3, 3))) is None


# ------------------------------------------------------------------ faults


def refuse(folder: Path, *words: str, **options) -> None:
    """Opening must fail with one sentence that holds all the words."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LumigraphWarning)
        with pytest.raises(LumigraphError) as caught:
            open_scene(folder, **options)
    sentence = str(caught.value)
    assert "\n" not in sentence
    for word in words:
        assert word in sentence, sentence


def change(folder: Path, **edits) -> Path:
    path = folder / "transforms.json"
    write_json(path, {**json.loads(path.read_text()), **edits})
    return folder


def change_frame(folder: Path, index: int, **edits) -> Path:
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    frames[index].update(edits)
    return change(folder, frames=frames)


def test_a_folder_that_is_none(tiny, tmp_path):
    refuse(tmp_path / "nowhere", "nowhere", "does not exist")
    (tmp_path / "empty").mkdir()
    refuse(tmp_path / "empty", "is empty")
    (tmp_path / "file").write_text("x")
    refuse(tmp_path / "file", "is a file")
    tiny.write_images(tmp_path / "photos")
    refuse(
        tmp_path / "photos",
        "no camera poses",
        "10 images",
        "transforms.json",
        "transforms_train.json",
        "sparse/0",
        "poses_bounds.npy",
    )
    refuse(tmp_path / "photos", "no reader called x", "colmap", reader="x")
    refuse(tmp_path / "photos", "poses_bounds.npy", reader="llff")
    refuse(write_ngp(tmp_path / "ngp", tiny), "--downscale 0", downscale=0)


def test_damaged_images(tiny, tmp_path):
    write_ngp(tmp_path, tiny)
    path = tmp_path / "images/view_03.png"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refuse(tmp_path, "view_03.png", "cannot be read")
    path.write_bytes(b"no image")
    refuse(tmp_path, "view_03.png", "unknown format")
    path.write_bytes(b"")
    refuse(tmp_path, "view_03.png")


def test_an_image_whose_shape_contradicts_its_lens(tiny, tmp_path):
    refuse(one_frame_scene(tmp_path, Image.new("RGB", (48, 40)), tiny), "view_01.png", "48x40", "48x36")


def test_a_mask_of_another_shape_or_without_a_pixel(tiny, tmp_path):
    frames = [{**f, "mask_path": "mask.png"} for f in tiny.frames("images/", ".png")]
    write_ngp(tmp_path, tiny, frames=frames)
    Image.new("L", (30, 36), 255).save(tmp_path / "mask.png")
    refuse(tmp_path, "mask.png", "30x36")
    Image.new("L", (48, 36), 0).save(tmp_path / "mask.png")
    refuse(tmp_path, "mask of", "no pixel")


def test_malformed_json(tiny, tmp_path):
    path = write_ngp(tmp_path, tiny) / "transforms.json"
    whole = path.read_text()
    path.write_text(whole[:200])
    refuse(tmp_path, "transforms.json", "JSON")
    path.write_text("[1, 2]")
    refuse(tmp_path, "transforms.json", "should be `object`, got `array`")
    path.write_text("{}")
    refuse(tmp_path, "transforms.json", "lacks `frames`")
    path.write_text(whole)
    refuse(change(tmp_path, frames=[1]), "frames[0] is 1, and should be `object`")
    refuse(change(tmp_path, frames=[{}]), "frame 0", "lacks `file_path`")


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda m: "no matrix", ("transform_matrix",)),
        (lambda m: m[:2], ("transform_matrix",)),
        (lambda m: [["a"] * 4] * 4, ("transform_matrix",)),
        (lambda m: (np.array(m) @ np.diag([2, 1, 1, 1])).tolist(), ("not rigid",)),
        (lambda m: (np.array(m) @ np.diag([-1, 1, 1, 1])).tolist(), ("mirrored",)),
        (lambda m: np.zeros((4, 4)).tolist(), ("last row is 0, 0, 0, 0",)),
    ],
    ids=["a word", "two rows", "letters", "scaled", "mirrored", "zeros"],
)
def test_poses_that_are_none(edit, words, tiny, tmp_path):
    write_ngp(tmp_path, tiny)
    matrix = tiny.frames("images/", ".png")[4]["transform_matrix"]
    refuse(change_frame(tmp_path, 4, transform_matrix=edit(matrix)), "view_04.png", *words)


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ({"fl_x": "wide"}, ("fl_x is 'wide', and should be",)),
        ({"fl_x": -3}, ("fl_x is -3, and should be from 0.01",)),
        ({"fl_x": 1e30}, ("fl_x is 1e+30, and should be from 0.01",)),
        ({"fl_x": None, "fl_y": None}, ("fl_x", "camera_angle_x")),
        ({"fl_x": None, "camera_angle_x": 4.0}, ("camera_angle_x is 4.0, and should be from",)),
        ({"w": 0}, ("w is 0, and should be from 1",)),
        ({"camera_model": "ORTHOPHOTO"}, ("ORTHOPHOTO", "OPENCV_FISHEYE")),
    ],
)
def test_lenses_that_are_none(edits, words, tiny, tmp_path):
    refuse(change(write_ngp(tmp_path, tiny), **edits), "transforms.json", *words)


def test_fewer_than_two_photographs(tiny, tmp_path):
    write_ngp(tmp_path, tiny)
    for name in tiny.names[1:]:
        (tmp_path / "images" / name).unlink()
    refuse(tmp_path, "1 usable photograph", "two", "missing")
    refuse(change(tmp_path, frames=[]), "no usable photographs")


def test_no_view_held_out(tiny, tmp_path):
    write_blender(tmp_path / "blender", tiny)
    for name in tiny.names[:3]:
        (tmp_path / "blender/all" / name).unlink()
    refuse(tmp_path / "blender", "no view for testing")
    names = [f"images/{name}" for name in tiny.names]
    write_nerfstudio(tmp_path / "all test", tiny, test_filenames=names)
    refuse(tmp_path / "all test", "no view for learning")


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("text", [False, True])
def test_damaged_colmap_models(part, text, tiny, tmp_path):
    path = write_colmap(tmp_path, tiny, text) / f"sparse/0/{part}.{'txt' if text else 'bin'}"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3 - 5] if not text else b"1 nonsense and 2 more\n")
    refuse(tmp_path, "sparse")


def test_colmap_images_that_are_elsewhere(tiny, tmp_path):
    write_colmap(tmp_path, tiny)
    (tmp_path / "images").rename(tmp_path / "other")
    tiny.write_images(tmp_path / "another")  # and nothing says which
    refuse(tmp_path, "none of the 10 photographs", "view_00.png")


def test_colmap_lenses_nobody_follows(tiny, tmp_path, monkeypatch):
    """All models of the COLMAP that is installed are followed; one of a later COLMAP would be named."""
    for name in set(pycolmap.CameraModelId.__members__) - {"INVALID"}:
        colmap.read_lens(pycolmap.Camera.create_from_model_name(1, name, 60.0, WIDTH, HEIGHT), tmp_path)
    camera = pycolmap.Camera(model="EUCM", width=WIDTH, height=HEIGHT, params=[60, 60, 24, 18, 1.5, 1.0])
    refuse(write_colmap(tmp_path / "beyond", tiny, cameras=[camera]), "alpha is 1.5, which is not between 0 and 1")
    monkeypatch.setattr(colmap, "PLANAR", ())
    refuse(write_colmap(tmp_path / "new", tiny), "PINHOLE", "image_undistorter")


def test_damaged_llff(tiny, tmp_path):
    path = write_llff(tmp_path, tiny) / "poses_bounds.npy"
    table = np.load(path)
    np.save(path, table[:7])
    refuse(tmp_path, "poses of 7 images", "10 in images_2")
    np.save(path, table[:, :15])
    refuse(tmp_path, "17 numbers")
    path.write_bytes(path.read_bytes()[:300])
    refuse(tmp_path, "17 numbers")
    table[3, 0] = math.nan
    np.save(path, table)
    refuse(tmp_path, "view_03.png")
    np.save(path, np.array([{"a": 1}]), allow_pickle=True)
    refuse(tmp_path, "17 numbers")


def test_damaged_points(tiny, tmp_path):
    path = write_nerfstudio(tmp_path / "ply", tiny) / "sparse.ply"
    path.write_text(path.read_text()[:300])
    refuse(tmp_path / "ply", "sparse.ply")
    write_colmap(tmp_path / "llff", tiny)
    write_llff(tmp_path / "llff", tiny)
    (tmp_path / "llff/sparse/0/images.bin").unlink()
    path = tmp_path / "llff/sparse/0/points3D.bin"
    assert open_scene(tmp_path / "llff").points.shape == (200, 3)
    path.write_bytes(path.read_bytes()[:500])
    refuse(tmp_path / "llff", "points3D.bin", "truncated")


def test_sources_are_left_as_they_are(tiny, tmp_path):
    write_ngp(tmp_path, tiny)
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in tmp_path.rglob("*") if p.is_file()}
    open_scene(tmp_path, memory=0, cache=tmp_path.parent / "cache")
    assert {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in tmp_path.rglob("*") if p.is_file()} == before


def test_opengl_is_what_the_writers_write():
    """The tests' own convention: a camera of transforms.json looks along its -z."""
    pose = look_at(np.array([0.0, -5.0, 0.0]), np.zeros(3)) @ OPENGL
    np.testing.assert_allclose(pose[:3, 2], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 1], [0, 0, 1], atol=1e-12)
