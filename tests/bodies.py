"""A bar of two bones, for tests of bodies: its file, its skeleton, and a scene's frame with it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tiny
import torch

from lumigraph.datasets.scene import Frame
from lumigraph.datasets.skeleton import BonePose, Skeleton, posed
from lumigraph.exchange.gltf import INDICES, Column, encoded
from lumigraph.geometry import to_matrix

BEND = math.radians(90)


def bent(angle: float) -> torch.Tensor:
    """Joints of the bar along z whose upper half turns about x, 3x4 matrices."""
    local = torch.eye(3, 4).double().repeat(2, 1, 1)
    local[0, 2, 3], local[1, 2, 3] = -0.4, 0.4
    half = angle / 2
    local[1, :, :3] = to_matrix(torch.tensor([[math.cos(half), math.sin(half), 0, 0]]).double())[0]
    return posed((-1, 0), local)


def skeleton() -> Skeleton:
    """The bar straight at time 1, bent by a right angle at time 3."""
    poses = tuple(BonePose.of(bent(angle)) for angle in (0.0, BEND))
    return Skeleton(("lower", "upper"), (-1, 0), poses[0], (1.0, 3.0), poses)


def frame() -> Frame:
    return replace(tiny.scene().frame, skeleton=skeleton(), times=(1.0, 3.0))


def write_bar(path: Path, change: Any = None) -> Path:
    """A skinned bar along y, as a .glb: 6 vertices, 4 triangles, weights that sum to a half, a clip that bends it."""
    vertices = np.array([[x, y, 0] for y in (-1, 0, 1) for x in (-0.2, 0.2)], np.float32)
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]], np.uint16)
    joints = np.repeat(np.array([[0, 1, 0, 0]], np.uint8), 6, 0)
    weights = np.repeat(np.array([[0.5, 0], [0.25, 0.25], [0, 0.5]], np.float32), 2, 0)
    weights = np.concatenate([weights, np.zeros((6, 2), np.float32)], 1)
    bind = np.repeat(np.eye(4, dtype=np.float32)[None], 2, 0)
    bind[0, 1, 3] = 1  # inverse of the joint at y = -1
    times = np.array([0, 1], np.float32)
    turns = np.array([[0, 0, 0, 1], [math.sin(BEND / 2), 0, 0, math.cos(BEND / 2)]], np.float32)
    columns = [
        Column(vertices, bounded=True),
        Column(joints),
        Column(weights),
        Column(faces.reshape(-1), target=INDICES),
    ]
    columns += [Column(bind.transpose(0, 2, 1).reshape(2, 16)), Column(times, bounded=True), Column(turns)]
    sampler, channel = {"input": 5, "output": 6}, {"sampler": 0, "target": {"node": 2, "path": "rotation"}}
    attributes = {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}
    about = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [
            {"mesh": 0, "skin": 0},
            {"name": "lower", "translation": [0, -1, 0], "children": [2]},
            {"name": "upper", "translation": [0, 1, 0]},
        ],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": 4}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1.0, 0.0, 0.0, 1.0]}}],
        "animations": [{"name": "bend", "samplers": [sampler], "channels": [channel]}],
    }
    if change is not None:
        change(about)
    path.write_bytes(encoded(about, columns))
    return path
