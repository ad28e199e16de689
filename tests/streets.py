"""A straight street between two walls of colours, as a folder with poses, for tests of scenes in blocks."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

SIZE, HALF_WIDTH, HALF_LENGTH, EYES = 16, 2.0, 6.0, 1.0


def write_street(folder: Path, photographs: int = 36, phase: float = 0.0, length: float = HALF_LENGTH) -> Path:
    """Cameras along x in pairs that look at either wall; z is up. phase: shifts the walls' colours"""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(photographs):
        forward = np.array([0.0, 1.0 if i % 2 else -1.0, 0.0])
        right = np.cross(forward, [0.0, 0.0, 1.0])
        down = np.cross(forward, right)
        eye = np.array([length * (2 * (i // 2) / (photographs // 2 - 1) - 1), 0.0, EYES])
        name = f"images/{i:03d}.png"
        Image.fromarray(picture(eye, right, down, forward, phase)).save(folder / name)
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, eye], -1)
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    lens = {"w": SIZE, "h": SIZE, "fl_x": SIZE, "fl_y": SIZE, "cx": SIZE / 2, "cy": SIZE / 2}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder


def picture(eye: np.ndarray, right: np.ndarray, down: np.ndarray, forward: np.ndarray, phase: float) -> np.ndarray:
    """Picture of the walls, bytes (height, width, 3)."""
    v, u = np.meshgrid(*[(np.arange(SIZE) + 0.5 - SIZE / 2) / SIZE] * 2, indexing="ij")
    ways = u[..., None] * right + v[..., None] * down + forward
    x, y, z = np.moveaxis(eye + (HALF_WIDTH / np.abs(ways[..., 1:2])) * ways, -1, 0)
    rgb = [0.5 + 0.4 * np.sin(1.3 * x + phase), 0.5 + 0.4 * np.sin(math.pi * z), np.where(y > 0, 0.8, 0.2)]
    return (255 * np.stack(rgb, -1)).astype(np.uint8)


def crossing_streets(across: int, along: int, apart: float, step: float, rig: int = 1) -> np.ndarray:
    """Places of photographs, (photograph, 2), along a grid of streets; of each, a rig takes so many."""
    width, height = (across - 1) * apart, (along - 1) * apart
    places = [(x, j * apart) for j in range(along) for x in np.arange(0, width + 1e-6, step)]
    places += [(i * apart, y) for i in range(across) for y in np.arange(0, height + 1e-6, step)]
    every = np.repeat(np.array(places), rig, 0)
    return every + 0.05 * np.random.default_rng(0).standard_normal(every.shape)
