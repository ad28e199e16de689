"""Fusion of depth maps in hashed blocks: exact surfaces, growth with surface, faults of depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera import Camera
from lumigraph.camera.lens import Equirectangular, OpenCV, Pinhole
from lumigraph.camera.rays import Rendering
from lumigraph.datasets.images import Layer
from lumigraph.depth_maps import DepthMap, VoxelBlocks, release_weight, sensor_faults, trust_of
from lumigraph.errors import LumigraphError
from lumigraph.kernels.block_hash import EMPTY, PRIMES
from lumigraph.kernels.block_surface import triangles
from lumigraph.methods.tsdf_fusion import Config, TSDFFusion

pytestmark = budget("methods", 5)

POSE = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]])
LENSES = {
    "pinhole": (Pinhole(torch.tensor([[60.0, 60.0]]), torch.tensor([[40.0, 30.0]])), (80, 60)),
    "bent": (
        OpenCV(
            torch.tensor([[60.0, 60.0]]),
            torch.tensor([[40.0, 30.0]]),
            torch.tensor([[-0.1, 0.02, 0, 0, 0, 0, 0, 0]]),
        ),
        (80, 60),
    ),
    "all around": (Equirectangular(torch.tensor([[128.0, 64.0]])), (128, 64)),
}


def camera_of(name: str) -> Camera:
    lens, size = LENSES[name]
    return Camera(POSE, lens, torch.tensor([size]))


def depth_map(camera: Camera, distance) -> DepthMap:
    """A depth map of what lies at a distance along each ray, with a colour that says where it points."""
    rays = camera.rays(camera.pixels())
    width, height = camera.size[0].tolist()
    depth = distance(rays.directions).view(height, width)
    return DepthMap.measured(camera, depth, (0.5 + 0.5 * rays.directions).clamp(0, 1).view(height, width, 3))


def wall(directions: torch.Tensor) -> torch.Tensor:
    """The plane z = 1."""
    return torch.where(directions[:, 2] > 0.1, 1 / directions[:, 2], torch.inf)


def ball(directions: torch.Tensor) -> torch.Tensor:
    """A sphere around the camera."""
    return torch.full_like(directions[:, 0], 0.8)


@pytest.mark.parametrize(("name", "shape"), [("pinhole", wall), ("bent", wall), ("all around", ball)])
def test_depth_along_rays_becomes_the_surface_through_any_lens(name, shape):
    """A plane stays flat through a wide lens; with depth along rays taken for that on the axis it would be a bowl."""
    volume, seen = VoxelBlocks(0.02, 4), depth_map(camera_of(name), shape)
    assert volume.fuse(seen, torch.ones_like(seen.depth))
    vertices, rgb, faces = volume.surface()
    error = (vertices[:, 2] - 1).abs() if shape is wall else (vertices.norm(dim=-1) - 0.8).abs()
    assert len(faces) > 1000 and float(error.median()) < 0.002 and float(error.max()) < 0.02
    towards = torch.nn.functional.normalize(vertices, dim=-1)
    assert float((rgb - (0.5 + 0.5 * towards).clamp(0, 1)).abs().mean()) < 0.02
    a, b, c = vertices[faces].unbind(1)
    outward = (torch.linalg.cross(b - a, c - a) * a).sum(-1)
    assert float((outward <= 0).float().mean()) > 0.999  # anticlockwise seen from the camera
    rays = seen.camera.rays(seen.camera.pixels())
    found, normals, _ = volume.cast(rays)
    hit = found.isfinite() & seen.depth.flatten().isfinite()
    assert float(hit.float().mean()) > 0.4
    assert float((found - seen.depth.flatten()).abs()[hit].median()) < 0.002
    assert float((normals * rays.directions).sum(-1)[hit].max()) < 0


def test_a_mean_follows_the_weights():
    """Two walls whose weights are as 1 to 3 (Curless and Levoy 1996, eq. 1)."""
    volume, camera = VoxelBlocks(0.02, 4), camera_of("pinhole")
    for distance, weight in ((1.0, 1.0), (1.02, 3.0)):
        seen = depth_map(camera, lambda d, distance=distance: distance * wall(d))
        volume.fuse(seen, torch.full_like(seen.depth, weight))
    vertices, _, _ = volume.surface()
    assert float(vertices[:, 2].median()) == pytest.approx(1.015, abs=5e-4)
    assert len(volume.surface(min_weight=4.5)[0]) == 0


def every_third(height: int, width: int) -> torch.Tensor:
    return (torch.arange(width) % 3 != 1).expand(height, width)


def pinholes(height: int, width: int) -> torch.Tensor:
    """Depth that is registered to the colours of a finer camera: a quarter is known, in a grid."""
    return (torch.arange(height)[:, None] % 2 == 1) & (torch.arange(width) % 2 == 1)


@pytest.mark.parametrize("unknown", [0.0, torch.nan, torch.inf])
@pytest.mark.parametrize("holes", [every_third, pinholes])
def test_holes_beside_known_depth_lose_no_surface(holes, unknown):
    """The wall is as large with holes as without, and as flat: each voxel takes the nearest known pixel."""
    lens = Pinhole(torch.tensor([[240.0, 240.0]]), torch.tensor([[160.0, 120.0]]))
    camera, areas = Camera(POSE, lens, torch.tensor([[320, 240]])), []
    for kept in (None, holes):
        volume, seen = VoxelBlocks(0.02, 4), depth_map(camera, wall)
        if kept is not None:
            depth = torch.where(kept(*seen.depth.shape), seen.depth, unknown)
            seen = DepthMap.measured(camera, depth, seen.rgb)
        volume.fuse(seen, trust_of(seen, 0.0, 9.0))
        vertices, _, faces = volume.surface()
        a, b, c = vertices[faces].unbind(1)
        areas.append(float(torch.linalg.cross(b - a, c - a).norm(dim=-1).sum()))
        assert float((vertices[:, 2] - 1).abs().median()) < 0.002 and float((vertices[:, 2] - 1).abs().max()) < 0.02
    assert areas[1] > 0.9 * areas[0]


def test_a_point_beside_a_hole_is_compared_with_the_nearest_pixel():
    camera = camera_of("pinhole")
    seen = depth_map(camera, wall)
    pixels = camera.pixels() + 0.3
    rays = camera.rays(pixels)
    points = rays.at(1 / rays.directions[:, 2])
    whole = seen.compare(points)
    kept = every_third(*seen.depth.shape)
    holed = replace(seen, depth=torch.where(kept, seen.depth, torch.nan)).compare(points)
    known = kept.flatten() & whole.ahead.isfinite()
    assert holed.smooth[known].all() and float(holed.ahead[known].abs().max()) < 0.02
    assert holed.ahead[~kept.flatten()].isnan().all()


def test_weight_and_truncation_are_the_releases():
    """VoxelHashing: max(3 * 1.5 (1 - (z - 0.4) / 3.6), 1), z along the axis; a truncation of 2 cm + 1 cm a metre."""
    frame = tiny.scene().frame
    method, camera = (
        TSDFFusion(frame, Config(voxel_size=0.02, truncation=2.0, truncation_growth=0.1)),
        camera_of("pinhole"),
    )
    method._fuse(depth_map(camera, wall))
    at_wall = 4.5 * (1 - (1 - 0.4) / 3.6)
    volume = method.volume
    seen = volume.voxels[..., 1] > 0
    torch.testing.assert_close(volume.voxels[..., 1][seen], torch.full((int(seen.sum()),), at_wall))
    distance = volume.voxels[..., 0][seen]
    assert float(distance.min()) < -2.5 and float(distance.min()) >= -(1 + 0.1 * 1.21 / 0.04)
    far = depth_map(camera, lambda d: 3.2 * wall(d))
    assert (
        not release_weight(far, 1.0, 3.0, (0.4, 4.0), 3.0)[30, 40]
        and release_weight(far, 1.0, 3.0, (0.4, 4.0), 9.0).min() == 1
    )


def test_the_table_has_the_papers_hash():
    volume, seen = VoxelBlocks(0.02, 4), depth_map(camera_of("pinhole"), wall)
    volume.fuse(seen, torch.ones_like(seen.depth))
    x, y, z = volume.blocks[0].long().tolist()
    first = (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % len(volume.table)
    behind = volume.table.roll(-first).tolist()
    assert 0 in behind[: behind.index(EMPTY)] and PRIMES == (73856093, 19349669, 83492791)
    assert int((volume.table != EMPTY).sum()) == len(volume) < len(volume.table) / 2


def test_every_cube_has_a_closed_surface_inside_it():
    """Each edge of a case's triangles is another triangle's too, the other way round, or lies on a face of the cube."""
    for case, fans in enumerate(triangles()):
        sides = [(fan[i], fan[i - 2]) for fan in fans for i in range(3)]
        assert len(set(sides)) == len(sides)
        for one, other in sides:
            if (other, one) in sides:
                continue
            faces = [{(axis, 0), (axis, 1)} for axis in range(3)]
            shared = set.intersection(*(on_faces(edge) for edge in (one, other)))
            assert shared and all(len(shared & face) < 2 for face in faces), case


def on_faces(edge: int) -> set[tuple[int, int]]:
    corner, along = edge // 3, edge % 3
    return {(axis, corner >> (2 - axis) & 1) for axis in range(3) if axis != along}


def test_memory_grows_with_surface():
    """Half the voxel: four times the blocks, not eight."""
    counts = []
    for edge in (0.04, 0.02):
        volume, seen = VoxelBlocks(edge, 4), depth_map(camera_of("pinhole"), wall)
        volume.fuse(seen, torch.ones_like(seen.depth))
        counts.append(len(volume))
    assert 2.5 < counts[1] / counts[0] < 5
    before = volume.surface()
    free = depth_map(seen.camera, lambda d: 2 * wall(d))
    for _ in range(40):
        volume.fuse(free, torch.ones_like(free.depth))  # the first wall is gone
    assert volume.prune() > 0.8 * counts[1]
    vertices, _, faces = volume.surface()
    assert len(before[2]) and len(faces) and float(vertices[:, 2].min()) > 1.5
    assert sorted(volume.table[volume.table != EMPTY].tolist()) == list(range(len(volume)))


def test_full_memory_keeps_what_there_is():
    volume, seen = VoxelBlocks(0.02, 4, max_blocks=10), depth_map(camera_of("pinhole"), wall)
    assert not volume.fuse(seen, torch.ones_like(seen.depth)) and len(volume) == 0


def test_trust_falls_with_distance_and_at_grazing_angles():
    seen = depth_map(camera_of("pinhole"), wall)
    everywhere, near = trust_of(seen, 0.0, 9.0), trust_of(seen, 0.5, 9.0)
    assert float(everywhere[30, 40]) == pytest.approx(1, abs=0.01)
    assert float(near[30, 40]) == pytest.approx(1 / 16, abs=0.01)
    assert not trust_of(seen, 0.0, 0.9).any() and float(everywhere[30, 0]) < float(everywhere[30, 40])


def with_depth(scale: float = 1.0, unknown: bool = False):
    """The tiny scene with points on its ball, and depth in another unit or not measured at all."""
    scene = tiny.scene()
    layer = scene.layers["depth"]
    wrong = Layer(layer.images, layer.planes, layer.dtype, 1, "distance", scale * (np.nan if unknown else 1.0))
    generator = torch.Generator().manual_seed(0)
    points = 0.6 * torch.nn.functional.normalize(torch.randn(500, 3, generator=generator), dim=-1)
    return replace(scene, layers={"depth": wrong}, points=points)


def test_a_wrong_unit_is_noticed():
    assert sensor_faults(with_depth()) == []
    (said,) = sensor_faults(with_depth(1000.0))
    assert "times as large as the sparse points are far away" in said and "factor of 1,000" in said
    (said,) = sensor_faults(replace(with_depth(1000.0), points=None))
    assert "metres, which no depth camera measures" in said
    (said,) = sensor_faults(with_depth(unknown=True))
    assert "nothing was measured" in said
    with pytest.raises(LumigraphError, match="has no depth beside its photographs"):
        sensor_faults(replace(tiny.scene(), layers={}))


def test_rendered_depth_of_another_method_is_fused():
    """`convert RUN tsdf-fusion`: a teacher that renders the tiny ball becomes a mesh of its radius."""

    class Teacher:
        def render(self, camera: Camera) -> Rendering:
            rays = camera.rays(camera.pixels())
            b = (rays.origins * rays.directions).sum(-1)
            under = b * b - rays.origins.square().sum(-1) + 0.36
            depth = torch.where(under > 0, -b - under.clamp_min(0).sqrt(), torch.inf)
            width, height = camera.size[0].tolist()
            opaque = depth.isfinite().float()
            rgb = torch.ones(height, width, 3)
            return Rendering(rgb, depth.view(height, width), opaque.view(height, width))

    method = TSDFFusion(tiny.scene().frame, Config(voxel_size=0.06, truncation=3.0, max_depth=0.0))
    method.from_field(Teacher(), tiny.scene().cameras)
    radius = np.linalg.norm(method.mesh().vertices, axis=-1)
    assert method.complete and abs(np.median(radius) - 0.6) < 0.02


def test_voxels_that_fit_no_scene_are_refused():
    with pytest.raises(LumigraphError, match="do not fit a box of interest of 2 units"):
        TSDFFusion(tiny.scene().frame, Config(voxel_size=5.0))
    assert TSDFFusion(tiny.scene().frame, Config(voxel_size=0.0)).volume.edge == pytest.approx(2 / 256)
