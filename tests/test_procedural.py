"""Procedural scenes against what geometry says about them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lumigraph import synthetic as procedural
from lumigraph.camera import Camera
from lumigraph.camera.lens import Equirectangular, Fisheye
from lumigraph.camera.rays import Rays
from lumigraph.errors import LumigraphError
from lumigraph.opening import open_scene
from lumigraph.synthetic import Lamp, Material, Object, Pose, Sky, Sun, World, scenes
from lumigraph.synthetic.cameras import look_at, pinhole
from lumigraph.synthetic.rendering import photograph, render, signed_distance, trace
from lumigraph.synthetic.shapes import (
    Arch,
    Ball,
    Cone,
    Cuboid,
    Cylinder,
    Plane,
    SoftCapsule,
    SolidShape,
    Torus,
    Triangle,
    triangle_of,
)
from lumigraph.synthetic.textures import Bricks, Checker, Marble, Mottle, Plain, Rings, Sectors, Stripes, Wood

SHAPES = [
    Ball(0.5),
    Cuboid((0.5, 0.3, 0.4)),
    Cuboid((0.5, 0.3, 0.4), rounding=0.1),
    Cylinder(0.4, 0.5),
    Cylinder(0.4, 0.5, rounding=0.1),
    Cone(0.5, 0.2, 0.4),
    Cone(0.2, 0.5, 0.4, rounding=0.05),
    Torus(0.4, 0.15),
    Arch((0.5, 0.3, 0.4), 0.3, spring=0.2),
    Arch((0.5, 0.3, 0.4), 0.25, spring=0.2, rounding=0.04),
    Plane(),
    Triangle(0.5, 0.2, 0.35, rounding=0.05),
    SoftCapsule(0.3, 0.35, curvature=-1.8, stretch=1.15),
]
LEANING = Pose.at(0.1, -0.2, 0.05, turn=25, tilt=35)
CHALK = Material(Plain((0.7, 0.6, 0.5)))
TEXTURES = [
    Checker((0.9, 0.8, 0.7), (0.2, 0.1, 0.1), size=0.2),
    Stripes((0.9, 0.8, 0.7), (0.2, 0.1, 0.1), period=0.3),
    Sectors((0.9, 0.8, 0.7), (0.2, 0.1, 0.1)),
    Rings((0.9, 0.8, 0.7), (0.2, 0.1, 0.1), period=0.3),
    Wood((0.9, 0.8, 0.7), (0.2, 0.1, 0.1), ring=0.2),
    Marble((0.9, 0.8, 0.7), (0.2, 0.1, 0.1)),
    Bricks((0.9, 0.8, 0.7), (0.2, 0.1, 0.1)),
    Mottle((0.9, 0.8, 0.7), (0.2, 0.1, 0.1)),
]


def exact(camera: Camera) -> Camera:
    """The camera in double precision."""
    lens = type(camera.lens)(camera.lens.focal.double(), camera.lens.centre.double())
    return replace(camera, pose=camera.pose.double(), lens=lens)


def camera_at(eye, target=(0.0, 0.0, 0.0), size: int = 48, field_of_view: float = 40.0) -> Camera:
    camera = exact(pinhole(look_at(eye, target)[None], size, field_of_view))
    return replace(camera, pose=torch.from_numpy(look_at(eye, target))[None])


def unfiltered(rays: Rays) -> Rays:
    """Rays so thin that textures keep all their detail; otherwise each view blurs them over its own footprint."""
    return replace(rays, radius=rays.radius * 1e-3)


def alone(shape: SolidShape, pose: Pose = LEANING, material: Material = CHALK) -> World:
    return World((Object(shape, material, pose),))


def in_frame(pose: Pose, points: np.ndarray, vectors: bool = False) -> np.ndarray:
    """Points of the world in an object's own frame."""
    return (points - (0.0 if vectors else np.array(pose.position))) @ np.array(pose.rotation)


@pytest.fixture(scope="module")
def still_life():
    return scenes.stage("still-life", size=64, views=8, seed=0)


