"""Skinned characters of glTF files in the tracer: a plate for each triangle, moved by bones.

The tree over plates is built once, and its boxes are refitted to every further pose.
"""

from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from ..datasets.skeleton import Skeleton
from ..exchange.skinned_gltf import read_character, subdivided
from ..geometry import Similarity
from .characters import FILL, KEY, SKY, Joints
from .shapes import TRIANGLE
from .textures import Plain
from .world import MATERIAL, OBJECT, Arrays, Material, World, hierarchy

HALF_SIZE = 0.8  # of the character at rest along its longest side, scene units
MIN_TRIANGLES = 2000  # into which coarse meshes are cut, as each has one colour
THICKNESS = 3e-3  # of plates, scene units
REPEATS = 5  # of an animation in a capture
COLOUR_STEPS = 32  # of each channel, so that plates share materials
MIN_LENGTH = 1e-9  # of sides and normals, against division by zero


class SkinnedBody:
    """A character of a file at the origin, a `characters.Character`.

    clip, seconds: its animation, which repeats, and the duration
    """

    def __init__(self, path: Path, clip: int = 0, seconds: float = 0.0):
        self.path, self.number = path, clip
        self.character = subdivided(read_character(path), MIN_TRIANGLES)
        self.clip = self.character.clip(clip) if self.character.clips else self.character.skeleton
        self.seconds = seconds or REPEATS * self.clip.times[-1]
        low, high = self.character.vertices.min(0), self.character.vertices.max(0)
        scale = 2 * HALF_SIZE / float((high - low).max())
        middle = torch.from_numpy(-scale * 0.5 * (low + high))
        self.placed = Similarity.make(scale, translation=middle)
        self.skeleton: Skeleton = self.character.skeleton.transformed(self.placed)
        self.vertices = self.placed.points(torch.from_numpy(self.character.vertices)).numpy()
        rest = self.character.vertices[self.character.faces]
        solid = np.linalg.norm(np.cross(rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]), axis=1) > MIN_LENGTH
        self.faces: Int[np.ndarray, "face 3"] = self.character.faces[solid]
        shade = 255 / COLOUR_STEPS
        colours = (self.character.colours[solid] / shade).round() * shade / 255
        distinct, self.material = np.unique(colours.clip(0, 1), axis=0, return_inverse=True)
        paints = (Material(Plain(tuple(colour)), gloss=0.1, roughness=0.6) for colour in distinct.tolist())
        self.materials = np.array([paint.describe() for paint in paints], MATERIAL)

    def __repr__(self) -> str:
        about = self.path.stat()
        return (
            f"skinned {self.path.resolve()} {about.st_size} {about.st_mtime_ns} {self.number} {HALF_SIZE} {THICKNESS}"
        )

    def pose(self, share: float) -> Joints:
        """Joints at a time from 0 to 1."""
        found = self.character.pose(self.number, share * self.seconds)
        moved = self.placed.points(torch.from_numpy(found[:, :, 3].copy())).numpy()
        return np.concatenate([found[:, :, :3], moved[:, :, None]], -1)

    def skinned(self, pose: Joints) -> Float[np.ndarray, "vertex 3"]:
        """Vertices in a pose."""
        rest = self.skeleton.rest.matrices.numpy()
        turn = pose[:, :, :3] @ rest[:, :, :3].transpose(0, 2, 1)
        shift = pose[:, :, 3] - (turn @ rest[:, :, 3:])[:, :, 0]
        weights = self.character.weights
        return np.einsum("vij,vj->vi", np.tensordot(weights, turn, 1), self.vertices) + weights @ shift

    def extent(self, pose: Joints) -> tuple[np.ndarray, np.ndarray]:
        """Bounding box in a pose: lowest and highest corner."""
        vertices = self.skinned(pose)
        return vertices.min(0), vertices.max(0)

    def world(self, pose: Joints) -> World:
        """The character in a pose, with light."""
        lit = World((), (KEY, FILL), SKY)
        empty = lit.arrays
        objects, low, high = self.plates(self.skinned(pose))
        nodes = self.tree[0].copy()
        nodes["low"], nodes["high"] = fitted_boxes(self.tree[0], self.tree[1], low, high)
        # What `arrays` would find, without an object for each plate.
        lit.__dict__["arrays"] = Arrays(objects, self.materials, empty.lights, empty.sky, nodes)
        lit.__dict__["names"] = ("body",)
        return lit

    @cached_property
    def tree(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Tree over the plates at rest, and its inner nodes by their depth, the deepest first."""
        _, low, high = self.plates(self.vertices)
        nodes = hierarchy(list(zip(low, high, strict=True)))
        depth = np.zeros(len(nodes), int)
        for i in np.flatnonzero(nodes["object"] < 0):
            first = i + 1
            depth[[first, nodes["skip"][first]]] = depth[i] + 1
        inner = np.flatnonzero(nodes["object"] < 0)
        return nodes, [inner[depth[inner] == level] for level in range(depth.max(), -1, -1)]

    def plates(self, vertices: Float[np.ndarray, "vertex 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A row of OBJECT for each triangle, and the corners of its box; see `shapes.triangle_of`."""
        corners = vertices[self.faces]
        sides = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2)
        order = (sides.argmax(1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners, order[:, :, None], 1).transpose(1, 0, 2)
        long = np.maximum(np.linalg.norm(b - a, axis=1), MIN_LENGTH)[:, None]
        x, normal = (b - a) / long, np.cross(b - a, c - a)
        size = np.linalg.norm(normal, axis=1, keepdims=True)
        z = np.where(size > MIN_LENGTH**2, normal / np.maximum(size, MIN_LENGTH**2), np.roll(x, 1, 1))
        y = np.cross(z, x)
        along, up = ((c - a) * x).sum(1, keepdims=True), ((c - a) * y).sum(1, keepdims=True)
        objects, rounding = np.zeros(len(corners), OBJECT), 0.5 * THICKNESS
        objects["kind"], objects["material"] = TRIANGLE, self.material
        up = np.maximum(up, MIN_LENGTH)
        objects["size"][:, :3] = np.concatenate([0.5 * long, along - 0.5 * long, 0.5 * up], 1)
        objects["size"][:, 5] = rounding
        half = np.concatenate([0.5 * long, 0.5 * up, 0 * up], 1) + rounding
        objects["half"], objects["rotation"] = half, np.stack([x, y, z], 2)
        objects["position"] = a + 0.5 * long * x + 0.5 * up * y
        reach = np.einsum("fij,fj->fi", np.abs(objects["rotation"]), half)
        return objects, objects["position"] - reach, objects["position"] + reach


def fitted_boxes(
    nodes: np.ndarray, levels: list[np.ndarray], low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Refit the boxes of a tree's nodes to new boxes of the same objects. levels: its inner nodes, the deepest first"""
    leaves = nodes["object"] >= 0
    own = nodes["object"].clip(0)
    lowest, highest = np.where(leaves[:, None], low[own], 0), np.where(leaves[:, None], high[own], 0)
    for inner in levels:
        first = inner + 1
        second = nodes["skip"][first]
        lowest[inner] = np.minimum(lowest[first], lowest[second])
        highest[inner] = np.maximum(highest[first], highest[second])
    return lowest, highest
