"""Datasets: shapes against what geometry says of them, collections, and one door to all."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import tiny
import tiny_collection
import tiny_shapes
import torch
import trimesh

from lumigraph import methods
from lumigraph.commands.cli import main
from lumigraph.datasets.collection import Collection
from lumigraph.datasets.dataset import Dataset
from lumigraph.datasets.scene import Scene
from lumigraph.datasets.shapes import PointBatch, Shapes
from lumigraph.datasets.shapes.triangles import Triangles
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.opening import kind_of, open_dataset
from lumigraph.readers import meshes
from lumigraph.run import Run, build
from lumigraph.training import fit

CPU = torch.device("cpu")


def anywhere(count: int, generator: torch.Generator) -> torch.Tensor:
    """Points all over the cube."""
    return 2 * torch.rand(count, 3, generator=generator) - 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tiny_shapes.write(tmp_path_factory.mktemp("shapes") / "three")


@pytest.mark.parametrize("data", [tiny.scene(), tiny_shapes.shapes(), tiny_collection.collection()])
def test_all_kinds_keep_the_protocol(data):
    members = [name for name in (*vars(Dataset), *Dataset.__annotations__) if not name.startswith("_")]
    assert "preview" in members and "kind" in members and all(hasattr(data, name) for name in members)
    assert data.kind in ("photographs", "shapes", "a collection")
    assert set(data.splits) == {"train", "test"} and max(map(max, data.splits.values())) < len(data.names)
    camera = data.preview()
    assert len(camera) == 1 and abs(float(camera.position.norm()) - 2.8) < 0.5


# Shapes


def test_a_box_is_as_far_as_geometry_says(generator):
    """Inigo Quilez's distance of a box; the normalised one is 1.8 x 0.9 x 0.45."""
    points, half = anywhere(2000, generator), torch.tensor([0.9, 0.45, 0.225])
    q = points.abs() - half
    expected = q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)
    assert (tiny_shapes.box().distance(points) - expected).abs().max() < 1e-6
    assert torch.equal(tiny_shapes.box().inside(points), (q < 0).all(-1))


def test_winding_far_away_is_near_the_exact_sum(generator):
    ball, points = tiny_shapes.ball(), anywhere(500, generator).numpy()
    exact, quick = ball._triangles.winding(points, math.inf), ball._triangles.winding(points)
    assert np.abs(exact - exact.round()).max() < 1e-9 and set(exact.round()) == {0.0, 1.0}
    assert np.abs(quick - exact).max() < 0.05 and (quick != exact).any()


def test_the_nearest_triangle_is_found_among_many(generator):
    """Against the nearest of very many points of each triangle."""
    corners = torch.rand(40, 3, 3, generator=generator, dtype=torch.float64).numpy()
    points = 2 * torch.rand(20, 3, generator=generator, dtype=torch.float64).numpy() - 0.5
    distance, face = Triangles(corners).nearest(points)
    a, b = np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60), indexing="ij")
    a, b = a[a + b <= 1], b[a + b <= 1]
    dense = np.einsum("sc,fcx->fsx", np.stack([1 - a - b, a, b], -1), corners)
    apart = np.linalg.norm(points[:, None, None] - dense, axis=-1).min(-1)
    assert (distance <= apart.min(-1) + 1e-12).all() and np.abs(distance - apart.min(-1)).max() < 0.01
    assert np.abs(apart[np.arange(20), face] - apart.min(-1)).max() < 0.01


def test_surfaces_are_drawn_evenly_with_their_normals(generator):
    batch = tiny_shapes.ball().surface(4000, generator)
    assert (batch.points.norm(dim=-1) - 0.9).abs().max() < 0.01
    assert (batch.normals * batch.points).sum(-1).min() > 0.87  # outwards
    assert batch.points.mean(0).norm() < 0.05 and abs(float((batch.points[:, 2] > 0.45).float().mean()) - 0.25) < 0.03