def test_a_plate_lies_between_its_corners():
    random = np.random.default_rng(0)
    for corners in random.uniform(-0.8, 0.8, (20, 3, 3)):
        shape, rotation, position = triangle_of(corners, thickness=0.02)
        pose = Pose(tuple(position.tolist()), tuple(map(tuple, rotation.tolist())))
        assert np.linalg.det(rotation) == pytest.approx(1) and abs(shape.apex) <= shape.base
        world = World((Object(shape, CHALK, pose),))
        shares = random.dirichlet((1, 1, 1), 30)
        aside = 0.3 * random.uniform(-1, 1, (30, 1)) * rotation[:, 2]
        there = signed_distance(world, torch.from_numpy(shares @ corners + aside))
        np.testing.assert_allclose(there, np.linalg.norm(aside, axis=1) - 0.01, atol=1e-9)
        beyond = signed_distance(world, torch.from_numpy(corners + 0.5 * (corners - corners.mean(0))))
        assert (beyond > 0).all()
        assert (signed_distance(world, torch.from_numpy(corners)) + 0.01).abs().max() < 1e-9
    assert triangle_of(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]), 0.1) is None


def test_depth_of_a_sphere_and_a_box_is_the_analytic_one():
    camera = camera_at((2.0, -1.5, 1.0))
    rays = camera.rays(camera.pixels())
    o, d = rays.origins.numpy(), rays.directions.numpy()

    local, along = in_frame(LEANING, o), in_frame(LEANING, d, vectors=True)
    b, c = (local * along).sum(-1), (local**2).sum(-1) - 0.5**2
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - c)
    sphere = np.where(np.isnan(root), np.inf, -b - root)

    half = np.array([0.5, 0.3, 0.4])
    near, far = np.sort(np.stack([(-half - local) / along, (half - local) / along]), 0)
    enter, leave = near.max(-1), far.min(-1)
    box = np.where(enter < leave, enter, np.inf)

    for shape, expected in ((Ball(0.5), sphere), (Cuboid((0.5, 0.3, 0.4)), box)):
        assert 0.1 < np.isfinite(expected).mean() < 0.9
        np.testing.assert_allclose(trace(alone(shape), rays).depth, expected, atol=1e-9)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_rays_stop_at_the_first_place_where_the_distance_is_zero(shape):
    """For any shape: the distance is positive all the way to where the ray stops, and zero there."""
    camera = camera_at((1.6, -1.1, 1.3))
    world, rays = alone(shape), camera.rays(camera.pixels())
    seen = trace(world, rays)
    hit = torch.from_numpy(np.isfinite(seen.depth))
    assert 0.05 < hit.double().mean()
    reached = rays[hit].at(torch.from_numpy(seen.depth)[hit])
    assert signed_distance(world, reached).abs().max() < 3e-7
    stop = torch.from_numpy(seen.depth).clamp_max(6.0)
    for share in torch.linspace(0.02, 0.98, 80, dtype=torch.float64):
        assert signed_distance(world, rays.at(share * stop)).min() > 0
    beyond = rays[hit].at(torch.from_numpy(seen.depth)[hit] + 1e-4)
    assert (signed_distance(world, beyond) < 0).double().mean() > 0.9


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_signed_distance_grows_by_one_per_unit_inside_and_out(shape):
    """A function that is zero on a surface and whose gradient is a unit vector almost everywhere is its distance."""
    points = torch.rand(4000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 1.6 - 0.8
    world, h = alone(shape), 1e-5
    assert (signed_distance(world, points) < 0).sum() > 20
    steps = h * torch.eye(3, dtype=torch.float64)
    gradient = torch.stack(
        [(signed_distance(world, points + s) - signed_distance(world, points - s)) / (2 * h) for s in steps], -1
    )
    assert ((gradient.norm(dim=-1) - 1).abs() < 1e-4).double().mean() > 0.99


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_normals_are_unit_face_the_camera_and_stand_on_the_surface(shape):
    camera = camera_at((1.6, -1.1, 1.3))
    world, rays = alone(shape), camera.rays(camera.pixels())
    seen = trace(world, rays)
    hit = np.isfinite(seen.depth)
    n = seen.normal[hit]
    np.testing.assert_allclose(np.linalg.norm(n, axis=-1), 1.0, atol=1e-9)
    assert (n * rays.directions.numpy()[hit]).sum(-1).max() < 1e-3
    assert not seen.normal[~hit].any()
    p = rays[torch.from_numpy(hit)].at(torch.from_numpy(seen.depth[hit]))
    slopes = [
        (signed_distance(world, p + 1e-6 * e) - signed_distance(world, p - 1e-6 * e)) / 2e-6
        for e in torch.eye(3).double()
    ]
    assert (np.abs(torch.stack(slopes, -1).numpy() - n).max(-1) < 1e-3).mean() > 0.98


def test_every_lens_sees_the_same_surface():
    fisheye = Fisheye(torch.full((1, 2), 20.0), torch.full((1, 2), 24.0), torch.tensor([[0.02, 0.0, 0.0, 0.0]]))
    camera = replace(pinhole(look_at((2.0, -1.5, 1.0), (0, 0, 0))[None], 48, 40.0), lens=fisheye)
    rays = camera.rays(camera.pixels())
    seen = trace(alone(Ball(0.5)), rays)
    hit = np.isfinite(seen.depth)
    reached = (rays.origins + rays.directions * torch.from_numpy(seen.depth).float()[:, None]).numpy()[hit]
    np.testing.assert_allclose(np.linalg.norm(reached - LEANING.position, axis=-1), 0.5, atol=1e-5)


def test_a_point_projects_to_its_pixel_and_other_views_see_the_same_point_and_colour(still_life):
    first, second = (exact(still_life.cameras["train"][i]) for i in (0, 1))
    pixels = first.pixels()
    rays = unfiltered(first.rays(pixels))
    seen = trace(still_life.world, rays, shaded=False)
    hit = torch.from_numpy(np.isfinite(seen.depth))
    points = rays[hit].at(torch.from_numpy(seen.depth)[hit])
    back, valid = first.project(points)
    assert valid.all()
    torch.testing.assert_close(back, pixels[hit], atol=1e-4, rtol=0)

    there, _ = second.project(points)
    again = unfiltered(second.rays(there))
    other = trace(still_life.world, again, shaded=False)
    distance = (points - again.origins).norm(dim=-1).numpy()
    assert (other.depth < distance + 1e-5).mean() > 0.995  # nothing lets a ray through, but past a rim it may slip
    same = np.abs(other.depth - distance) < 1e-5
    assert same.mean() > 0.3
    assert (other.identity[same] == seen.identity[hit][same]).mean() > 0.999
    difference = np.abs(other.reflectance[same] - seen.reflectance[hit][same]).max(-1)
    assert (difference < 0.01).mean() > 0.99


@pytest.mark.parametrize("texture", TEXTURES, ids=lambda t: type(t).__name__)
def test_chalk_looks_the_same_from_everywhere(texture):
    world = World(
        (
            Object(Ball(0.5), Material(texture), LEANING),
            Object(Cuboid((1, 1, 0.05)), Material(texture), Pose.at(0, 0, -0.6)),
        ),
        (Lamp((1.0, -2.0, 2.0), radius=0.0, power=3.0),),
        Sky(light=0.3),
    )
    first, second = camera_at((1.6, -1.2, 1.2)), camera_at((0.4, -1.9, 1.4))
    rays = unfiltered(first.rays(first.pixels()))
    seen = trace(world, rays)
    assert seen.reflectance[np.isfinite(seen.depth)].std() > 0.03
    points = rays.at(torch.from_numpy(seen.depth).clamp_max(10))
    again = unfiltered(second.rays(second.project(points)[0]))
    other = trace(world, again)
    same = np.abs(other.depth - (points - again.origins).norm(dim=-1).numpy()) < 1e-6
    assert same.mean() > 0.2
    # 1 in 100: shadows' edges fall on one side or the other of a rounding error
    assert (np.abs(other.radiance[same] - seen.radiance[same]).max(-1) < 2e-3).mean() > 0.99


def test_gloss_depends_on_where_one_looks_from():
    world = World(
        (Object(Ball(0.5), Material(Plain((0.7, 0.2, 0.1)), gloss=1.0, roughness=0.3)),),
        (Lamp((0, 0, 4), 0.2, 12.0),),
    )
    point = torch.tensor([[0.0, 0.0, 0.5]], dtype=torch.float64)
    rgb = []
    for eye in ((0.1, 0.0, 3.0), (2.0, 0.0, 2.0)):
        camera = camera_at(eye)
        rgb.append(trace(world, camera.rays(camera.project(point)[0])).radiance[0])
    assert rgb[0][2] > 2 * rgb[1][2]


def test_alpha_is_the_share_of_a_pixel_that_is_covered():
    camera, fine = camera_at((2.0, 0, 0), size=32), camera_at((2.0, 0, 0), size=32 * 16)
    _, alpha = photograph(alone(Ball(0.5), Pose()), camera)
    covered = np.isfinite(trace(alone(Ball(0.5), Pose()), fine.rays(fine.pixels())).depth)
    expected = covered.reshape(32, 16, 32, 16).mean((1, 3))
    assert (alpha[expected == 0] == 0).all() and (alpha[expected == 1] == 1).all()
    edge = (expected > 0) & (expected < 1)
    assert edge.sum() > 40
    assert np.abs(alpha - expected)[edge].mean() < 0.05
    assert abs(alpha.sum() / expected.sum() - 1) < 5e-3


def test_colour_at_an_edge_is_not_mixed_with_the_background():
    world = World((Object(Ball(0.5), CHALK),), sky=Sky(light=0.5))
    rgb, alpha = photograph(world, camera_at((2.0, 0, 0), size=32))
    inside = rgb[alpha == 1].mean(0)
    np.testing.assert_allclose(rgb[(alpha > 0) & (alpha < 1)].mean(0), inside, atol=0.02)
    assert not rgb[alpha == 0].any()


def test_the_same_seed_gives_the_same_bytes_and_another_seed_other_cameras():
    def bytes_and_poses(seed: int):
        capture = procedural.read(f"still-life,size=24,views=5,seed={seed}")
        return [s.image() for s in capture.shots], np.stack([s.pose for s in capture.shots])

    images, poses = bytes_and_poses(3)
    again, same = bytes_and_poses(3)
    assert all((a == b).all() for a, b in zip(images, again, strict=True)) and (poses == same).all()
    assert images[0].shape == (24, 24, 4) and 0.1 < (images[0][..., 3] > 0).mean() < 0.9
    _, other = bytes_and_poses(4)
    assert (np.abs(other - poses).max((1, 2)) > 0.1).all()


def test_a_turned_world_gives_the_turned_picture(still_life):
    """Camera and world turned together: nothing changes. Lights are points, for their samples know up from down."""
    motion = Pose.about((1.0, 2.0, 3.0), 50) @ Pose((0.3, -0.2, 0.1))
    lights = tuple(replace(light, radius=0.0) for light in still_life.world.lights)
    world = replace(still_life.world, lights=lights, sky=Sky(light=0.4))
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = torch.tensor(motion.rotation), torch.tensor(motion.position)
    camera = camera_at((2.4, -2.2, 1.5), size=40)
    before, after = render(world, camera), render(world.transformed(motion), camera.transformed(matrix))
    assert (before.extra["ids"] == after.extra["ids"]).double().mean() > 0.999
    torch.testing.assert_close(after.depth, before.depth, atol=1e-4, rtol=0)
    assert ((after.rgb - before.rgb).abs().amax(-1) < 0.01).double().mean() > 0.995
    turned = before.extra["normals"].double() @ torch.tensor(motion.rotation, dtype=torch.float64).T
    assert ((after.extra["normals"] - turned).abs().amax(-1) < 1e-3).double().mean() > 0.995


def test_shadow_lies_where_geometry_says():
    toward = np.array([0.5, -0.3, 0.8]) / np.linalg.norm([0.5, -0.3, 0.8])
    ball, centre = Object(Ball(0.4), CHALK, Pose((0.0, 0.0, 0.7)), "ball"), np.array([0.0, 0.0, 0.7])
    world = World((Object(Plane(), CHALK, name="floor"), ball), (Sun(tuple(toward), 0.0, 1.0),), Sky(light=0.0))
    camera = camera_at((1.5, -2.5, 2.0), target=(-0.3, 0.2, 0.0))
    rays = camera.rays(camera.pixels())
    seen = trace(world, rays)
    floor = seen.identity == 0
    p = rays[torch.from_numpy(floor)].at(torch.from_numpy(seen.depth[floor])).numpy()
    offset = (centre - p) - ((centre - p) @ toward)[
        :, None
    ] * toward  # how far the ball's centre is off the ray to the sun
    miss = np.linalg.norm(offset, axis=-1) - 0.4
    dark = seen.radiance[floor].max(-1) == 0
    assert 20 < dark.sum() < 0.5 * floor.sum()
    assert (dark == (miss < 0))[np.abs(miss) > 1e-3].all()
    np.testing.assert_allclose(seen.radiance[floor][~dark], toward[2] * seen.reflectance[floor][~dark], rtol=1e-6)


def test_a_wide_light_casts_a_shadow_whose_edge_is_half_lit():
    """A half-space hides half of a lamp from where its edge and the lamp's centre line up."""
    wall = Object(Cuboid((0.01, 4.0, 0.5)), CHALK, Pose((0.0, 0.0, 0.5)), "wall")
    sun = Sun((1.0, 0.0, 1.0), 0.2, 1.0)
    world = World((Object(Plane(), CHALK, name="floor"), wall), (sun,), Sky(light=0.0))
    camera = camera_at((-1.0, 0.0, 3.0), target=(-1.0, 0.01, 0.0), size=64, field_of_view=36.0)
    rgb, _ = photograph(world, camera)
    light = render(world, camera).extra["albedo"][0, 0, 0].item() * np.sqrt(0.5)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)[..., 0] / light
    across = linear.mean(1) if np.ptp(linear.mean(1)) > np.ptp(linear.mean(0)) else linear.mean(0)
    across = across if across[0] < across[-1] else across[::-1]
    assert across[0] < 0.02 and abs(across[-1] - 1) < 0.02
    middle = np.abs(np.arange(64) + 0.5 - 32).argmin()
    assert abs(across[middle - 1 : middle + 2].mean() - 0.5) < 0.08
    assert 8 < ((across > 0.05) & (across < 0.95)).sum() < 40


