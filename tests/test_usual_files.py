"""Sound files of further programs: what they hold is used, or a sentence says why it is not."""

from __future__ import annotations

import json
import struct
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pycolmap
import pytest
import torch
import trimesh
from captures import HEIGHT, WIDTH, Tiny, write_colmap, write_ngp
from PIL import Image
from ply_files import ply_file

from lumigraph.commands.cli import main
from lumigraph.datasets.mesh import Mesh, MeshTexture
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.exchange import read_gaussians, read_moving, write_gaussians
from lumigraph.export.mesh_file import files_of, write_mesh
from lumigraph.gaussians import Gaussians
from lumigraph.opening import open_dataset, read_capture
from lumigraph.readers.meshes import read_mesh
from lumigraph.sfm.photos import gather
from lumigraph.viewer.address import Address, PortTakenError, at_free_address

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
ROWS = [" ".join(map(str, row)) for row in CORNERS]
SIDES = ["3 " + " ".join(map(str, face)) for face in FACES]


@pytest.fixture(scope="module")
def tiny() -> Tiny:
    return Tiny(count=6)


# Photographs and poses


def doubled(folder: Path, **change) -> Path:
    """A capture whose first frame is listed twice, the second time with a change."""
    whole = json.loads((folder / "transforms.json").read_text())
    whole["frames"].append(whole["frames"][0] | change)
    (folder / "transforms.json").write_text(json.dumps(whole))
    return folder


@pytest.mark.parametrize("name", ["images/view_00.png", "./images/view_00.png", "images\\view_00.png"])
def test_a_frame_that_is_listed_twice_counts_once(tiny, tmp_path, name):
    capture = read_capture(doubled(write_ngp(tmp_path, tiny), file_path=name))
    assert len(capture.shots) == 6
    (note,) = (note for note in capture.notes if "more than once" in note)
    assert "1 photograph more" in note and "poses" not in note


def test_a_frame_with_two_poses_keeps_the_first_and_moments_are_apart(tiny, tmp_path):
    folder = write_ngp(tmp_path / "a", tiny)
    other = json.loads((folder / "transforms.json").read_text())["frames"][3]["transform_matrix"]
    capture = read_capture(doubled(folder, transform_matrix=other))
    np.testing.assert_array_equal(capture.shots[0].pose, tiny.poses[0][:3])
    assert len(capture.shots) == 6 and any("first of its poses" in note for note in capture.notes)
    moving = read_capture(doubled(write_ngp(tmp_path / "b", tiny), time=0.5))
    assert len(moving.shots) == 7 and not any("more than once" in note for note in moving.notes)


@pytest.mark.parametrize("name", ["view_00.gif", "view_00.png.gif", "view_00_mask.gif"])
def test_masks_of_gif_are_used(tiny, tmp_path, name):
    write_colmap(tmp_path, tiny)
    grey = np.full((HEIGHT, WIDTH), 255, np.uint8)
    grey[: HEIGHT // 2] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(grey).save(tmp_path / "masks" / name)
    assert open_dataset(tmp_path).images.trusted_pixels[0] == WIDTH * HEIGHT // 2


@pytest.mark.parametrize("name", ["view_00.npy", "other.png"])
def test_masks_that_are_not_used_are_named(tiny, tmp_path, name):
    write_colmap(tmp_path, tiny)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / name).write_bytes(b"mask")
    with pytest.warns(LumigraphWarning, match=f"such as {name}"):
        read_capture(tmp_path)


@pytest.mark.parametrize("name", ["depth", "normals"])
def test_planes_beside_photographs_are_named(tiny, tmp_path, name):
    write_colmap(tmp_path, tiny)
    (tmp_path / name).mkdir()
    assert any(f"{name} is not used" in note for note in read_capture(tmp_path).notes)


@pytest.mark.parametrize("name", ["sparse_pc.ply", "init.ply"])
def test_points_beside_a_json_start_the_scene(tiny, tmp_path, name):
    write_ngp(tmp_path, tiny)
    trimesh.PointCloud(tiny.points, tiny.colours).export(tmp_path / name)
    np.testing.assert_allclose(read_capture(tmp_path).points, tiny.points, atol=1e-6)


