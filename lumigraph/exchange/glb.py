"""Clouds as glTF, one .glb file: the extension KHR_gaussian_splatting, ratified by Khronos in 2026.

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting. A primitive of points has
an attribute for each quantity, float32: POSITION, ROTATION (x, y, z, w), SCALE (no logarithm), OPACITY (after the
sigmoid) and SH_DEGREE_l_COEF_n. COLOR_0, in linear light, is for programs that draw points and lack the extension.
glTF has y up and z back, so all is rotated by 180 degrees around x.

The only loss is float32 rounding, so opacities beyond 1 - 2^-24 become 1. `antialiased`, which the extension lacks, is
in the primitive's extras. A Gaussian takes 64 + 12 (K - 1) bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from ..color.srgb import linear_from_srgb
from ..errors import LumigraphError
from ..files import write_bytes
from ..files.ranges import format_value
from ..gaussians import Gaussians
from ..geometry import is_similarity, to_matrix
from ..kernels.spherical_harmonics import K00
from . import gltf
from .checks import check_room
from .codes import TURN_HARMONICS, TURN_MEAN, TURN_ROTATION, array, cloud, from_scales, to_scales, unit

EXTENSION = "KHR_gaussian_splatting"
ROTATION, SCALE, OPACITY = (f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))
HARMONICS = [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{i}" for band in range(4) for i in range(2 * band + 1)]
KERNEL_PROPERTIES = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}  # what is written, and all that is read
KNOWN_EXTENSIONS = {EXTENSION, "KHR_mesh_quantization"}
POINTS = 0
ANTIALIASED = "antialiased"
MAX_JSON_BYTES = 1 << 24  # bytes of JSON


def recognises(path: Path) -> bool:
    """True if a .glb file has Gaussians, not meshes: its JSON names the extension."""
    with open(path, "rb") as file:
        head = file.read(gltf.HEADER.size + gltf.CHUNK.size)
        if head[:4] != gltf.MAGIC or len(head) < gltf.HEADER.size + gltf.CHUNK.size:
            return False
        length, _ = gltf.CHUNK.unpack_from(head, gltf.HEADER.size)
        return f'"{EXTENSION}"'.encode() in file.read(min(MAX_JSON_BYTES, length))


def read(path: Path) -> Gaussians:
    """Read all clouds of the scene as one, with their nodes' transforms; meshes are skipped.

    Raises LumigraphError for unknown extensions, kernels and colours, and for damaged files.
    """
    file = gltf.File(path)
    if unknown := sorted({*file.about.extensions_required} - KNOWN_EXTENSIONS):
        raise LumigraphError(
            f"{path} needs {format_value(', '.join(unknown))}, which is not read here; export it without"
        )
    placed = [
        (primitive, matrix)
        for mesh, matrix in _placed(file)
        for primitive in file.one(file.about.meshes, mesh, "mesh").primitives
        if EXTENSION in primitive.extensions
    ]
    if not placed:
        raise LumigraphError(f"{path} holds no Gaussians, for nothing in its scene has {EXTENSION}; name another file")
    most = max(_bands(file, primitive) for primitive, _ in placed)
    check_room(path, sum(_count(file, primitive) for primitive, _ in placed), most**2)
    parts = [_cloud(file, primitive, most, matrix) for primitive, matrix in placed]
    names = "means", "quaternions", "log_scales", "opacities", "harmonics"
    whole = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return Gaussians(**whole, antialiased=all(part.antialiased for part in parts))


def _placed(file: gltf.File) -> Iterator[tuple[int, Float[np.ndarray, "4 4"]]]:
    """Meshes of the scene, and their transforms. Raises LumigraphError if nodes are no trees."""
    about = file.about
    if about.scenes:
        roots = file.one(about.scenes, about.scene, "scene").nodes
    else:
        roots = sorted({*range(len(about.nodes))} - {child for node in about.nodes for child in node.children})
    waiting, seen = [(root, np.eye(4)) for root in reversed(roots)], set()
    while waiting:
        index, above = waiting.pop()
        if index in seen:
            raise LumigraphError(f"{file.path} has node {index} in two places, where nodes are trees; export it again")
        seen.add(index)
        node = file.one(about.nodes, index, "node")
        matrix = above @ node_matrix(file, node)
        if node.mesh is not None:
            yield node.mesh, matrix
        waiting += [(child, matrix) for child in reversed(node.children)]


def node_matrix(file: gltf.File, node: gltf.Node) -> Float[np.ndarray, "4 4"]:
    """Transform from a node's frame to its parent's."""
    sizes = len(node.rotation), len(node.scale), len(node.translation), len(node.matrix or range(16))
    if sizes != (4, 3, 3, 16):
        raise LumigraphError(f"{file.path} has a node whose place is no place; export it again")
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    x, y, z, w = node.rotation
    turn = to_matrix(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
    matrix = np.eye(4)
    matrix[:3, :3] = turn * np.array(node.scale)
    matrix[:3, 3] = node.translation
    return matrix


def _bands(file: gltf.File, primitive: gltf.Primitive) -> int:
    """Number of bands of harmonics of a primitive. Raises LumigraphError if the primitive is of another kind,
    compressed or incomplete."""
    about = primitive.extensions[EXTENSION]
    about = about if isinstance(about, dict) else {}
    if primitive.mode != POINTS or any(about.get(name) != value for name, value in KERNEL_PROPERTIES.items()):
        kernel, colours = format_value(about.get("kernel")), format_value(about.get("colorSpace"))
        found = f"mode {primitive.mode}, kernel {kernel}, colours {colours}"
        raise LumigraphError(
            f"{file.path} has Gaussians of another kind ({found}), where points, ellipse and srgb_rec709_display are "
            "read; export it as those"
        )
    if inner := about.get("extensions"):
        by = ", ".join(inner) if isinstance(inner, dict) else inner
        raise LumigraphError(f"{file.path} packs its Gaussians by {format_value(by)}; export it without compression")
    bands = 1 + math.isqrt(max((i for i, name in enumerate(HARMONICS) if name in primitive.attributes), default=0))
    wanted = ["POSITION", ROTATION, SCALE, OPACITY, *HARMONICS[: bands**2]]
    if missing := [name for name in wanted if name not in primitive.attributes]:
        raise LumigraphError(f"{file.path} lacks {', '.join(missing)}; export it again")
    return bands


def _count(file: gltf.File, primitive: gltf.Primitive) -> int:
    """Number of Gaussians. Raises LumigraphError unless all attributes have equally many."""
    names = ["POSITION", ROTATION, SCALE, OPACITY, *(name for name in HARMONICS if name in primitive.attributes)]
    counts = {file.accessor(primitive.attributes[name]).count for name in names}
    if len(counts) > 1:
        raise LumigraphError(f"{file.path} has attributes of {sorted(counts)} rows, not equally many; export it again")
    return counts.pop()


def _cloud(file: gltf.File, primitive: gltf.Primitive, most: int, matrix: Float[np.ndarray, "4 4"]) -> Gaussians:
    """A primitive in this package's axes, with zeros for missing bands."""
    at, bands = primitive.attributes, _bands(file, primitive)
    harmonics = np.stack([file.numbers(at[name], (3,)) for name in HARMONICS[: bands**2]], 1)
    with np.errstate(divide="ignore"):  # 0 and 1 have logits that are infinite, and get others later
        opacities = file.numbers(at[OPACITY], (1,))[:, 0].astype(np.float64)
        opacities = np.where((opacities >= 0) & (opacities <= 1), opacities, np.nan)
        logits = np.log(opacities) - np.log1p(-opacities)
    found = cloud(
        file.numbers(at["POSITION"], (3,)),
        np.roll(file.numbers(at[ROTATION], (4,)), 1, -1),
        from_scales(file.numbers(at[SCALE], (3,))),
        logits,
        np.pad(harmonics, [(0, 0), (0, most**2 - bands**2), (0, 0)]),
        isinstance(primitive.extras, dict) and primitive.extras.get(ANTIALIASED) is True,
    )
    if not np.array_equal(matrix, np.eye(4)):
        place = torch.from_numpy(matrix)
        if not is_similarity(place):
            raise LumigraphError(f"{file.path} stretches or mirrors its Gaussians by a node; apply its place to them")
        found = found.transformed(place, far=True)
    return cloud(
        found.means.numpy() * TURN_MEAN,
        array(found.quaternions) * TURN_ROTATION,
        array(found.log_scales),
        array(found.opacities),
        array(found.harmonics) * TURN_HARMONICS[: most**2],
        found.antialiased,
    )