def test_masks_name_things_and_a_thing_can_move(still_life):
    world, camera = still_life.world, camera_at((0.4, -3.2, 1.6), size=64)
    before = render(world, camera).extra["ids"]
    ball = world.names.index("ball")
    assert (before == ball).any()
    after = render(world.move_object("ball", Pose((0.0, 0.0, 3.0))), camera).extra["ids"]
    assert not (after == ball).any() and (after[before != ball] == before[before != ball]).all()
    with pytest.raises(KeyError, match="nothing here is called 'cat'"):
        world.move_object("cat", Pose())


def test_a_visible_sky_leaves_no_pixel_empty():
    stage = scenes.stage("courtyard", size=32, views=4)
    seen = render(stage.world, stage.cameras["train"][0])
    sky = seen.extra["ids"] < 0
    assert 0.05 < sky.double().mean() < 0.7
    assert (seen.opacity == 1).all() and (torch.isinf(seen.depth) == sky).all()
    assert (seen.rgb[sky].mean(0) > 0.4).all() and seen.rgb[sky].std() < 0.3
    positions = torch.cat([c.position for c in stage.cameras.values()])
    assert signed_distance(stage.world, positions).min() > stage.near


def test_the_room_is_closed_and_its_cameras_look_everywhere():
    stage = scenes.stage("room", size=32, views=40)
    sphere = Equirectangular(torch.tensor([[64.0, 32.0]]))
    upright = torch.tensor([[[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]]])
    seen = render(stage.world, Camera(upright, sphere, torch.tensor([[64, 32]])))
    assert (seen.extra["ids"] >= 0).all() and seen.depth.max() < 1.5 and (seen.opacity == 1).all()
    assert seen.rgb.amax() < 0.999 and seen.rgb.reshape(-1, 3).std(0).min() > 0.1  # lit, nowhere too brightly
    train = stage.cameras["train"]
    assert signed_distance(stage.world, torch.cat([c.position for c in stage.cameras.values()])).min() > stage.near
    everywhere = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert (everywhere @ train.forward.T).amax(-1).min() > math.cos(math.radians(38))  # in somebody's picture