@pytest.mark.parametrize(
    ("values", "unit", "wanted"),
    [(4000, None, None), (400, None, "0.01"), (4000, 1.0, "0.001"), (4.0, None, "1"), (4.0, 1.0, None)],
)
def test_depth_of_another_unit_than_the_points_is_named(tiny, tmp_path, values, unit, wanted):
    """Millimetres are the convention of `depth_file_path`; poses and points are in metres, four from the cameras."""
    write_ngp(tmp_path, tiny, **({} if unit is None else {"depth_unit_scale_factor": unit}))
    trimesh.PointCloud(tiny.points, tiny.colours).export(tmp_path / "sparse_pc.ply")
    whole = json.loads((tmp_path / "transforms.json").read_text())
    suffix = ".npy" if isinstance(values, float) else ".png"
    for i, frame in enumerate(whole["frames"]):
        frame["depth_file_path"] = f"depth/{i}{suffix}"
    (tmp_path / "transforms.json").write_text(json.dumps(whole))
    (tmp_path / "depth").mkdir()
    for i in range(len(whole["frames"])):
        depth = np.full((HEIGHT, WIDTH), values, np.uint16 if suffix == ".png" else np.float32)
        if suffix == ".png":
            Image.fromarray(depth).save(tmp_path / "depth" / f"{i}.png")
        else:
            np.save(tmp_path / "depth" / f"{i}.npy", depth)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = [text for text in open_dataset(tmp_path).warnings if "distance of the sparse points" in text]
    assert [text.split("should be ")[1].split()[0] for text in found] == ([wanted] if wanted else [])


def as_text(folder: Path) -> Path:
    """The model of a capture as text alone."""
    place = folder / "sparse" / "0"
    pycolmap.Reconstruction(place).write_text(place)
    for path in place.glob("*.bin"):
        path.unlink()
    return place


@pytest.mark.parametrize("lost", ["rigs", "frames"])
@pytest.mark.parametrize("text", [False, True])
def test_rigs_of_another_state_do_not_decide(tiny, tmp_path, lost, text):
    """Programs that know COLMAP's three old files alone copy some of the five, or leave two as they were."""
    write_colmap(tmp_path, tiny)
    place = as_text(tmp_path) if text else tmp_path / "sparse" / "0"
    (place / f"{lost}.{'txt' if text else 'bin'}").unlink()
    capture = read_capture(tmp_path)
    np.testing.assert_allclose([shot.pose for shot in capture.shots], [pose[:3] for pose in tiny.poses], atol=1e-6)


def test_rigs_of_more_photographs_than_the_model(tiny, tmp_path):
    few = Tiny(count=6)
    write_colmap(tmp_path, tiny)
    place = tmp_path / "sparse" / "0"
    rigs = {name: (place / name).read_bytes() for name in ("rigs.bin", "frames.bin")}
    few.names, few.poses, few.pictures = tiny.names[:4], tiny.poses[:4], tiny.pictures[:4]
    write_colmap(tmp_path / "b", few)
    for name, data in rigs.items():
        (tmp_path / "b" / "sparse" / "0" / name).write_bytes(data)
    assert len(read_capture(tmp_path / "b").shots) == 4


def test_decimal_commas_in_a_text_model(tiny, tmp_path):
    write_colmap(tmp_path, tiny)
    for path in as_text(tmp_path).glob("*.txt"):
        lines = [x if x.startswith("#") else x.replace(".", ",").replace(",png", ".png") for x in path.open()]
        path.write_text("".join(lines))
    capture = read_capture(tmp_path)
    np.testing.assert_allclose([shot.pose for shot in capture.shots], [pose[:3] for pose in tiny.poses], atol=1e-6)
    assert capture.shots[0].lens.focal[0, 0] == 60


