"""Photographs of the corner of a room, drawn for structure from motion: three walls with random patterns."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageFilter

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
TARGET = np.array([0.9, 0.9, 0.5])
WALL = 4.0  # side of each wall


@cache
def pattern(seed: int, size: int = 768) -> np.ndarray:
    """Noise at several scales, as colours in [0, 255]."""
    chance = np.random.default_rng(seed)
    total = np.zeros((size, size, 3))
    for cells, weight in ((16, 1.0), (64, 1.0), (160, 0.9), (320, 0.6)):
        noise = Image.fromarray(chance.integers(0, 256, (cells, cells, 3), dtype=np.uint8))
        total += weight * np.asarray(noise.resize((size, size), Image.Resampling.BICUBIC), float)
    low, high = np.percentile(total, [1, 99])
    return ((total - low) / (high - low)).clip(0, 1) * 255


def look_at(eye: np.ndarray, target: np.ndarray = TARGET) -> np.ndarray:
    """Camera-to-world, (3, 4), +x right, +y down, +z forward; up is +z of the world."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward, eye], -1)


def arc(count: int, distance: float = 3.0) -> list[np.ndarray]:
    """Cameras around the corner, at eye's height and a little above and below."""
    angles = np.linspace(np.radians(12), np.radians(78), count)
    return [look_at(np.array([distance * np.cos(a), distance * np.sin(a), 1.2 + 0.25 * np.sin(5 * a)])) for a in angles]


def pinhole(width: int = WIDTH, height: int = HEIGHT, focal: float = FOCAL) -> np.ndarray:
    """Direction of each pixel in the camera's frame."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)], -1)


def panorama(width: int) -> np.ndarray:
    """The same of an equirectangular panorama."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(width // 2) + 0.5)
    longitude, latitude = (2 * x / width - 1) * np.pi, (2 * y / width - 0.5) * np.pi
    level = np.cos(latitude)
    return np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], -1)


def draw(pose: np.ndarray, walls: list[np.ndarray], inward: np.ndarray | None = None) -> Image.Image:
    """Picture of the walls x = 0, y = 0 and z = 0, and of those opposite if there are more."""
    inward = pinhole() if inward is None else inward
    directions, eye = inward @ pose[:, :3].T, pose[:, 3]
    picture, nearest = np.zeros(inward.shape), np.full(inward.shape[:2], np.inf)
    for i, wall in enumerate(walls):
        axis = i % 3
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (WALL * (i // 3) - eye[axis]) / directions[..., axis]
            hits = eye + away[..., None] * directions
        u, v = (np.delete(hits, axis, -1) / WALL * (len(wall) - 1)).transpose(2, 0, 1)
        shown = (away > 0) & (away < nearest) & (u >= 0) & (v >= 0) & (u < len(wall) - 1) & (v < len(wall) - 1)
        nearest[shown] = away[shown]
        picture[shown] = between(wall, u[shown], v[shown])
    return Image.fromarray(picture.round().astype(np.uint8))


def between(wall: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear."""
    i, j = v.astype(int), u.astype(int)
    s, t = (v - i)[:, None], (u - j)[:, None]
    upper = (1 - t) * wall[i, j] + t * wall[i, j + 1]
    return (1 - s) * upper + s * ((1 - t) * wall[i + 1, j] + t * wall[i + 1, j + 1])


def write_views(folder: Path, count: int = 12) -> dict[str, np.ndarray]:
    """JPEGs view00.jpg, view01.jpg, ...; gives the pose of each."""
    folder.mkdir(parents=True, exist_ok=True)
    walls = [pattern(seed) for seed in range(3)]
    poses = {f"view{i:02d}.jpg": pose for i, pose in enumerate(arc(count))}
    for name, pose in poses.items():
        draw(pose, walls).save(folder / name, quality=95)
    return poses


def spoil(folder: Path) -> dict[str, list[str]]:
    """Add one that is blurred, a duplicate, two of something else, a blank and a broken one; gives the names."""
    walls = [pattern(seed) for seed in range(3)]
    blurred = draw(arc(12)[4] + np.array([0, 0, 0, 0.05]), walls).filter(ImageFilter.GaussianBlur(6))
    blurred.save(folder / "blurred.jpg", quality=95)
    with Image.open(folder / "view03.jpg") as image:
        image.save(folder / "again.jpg", quality=90)
    for i in range(2):
        stranger = Image.fromarray(pattern(20 + i, 512).astype(np.uint8)).resize((WIDTH, HEIGHT))
        stranger.save(folder / f"stranger{i}.jpg", quality=95)
    Image.new("RGB", (WIDTH, HEIGHT), "#8090a0").save(folder / "blank.jpg")
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no picture")
    return {
        "blurred": ["blurred.jpg"],
        "duplicates": ["again.jpg"],
        "left_out": ["blank.jpg", "broken.jpg", "stranger0.jpg", "stranger1.jpg"],
    }