def test_worlds_are_data_nothing_is_compiled_for_a_new_one(still_life):
    from lumigraph.synthetic import tracer

    camera = camera_at((2.4, -2.2, 1.5), size=8)
    for world in (still_life.world, alone(Torus(0.4, 0.1)), World((Object(Plane(), CHALK),))):
        render(world, camera)
    assert len(tracer.gather.signatures) == 1 and len(tracer.trace.signatures) == 1


def test_the_still_life_fills_its_bounds_and_no_more(still_life):
    low, high = still_life.world.bounds()
    assert (low >= still_life.bounds[0]).all() and (high <= still_life.bounds[1]).all()
    assert (high - low).max() > 1.9
    edge = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    edge[torch.arange(2000), torch.arange(2000) % 3] = torch.sign(edge[:, 0])
    assert signed_distance(still_life.world, edge).min() > 0


def test_tourists_have_a_light_each_and_the_truth_without_them():
    scene = open_scene("procedural:tourists,size=24,views=6")
    photographs = torch.stack([scene.photograph(i).rgb for i in range(len(scene))])
    clean = torch.stack([scene.photograph(i, layers=("clean",)).extra["clean"] for i in range(len(scene))])
    train, test = scene.splits["train"], scene.splits["test"]
    assert torch.equal(photographs[test], clean[test])  # nobody is before what is held out
    passing = ((photographs - clean).abs() > 0.05).any(-1).float().mean((1, 2))
    assert (passing[train] > 0).float().mean() > 0.8 and passing.max() < 0.7
    brightness = clean.mean((1, 2))
    assert brightness.std(0).min() > 0.02 and (brightness[:, 0] / brightness[:, 2]).std() > 0.05  # light, and its tint
    focal = scene.cameras.lens.focal[:, 0]
    assert focal.max() > 1.1 * focal.min()