def test_sampling_is_near_the_surface_and_elsewhere(generator):
    batch = tiny_shapes.several().sample(1000, generator, near=0.5, spread=0.01, split="train")
    assert isinstance(batch, PointBatch) and len(batch) == 1000 and batch.to("cpu").occupancy.shape == (1000,)
    assert (batch.distance[:500].abs() < 0.05).all() and (batch.distance[500:].abs() > 0.05).float().mean() > 0.6
    assert torch.equal(batch.distance < 0, batch.occupancy == 1) and (batch.member == 1).all()
    again = tiny_shapes.several().sample(1000, torch.Generator().manual_seed(0), spread=0.01)
    assert torch.equal(again.points, batch.points)
    both = Shapes([tiny_shapes.ball(), tiny_shapes.box()], {"train": torch.arange(2)}).sample(90, generator, members=3)
    assert len(both) == 90 and set(both.member.bincount(minlength=2).tolist()) <= {0, 30, 60, 90}


def test_files_come_normalised_and_lead_back(folder, generator):
    with pytest.warns(LumigraphWarning) as told:
        shapes = open_dataset(folder)
    assert isinstance(shapes, Shapes) and shapes.names == ["ball", "box", "cloud"]
    assert (
        "cloud: a cloud of points has no inside" in str(told[0].message)
        and "box: the surface is not" in shapes.warnings[1]
    )
    ball, box, cloud = shapes.members
    assert [x.closed for x in shapes.members] == [True, False, False] and cloud.is_cloud
    for shape, extent in ((ball, [0.5] * 3), (box, [2.0, 1.0, 0.5]), (cloud, [0.5] * 3)):
        assert np.abs(shape.mesh.vertices).max() == pytest.approx(0.9)
        back = shape.mesh.in_source(shape.frame).vertices
        assert np.ptp(back, 0) == pytest.approx(extent, abs=1e-6)
    up = shapes.members[1].mesh.vertices  # the file's y is up
    assert np.ptp(up, 0) == pytest.approx([1.8, 0.45, 0.9], abs=1e-6)
    assert (box.distance(anywhere(100, generator)) >= 0).all()
    known = cloud.known(torch.zeros(1, 3))
    assert known.occupancy is None and known.distance.item() == pytest.approx(0.9, abs=0.02)
    seen = cloud.surface(50, generator)
    assert (seen.points * seen.normals).sum(-1).min() > 0.85
    assert shapes.frame.bounds == ((-1.0,) * 3, (1.0,) * 3) and shapes.splits["test"].tolist() == [0]


def test_a_mesh_that_is_inside_out_is_turned(tmp_path):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.invert()
    ball.export(tmp_path / "ball.off")
    shape = open_dataset(tmp_path / "ball.off").members[0]
    assert shape.closed and shape.distance(torch.zeros(1, 3)).item() < -0.8


def test_a_material_is_the_colour_of_what_has_no_texture(tmp_path):
    """Two triangles without texture coordinates, each of a material of its own."""
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 0 1 1\n"
    (tmp_path / "two.obj").write_text(f"mtllib two.mtl\n{corners}usemtl red\nf 1 2 3\nusemtl blue\nf 4 5 6\n")
    (tmp_path / "two.mtl").write_text("newmtl red\nKd 0.8 0.2 0.0\n\nnewmtl blue\nKd 0.0 0.4 1.0\n")
    mesh = meshes.read_shape(tmp_path / "two.obj", "two").mesh
    red, blue = (mesh.vertices[(mesh.colours == colour).all(-1)] for colour in ((204, 51, 0), (0, 102, 255)))
    assert len(red) == len(blue) == 3
    assert np.ptp(red[:, 1]) < 1e-6 and np.ptp(blue[:, 1]) < 1e-6  # the file's z, which is up no more
    assert red[0, 1] > blue[0, 1] + 0.1
    (tmp_path / "two.mtl").unlink()
    assert (meshes.read_shape(tmp_path / "two.obj", "two").mesh.colours == 160).all()