def test_half_a_model_is_named(tiny, tmp_path, capsys):
    write_colmap(tmp_path, tiny)
    (tmp_path / "sparse" / "0" / "cameras.bin").unlink()
    assert main(["info", str(tmp_path)]) == 2
    assert "COLMAP without its cameras" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "form"), [("a.lrv", "mp4"), ("clip", "mp4"), ("a.gif", "gif")])
def test_a_film_is_known_by_its_content(tmp_path, name, form):
    picture = np.random.default_rng(0).integers(0, 255, (64, 96, 3), np.uint8)
    with av.open(str(tmp_path / name), "w", format=form) as film:
        stream = film.add_stream(*(("gif", 10) if form == "gif" else ("libx264", 10)))
        stream.width, stream.height, stream.pix_fmt = 96, 64, "rgb8" if form == "gif" else "yuv420p"
        for i in range(8):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.roll(picture, 4 * i, 1), format="rgb24")))
        film.mux(stream.encode(None))
    assert len(gather([tmp_path / name], tmp_path / "work", frames=4).photos) == 4


def test_a_picture_of_an_unread_kind_is_no_film(tmp_path):
    Image.fromarray(np.zeros((64, 96, 3), np.uint8)).save(tmp_path / "a.tga")
    with pytest.raises(LumigraphError, match="its format is not read here"):
        gather([tmp_path / "a.tga"], tmp_path / "work")


# Meshes


def off(kind: str, rows: list[str], faces: list[str]) -> str:
    return "\n".join([f"{kind}\n# made\n{len(rows)} {len(faces)} 0", *rows, *faces, ""])


@pytest.mark.parametrize(
    ("text", "colour"),
    [
        (off("COFF", [row + " 200 10 20 255" for row in ROWS], SIDES), (200, 10, 20)),
        (off("OFF", [row + " 200 10 20" for row in ROWS], SIDES), (200, 10, 20)),
        (off("COFF", [row + " 0.5 0.25 1.0 1.0" for row in ROWS], SIDES), (128, 64, 255)),
        (off("STCNOFF", [row + " 0 0 1 200 10 20 255 0.5 0.5" for row in ROWS], SIDES), (200, 10, 20)),
        (off("OFF", ROWS, [side + " 255 0 0" for side in SIDES]), (255, 0, 0)),
        (off("OFF", ROWS, [side + " 1.0 0.0 0.0 0.5" for side in SIDES]), (255, 0, 0)),
        (off("NOFF", [row + " 0 0 1" for row in ROWS], [side + " 7" for side in SIDES]), (160, 160, 160)),
        (off("4OFF", [" ".join(str(2 * int(x)) for x in row.split()) + " 2" for row in ROWS], SIDES), (160, 160, 160)),
    ],
)
def test_colours_of_off(tmp_path, text, colour):
    (tmp_path / "a.off").write_text(text)
    mesh = read_mesh(tmp_path / "a.off")
    np.testing.assert_array_equal(mesh.vertices, CORNERS)
    assert mesh.faces.tolist() == FACES and {*map(tuple, mesh.colours.tolist())} == {colour}


def test_points_and_short_files_of_off(tmp_path):
    (tmp_path / "a.off").write_text(f"OFF 4 0 0\n{chr(10).join(ROWS)}\n")
    assert read_mesh(tmp_path / "a.off").vertices.shape == (4, 3)
    (tmp_path / "b.off").write_text(off("OFF", ROWS, SIDES)[:-9])
    with pytest.raises(LumigraphError, match="ends early"):
        read_mesh(tmp_path / "b.off")


@pytest.mark.parametrize(
    ("header", "bits", "colour"),
    [
        (b"", 0x8000 | 31 << 10 | 16 << 5 | 4, (255, 132, 33)),  # VisCAM: blue first
        (b"COLOR=\x0a\x14\x1e\xff", 31 | 16 << 5 | 4 << 10, (255, 132, 33)),  # Magics: red first
        (b"COLOR=\x0a\x14\x1e\xff", 0x8000, (10, 20, 30)),  # the colour of the whole
        (b"", 0, (160, 160, 160)),
    ],
)
def test_colours_of_stl(tmp_path, header, bits, colour):
    data = bytearray(trimesh.Trimesh(CORNERS, FACES, process=False).export(file_type="stl"))
    data[:80] = header.ljust(80)
    for at in range(84 + 48, len(data), 50):
        struct.pack_into("<H", data, at, bits)
    (tmp_path / "a.stl").write_bytes(data)
    assert {*map(tuple, read_mesh(tmp_path / "a.stl").colours.tolist())} == {colour}