def test_jittered_poses_are_off_by_as_much_as_asked_and_their_pictures_are_the_same():
    exact, off = (open_scene(f"procedural:still-life,size=16,views=4{more}") for more in ("", ",jitter_poses=2"))
    train, test = exact.splits["train"], exact.splits["test"]
    turned = exact.cameras.pose[train, :, :3].mT @ off.cameras.pose[train, :, :3]
    angle = ((turned.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).acos().rad2deg()
    moved = (exact.cameras.position - off.cameras.position)[train].norm(dim=-1)
    low, high = (torch.tensor(x) for x in scenes.stage("still-life").bounds)
    torch.testing.assert_close(angle, torch.full((4,), 2.0), atol=0.02, rtol=0)
    torch.testing.assert_close(moved, 0.02 * (high - low).max().expand(4), rtol=1e-3, atol=0)
    assert torch.equal(exact.cameras.pose[test], off.cameras.pose[test])
    assert torch.equal(exact.photograph(0).rgb, off.photograph(0).rgb)


def test_open_scene_makes_a_scene_in_the_worlds_own_frame():
    scene = open_scene("procedural:still-life,size=32,views=6,seed=1")
    assert len(scene.splits["train"]) == 6 and len(scene.splits["test"]) >= 2
    assert scene.frame.has_alpha and scene.frame.background == (1.0, 1.0, 1.0) and scene.frame.reach == 1.0
    torch.testing.assert_close(torch.tensor(scene.frame.source_from_scene), torch.eye(4), atol=1e-6, rtol=0)
    index = int(scene.splits["test"][0])
    photograph = scene.photograph(index)
    world = scenes.stage("still-life").world
    seen = render(world, photograph.camera)
    torch.testing.assert_close(photograph.alpha, seen.opacity, atol=0.003, rtol=0)
    torch.testing.assert_close(photograph.rgb, seen.rgb, atol=0.003, rtol=0)


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        (
            "still-lif",
            "choose one of blocks, character, city, clockwork, courtyard, fog, grasp, head, jelly",
        ),
        ("still-life,colour=3", "no option 'colour'; there are size, views, seed"),
        ("still-life,size=big", "size must be a whole number, as in size=20; got 'big'"),
        ("still-life,views=0", "views is 0, and should be from 1"),
    ],
)
def test_what_does_not_exist_is_named(request_, sentence):
    with pytest.raises(LumigraphError, match=sentence):
        open_scene(f"procedural:{request_}")