@pytest.mark.parametrize("content", ["", "v 0 0 0\n", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "v a b c\nf 1 2 3\n"])
def test_what_is_no_mesh_is_refused_in_one_sentence(tmp_path, content):
    (tmp_path / "a.obj").write_text(content)
    with pytest.raises(LumigraphError, match="a.obj"):
        open_dataset(tmp_path / "a.obj")


def test_bad_meshes_are_refused_in_one_sentence(tmp_path, monkeypatch):
    """NaN corners, triangles without an area, and more triangles than memory holds."""
    broken = trimesh.creation.box()
    broken.vertices[0, 0] = np.nan
    broken.export(tmp_path / "a.ply")
    with pytest.raises(LumigraphError, match=r"a\.ply has points that are not finite"):
        open_dataset(tmp_path / "a.ply")
    (path := tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nv 3 0 0\nf 1 2 3\nf 2 3 4\n")
    with pytest.raises(LumigraphError, match=r"a\.obj has triangles, and none of them has an area"):
        open_dataset(path)
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n" + "f 1 2 3\nf 2 3 4\n" * 50_000)
    monkeypatch.setattr("lumigraph.system.memory.free_memory", lambda: 20_000_000)
    with pytest.raises(LumigraphError, match=r"a\.obj has 100,000 triangles, which would need 0\.1 GB"):
        open_dataset(path)


def test_normals_that_are_none_do_not_count(tmp_path):
    """A cloud whose file has a normal of zero or of NaN has no normals, as one whose file has no such columns."""
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
    )
    for normal, known in (("0 0 2", True), ("0 0 0", False), ("nan 0 1", False)):
        rows = f"0 0 0 0 0 1\n1 0 0 {normal}\n0 1 0 1 0 0\n"
        (tmp_path / "a.ply").write_text(head + "end_header\n" + rows)
        normals = meshes.read_shape(tmp_path / "a.ply", "a").normals
        assert (normals is not None) == known
        if normals is not None:
            assert np.abs(np.linalg.norm(normals, axis=-1) - 1).max() < 1e-9


# Collections


def test_members_open_when_asked():
    opened = []

    def opener(name):
        return lambda: opened.append(name) or tiny_collection.tinted(name)

    data = Collection.of({name: opener(name) for name in ("white", "amber", "blue")}, "in memory")
    assert opened == [] and data.names == ["amber", "blue", "white"] and data.splits["test"].tolist() == [0]
    number, member = data.sample_member(torch.Generator().manual_seed(1))
    assert opened == [data.names[number]] and number > 0 and data[data.names[number]] is member
    assert [name for name, _ in data.members("test")] == ["amber"]
    assert data.frame.background == member.frame.background and data.frame.bounds == ((-1.0,) * 3, (1.0,) * 3)


def test_folders_of_scenes_and_of_shapes(tmp_path, folder):
    for name in ("a", "b"):
        tiny.write_blender(tmp_path / "scenes" / name)
    data = open_dataset(tmp_path / "scenes", downscale=2)
    assert isinstance(data, Collection) and data.names == ["a", "b"]
    assert isinstance(data["b"], Scene) and data["b"].cameras.size[0].tolist() == [12, 12]
    assert kind_of(tmp_path / "scenes" / "a") is Scene and kind_of("procedural:still-life") is Scene
    assert kind_of(folder) is Shapes and kind_of(folder.parent) is Scene and kind_of(folder.parent, Shapes) is Shapes
    assert kind_of(folder, Collection) is Collection and isinstance(open_dataset(folder, Collection)["ball"], Shapes)
    with pytest.raises(LumigraphError, match="does not exist"):
        kind_of(tmp_path / "nowhere.obj")


# What learns from them