def test_several_files_of_materials_on_one_line(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl r\nKd 1 0 0\n")
    (tmp_path / "b.mtl").write_text("newmtl g\nKd 0 1 0\n")
    corners = "".join(f"v {row}\n" for row in ROWS)
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl b.mtl\n{corners}usemtl r\nf 1 2 3\nusemtl g\nf 1 2 4\n")
    assert {*map(tuple, read_mesh(tmp_path / "a.obj").colours.tolist())} == {(255, 0, 0), (0, 255, 0)}


def test_blanks_in_the_name_of_a_textured_obj(tmp_path):
    texture = MeshTexture(np.eye(3)[:, :2], np.zeros((8, 8, 3), np.uint8), None)
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.zeros((3, 3), np.uint8), texture)
    written = write_mesh(path := tmp_path / "my scene.obj", mesh)
    assert [file.name for file in written] == ["my scene.obj", "my_scene.mtl", "my_scene.png"]
    assert {*written} <= {*files_of(path, texture=True)}
    assert "mtllib my_scene.mtl\n" in path.read_text() and "map_Kd my_scene.png\n" in written[1].read_text()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_mesh(path)


def test_a_gltf_of_lines_alone_says_so(tmp_path):
    (tmp_path / "a.glb").write_bytes(trimesh.Scene(trimesh.load_path(CORNERS)).export(file_type="glb"))
    with pytest.raises(LumigraphError, match="neither triangles nor points"):
        read_mesh(tmp_path / "a.glb")


# Splats, and the viewer


def test_kernels_that_are_no_gaussians_are_named(tmp_path):
    names = [
        "x",
        "y",
        "z",
        "sh0_0",
        "sh0_1",
        "sh0_2",
        "sb_params_0",
        "opacity",
        "beta",
        "scale_0",
        "scale_1",
        "scale_2",
    ]
    names += [f"rot_{i}" for i in range(4)]
    rows = torch.randn(5, len(names)).tolist()
    (tmp_path / "a.ply").write_bytes(ply_file([("vertex", dict.fromkeys(names, "float"), rows)]))
    with pytest.raises(LumigraphError, match="Beta Splatting"):
        read_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["a.drc", "a.h5"])
def test_files_of_further_programs_are_named(tmp_path, name, capsys):
    (tmp_path / name).write_bytes(b"data")
    assert main(["info", str(tmp_path / name)]) == 2
    assert "export" in capsys.readouterr().err


def test_a_clip_keeps_its_duration(tmp_path):
    gaussians = Gaussians(*(torch.ones(5, *x) for x in ((3,), (4,), (3,), (), (1, 3))))
    for i in range(6):
        write_gaussians(tmp_path / "clip" / f"{i}.ply", replace(gaussians, means=gaussians.means + 0.1 * i))
    for more, seconds in (([], 0.2), (["--duration", "2"], 2.0)):
        assert main(["export", "splats", str(tmp_path / "clip"), str(tmp_path / "a.4dgs"), *more, "--overwrite"]) == 0
        assert read_moving(tmp_path / "a.4dgs").duration == pytest.approx(seconds)


def taken(times: int) -> Callable[[Address], Address]:
    """A server whose port another program takes so many times."""
    left = [times]

    def start(address: Address) -> Address:
        left[0] -= 1
        if left[0] >= 0:
            raise PortTakenError(f"Port {address.port} has just been taken")
        return address

    return start


def test_two_viewers_that_start_at_once_both_start():
    assert at_free_address("127.0.0.1", None, "", taken(2)).port >= 8080
    with pytest.raises(PortTakenError):
        at_free_address("127.0.0.1", 0, "", taken(1))
