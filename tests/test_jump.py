"""Jump: a ring of cameras inside a textured sphere as omnidirectional stereo, against what the eyes would see."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from budgets import budget
from torch.nn.functional import normalize

from lumigraph.camera import Camera
from lumigraph.camera.lens import OmnidirectionalStereo, Pinhole
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Frame, Scene
from lumigraph.errors import LumigraphError
from lumigraph.export import jump
from lumigraph.export.options import JumpOptions
from lumigraph.geometry import look_at

pytestmark = budget("exports", 6)

RADIUS, SPHERE, CAMERAS, SIZE = 0.1, 0.8, 10, 120


def seen(camera: Camera) -> torch.Tensor:
    """Colours of the inside of a sphere."""
    rays = camera.rays(camera.pixels())
    b = (rays.origins * rays.directions).sum(1)
    t = -b + (b * b - (rays.origins**2).sum(1) + SPHERE**2).sqrt()
    places = rays.origins + t[:, None] * rays.directions
    waves = torch.stack([(9 * places[:, k] + 7 * places[:, (k + 1) % 3]).sin() for k in range(3)], 1)
    width, height = camera.size[0].tolist()
    return (0.5 + 0.25 * waves + 0.2 * (23 * places).sin()).view(height, width, 3)


@cache
def ring(missing: int | None = None) -> Scene:
    up, poses = torch.tensor([0.0, 0.0, 1.0]), []
    for k in range(CAMERAS):
        angle = 2 * math.pi * k / CAMERAS
        outward = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        poses.append(look_at(RADIUS * outward, outward, up).float())
    pose = torch.stack([one for k, one in enumerate(poses) if k != missing])
    count = len(pose)
    focal = SIZE / 2 / math.tan(math.radians(57.5))
    lens = Pinhole(torch.full((count, 2), focal), torch.full((count, 2), SIZE / 2))
    camera = Camera(pose, lens, torch.full((count, 2), SIZE), image_index=torch.arange(count))
    pictures = [(seen(camera[k]) * 255).round().to(torch.uint8).numpy() for k in range(count)]
    frame = Frame(near=0.05, reach=1.0, image_count=count)
    splits = {"train": torch.arange(count), "test": torch.arange(0)}
    return Scene(camera, ImageStore.from_arrays(pictures), frame, splits, [f"camera{k}" for k in range(count)], "ring")


@cache
def stitched():
    return jump.stereo_panorama(ring(), JumpOptions(256))


def test_panoramas_are_what_the_eyes_would_see():
    panorama, _ = stitched()
    forward, up = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1])
    pose = torch.stack([torch.linalg.cross(-up, forward), -up, forward, torch.zeros(3)], 1)[None]
    rows = ((torch.arange(128) + 0.5 - 64) / 128 * 180).abs() < 40
    assert panorama.seen[rows].float().mean() > 0.98
    for side, found in ((-1, panorama.left), (1, panorama.right)):
        lens = OmnidirectionalStereo(torch.tensor([[256.0, 128.0]]), offset=torch.tensor([[side * panorama.eyes / 2]]))
        truth = seen(Camera(pose, lens, torch.tensor([[256, 128]])))
        error = ((found - truth) ** 2)[rows].mean()
        assert -10 * math.log10(error) > 25
    assert ((panorama.left - panorama.right)[rows] ** 2).mean() > 3 * error  # the eyes do differ


def test_depth_is_that_of_the_sphere():
    panorama, _ = stitched()
    depth = panorama.depth[0][panorama.seen]
    assert (depth / SPHERE - 1).abs().median() < 0.05


def test_a_rig_has_a_nearest_distance():
    """Nothing within the cameras' circle is reliable; the sphere is."""
    panorama, _ = stitched()
    assert RADIUS < panorama.nearest < SPHERE


def test_gains_undo_exposures():
    scene = ring()
    images = [scene.images[k][..., :3] for k in range(CAMERAS)]
    images[3] = (images[3].float() * 0.8).to(torch.uint8)
    darker = replace(scene, images=ImageStore.from_arrays([x.numpy() for x in images]))
    rig = jump.rig_of(darker)
    photographs = [darker.photograph(int(k)) for k in rig.order]
    gains = jump.balanced([jump.RingPair.of(rig, photographs, k, 128) for k in range(CAMERAS)])
    number = rig.order.tolist().index(3)
    others = gains[[k for k in range(CAMERAS) if k != number]].mean(0)
    torch.testing.assert_close(gains[number] / others, torch.full((3,), 1.25), rtol=0.05, atol=0)


def test_a_still_scene_keeps_its_disparities():
    """With noise in the second moment, disparities differ less if the first moment is known."""
    scene = ring()
    _, before = stitched()
    generator = torch.Generator().manual_seed(0)
    noisy = [
        (scene.images[k][..., :3] + 8 * torch.randn(SIZE, SIZE, 3, generator=generator)).clamp(0, 255).to(torch.uint8)
        for k in range(CAMERAS)
    ]
    later = replace(scene, images=ImageStore.from_arrays([x.numpy() for x in noisy]))
    changes = []
    for known in (None, before):
        _, now = jump.stereo_panorama(later, JumpOptions(256), before=known)
        changes.append(sum(float((a[1] - b[1]).abs().mean()) for a, b in zip(now, before, strict=True)))
    assert changes[1] < 0.9 * changes[0]


def test_a_missing_camera_is_a_fault():
    with pytest.raises(LumigraphError, match="A camera is missing in ring between camera\\d and camera\\d"):
        jump.rig_of(ring(missing=3))


def test_cameras_that_look_elsewhere_are_no_rig():
    scene = ring()
    pose = scene.cameras.pose.clone()
    pose[2, :, 2] *= -1
    turned = replace(scene, cameras=replace(scene.cameras, pose=pose))
    with pytest.raises(LumigraphError, match="are no rig"):
        jump.rig_of(turned)
    assert normalize(turned.cameras.forward, dim=1).shape == (CAMERAS, 3)


def test_eyes_wider_than_the_rig_are_a_fault():
    with pytest.raises(LumigraphError, match="farther apart"):
        jump.stereo_panorama(ring(), JumpOptions(128, interpupillary=3 * RADIUS))
