"""Skinned characters as glTF, one .glb file: a mesh, the bones that move it, their animations (sections 3.7.3, 3.11).

Vertices and bones are converted to +z up and placed by the root joint's pose at the start of the first animation. A
skeleton here is rigid, so bones whose scale is animated are refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from ..datasets.skeleton import ROOT, BonePose, Skeleton
from ..errors import LumigraphError
from ..files.reading import reads
from . import gltf
from .glb import node_matrix
from .unpacked_gltf import base_colours, packed, unpacked

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # to +z
SCALE_TOLERANCE = 0.02  # relative, of the scale of a bone that counts as constant
TRIANGLES = 4
LISTED = ("POSITION", "JOINTS_0", "WEIGHTS_0")
PATHS = {"translation": 3, "rotation": 4, "scale": 3}  # of channels, and their numbers
SPOTS = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]], float)  # of a triangle, where its texture is looked up
SPOTS /= SPOTS.sum(1, keepdims=True)


@dataclass(frozen=True)
class AnimationClip:
    """An animation: keyframes of nodes by (node, path). seconds: of its last keyframe"""

    name: str
    seconds: float
    keys: dict[tuple[int, str], tuple[Float[np.ndarray, " key"], Float[np.ndarray, "key _"], bool]]


@dataclass(frozen=True)
class SkinnedCharacter:
    """A skinned character.

    vertices: at rest
    weights:  skinning weights of each vertex; they sum to 1
    colours:  of the triangles, sRGB-encoded
    skeleton: with the rest pose alone
    clips:    animations
    """

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    weights: Float[np.ndarray, "vertex bone"]
    colours: UInt8[np.ndarray, "face 3"]
    skeleton: Skeleton
    clips: tuple[AnimationClip, ...]
    nodes: _Nodes

    def pose(self, clip: int, seconds: float) -> Float[np.ndarray, "bone 3 4"]:
        """Joints at a time of an animation, which repeats; the rest pose without one."""
        if not self.clips:
            return self.skeleton.rest.matrices.numpy()
        chosen = self.clips[clip]
        return self.nodes.joints(chosen, seconds % chosen.seconds if chosen.seconds else 0.0)

    def clip(self, number: int) -> Skeleton:
        """The skeleton with the poses of an animation at its keyframes, times in seconds. Raises LumigraphError if
        there is none of that number."""
        if number >= len(self.clips):
            raise LumigraphError(
                f"{self.nodes.file.path} has {len(self.clips)} animations and none of number {number}; choose another"
            )
        keys = [moments for moments, _, _ in self.clips[number].keys.values()]
        times = np.unique(np.concatenate([moments.astype(float) for moments in keys]))
        poses = tuple(BonePose.of(torch.from_numpy(self.nodes.joints(self.clips[number], t))) for t in times)
        return replace(self.skeleton, times=tuple(times.tolist()), poses=poses)

    def skinned(self, pose: Float[np.ndarray, "bone 3 4"]) -> Float[np.ndarray, "vertex 3"]:
        """Vertices in a pose: linear blend skinning (section 3.7.3.3)."""
        rest = self.skeleton.rest.matrices.numpy()
        turn = pose[:, :, :3] @ rest[:, :, :3].transpose(0, 2, 1)
        shift = pose[:, :, 3] - (turn @ rest[:, :, 3:])[:, :, 0]
        each = np.einsum("bij,vj->vbi", turn, self.vertices) + shift
        return np.einsum("vb,vbi->vi", self.weights, each)


@dataclass(frozen=True)
class _Nodes:
    """Nodes of a file, and the joints among them. parents: of nodes, -1 for a root; joints: node of each bone"""

    file: gltf.File
    parents: tuple[int, ...]
    bones: tuple[int, ...]

    def worlds(self, clip: AnimationClip | None, seconds: float) -> Float[np.ndarray, "bone 4 4"]:
        """From the bones' frames to the scene, +z up."""
        found: dict[int, np.ndarray] = {}

        def world(index: int) -> np.ndarray:
            if index not in found:
                above = Y_UP if self.parents[index] < 0 else world(self.parents[index])
                found[index] = above @ self.local(index, clip, seconds)
            return found[index]

        return np.stack([world(index) for index in self.bones])

    def local(self, index: int, clip: AnimationClip | None, seconds: float) -> Float[np.ndarray, "4 4"]:
        node = self.file.about.nodes[index]
        keys = {} if clip is None else {path: clip.keys[index, path] for path in PATHS if (index, path) in clip.keys}
        if not keys:
            return node_matrix(self.file, node)
        changed = {path: tuple(sampled(*key, seconds, path == "rotation").tolist()) for path, key in keys.items()}
        fields = {path: changed.get(path, getattr(node, path)) for path in PATHS}
        return node_matrix(self.file, gltf.Node(**fields))

    def joints(self, clip: AnimationClip, seconds: float) -> Float[np.ndarray, "bone 3 4"]:
        """Rigid joint frames in the scene."""
        return rigid(self.worlds(clip, seconds))


