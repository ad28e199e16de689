"""Captures and clouds as other programs write them: what they mean is used, and what is not used is named."""

from __future__ import annotations

import base64
import json
import math
import shutil
import sys
import unicodedata
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from budgets import budget
from captures import FOCAL, HEIGHT, WIDTH, Tiny, write_colmap, write_nerfies, write_nerfstudio, write_ngp
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from lumigraph.camera.lens import Pinhole
from lumigraph.datasets.mesh import Mesh
from lumigraph.datasets.shapes import Shapes
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.exchange import holds_points, is_moving, is_splat_file, read_gaussians, read_moving, write_gaussians
from lumigraph.exchange.fourdgs import write_moving
from lumigraph.exchange.unpacked_gltf import packed, part, unpacked
from lumigraph.export.mesh_file import write_mesh
from lumigraph.files.ply import read_rows, write_rows
from lumigraph.gaussians import Gaussians
from lumigraph.kernels.spherical_harmonics import K00
from lumigraph.large import open_any
from lumigraph.opening import folder_of, kind_of, read_capture
from lumigraph.readers import choose_reader, colmap, light_field, nerfies, phones, pictures, transforms
from lumigraph.readers.capture import checked_pose
from lumigraph.readers.finding import find_named, paired
from lumigraph.readers.meshes import read_mesh
from lumigraph.readers.numbers import kind_of as kind_of_numbers
from lumigraph.readers.numbers import read_numbers
from lumigraph.readers.pictures import find_file, read_image, read_mask
from lumigraph.sfm.photos.gather import gather, is_bare, left_out_films, lone_film, walk
from lumigraph.system.cache import cache_folder, temporary_cache

pytestmark = budget("capture", 12)


@pytest.fixture(scope="module")
def tiny() -> Tiny:
    return Tiny(count=6)


def frames_named(tiny: Tiny, form: str) -> list[dict]:
    return [
        frame | {"file_path": form.format(Path(frame["file_path"]).name)} for frame in tiny.frames("images/", ".png")
    ]


@pytest.mark.parametrize(
    "form",
    [r"images\{}", r"C:\Users\me\scan\images\{}", "/home/me/scan/images/{}", "scan/images/{}", "./images/{}", "{}",
     r"\\server\share\scan\images\{}", "IMAGES/{}", "images/images/{}", "file:///home/me/image%73/{}"],
)  # fmt: skip
def test_paths_of_other_machines_lead_to_the_photographs(tiny, tmp_path, form):
    folder = write_ngp(tmp_path, tiny, frames=frames_named(tiny, form))
    found = transforms.read(folder)
    assert len(found.shots) == 6 and not found.missing


def test_a_link_that_was_copied_as_text_leads_to_its_folder(tiny, tmp_path):
    folder = write_ngp(tmp_path / "scene", tiny, frames=frames_named(tiny, "/home/me/scan/images/{}"))
    (folder / "images").rename(tmp_path / "photographs")
    (folder / "images").write_text("../photographs")
    assert len(transforms.read(folder).shots) == 6


def test_names_in_another_encoding(tiny, tmp_path):
    folder = write_colmap(tmp_path, tiny, text=True)
    for path in [*(folder / "images").iterdir()]:
        path.rename(path.with_name(path.name.replace("view", "v\u00fce")))
    path = folder / "sparse/0/images.txt"
    path.write_bytes(path.read_text().replace("view", "v\u00fce").encode("latin-1"))
    assert len(colmap.read(folder).shots) == 6


def test_photographs_beside_the_folder_of_poses(tiny, tmp_path):
    folder = write_ngp(tmp_path / "nerfstudio", tiny, frames=frames_named(tiny, "{}"))
    (folder / "images").rename(tmp_path / "resized_images")
    assert len(transforms.read(folder).shots) == 6


def test_names_in_other_letters(tmp_path):
    name = "Stra\u00dfe caf\u00e9 (1).JPG"
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / unicodedata.normalize("NFD", name)).write_bytes(b"x")
    for asked in (unicodedata.normalize("NFC", name), name.lower(), "images/Stra\u00dfe caf\u00e9 _1_.jpg"):
        assert find_named(tmp_path, asked).is_file(), asked
    assert not find_named(tmp_path, "images/2.jpg").is_file()
    (tmp_path / "images" / "A.png").write_bytes(b"x")
    (tmp_path / "images" / "a.png").write_bytes(b"x")
    assert not find_named(tmp_path, "images/stra\u00dfe CAF\u00c9 (1).jpg").is_file(), "letters decide there"
    assert find_named(tmp_path, "images/a.png").name == "a.png"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_json_of_windows_editors(tiny, tmp_path, encoding):
    path = write_ngp(tmp_path, tiny) / "transforms.json"
    path.write_text(path.read_text(), encoding=encoding)
    assert len(transforms.read(tmp_path).shots) == 6


def test_pairs_are_by_path_and_never_by_stem_alone():
    names = ["left/0001.jpg", "left/0002.jpg", "right/0001.jpg"]
    assert paired(names, [f"images/{name}" for name in names]) == {name: f"images/{name}" for name in names}
    assert paired(["a/0001.jpg"], ["b/0001.png"]) == {"a/0001.jpg": "b/0001.png"}  # each alone in its folder
    assert paired(["0001.jpg"], ["left/0001.jpg", "right/0001.jpg"]) == {}
    assert paired(["left/0001.jpg", "right/0001.jpg"], ["left/0001.png", "top/0001.png"]) == {
        "left/0001.jpg": "left/0001.png"
    }


# COLMAP's models


def with_names(folder: Path, form: str) -> None:
    """Rename a text model's photographs, and end its lines as Windows does."""
    path = folder / "images.txt"
    lines = path.read_text().splitlines()
    for number in colmap.image_lines(lines):
        *numbers, name = lines[number].split(maxsplit=9)
        lines[number] = " ".join([*numbers, form.format(Path(name).stem)])
    path.write_bytes("\r\n".join(["", *lines, ""]).encode("utf-8-sig"))