def test_a_scene_written_as_a_blender_folder_reads_back(tmp_path):
    stage = scenes.stage("still-life", size=24, views=4, seed=2)
    procedural.write_blender(stage, tmp_path / "toys")
    scene = open_scene(tmp_path / "toys")
    assert len(scene.splits["train"]) == 4 and len(scene.splits["test"]) == len(stage.cameras["test"])
    matrix = torch.tensor(scene.frame.source_from_scene)
    for split, cameras in stage.cameras.items():
        for k, index in enumerate(scene.splits[split].tolist()):
            photograph = scene.photograph(index)
            torch.testing.assert_close(
                photograph.camera.transformed(matrix).pose[0], cameras.pose[k], atol=1e-4, rtol=0
            )
            seen = render(stage.world, cameras[k])
            torch.testing.assert_close(photograph.rgb, seen.rgb, atol=0.003, rtol=0)
            torch.testing.assert_close(photograph.alpha, seen.opacity, atol=0.003, rtol=0)
    truth = np.load(tmp_path / "toys" / "train" / "r_0000_truth.npz")
    seen = render(stage.world, stage.cameras["train"][0])
    assert (truth["depth"] == seen.depth.numpy()).all() and (truth["ids"] == seen.extra["ids"].numpy()).all()
    assert list(truth["names"]) == list(stage.world.names)
    assert truth["normals"].shape == (24, 24, 3)
    with pytest.raises(FileExistsError):
        procedural.write_blender(stage, tmp_path / "toys")