def write(path: Path, gaussians: Gaussians, offset: Float[np.ndarray, " 3"] | None = None) -> None:
    """Write a GLB file. Raises LumigraphError for an empty cloud, since glTF has no empty arrays.

    offset: of the node, which is added to the centres
    """
    if not len(gaussians):
        raise LumigraphError(f"{path} cannot hold a cloud of no Gaussians; write it as .ply")
    harmonics = array(gaussians.harmonics)
    opacities = 0.5 * (1 + np.tanh(array(gaussians.opacities).astype(np.float64) / 2))
    light = linear_from_srgb(np.clip(K00 * harmonics[:, 0] + 0.5, 0, 1))
    fallback = np.rint(65535 * np.concatenate([light, opacities[:, None]], 1)).astype("<u2")
    rotations = np.roll(unit(array(gaussians.quaternions)) * TURN_ROTATION, -1, -1)
    columns = {
        "POSITION": gltf.Column((array(gaussians.means) * TURN_MEAN).astype("<f4"), bounded=True),
        "COLOR_0": gltf.Column(fallback, normalised=True),
        ROTATION: gltf.Column(rotations.astype("<f4")),
        SCALE: gltf.Column(to_scales(array(gaussians.log_scales)).astype("<f4")),
        OPACITY: gltf.Column(opacities.astype("<f4")),
    }
    turned = (harmonics * TURN_HARMONICS[: harmonics.shape[1]]).astype("<f4")
    columns |= {HARMONICS[i]: gltf.Column(turned[:, i]) for i in range(turned.shape[1])}
    primitive = {
        "mode": POINTS,
        "attributes": {name: i for i, name in enumerate(columns)},
        "extensions": {EXTENSION: KERNEL_PROPERTIES},
    }
    if gaussians.antialiased:
        primitive["extras"] = {ANTIALIASED: True}
    node: dict[str, Any] = {"mesh": 0}
    if offset is not None:
        node["translation"] = (offset * TURN_MEAN).tolist()
    about = {
        "asset": {"version": "2.0", "generator": "Lumigraph"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
    }
    write_bytes(path, gltf.encoded(about, [*columns.values()]), "splats")
