"""Depth that comes in otherwise than as a picture beside each photograph: clouds, meshes, phones, another camera."""

from __future__ import annotations

import base64
import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from budgets import budget
from PIL import Image
from test_depth_readers import SIZE, picture, poses, write_scannet

from lumigraph.camera.lens import Pinhole
from lumigraph.errors import LumigraphError
from lumigraph.opening import open_scene, read_capture
from lumigraph.readers.inner_depth import InnerDepth, inner_depth, of_heic, of_jpeg
from lumigraph.readers.surveyed import Surveyed, registered, seen_depth, with_surveyed

pytestmark = budget("capture", 8)
LENS = Pinhole(torch.tensor([[20.0, 20.0]]), torch.tensor([[20.0, 15.0]]))  # half a right angle to each side


def write_posed(folder, depth: str | None = None, **about) -> None:
    """Three photographs with poses and a wide lens, as transforms.json has them."""
    flip, frames = np.diag([1.0, -1, -1, 1]), []
    for i, pose in enumerate(poses()):
        picture(folder / f"{i}.png")
        one = {"file_path": f"{i}.png", "transform_matrix": (pose @ flip).tolist()}
        frames.append(one | ({"depth_file_path": depth.format(i)} if depth else {}))
    camera = {"fl_x": 20.0, "fl_y": 20.0, "cx": 20.0, "cy": 15.0, "w": 40, "h": 30}
    (folder / "transforms.json").write_text(json.dumps(camera | about | {"frames": frames}))


def wall_points(count: int = 40_000) -> np.ndarray:
    """A wall at z = 1.7, two metres before the cameras of `poses`."""
    x, y = np.random.default_rng(0).uniform(-3, 3, (2, count))
    return np.stack([x, y, np.full(count, 1.7)], -1)


def write_cloud(path, points: np.ndarray) -> None:
    if path.suffix == ".e57":
        pye57 = pytest.importorskip("pye57")
        with pye57.E57(str(path), mode="w") as file:
            file.write_scan_raw({f"cartesian{a}": points[:, i].copy() for i, a in enumerate("XYZ")})
    elif path.suffix in (".las", ".laz"):
        laspy = pytest.importorskip("laspy")
        header = laspy.LasHeader(point_format=0, version="1.2")
        header.scales, header.offsets = np.full(3, 1e-4), points.mean(0)
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = points.T
        cloud.write(path)
    elif path.suffix == ".ply":
        trimesh.PointCloud(points).export(path)
    else:
        corners = np.array([[-3, -3, 1.7], [3, -3, 1.7], [3, 3, 1.7], [-3, 3, 1.7]])
        trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False).export(path)


@pytest.mark.parametrize("name", ["wall.las", "wall.laz", "wall.e57", "wall.ply", "wall.obj"])
def test_a_cloud_or_a_mesh_is_the_depth_of_every_photograph(name, tmp_path):
    """Back-projected through a wide lens, depth lies on the wall; along the axis taken for along the ray it would be
    30 % off in the corners."""
    write_posed(tmp_path / "scan")
    write_cloud(tmp_path / name, wall_points())
    scene = open_scene(tmp_path / "scan", depth_from=tmp_path / name)
    for i in range(len(scene)):
        photograph = scene.photograph(i, ("depth",))
        measured = photograph.extra["depth"]
        known = measured.isfinite()
        assert float(known.float().mean()) > 0.95
        rays = photograph.camera.rays(photograph.camera.pixels()[known.flatten()])
        places = scene.frame.to_source.points(rays.at(measured[known]))
        error = (places[:, 2] - 1.7).abs()
        assert float(error.mean()) < 0.02 and float(error.max()) < 0.2


def test_what_a_cloud_hides_is_not_seen_through_its_gaps():
    """A sparse wall at 2 m before a dense one at 4 m: between its points the far one is not taken for seen."""
    x, y = np.meshgrid(np.linspace(-4, 4, 90), np.linspace(-4, 4, 90))
    near = np.stack([x, y, np.full_like(x, 2)], -1).reshape(-1, 3)
    far = np.concatenate([2 * wall_points(60_000)[:, :2], np.full((60_000, 1), 4.5)], 1)
    found = Surveyed(np.concatenate([near, far]), np.zeros((0, 3), np.int64))
    depth = seen_depth(np.eye(3, 4), LENS, SIZE, found)
    along = depth * np.cos(np.arctan(np.hypot(*np.meshgrid(np.arange(40) - 19.5, np.arange(30) - 14.5)) / 20))
    assert np.nanmax(along) < 2.6 and np.isfinite(along).mean() > 0.5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: p * 1000, "scale it by 0.001"),
        (lambda p: p + [0, 0, 40], "register it to the capture's frame"),
    ],
)
def test_a_cloud_in_another_frame_is_refused(change, said, tmp_path):
    write_posed(tmp_path / "scan")
    write_cloud(tmp_path / "wall.ply", change(wall_points(4000)))
    capture = replace(read_capture(tmp_path / "scan"), points=wall_points(500))
    with pytest.raises(LumigraphError, match=said):
        with_surveyed(capture, tmp_path / "wall.ply")