@pytest.mark.parametrize("form", ["images/{}.png", "a {} (b).png", "C:\\scan\\images\\{}.png"])
def test_text_models_name_photographs_to_the_end_of_the_line(tiny, tmp_path, form):
    folder = write_colmap(tmp_path, tiny, text=True)
    with_names(folder / "sparse" / "0", form)
    if " " in form:
        for file in (folder / "images").iterdir():
            file.rename(file.with_name(form.format(file.stem)))
    found = colmap.read(folder)
    assert len(found.shots) == 6 and len(found.points) == len(tiny.points)


def test_the_largest_of_several_models_is_used(tiny, tmp_path):
    write_colmap(tmp_path, Tiny(count=3), place="sparse/0")
    write_colmap(tmp_path, tiny, place="sparse/1")
    write_colmap(tmp_path, Tiny(count=4), place="sparse/10", text=True)
    found = colmap.read(tmp_path)
    assert len(found.shots) == 6 and "1, is used, without 4 photographs in 10, 3 photographs in 0" in found.notes[0]


@pytest.mark.parametrize("place", ["sparse/2", "dense/sparse", "dense/0/sparse", "undistorted/sparse", "colmap/0", "3"])
def test_models_are_found_where_programs_leave_them(tiny, tmp_path, place):
    write_colmap(tmp_path, tiny, place=place)
    if place.startswith("dense"):
        shutil.move(tmp_path / "images", (tmp_path / place).parent / "images")
    assert len(colmap.read(tmp_path).shots) == 6


def test_what_is_not_found_is_named_with_the_place(tiny, tmp_path):
    write_colmap(tmp_path, tiny)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(LumigraphError, match=r"looked for view_00\.png"):
        colmap.read(tmp_path)


@pytest.mark.parametrize("text", [False, True])
def test_models_without_points_and_with_a_cloud_beside(tiny, tmp_path, text):
    place = write_colmap(tmp_path, tiny, text=text) / "sparse" / "0"
    (place / f"points3D.{'txt' if text else 'bin'}").unlink()
    found = colmap.read(tmp_path)
    assert len(found.shots) == 6 and found.points is None
    shutil.copyfile(write_nerfstudio(tmp_path / "other", tiny) / "sparse.ply", place / "points3D.ply")
    np.testing.assert_allclose(colmap.read(tmp_path).points, tiny.points, atol=1e-6)


@pytest.mark.parametrize(("named", "images"), [("sparse/0", "images"), ("sparse", "images"), (".", "pictures")])
def test_a_model_finds_its_photographs_from_its_own_folder(tiny, tmp_path, named, images):
    write_colmap(tmp_path, tiny)
    (tmp_path / "images").rename(tmp_path / images)
    assert len(colmap.read(tmp_path / named).shots) == 6


# Lenses and keys of transforms.json


def test_lost_poses_cost_their_photographs_and_a_scaled_camera_none(tiny, tmp_path):
    path = write_ngp(tmp_path, tiny) / "transforms.json"
    said = json.loads(path.read_text())
    said["frames"][1]["transform_matrix"][0][3] = math.nan
    said["frames"][2]["transform_matrix"] = None
    for row in said["frames"][3]["transform_matrix"][:3]:
        row[:3] = [2.5 * x for x in row[:3]]
    path.write_text(json.dumps(said))
    with pytest.warns(LumigraphWarning, match="2 photographs whose pose is null or NaN"):
        shots = transforms.read(tmp_path).shots
    assert len(shots) == 4
    np.testing.assert_allclose(checked_pose(shots[1], "here"), tiny.poses[3][:3], atol=1e-6)


def test_published_splits_of_dycheck(tiny, tmp_path):
    folder = write_nerfies(tmp_path, tiny)
    ids = json.loads((folder / "dataset.json").read_text())["ids"]
    (folder / "splits").mkdir()
    for split, names in (("train", ids[::2]), ("val", ids[3:4])):
        (folder / "splits" / f"{split}.json").write_text(json.dumps({"frame_names": names, "camera_ids": [0]}))
    found = {shot.name: shot.split for shot in nerfies.read(folder).shots}
    assert found == {name: "test" if name == ids[3] else "train" if name in ids[::2] else "val" for name in ids}


def test_models_without_lines_of_features(tiny, tmp_path):
    folder = write_colmap(tmp_path, tiny, text=True)
    path = folder / "sparse/0/images.txt"
    path.write_text("".join(f"{x}\n" for x in path.read_text().splitlines() if x.endswith(".png") or x[0] == "#"))
    found = colmap.read(folder)
    assert len(found.shots) == 6 and found.points is not None and len(found.points) == 200


def test_fields_that_are_null_count_as_absent(tiny, tmp_path):
    folder = write_ngp(tmp_path, tiny, camera_model=None, k1=None, ply_file_path=None)
    assert len(transforms.read(folder).shots) == 6


def test_masks_that_are_not_there_are_named_and_cost_nothing(tiny, tmp_path):
    folder = write_ngp(tmp_path, tiny, mask_path="masks/none.png")
    found = transforms.read(folder)
    assert len(found.shots) == 6 and found.missing == ["masks/none.png"] * 6
    assert all(shot.mask is None for shot in found.shots)