def test_a_depth_camera_has_noise_quantisation_shadows_and_a_loop():
    """Noise and steps of disparity against the published model; holes where the projector casts its shadow."""
    stage = scenes.stage("room", size=64, views=200, depth=1)
    assert stage.depth_camera is not None
    cameras, sensor, unit = stage.cameras["train"], stage.depth_camera, stage.unit
    assert (cameras.position[0] - cameras.position[190]).norm() * unit < 0.1  # 190 / 199 of 1.05 loops
    wall = World((Object(Cuboid((9.0, 9.0, 0.5)), CHALK, Pose.at(0, 0, 2.5)),))
    ahead = pinhole(np.eye(4)[None, :3], (64, 48), 62.7)
    found = replace(sensor, unit=1.0).measure(wall, ahead)  # 2 m away
    levels = 351.3 / (found[found > 0] / 1000)
    assert np.abs(levels - np.rint(levels)).max() < 0.05  # within a millimetre
    assert found.min() > 0 and np.median(found) == pytest.approx(2000, abs=6)
    spread = 4 / 351.3 * 1000 * math.hypot(0.5, 12**-0.5)  # mm: half a level of noise, rounded to levels
    assert found.std() == pytest.approx(spread, rel=0.05)
    assert not replace(sensor, unit=1.0, range=(0.4, 1.9)).measure(wall, ahead).any()

    post = replace(wall, objects=(*wall.objects, Object(Cuboid((0.1, 9.0, 0.1)), CHALK, Pose.at(0, 0, 1.0))))
    row = replace(sensor, unit=1.0).measure(post, ahead)[24]
    width = 0.075 * (1 / 0.9 - 1 / 2) * 64 / (2 * math.tan(math.radians(62.7 / 2)))  # pixels: b (1/z - 1/Z) f
    assert (row[:32] == 0).sum() == pytest.approx(width, abs=1.5) and (row[32:] == 0).sum() <= 1


def test_a_film_of_the_room_is_in_metres_with_the_truth_beside():
    scene = open_scene("procedural:room,depth,views=10,size=32,seed=3")
    assert scene.cameras.size[0].tolist() == [32, 24] and scene.frame.to_source.scale == pytest.approx(2.6)
    photo = scene.photograph(0, ("depth", "exact_depth"))
    measured, exact = photo.extra["depth"], photo.extra["exact_depth"]
    near = (2.6 * (measured - exact).abs())[measured.isfinite()]
    assert near.median() < 0.03 and exact.isfinite().all() and 0.3 < float(2.6 * exact.min())
    stage = scenes.stage("room", size=32, views=10, seed=3, depth=1)
    place = scene.frame.to_source.points(photo.camera.position) / 2.6
    assert float((place - stage.cameras["test"].position[0]).norm()) < 1e-5
    with pytest.raises(LumigraphError, match="no option 'depth'"):
        open_scene("procedural:still-life,depth")


# Nuisances


def nuisance(text: str, scene: str = "still-life,size=16,views=6"):
    return open_scene(f"procedural:{scene}{text and ','}{text}")


def test_nuisances_are_off_by_default_and_compose():
    plain, none = nuisance(""), nuisance("open=0,exposure=0,scale=1,step=1,holes=")
    assert plain.names == none.names and plain.frame == none.frame
    assert torch.equal(plain.photograph(5).rgb, none.photograph(5).rgb)
    many = nuisance(
        "open=3,clutter=4,shape=2,exposure=1,blur=2,white_balance=10,poses=1,labels=20,scale=10,order,few=3"
    )
    assert len(many.splits["train"]) == 3 and not many.frame.has_alpha and many.frame.is_open