@reads("is damaged", "export it again")
def read_character(path: Path) -> SkinnedCharacter:
    """The first skinned mesh of a file with its bones and animations. Raises LumigraphError for a file without one."""
    file = gltf.File(path, packed(*unpacked(path)))
    about = file.about
    index = next((i for i, node in enumerate(about.nodes) if node.mesh is not None and node.skin is not None), None)
    if index is None:
        raise LumigraphError(f"{path} holds no character, for no mesh in it has a skin; name another file")
    mesh, number = about.nodes[index].mesh, about.nodes[index].skin
    assert mesh is not None and number is not None
    skin = file.one(about.skins, number, "skin")
    if skin.inverse_bind_matrices is None:
        raise LumigraphError(f"{path} has a skeleton without a bind pose; export it with inverse bind matrices")
    order, parents = tree(file, skin.joints)
    bind = file.numbers(skin.inverse_bind_matrices, (16,)).astype(float).reshape(-1, 4, 4).transpose(0, 2, 1)
    if len(bind) != len(skin.joints):
        raise LumigraphError(f"{path} has {len(bind)} bind poses of {len(skin.joints)} joints; export it again")
    bind = bind[order]
    if np.abs(np.linalg.det(bind[:, :3, :3])).min() < 1e-12:
        raise LumigraphError(f"{path} has a bind pose that flattens space, so it has no inverse; export it again")
    bones = tuple(skin.joints[i] for i in order)
    above = {child: number for number, each in enumerate(about.nodes) for child in each.children}
    nodes = _Nodes(file, tuple(above.get(i, ROOT) for i in range(len(about.nodes))), bones)
    clips = tuple(clip_of(file, animation) for animation in about.animations)
    first = nodes.worlds(clips[0] if clips else None, 0.0)
    check_scales(path, nodes, clips, bind)
    place = first[0] @ bind[0]
    rest = rigid(place @ np.linalg.inv(bind))
    names = unique([about.nodes[i].name or f"joint {number}" for number, i in enumerate(bones)])
    pose = BonePose.of(torch.from_numpy(rest))
    skeleton = Skeleton(names, parents, pose, (0.0,), (pose,))
    vertices, faces, weights, colours = mesh_of(file, mesh, np.argsort(order))
    vertices = vertices @ place[:3, :3].T + place[:3, 3]
    return SkinnedCharacter(vertices, faces, weights, colours, skeleton, clips, nodes)


def tree(file: gltf.File, joints: list[int]) -> tuple[list[int], tuple[int, ...]]:
    """Joints sorted from the root on, as numbers in the skin, and each one's parent in this order."""
    above = {child: number for number, node in enumerate(file.about.nodes) for child in node.children}
    for joint in joints:
        file.one(file.about.nodes, joint, "node")

    def line(node: int) -> list[int]:
        found: list[int] = []
        while node in above and len(found) <= len(file.about.nodes):
            node = above[node]
            found.append(node)
        return found

    order = sorted(range(len(joints)), key=lambda i: len(line(joints[i])))
    place = {joints[i]: number for number, i in enumerate(order)}
    return order, tuple(next((place[up] for up in line(joints[i]) if up in place), ROOT) for i in order)