BLACK = np.zeros((HEIGHT, WIDTH), np.uint8)
HALF = np.repeat(np.arange(2, dtype=np.uint8), WIDTH // 2)[None].repeat(HEIGHT, 0)


@pytest.mark.parametrize(
    ("picture", "share"),
    [
        (HALF, 0.5),
        (np.dstack([BLACK, BLACK, BLACK, 255 * HALF]), 0.5),
        (255 * HALF, 0.5),
        (257 * 255 * HALF.astype(np.uint16), 0.5),
    ],
)
def test_masks_of_ones_and_masks_in_alpha(tiny, tmp_path, picture, share):
    folder = write_ngp(tmp_path, tiny)
    (folder / "Masks").mkdir()
    for name in tiny.names:
        Image.fromarray(picture).save(folder / "Masks" / name)
    masks = [shot.mask for shot in read_capture(folder).shots]
    assert {read_mask(mask, (WIDTH, HEIGHT), True).mean() for mask in masks} == {share}


def test_thumbnails_of_a_nas_and_of_macos_are_no_photographs(tmp_path):
    unseen = "@eaDir/a.jpg/SYNOPHOTO_THUMB_M.jpg", "__MACOSX/._a.jpg", "__MACOSX/b.jpg", ".thumbs/c.jpg"
    for place in (*unseen, "a.jpg", "a.mask.png"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (4, 4)).save(tmp_path / place)
    assert pictures.list_images(tmp_path) == ["a.jpg", "a.mask.png"]
    assert [path.name for path in walk(tmp_path)] == ["a.jpg"]


def test_transposed_poses_are_refused(tiny, tmp_path):
    frames = frames_named(tiny, "images/{}")
    for frame in frames:
        frame["transform_matrix"] = np.transpose(frame["transform_matrix"]).tolist()
    with pytest.raises(LumigraphError, match="last row is 4, 0, 1, 1, not 0, 0, 0, 1; transpose it"):
        transforms.read(write_ngp(tmp_path, tiny, frames=frames))


def test_a_capture_further_down_and_under_another_name_is_named(tiny, tmp_path):
    write_ngp(tmp_path / "unpacked" / "scene", tiny)
    with pytest.raises(LumigraphError, match=r"no camera poses itself, and .*unpacked/scene does"):
        read_capture(tmp_path)
    (tmp_path / "cameras.xml").write_text("<document>")
    with pytest.raises(LumigraphError, match="the poses of Metashape"):
        read_capture(tmp_path / "cameras.xml")
    place = tmp_path / "unpacked" / "scene" / "transforms.json"
    place.rename(place.with_name("cameras_nerf.json"))
    for path in (place.parent, place.with_name("cameras_nerf.json")):
        with pytest.raises(LumigraphError, match="under another name, .* name the file transforms.json"):
            read_capture(path)


@pytest.mark.parametrize("file", ["transforms.json", "sparse/0/images.bin", "sparse/0/cameras.txt"])
def test_a_scene_is_named_by_its_file_too(tiny, tmp_path, file, monkeypatch):
    folder = write_ngp(tmp_path, tiny) if file == "transforms.json" else write_colmap(tmp_path, tiny)
    (folder / file).touch()
    assert folder_of(folder / file) == folder
    monkeypatch.chdir((folder / file).parent)
    assert folder_of(Path(Path(file).name if "/" not in file else folder / file)) == folder
    assert file == "sparse/0/cameras.txt" or len(read_capture(folder / file).shots) == 6


@pytest.mark.parametrize(("kind", "suffix"), [("JPEG", ".tif"), ("AVIF", ".avif"), ("JPEG", ".jfif"), ("WEBP", ".jpg")])
def test_photographs_are_known_by_their_content(tmp_path, kind, suffix):
    Image.fromarray(np.full((20, 30, 3), 90, np.uint8)).save(tmp_path / f"a{suffix}", format=kind)
    found = find_file(tmp_path / "a")
    assert found.suffix == suffix and read_image(found, True, (30, 20)).mean() == pytest.approx(90, abs=2)


def test_a_large_jpeg_is_decoded_reduced(tmp_path, monkeypatch):
    y, x = np.mgrid[:480, :640]
    whole = np.stack([x / 3, y / 2, 99 + 0 * x], -1).astype(np.uint8)
    Image.fromarray(whole).save(tmp_path / "a.jpg", quality=95)
    before = read_image(tmp_path / "a.jpg", False, (64, 48)).astype(float)
    drafts: list[tuple] = []
    draft = JpegImageFile.draft
    monkeypatch.setattr(JpegImageFile, "draft", lambda *given: drafts.append(draft(*given)))
    monkeypatch.setattr(pictures, "LARGE", 100_000)
    after = read_image(tmp_path / "a.jpg", False, (64, 48)).astype(float)
    assert len(drafts) == 1 and np.abs(after - before).mean() < 1


def test_depth_of_floats_keeps_its_numbers(tmp_path):
    values = np.linspace(0.5, 7, 12, dtype="<f4").reshape(3, 4)
    (tmp_path / "a.pfm").write_bytes(b"Pf\n4 3\n-1.0\n" + values[::-1].tobytes())
    assert kind_of_numbers(tmp_path / "a.pfm").dtype == np.float32
    np.testing.assert_array_equal(read_numbers(tmp_path / "a.pfm"), values)


# Masks, depth and films beside photographs


@pytest.mark.parametrize("name", ["view_00.png", "view_00.png.png", "view_00.jpg", "view_00_mask.png", "view_00.PNG"])
def test_masks_of_other_names_are_used(tiny, tmp_path, name):
    write_ngp(tmp_path, tiny)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / name).write_bytes(b"x")
    assert read_capture(tmp_path).shots[0].mask == tmp_path / "masks" / name


@pytest.mark.parametrize("name", ["mask/view_00.png", "images/view_00_mask.png", "images/dynamic_mask_view_00.png"])
def test_masks_in_other_places_are_named_and_are_no_photographs(tiny, tmp_path, name):
    write_colmap(tmp_path, tiny)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    tiny_mask = Image.new("L", (WIDTH, HEIGHT), 255)
    tiny_mask.save(tmp_path / name)
    assert f"{tmp_path / name.split('/view')[0]}" in read_capture(tmp_path).notes[0]
    assert len(list(walk(tmp_path))) == 6


def test_depth_is_no_photograph_and_films_beside_photographs_are_named(tiny, tmp_path):
    tiny.write_images(tmp_path / "color")
    tiny.write_images(tmp_path / "depth")
    (tmp_path / "IMG_1.MOV").write_bytes(b"x")
    assert {path.parent.name for path in walk(tmp_path)} == {"color"}
    assert "1 film beside the photographs, such as IMG_1.MOV," in left_out_films([tmp_path])[0]
    shutil.rmtree(tmp_path / "color")
    assert lone_film([tmp_path]) == [tmp_path / "IMG_1.MOV"] and is_bare(tmp_path)
    (tmp_path / "IMG_2.MOV").write_bytes(b"x")
    with pytest.raises(LumigraphError, match="2 films and no photographs"):
        lone_film([tmp_path])