def test_a_unit_and_an_origin_change_the_source_and_not_the_scene():
    plain = nuisance("")
    for text, scale in (("scale=0.001", 1e-3), ("scale=1e5,offset=1e6", 1e5)):
        moved = nuisance(text)
        assert moved.frame.to_source.scale == pytest.approx(scale * plain.frame.to_source.scale, rel=1e-6)
        torch.testing.assert_close(moved.cameras.pose, plain.cameras.pose, atol=1e-4, rtol=0)
        depth, other = (one.photograph(5, ("depth",)).extra["depth"] for one in (plain, moved))
        torch.testing.assert_close(depth, other, atol=1e-5, rtol=1e-5)


def test_a_tracked_mesh_has_the_unit_of_its_photographs():
    head, large = (nuisance(text, "head,size=16,views=8") for text in ("", "scale=1000,offset=7"))
    torch.testing.assert_close(large.about["vertices"], 1000 * head.about["vertices"] + 7, rtol=1e-4, atol=1e-3)


def test_training_poses_are_off_by_pixels_and_the_truth_is_known():
    exact, off = nuisance("", "still-life,size=64,views=30"), nuisance("poses=3", "still-life,size=64,views=30")
    train, test = off.splits["train"], off.splits["test"]
    assert torch.equal(exact.cameras.pose[test], off.cameras.pose[test])
    ahead = exact.cameras.position + 3 * exact.cameras.forward
    away = torch.stack([off.cameras[i].project(ahead[i : i + 1])[0][0] - 32 for i in train.tolist()])
    assert 2 < float(away.norm(dim=-1).square().mean().sqrt()) < 4
    torch.testing.assert_close(off.about["true_pose"][train].float(), exact.cameras.pose[train], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("holes", "kept"), [("grid", 0.25), ("columns", 2 / 3), ("far", 0.5)])
def test_depth_has_the_holes_that_are_asked_for(holes, kept):
    room = "room,depth,size=48,views=4"
    plain, pierced = (nuisance(text, room).photograph(2, ("depth",)).extra["depth"] for text in ("", f"holes={holes}"))
    known, left = plain.isfinite(), pierced.isfinite()
    assert (known | ~left).all() and torch.equal(pierced[left], plain[left])
    assert float(left.sum() / known.sum()) == pytest.approx(kept, abs=0.03)


def test_depth_is_as_wrong_as_asked():
    room = "room,depth,size=48,views=4"
    plain, scaled, steps, returns = (
        nuisance(text, room).photograph(2, ("depth",)).extra["depth"]
        for text in ("", "noise=scaled", "noise=quantised", "noise=returns")
    )
    known = plain.isfinite()
    torch.testing.assert_close(scaled[known], 1.05 * plain[known], atol=1e-3, rtol=1e-3)
    assert len(steps[steps.isfinite()].unique()) < len(plain[known].unique()) and not torch.equal(steps, plain)
    assert 0.05 < float((returns[known] != plain[known]).float().mean()) < 0.15


def test_a_background_goes_with_the_camera_on_a_turntable():
    """Its border differs less between photographs than that of a background that stays."""
    turned, still = nuisance("turntable"), nuisance("open=3")
    borders = [torch.stack([x.photograph(i).rgb[0] for i in x.splits["train"].tolist()]) for x in (turned, still)]
    spread = [float(border.std(0).mean()) for border in borders]
    assert spread[0] < 0.7 * spread[1]  # its light alone changes


def test_labels_are_wrong_in_places_and_missing_in_photographs():
    plain, wrong = nuisance(""), nuisance("labels=40", "still-life,size=16,views=12")
    assert len(plain.layers["labels"]) == len(plain) and len(wrong.layers["labels"]) < len(wrong)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("still-life,scale=big", "scale must be a number; got 'big'"),
        ("still-life,scale=nan", "scale is nan, and should be from"),
        ("still-life,holes=many", "should be  or grid or columns"),
        ("jelly,shape=2", "this one changes; leave shape out"),
        ("blocks,scale=2", "a block world has one unit"),
    ],
)
def test_a_nuisance_that_cannot_be_is_refused(text, sentence):
    with pytest.raises(LumigraphError, match=sentence):
        open_scene(f"procedural:{text}")


def test_a_tail_has_as_many_bones_as_asked():
    scene = open_scene("procedural:tail,joints=40,size=16,views=4")
    assert len(scene.frame.skeleton.names) == 40
    assert open_scene("procedural:tail,joints=2,clips=1,size=16,views=4").frame.skeleton.parents == (-1, 0)