@pytest.mark.parametrize(
    ("method", "source", "words"),
    [
        ("voxel-grid", "ball.obj", "voxel-grid learns from photographs, and .*ball.obj holds shapes.*distance-grid"),
        ("distance-grid", "procedural:still-life", "learns from shapes, and .* holds photographs"),
        ("tinted-grid", "ball.obj", "learns from a collection, and .* holds shapes"),
    ],
)
def test_train_refuses_another_kind(folder, tmp_path, capsys, method, source, words):
    place = source if ":" in source else str(folder / source)
    assert main(["train", method, place, "--steps", "1", "--output", str(tmp_path / "run")]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1 and not (tmp_path / "run").exists()
    with pytest.raises(LumigraphError, match=words):
        raise LumigraphError(told[0])


def test_fit_refuses_another_kind():
    with pytest.raises(LumigraphError, match="voxel-grid learns from photographs, and in memory holds shapes"):
        fit(tiny.method(), tiny_shapes.shapes(), steps=1, show=False)


def test_options_of_photographs_are_refused_for_shapes(folder, tmp_path, capsys):
    command = ["train", "distance-grid", str(folder / "ball.obj"), "--steps", "1", "--output", str(tmp_path / "run")]
    assert main([*command, "--views", "3"]) == 2 and "--views is about photographs" in capsys.readouterr().err


def begin(name: str, data: Dataset, folder) -> Run:
    kind = methods.find(name)
    return Run.create(folder, build(kind, data.frame, kind.Config(), CPU, 0), data)


def test_a_run_without_cameras_has_a_ring(tmp_path):
    run = begin("distance-grid", tiny_shapes.shapes(), tmp_path / "run")
    assert not (run.folder / "cameras.json").exists() and not run.photographed and run.kind == "shapes"
    cameras = run.cameras()["train"]
    assert len(cameras) == 24 and run.view_names() == {}
    towards = -cameras.position / cameras.position.norm(dim=-1, keepdim=True)
    assert (towards * cameras.forward).sum(-1).min() > 0.999
    photographs = Run(tiny.new_run(tmp_path / "other").folder)
    assert photographs.photographed and "kind" not in photographs.settings.to_json()["scene"]
    (photographs.folder / "cameras.json").unlink()
    with pytest.raises(LumigraphError, match="cameras.json"):
        photographs.cameras()


def test_from_a_mesh_to_a_film_on_the_command_line(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lumigraph.training.loop.PREVIEW_SIZE", 32)
    run = tmp_path / "run"
    command = ["train", "distance-grid", str(folder / "ball.obj"), "--steps", "20", "--output", str(run)]
    assert main([*command, "--pause-at", "10"]) == 0 and main(["resume", str(run)]) == 0
    assert Run(run).state.step == 20 and all("psnr" not in row for row in Run(run).metrics())
    assert len(Run(run).previews()) >= 3
    assert main(["render", str(run), "--frames", "2", "--size", "32"]) == 0
    assert (run / "renders" / "orbit.mp4").exists()
    assert len(Run(run).survey(Run(run).cameras()["train"])) == 72  # a dome of cameras, not a ring, looks for surfaces
    assert main(["report", str(run)]) == 0 and main(["info", str(run)]) == 0 and main(["info", str(folder)]) == 0
    page = (run / "report.html").read_text()
    assert "trained on 1 shape" in page and "PSNR" not in page and "distance" in page
    assert "closed" in capsys.readouterr().out
    with pytest.raises(LumigraphError, match="bounds differ"):
        Run(run).dataset(str(folder / "box.ply"))


def test_what_is_told_reaches_the_colours():
    """A collection's method, told of a member that it has not learnt from."""
    data, kind = tiny_collection.collection(), methods.find("tinted-grid")
    method = build(kind, data.frame, kind.Config(), CPU, 0)
    fit(method, data, steps=40, show=False)
    camera = data["amber"].cameras[0]
    red, blue = (method.given(tiny_collection.tinted(name)).render(camera).rgb[12, 12] for name in ("amber", "blue"))
    assert red[0] > red[2] and blue[2] > blue[0]
    with pytest.raises(LumigraphError, match="cannot be given a Shapes; it takes Scene"):
        method.given(tiny_shapes.shapes())


def test_a_config_names_the_kind(tmp_path):
    run = begin("tinted-grid", tiny_collection.collection(), tmp_path / "run")
    scene = json.loads((run.folder / "config.json").read_text())["scene"]
    assert scene["kind"] == "a collection" and dataclasses.asdict(run.new_method().config)["cells"] == 12