def test_frames_of_a_row_of_cameras_are_no_light_field(tiny, tmp_path):
    picture = Image.fromarray(tiny.pictures[0])
    for camera in range(2):
        for frame in range(5):
            picture.save(tmp_path / f"cam_{camera}_{frame:04}.png")
    assert not light_field.recognises(tmp_path)
    for frame in range(3, 5):
        (tmp_path / f"cam_0_{frame:04}.png").unlink()
        (tmp_path / f"cam_1_{frame:04}.png").unlink()
    assert light_field.recognises(tmp_path) and "if it is none" in light_field.read(tmp_path).notes[0]


# Meshes


def write_gltf(path: Path, accessor: dict, numbers: bytes, **primitive: int) -> None:
    """A mesh of four corners whose positions are the first accessor, with its buffer in a file with a blank."""
    (path.parent / "my bin.bin").write_bytes(numbers)
    views = accessor.pop("views")
    about = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    about |= {"buffers": [{"uri": "my%20bin.bin", "byteLength": len(numbers)}], "accessors": [accessor]}
    about["bufferViews"] = [{"buffer": 0, "byteOffset": at, "byteLength": size} for at, size in views]
    about["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 5} | primitive]}]
    path.write_text(json.dumps(about))


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FLOATS = CORNERS.astype("<f4").tobytes()


@pytest.mark.parametrize(
    ("more", "numbers", "last"),
    [
        ({"componentType": 5126, "views": [(0, 48)]}, FLOATS, 1),
        (
            {"componentType": 5122, "normalized": True, "views": [(0, 24)]},
            (32767 * CORNERS).astype("<i2").tobytes(),
            1,
        ),
        (
            {
                "componentType": 5126,
                "views": [(0, 48), (48, 2), (52, 12)],
                "sparse": {
                    "count": 1,
                    "indices": {"bufferView": 1, "componentType": 5123},
                    "values": {"bufferView": 2},
                },
            },
            FLOATS + bytes([3, 0, 0, 0]) + np.array([0, 0, 9], "<f4").tobytes(),
            9,
        ),
    ],
)
@pytest.mark.parametrize("mode", [5, 6])
def test_gltf_of_other_programs(more, numbers, last, mode, tmp_path):
    accessor = {"bufferView": 0, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 9]} | more
    write_gltf(tmp_path / "a.gltf", accessor, numbers, mode=mode)
    found = read_mesh(tmp_path / "a.gltf")
    assert len(found.faces) == 2
    np.testing.assert_allclose(found.vertices, CORNERS * [1, 1, last], atol=1e-4)
    (tmp_path / "my bin.bin").unlink()
    with pytest.raises(LumigraphError, match="my bin.bin, which does not exist"):
        read_mesh(tmp_path / "a.gltf")


@pytest.mark.parametrize(("form", "full"), [("ushort red", 65535), ("uchar diffuse_red", 255), ("float red", 1)])
def test_colours_of_ply(form, full, tmp_path):
    names = "".join(f"property {form.replace('red', colour)}\n" for colour in ("red", "green", "blue"))
    place = "".join(f"property float {axis}\n" for axis in "xyz")
    rows = f"0 0 0 {full} 0 0\n1 0 0 0 {full} 0\n0 1 1 0 0 0\n"
    head = "ply\nformat ascii 1.0\nelement vertex 3\n"
    (tmp_path / "a.ply").write_text(f"{head}{place}{names}end_header\n{rows}")
    assert read_mesh(tmp_path / "a.ply").colours.tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 0]]
    assert holds_points(tmp_path / "a.ply")


# Files of other programs


@pytest.mark.parametrize(
    ("name", "words"),
    [("a.ksplat", "SuperSplat"), ("a.zip", "unpack it"), ("a.fbx", "Blender"), ("a.insv", "equirectangular"),
     ("a.r3d", "RGBD"), ("a.bag", "depth/0.png")],
)  # fmt: skip
def test_files_of_other_programs_are_named_with_a_way_out(tmp_path, name, words):
    (tmp_path / name).write_bytes(b"x")
    for look in (choose_reader, open_any, lambda path: gather([path], tmp_path / "work")):
        with pytest.raises(LumigraphError, match=words):
            look(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [("cameras.xml", "<document/>", "Metashape"), ("bundle.out", "# Bundle file v0.3", "Bundler"),
     ("images/a.xmp", "xcr:Position", "RealityScan"), ("a.csv", "#name,x,y,alt", "RealityScan"),
     ("cameras_sphere.npz", "", "NeuS"), ("reconstruction.json", "[]", "OpenSfM"), ("a.csv", "price", "no camera")],
)  # fmt: skip
def test_poses_of_other_programs_are_named_with_a_way_out(tiny, tmp_path, name, text, words):
    tiny.write_images(tmp_path / "images")
    (tmp_path / name).write_text(text)
    with pytest.raises(LumigraphError, match=words):
        choose_reader(tmp_path)


def test_k4_without_k5_and_k6_is_the_power_of_eight(tiny, tmp_path):
    powers = 0.06, -0.08, 0.01, 0.09
    named = {f"k{i + 1}": k for i, k in enumerate(powers)}
    found = transforms.read(write_ngp(tmp_path, tiny, camera_model="OPENCV", **named))
    assert any("r^8" in note for note in found.notes)
    random = torch.Generator().manual_seed(0)
    places = torch.rand(200, 2, generator=random) * torch.tensor([WIDTH, HEIGHT])
    rays = found.shots[0].lens.unproject(places)
    x, y = (rays[:, :2] / rays[:, 2:]).unbind(-1)
    r2 = x**2 + y**2
    factor = 1 + sum(k * r2 ** (i + 1) for i, k in enumerate(powers))
    back = torch.stack([x * factor * FOCAL + WIDTH / 2, y * factor * FOCAL + HEIGHT / 2], -1)
    assert (back - places).norm(dim=-1).max() < 0.1
    rational = transforms.read(write_ngp(tmp_path / "b", tiny, camera_model="FULL_OPENCV", **named))
    assert not rational.notes and rational.shots[0].lens.distortion[0, 5] == pytest.approx(0.09)