def test_a_cloud_that_no_photograph_sees_is_refused(tmp_path):
    write_posed(tmp_path / "scan")
    write_cloud(tmp_path / "wall.ply", wall_points(4000) * [1, 1, -1])
    with pytest.raises(LumigraphError, match="no photograph sees it"):
        open_scene(tmp_path / "scan", depth_from=tmp_path / "wall.ply")
    with pytest.raises(LumigraphError, match="neither a cloud nor a mesh"):
        open_scene(tmp_path / "scan", depth_from=tmp_path / "scan" / "0.png")


# Phones


def jpeg(xmp: str, behind: bytes = b"") -> bytes:
    """A photograph with XMP, and what lies behind it."""
    data = io.BytesIO()
    Image.new("RGB", SIZE, (90, 90, 90)).save(data, "JPEG")
    part = b"http://ns.adobe.com/xap/1.0/\0" + xmp.encode()
    whole = data.getvalue()
    return whole[:2] + b"\xff\xe1" + (len(part) + 2).to_bytes(2) + part + whole[2:] + behind


def png(values: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(values).save(data, "PNG")
    return data.getvalue()


STORED = np.array([[0, 51], [204, 255]], np.uint8)  # 0, 1/5, 4/5, 1


def test_dynamic_depth_and_its_forerunner_are_read():
    """Z = far near / (far - v (far - near)) is near for 0 and far for 1; RangeLinear is linear; units count."""
    picture_of_depth = png(STORED)
    inside = (
        '<rdf:li><Container:Item Item:Mime="image/jpeg" Item:Semantic="Primary"/></rdf:li>'
        f'<rdf:li><Container:Item Item:Mime="image/png" Item:Semantic="Depth" Item:Length="{len(picture_of_depth)}"/>'
        '</rdf:li><rdf:li><Container:Item Item:Semantic="Confidence" Item:Length="3"/></rdf:li>'
        '<Depth:Map Depth:Format="RangeInverse" Depth:Near="500" Depth:Far="4000" Depth:Units="Millimeters" '
        'Depth:MeasureType="OpticRay"/>'
    )
    found = of_jpeg(jpeg(inside, picture_of_depth + b"abc"))
    assert found is not None and found.along_ray
    expected = [[0.5, 2 / (4 - 0.2 * 3.5)], [2 / (4 - 0.8 * 3.5), 4.0]]
    np.testing.assert_allclose(found.metres, expected, rtol=1e-6)
    older = base64.b64encode(picture_of_depth).decode()
    found = of_jpeg(jpeg(f'<x GDepth:Format="RangeLinear" GDepth:Near="1" GDepth:Far="2" GDepth:Data="{older}"/>'))
    assert found is not None and not found.along_ray
    np.testing.assert_allclose(found.metres, [[1, 1.2], [1.8, 2]], rtol=1e-6)
    assert of_jpeg(jpeg("<x/>")) is None
    assert of_jpeg(jpeg(f'<x GDepth:Near="1" GDepth:Far="2" GDepth:Units="Diopters" GDepth:Data="{older}"/>')) is None


def test_apples_disparity_is_one_over_metres(monkeypatch, tmp_path):
    """1 / Z from d_min to d_max; a disparity of 0 is infinitely far, hence unknown."""
    about = {"representation_type": 1, "d_min": 0.0, "d_max": 2.0}
    aux = SimpleNamespace(info={"metadata": about}, to_pillow=lambda: Image.fromarray(STORED))

    class Opened:
        info = {"depth_images": [aux]}
        __enter__ = lambda self: self  # noqa: E731
        __exit__ = lambda self, *_: None  # noqa: E731

    monkeypatch.setattr(Image, "open", lambda path: Opened())
    monkeypatch.setattr("lumigraph.readers.inner_depth.reads_heic", lambda: True)
    found = of_heic(tmp_path / "a.heic")
    assert found is not None
    np.testing.assert_allclose(found.metres, [[np.nan, 2.5], [0.625, 0.5]], rtol=1e-6)


def test_depth_inside_a_photograph_becomes_its_layer(tmp_path):
    """Upright as the photograph is, in metres along the axis."""
    write_posed(tmp_path / "scan")
    values = np.full((15, 20), 102, np.uint8)
    values[:, 10:] = 204
    stored = base64.b64encode(png(values)).decode()
    for i in range(3):
        (tmp_path / "scan" / f"{i}.png").unlink()
        data = jpeg(f'<x GDepth:Format="RangeLinear" GDepth:Near="1" GDepth:Far="6" GDepth:Data="{stored}"/>')
        (tmp_path / "scan" / f"{i}.jpg").write_bytes(data)
    text = (tmp_path / "scan" / "transforms.json").read_text().replace(".png", ".jpg")
    (tmp_path / "scan" / "transforms.json").write_text(text)
    assert inner_depth(tmp_path / "scan" / "0.jpg") is not None
    scene = open_scene(tmp_path / "scan")
    photograph = scene.photograph(0, ("depth",))
    rays = photograph.camera.rays(photograph.camera.pixels())
    along = photograph.extra["depth"].flatten() * (rays.directions @ photograph.camera.forward[0])
    along = (along * scene.frame.to_source.scale).view(30, 40)
    torch.testing.assert_close(along[:, :19], torch.full((30, 19), 3.0), atol=1e-3, rtol=0)
    torch.testing.assert_close(along[:, 21:], torch.full((30, 19), 5.0), atol=1e-3, rtol=0)


def test_inner_depth_beyond_all_bounds_is_unknown():
    assert np.isnan(InnerDepth(np.zeros((1, 1)), 0.5, np.inf, "inverse").metres).all()


# Two cameras


def test_depth_of_another_camera_is_carried_over():
    """A depth camera 10 cm to the left, with a wider lens, before a slanted wall."""
    wide = Pinhole(torch.tensor([[15.0, 15.0]]), torch.tensor([[20.0, 15.0]]))
    x = (np.arange(40) + 0.5 - 20) / 15
    stored = np.repeat((2 / (1 - 0.3 * x))[None], 30, 0)  # the plane z = 2 + 0.3 x
    shift = np.eye(3, 4)
    shift[0, 3] = -0.1  # from the depth camera's frame to that of the colours
    found = registered(stored, wide, LENS.resized(torch.tensor([[2.0, 2.0]])), (80, 60), shift)
    assert found.shape == (30, 40) and np.isfinite(found).mean() > 0.5
    rows, columns = np.nonzero(np.isfinite(found))
    pixels = torch.from_numpy(np.stack([columns, rows], -1) + 0.5).float()
    points = LENS.unproject(pixels) * torch.from_numpy(found[rows, columns])[:, None]
    error = points[:, 2] - (2 + 0.3 * (points[:, 0] + 0.1))
    assert float(error.abs().mean()) < 0.03


def test_scannets_depth_camera_is_another(tmp_path):
    write_scannet(tmp_path / "same")
    camera = np.eye(4)
    camera[:2, :3] = [[17.5, 0, 9.5], [0, 17.5, 7.0]]
    for name, scale in (("same", 1.0), ("other", 0.7)):
        if name == "other":
            write_scannet(tmp_path / name)
        np.savetxt(
            tmp_path / name / "frames" / "intrinsic" / "intrinsic_depth.txt", camera * [[scale], [scale], [1], [1]]
        )
    kinds = [read_capture(tmp_path / name).shots[0].planes["depth"].encoding for name in ("same", "other")]
    assert kinds == ["z-depth", "distance"]
    measured = open_scene(tmp_path / "other").photograph(0, ("depth",)).extra["depth"]
    assert measured.isfinite().float().mean() > 0.3


@pytest.mark.parametrize("along_ray", [False, True])
def test_axis_and_ray_are_never_mixed_up(along_ray, tmp_path):
    """A wide lens: the same numbers are a wall along the axis, and a ball around the camera along the ray."""
    (tmp_path / "scan").mkdir()
    values = np.full((30, 40), 2000, np.uint16)
    for i in range(3):
        Image.fromarray(values).save(tmp_path / "scan" / f"depth{i}.png")
    about = {"depth_unit_scale_factor": 1e-3, "is_euclidean_depth": along_ray}
    write_posed(tmp_path / "scan", "depth{}.png", **about)
    scene = open_scene(tmp_path / "scan")
    photograph = scene.photograph(0, ("depth",))
    camera = photograph.camera
    points = camera.rays(camera.pixels()).at(photograph.extra["depth"].flatten()) - camera.position
    length = points.norm(dim=-1) if along_ray else points @ camera.forward[0]
    torch.testing.assert_close(length * scene.frame.to_source.scale, torch.full((1200,), 2.0), atol=1e-3, rtol=0)


def test_pictures_without_depth_inside_stay_as_they_are(tmp_path):
    write_posed(tmp_path / "scan")
    assert all(not shot.planes for shot in read_capture(tmp_path / "scan").shots)