def mesh_of(file: gltf.File, mesh: int, place: Int[np.ndarray, " bone"]) -> tuple[np.ndarray, ...]:
    """Vertices, faces, weights and colours of faces of all triangles of a mesh. place: bone number of each joint"""
    vertices, faces, weights, colours, begin = [], [], [], [], 0
    for primitive in file.one(file.about.meshes, mesh, "mesh").primitives:
        if primitive.mode != TRIANGLES or (lacking := [x for x in LISTED if x not in primitive.attributes]):
            what = "are no triangles" if primitive.mode != TRIANGLES else f"lack {', '.join(lacking)}"
            raise LumigraphError(f"{file.path} has skinned surfaces that {what}; export it again")
        points = file.numbers(primitive.attributes["POSITION"], (3,)).astype(float)
        which = file.numbers(primitive.attributes["JOINTS_0"], (4,)).astype(int)
        share = file.numbers(primitive.attributes["WEIGHTS_0"], (4,)).astype(float).clip(0)
        numbers = np.arange(len(points)) if primitive.indices is None else file.numbers(primitive.indices, (1,))[:, 0]
        corners = numbers.astype(int)[: len(numbers) // 3 * 3].reshape(-1, 3)
        if not len(points) == len(which) == len(share) or which.max() >= len(place) or corners.max() >= len(points):
            raise LumigraphError(f"{file.path} names joints or corners that it does not have; export it again")
        total = share.sum(1, keepdims=True)
        share = np.where(total > 0, share / np.where(total > 0, total, 1), [1.0, 0, 0, 0])  # files need not sum to 1
        own = np.zeros((len(points), len(place)))
        np.add.at(own, (np.arange(len(points))[:, None], place[which]), share)
        vertices.append(points)
        weights.append(own)
        faces.append(corners + begin)
        colours.append(base_colours(file, primitive, corners, SPOTS))
        begin += len(points)
    return tuple(np.concatenate(part) for part in (vertices, faces, weights, colours))


def clip_of(file: gltf.File, animation: gltf.Animation) -> AnimationClip:
    """Keyframes of an animation's nodes; of cubic splines only the values at keyframes."""
    keys = {}
    for channel in animation.channels:
        node, path = channel.target.node, channel.target.path
        if node is None or path not in PATHS:
            continue
        sampler = file.one(animation.samplers, channel.sampler, "sampler")
        moments = file.numbers(sampler.input, (1,))[:, 0]
        values = file.numbers(sampler.output, (PATHS[path],))
        if sampler.interpolation == "CUBICSPLINE":
            values = values[1::3]
        if not len(moments) or len(values) != len(moments):
            raise LumigraphError(f"{file.path} has {len(moments)} keyframes of {len(values)} values; export it again")
        keys[node, path] = moments, values, sampler.interpolation == "STEP"
    return AnimationClip(animation.name, max((float(key[0][-1]) for key in keys.values()), default=0.0), keys)


def sampled(
    moments: Float[np.ndarray, " key"],
    values: Float[np.ndarray, "key _"],
    steps: bool,
    seconds: float,
    rotation: bool,
) -> Float[np.ndarray, " _"]:
    """Interpolated value at a time between keyframes: linear, for rotations spherical (appendix C)."""
    after = int(np.searchsorted(moments, seconds, side="right").clip(1, max(len(moments) - 1, 1)))
    if len(moments) == 1:
        return values[0].astype(float)
    a, b = values[after - 1].astype(float), values[after].astype(float)
    share = float(np.clip((seconds - moments[after - 1]) / max(moments[after] - moments[after - 1], 1e-9), 0, 1))
    if steps:
        return b if share >= 1 else a
    if not rotation:
        return (1 - share) * a + share * b
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    b, angle = (b if cosine >= 0 else -b), float(np.arccos(min(abs(cosine), 1.0)))
    if angle < 1e-6:
        return b
    return (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)


def rigid(matrices: Float[np.ndarray, "bone 4 4"]) -> Float[np.ndarray, "bone 3 4"]:
    """Rotation and position of frames, without their scale."""
    u, _, vt = np.linalg.svd(matrices[:, :3, :3])
    return np.concatenate([u @ vt, matrices[:, :3, 3:]], -1)


def check_scales(
    path: Path, nodes: _Nodes, clips: tuple[AnimationClip, ...], bind: Float[np.ndarray, "bone 4 4"]
) -> None:
    """Raise LumigraphError for animated and for anisotropic scales of bones."""
    for clip in clips or (None,):
        for seconds in np.linspace(0, clip.seconds if clip else 0.0, 4):
            sizes = np.linalg.svd((nodes.worlds(clip, seconds) @ bind)[:, :3, :3], compute_uv=False)
            if np.ptp(sizes) > SCALE_TOLERANCE * sizes.mean():
                raise LumigraphError(f"{path} animates the scale of bones, and they are rigid here; export it without")


def unique(names: list[str]) -> tuple[str, ...]:
    """The names, duplicates numbered."""
    seen: dict[str, int] = {}
    found = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        found.append(name if seen[name] == 1 else f"{name} {seen[name]}")
    return tuple(found)


def subdivided(character: SkinnedCharacter, least: int) -> SkinnedCharacter:
    """The character with triangles subdivided into four until there are at least so many; colours are inherited."""
    while len(character.faces) < least:
        character = _cut(character)
    return character


def _cut(character: SkinnedCharacter) -> SkinnedCharacter:
    a, b, c = character.faces.T
    count, n = len(character.vertices), len(a)
    pairs = ((a, b), (b, c), (c, a))
    middle = partial(lambda x: np.concatenate([0.5 * (x[i] + x[j]) for i, j in pairs]))
    ab, bc, ca = (count + k * n + np.arange(n) for k in range(3))
    faces = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return replace(
        character,
        vertices=np.concatenate([character.vertices, middle(character.vertices)]),
        weights=np.concatenate([character.weights, middle(character.weights)]),
        faces=faces,
        colours=np.concatenate([character.colours] * 4),
    )