def test_other_ways_to_say_a_lens(tiny, tmp_path):
    degrees = 2 * math.degrees(math.atan(WIDTH / 2 / FOCAL))
    for i, extra in enumerate(({"x_fov": degrees, "fl_x": None}, {"camera_model": "SIMPLE_PINHOLE"})):
        lens = transforms.read(write_ngp(tmp_path / f"{i}", tiny, **extra)).shots[0].lens
        assert isinstance(lens, Pinhole) and lens.focal[0, 0] == pytest.approx(FOCAL, rel=1e-4)
    radial = transforms.read(write_ngp(tmp_path / "r", tiny, camera_model="SIMPLE_RADIAL", k1=0.1)).shots[0].lens
    assert radial.distortion[0, 0] == pytest.approx(0.1)
    circle = transforms.read(write_ngp(tmp_path / "f", tiny, camera_model="OPENCV_FISHEYE", fisheye_crop_radius=15))
    assert circle.shots[0].mask.sum() == pytest.approx(math.pi * 15**2, rel=0.02)
    told = transforms.read(write_ngp(tmp_path / "u", tiny, rolling_shutter=[0, 0, 0.01, 0], sharpness=3, mood="good"))
    assert "passed over: mood" in told.notes[0] and "rolling shutter" in told.notes[1]


def test_polycam_without_sizes(tiny, tmp_path):
    for name in ("corrected_cameras", "cameras", "corrected_images"):
        (tmp_path / "keyframes" / name).mkdir(parents=True)
    pose = {f"t_{i}{j}": float(tiny.poses[0][i, j]) for i in range(3) for j in range(4)}
    lens = {"fx": 60.0, "fy": 60.0, "cx": 24.0, "cy": 18.0}
    for stem, sizes in (("1", {"width": 96, "height": 72}), ("2", {})):
        tiny.write_images(tmp_path / "made")
        shutil.copyfile(tmp_path / "made" / tiny.names[0], tmp_path / "keyframes" / "corrected_images" / f"{stem}.png")
        (tmp_path / "keyframes" / "corrected_cameras" / f"{stem}.json").write_text(json.dumps(pose | lens))
        (tmp_path / "keyframes" / "cameras" / f"{stem}.json").write_text(json.dumps(pose | lens | sizes))
    assert [shot.size for shot in phones.read(tmp_path).shots] == [(96, 72), None]


# Clouds


def cloud(count: int = 40, far: bool = False) -> Gaussians:
    random = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=random, dtype=torch.float64)
    if far:
        means = means + torch.tensor([512345.7, 4649776.2, 312.4], dtype=torch.float64)
    return Gaussians(
        means if far else means.float(),
        torch.randn(count, 4, generator=random),
        torch.randn(count, 3, generator=random) * 0.3 - 3,
        torch.randn(count, generator=random),
        torch.randn(count, 1, 3, generator=random),
    )


def with_properties(path: Path, to: Path, without: tuple[str, ...] = (), **more: np.ndarray) -> Path:
    """A copy of a .ply without some properties and with others."""
    rows = read_rows(path, ["vertex"])["vertex"]
    fields = {name: rows[name] for name in rows.dtype.names if name not in without} | more
    made = np.empty(len(rows), [(name, values.dtype) for name, values in fields.items()])
    for name, values in fields.items():
        made[name] = values
    write_rows(to, "splats", {"vertex": made})
    return to


def test_the_filter_of_mip_splatting_is_applied(tmp_path):
    write_gaussians(tmp_path / "a.ply", cloud())
    size = np.linspace(0.01, 0.1, 40).astype(np.float32)
    found = read_gaussians(with_properties(tmp_path / "a.ply", tmp_path / "b.ply", filter_3D=size))
    before = read_gaussians(tmp_path / "a.ply")
    variances = before.log_scales.exp() ** 2
    wider = variances + torch.from_numpy(size)[:, None] ** 2
    torch.testing.assert_close(found.log_scales.exp() ** 2, wider)
    share = (variances.prod(1) / wider.prod(1)).sqrt()
    torch.testing.assert_close(found.opacities.sigmoid(), before.opacities.sigmoid() * share)


def test_flat_gaussians_and_properties_that_are_not_used(tmp_path):
    write_gaussians(tmp_path / "a.ply", cloud())
    path = with_properties(tmp_path / "a.ply", tmp_path / "b.ply", ("scale_2",), label=np.arange(40, dtype=np.int32))
    with pytest.warns(LumigraphWarning) as told:
        found = read_gaussians(path)
    assert sorted(str(one.message).split(": ", 1)[1].split(",")[0] for one in told) == [
        "Gaussians without scale_2 are flat",
        "passed over: label",
    ]
    assert (found.log_scales[:, 2] < found.log_scales[:, :2].amin(1) - 4).all()


def test_axes_without_length_are_thin_and_a_trained_folder_is_its_last_cloud(tmp_path):
    for number in (7000, 30000):
        write_gaussians(tmp_path / f"point_cloud/iteration_{number}/point_cloud.ply", cloud(number // 1000))
    flat = np.full(30, -np.inf, np.float32)
    path = tmp_path / "point_cloud/iteration_30000/point_cloud.ply"
    with_properties(path, path.with_name("b.ply"), ("scale_1",), scale_1=flat).replace(path)
    assert is_splat_file(tmp_path)
    found = read_gaussians(tmp_path)
    longest = found.log_scales.amax(-1)
    assert len(found) == 30
    torch.testing.assert_close(found.log_scales[:, 1], longest + math.log(0.01))


def spacetime(tmp_path: Path) -> Path:
    random = np.random.default_rng(0)
    write_gaussians(tmp_path / "a.ply", cloud())
    more = {"trbf_center": random.uniform(0, 1, 40), "trbf_scale": np.full(40, np.log(0.2))}
    more |= {f"motion_{i}": random.normal(0, 1, 40) for i in range(9)} | {f"omega_{i}": np.zeros(40) for i in range(4)}
    more = {name: values.astype(np.float32) for name, values in more.items()}
    return with_properties(tmp_path / "a.ply", tmp_path / "b.ply", **more)


def test_spacetime_gaussians_move(tmp_path):
    path = spacetime(tmp_path)
    assert is_moving(path) and not is_splat_file(path)
    with pytest.raises(LumigraphError, match=r"move; make a file"):
        read_gaussians(path)
    rows = read_rows(path, ["vertex"])["vertex"]
    moving, before = read_moving(path), read_gaussians(tmp_path / "a.ply")
    for time in (0.05, 0.4, 0.77):
        now = moving.at(time * moving.duration)
        away = time - torch.from_numpy(rows["trbf_center"].copy())
        parts = [torch.from_numpy(np.stack([rows[f"motion_{3 * k + i}"] for i in range(3)], 1)) for k in range(3)]
        places = before.means + sum(part * away[:, None] ** (k + 1) for k, part in enumerate(parts))
        seen = before.opacities.sigmoid() * torch.exp(-((away / 0.2) ** 2))
        for place, opacity in zip(places[seen > 0.1], seen[seen > 0.1], strict=True):
            nearest = (now.means - place).norm(dim=-1).argmin()
            assert (now.means[nearest] - place).norm() < 0.03
            assert now.opacities[nearest].sigmoid() == pytest.approx(float(opacity), rel=0.02)
    assert open_any(path).frame.times == (0.0, 3.0)


def test_a_folder_of_a_cloud_a_frame_moves(tmp_path):
    for i in range(4):
        write_gaussians(tmp_path / "clip" / f"frame_{i:04}.ply", replace(cloud(), means=cloud().means + 0.1 * i))
    moving = read_moving(tmp_path / "clip")
    torch.testing.assert_close(moving.at(1.5 / 30).means, cloud().means + 0.15)
    write_moving(tmp_path / "a.4dgs", moving)
    assert len(read_moving(tmp_path / "a.4dgs")) == 160
    write_gaussians(tmp_path / "clip" / "other.ply", cloud())
    assert not is_moving(tmp_path / "clip"), "a folder of clouds that are no frames"


def test_several_clouds_are_no_shapes(tmp_path):
    for name in ("chair.ply", "lamp.ply"):
        write_gaussians(tmp_path / name, cloud())
    for read in (kind_of, open_any):
        with pytest.raises(LumigraphError, match="holds 2 files of Gaussians, such as chair.ply; name one"):
            read(tmp_path)
    (tmp_path / "a.obj").write_text("v 0 0 0")
    assert kind_of(tmp_path) is Shapes


def test_colours_as_bytes_and_one_scale(tmp_path):
    write_gaussians(tmp_path / "a.ply", cloud())
    rows = read_rows(tmp_path / "a.ply", ["vertex"])["vertex"]
    known = [x for x in rows.dtype.names if not x.startswith(("f_", "scale_1", "scale_2"))]
    other = np.zeros(len(rows), [(x, "<f4") for x in known] + [(x, "u1") for x in ("red", "green", "blue")])
    for name in known:
        other[name] = rows[name]
    other["green"] = 255
    write_rows(tmp_path / "b.ply", "splats", {"vertex": other}, [])
    found = read_gaussians(tmp_path / "b.ply")
    torch.testing.assert_close(found.harmonics[:, 0] * K00 + 0.5, torch.tensor([0.0, 1, 0]).expand(len(rows), 3))
    torch.testing.assert_close(found.log_scales, cloud().log_scales[:, :1].expand(-1, 3))


@pytest.mark.parametrize(
    ("names", "words"), [(["f_anchor_feat_0"], "anchors of Scaffold-GS"), (["t", "scale_t"], "4D-GS")]
)
def test_clouds_that_need_more_than_their_file_are_named(tmp_path, names, words):
    write_gaussians(tmp_path / "a.ply", cloud())
    rows = read_rows(tmp_path / "a.ply", ["vertex"])["vertex"]
    more = np.zeros(len(rows), rows.dtype.descr + [(name, "<f4") for name in names])
    write_rows(tmp_path / "b.ply", "splats", {"vertex": more}, [])
    with pytest.raises(LumigraphError, match=words):
        read_gaussians(tmp_path / "b.ply")


def test_a_zipped_folder_of_sog_opens(tmp_path):
    write_gaussians(tmp_path / "a.sog", cloud())
    with zipfile.ZipFile(tmp_path / "a.sog") as old, zipfile.ZipFile(tmp_path / "b.sog", "w") as new:
        new.writestr("scene/", "")
        new.writestr("__MACOSX/scene/._meta.json", "")
        for name in old.namelist():
            new.writestr(f"scene/{name}", old.read(name))
    torch.testing.assert_close(read_gaussians(tmp_path / "b.sog").means, read_gaussians(tmp_path / "a.sog").means)


def test_harmonics_of_degree_four_are_cut(tmp_path):
    write_gaussians(tmp_path / "a.ply", cloud())
    rows = read_rows(tmp_path / "a.ply", ["vertex"])["vertex"]
    known = [name for name in rows.dtype.names if not name.startswith("f_rest_")]
    more = np.zeros(len(rows), [(x, "<f4") for x in (*known, *(f"f_rest_{i}" for i in range(72)))])
    for name in known:
        more[name] = rows[name]
    for i in range(72):
        more[f"f_rest_{i}"] = i
    write_rows(tmp_path / "b.ply", "splats", {"vertex": more}, [])
    with pytest.warns(LumigraphWarning, match="harmonics of degree 4 are passed over"):
        found = read_gaussians(tmp_path / "b.ply")
    assert found.harmonics[0, 1:, 2].tolist() == list(range(48, 63))


def test_frames_of_other_gaussians_follow_each_other(tmp_path):
    for i in range(2):
        write_gaussians(tmp_path / "clip" / f"{i}.ply", cloud(20 + i))
    with pytest.warns(LumigraphWarning, match="nothing moves between frames"):
        moving = read_moving(tmp_path / "clip")
    assert [len(moving.at(t / 30)) for t in (0.5, 1.5)] == [20, 21]


@pytest.mark.parametrize("name", ["a.ply", "a.glb", "a.spz", "a.sog", "a.splat", "folder/meta.json"])
def test_far_from_the_origin_centres_are_kept(tmp_path, name):
    far = cloud(far=True)
    write = pytest.warns(LumigraphWarning, match=r"offset\.json has that offset")
    if name in ("a.ply", "a.glb"):
        write_gaussians(tmp_path / name, far)
    else:
        with write:
            write_gaussians(tmp_path / name, far)
    found = read_gaussians(tmp_path / name)
    assert found.means.dtype == torch.float64
    size = far.log_scales.amax(-1).exp().median()
    assert (found.means[:, None] - far.means).norm(dim=-1).amin(1).max() < 0.01 * size
    write_gaussians(tmp_path / name, cloud())
    near = read_gaussians(tmp_path / name)
    assert near.means.dtype == torch.float32 and near.means.abs().max() < 10, "the offset went with its file"


def test_a_cloud_far_away_is_rendered_as_near_the_origin(tmp_path):
    write_gaussians(tmp_path / "a.ply", cloud(far=True))
    write_gaussians(tmp_path / "b.ply", cloud())
    far, near = (open_any(tmp_path / f"{x}.ply") for x in "ab")
    pictures = [one.method("cpu").render(one.cameras()["train"][0]).rgb for one in (far, near)]
    torch.testing.assert_close(*pictures, atol=2e-3, rtol=0)


# A home that cannot be written


def test_caches_lie_in_the_temporary_folder_where_the_home_cannot_be_written(tmp_path, monkeypatch):
    for name in ("LUMIGRAPH_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    temporary_cache.cache_clear()
    with pytest.warns(LumigraphWarning, match="set LUMIGRAPH_CACHE"):
        found = cache_folder()
    assert found.parent == tmp_path and found.stat().st_mode & 0o077 == 0
    temporary_cache.cache_clear()
    found.chmod(0o777)  # another user may have put code there
    with pytest.warns(LumigraphWarning):
        assert cache_folder() != found
    temporary_cache.cache_clear()


def test_a_cloud_of_points_is_described(tmp_path):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0)
    header.offsets, header.scales = [500000, 4600000, 0], [0.001] * 3
    made = laspy.LasData(header)
    made.x, made.y, made.z = np.linspace(500000, 500010, 90), np.linspace(4600000, 4600020, 90), np.linspace(0, 5, 90)
    made.write(tmp_path / "a.las")
    with pytest.raises(LumigraphError, match=r"cloud of 90 points, 10 x 20 x 5 large, .* --depth-from"):
        choose_reader(tmp_path / "a.las")
    (tmp_path / "a.xyz").write_text("0 0 0")
    with pytest.raises(LumigraphError, match="convert it to"):
        choose_reader(tmp_path / "a.xyz")


@pytest.mark.parametrize("line", ["-s 1 1 1 tex\\a b.png", r"C:\Users\me\A B.png", "none.png"])
def test_textures_are_found_as_photographs_are(tmp_path, line):
    (tmp_path / "tex").mkdir()
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / ("tex" if "tex" in line else ".") / "a b.png")
    (tmp_path / "m.mtl").write_text(f"newmtl a\nKd 1 1 1\nmap_Kd {line}\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(f"mtllib m.mtl\n{corners}usemtl a\nf 1/1 2/2 3/3\n")
    if line == "none.png":
        with pytest.warns(LumigraphWarning, match="names none.png, which is not beside it"):
            read_mesh(tmp_path / "a.obj")
    else:
        assert (read_mesh(tmp_path / "a.obj").colours == [255, 0, 0]).all()


def test_strips_of_triangles(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {x}\n" for x in "xyz")
    head += "".join(f"property uchar {x}\n" for x in "rgb") + "element tristrips 1\n"
    rows = "0 0 0 9 0 0\n1 0 0 9 0 0\n0 1 0 9 0 0\n1 1 0 9 0 0\n9 0 1 2 3 -1 1 3 2 -1\n"
    (tmp_path / "a.ply").write_text(f"{head}property list int int vertex_indices\nend_header\n{rows}")
    found = read_mesh(tmp_path / "a.ply")
    assert len(found.faces) == 3 and (found.colours == [9, 0, 0]).all()


# Red above, blue below, 8 x 8 pixels of ETC1S
KTX2 = (
    "q0tUWCAyMLsNChoKAAAAAAEAAAAIAAAACAAAAAAAAAAAAAAAAQAAAAEAAAABAAAAaAAAACwAAACUAAAAJAAAALgAAAAAAAAAggAA"
    "AAAAAAA6AQAAAAAAAAEAAAAAAAAAAAAAAAAAAAAsAAAAAAAAAAIAKACjAQIAAwMAAAgAAAAAAAAAAAA/AAAAAAAAAAAA/////x8A"
    "AABLVFh3cml0ZXIAQmFzaXMgVW5pdmVyc2FsIDIuMTAAAAIAAQAqAAAABQAAACsAAAAAAAAAAAAAAAAAAAABAAAAAAAAAAAAAAAg"
    "wEQAAAAAAADiRAQwEQAAAAAAgCQgAEwACAAAAAAgBgATAAAAAAAACCasqqqqAjTARAAAAAAAABJFAJgAEAAAAABAFAImAgAAAAAA"
    "kDYCwASAAAAAAAAiEAAA"
)
SOLID = trimesh.creation.icosphere(1)
BALL = Mesh(np.array(SOLID.vertices), np.array(SOLID.faces), (127 * SOLID.vertices + 127).astype(np.uint8))
VECTOR = {"type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]}


def packed_ball(path: Path, how: str) -> dict:
    """JSON of a coloured mesh that is written, packed by an extension."""
    write_mesh(path, BALL, np.array([0.0, 1, 0]))
    about, whole = unpacked(path)
    position, colours, faces = (about["accessors"][i] for i in (0, 2, 3))
    if how == "draco":
        library = pytest.importorskip("DracoPy")
        light = np.frombuffer(bytes(whole), "<f4", 3 * colours["count"], about["bufferViews"][2]["byteOffset"]).reshape(
            -1, 3
        )
        data = library.encode(BALL.vertices, BALL.faces, 20, preserve_order=True, generic_attributes={7: light})
        primitive, numbers = about["meshes"][0]["primitives"][0], {"POSITION": 0, "COLOR_0": 7}
        numbers["POSITION"] = next(x["unique_id"] for x in library.decode(data).attributes if x["attribute_type"] == 0)
        said = {"bufferView": part(about, whole, data), "attributes": numbers}
        primitive["extensions"] = {"KHR_draco_mesh_compression": said}
        for accessor in (position, colours, faces):
            accessor.pop("bufferView")
    else:
        library = pytest.importorskip("meshopt")
        for accessor, mode, width in ((position, "ATTRIBUTES", 3), (colours, "ATTRIBUTES", 3), (faces, "TRIANGLES", 1)):
            view = about["bufferViews"][accessor["bufferView"]]
            rows = np.frombuffer(bytes(whole), "<u4", width * accessor["count"], view["byteOffset"]).reshape(-1, width)
            data = library.encode_gltf_buffer(rows if width > 1 else rows[:, 0], mode, 1 if how == "KHR" else 0)
            inner = about["bufferViews"][part(about, whole, data)]
            said = inner | {"count": len(rows), "mode": mode, "byteStride": 4 * width}
            view |= {"buffer": 1, "byteOffset": 0, "extensions": {f"{how}_meshopt_compression": said}}
        about["buffers"] = [{}, {"byteLength": 1, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}]
    about["buffers"][0] = {"byteLength": len(whole)}
    path.write_bytes(packed(about, whole))
    return about


def test_a_gltf_without_scenes_is_the_scene_of_its_nodes(tmp_path):
    write_mesh(tmp_path / "a.glb", BALL, np.array([0.0, 1, 0]))
    about, whole = unpacked(tmp_path / "a.glb")
    del about["scenes"], about["scene"]
    (tmp_path / "a.glb").write_bytes(packed(about, whole))
    np.testing.assert_allclose(read_mesh(tmp_path / "a.glb").vertices, BALL.vertices, atol=1e-6)


@pytest.mark.parametrize("how", ["draco", "EXT", "KHR"])
def test_packed_meshes_are_unpacked(tmp_path, how):
    packed_ball(tmp_path / "a.glb", how)
    found = read_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(found.vertices, BALL.vertices, atol=1e-5)
    np.testing.assert_array_equal(found.colours, BALL.colours)
    first, second = (np.sort(faces, 1) for faces in (found.faces, BALL.faces))
    assert {*map(tuple, first)} == {*map(tuple, second)} and len(first) == len(second)


@pytest.mark.parametrize(("how", "library"), [("draco", "DracoPy"), ("EXT", "meshopt")])
def test_packed_meshes_name_the_package_that_unpacks_them(tmp_path, how, library, monkeypatch):
    about = packed_ball(tmp_path / "a.glb", how)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(LumigraphError, match=f"which {library} reads; install it: pip install 'lumigraph"):
        read_mesh(tmp_path / "a.glb")
    monkeypatch.undo()
    view = about["bufferViews"][-1]
    (tmp_path / "a.glb").write_bytes(packed(about, bytearray(view["byteOffset"] + view["byteLength"])))
    with pytest.raises(LumigraphError, match="is damaged where .* packs it"):
        read_mesh(tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("material", "colours"),
    [
        ({"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 0.5, 1]}}, [188, 188, 188]),
        ({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, "picture"),
        ({"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}}}, "picture"),
    ],
)
@pytest.mark.parametrize("kind", ["png", "webp", "ktx2"])
def test_colours_of_gltf_are_those_of_its_material(tmp_path, material, colours, kind):
    if kind == "ktx2" and colours == "picture":
        pytest.importorskip("opengl_basisu")
    write_gltf(
        tmp_path / "a.gltf", {"componentType": 5126, "views": [(0, 48)], "bufferView": 0, "count": 4} | VECTOR, FLOATS
    )
    about = json.loads((tmp_path / "a.gltf").read_text())
    uv = np.array([[10, 10], [10, 90], [90, 10], [90, 90]], "<u2")  # in hundredths, as quantisation has them
    about["buffers"].append({"uri": "data:;base64," + base64.b64encode(uv.tobytes()).decode(), "byteLength": 16})
    about["bufferViews"].append({"buffer": 1, "byteLength": 16})
    about["accessors"].append({"bufferView": 1, "componentType": 5123, "count": 4, "type": "VEC2"})
    about["meshes"][0]["primitives"][0] |= {"material": 0}
    about["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 1
    for said in (material.get("pbrMetallicRoughness", {}), *material.get("extensions", {}).values()):
        for link in (x for x in said.values() if isinstance(x, dict)):
            link["extensions"] = {"KHR_texture_transform": {"scale": [0.01, 0.01]}}
    picture = np.repeat([[[255, 0, 0]], [[0, 0, 255]]], 4, 0).astype(np.uint8).repeat(8, 1)
    if kind == "ktx2":
        (tmp_path / "my picture.ktx2").write_bytes(base64.b64decode(KTX2))
    else:
        Image.fromarray(picture).save(tmp_path / f"my picture.{kind}", lossless=True)
    named = {"ktx2": "KHR_texture_basisu", "webp": "EXT_texture_webp"}
    source = {"extensions": {named[kind]: {"source": 0}}} if kind in named else {"source": 0}
    about |= {"materials": [material], "textures": [source], "images": [{"uri": f"my%20picture.{kind}"}]}
    (tmp_path / "a.gltf").write_text(json.dumps(about))
    expected = [[255, 0, 0], [0, 0, 255], [255, 0, 0], [0, 0, 255]] if colours == "picture" else [colours] * 4
    np.testing.assert_allclose(read_mesh(tmp_path / "a.gltf").colours.astype(int), expected, atol=8)
