"""Folder of SNeRG's viewer: scene_params.json, slices of the atlas as PNG, and the positions of its blocks.

https://github.com/google-research/google-research/tree/master/snerg. Four layers of the atlas are in a picture, one
below another: rgba_000.png has colours and alpha, feature_000.png the features. atlas_indices.png has the position in
the atlas of each block of the grid, 255 for empty ones. Without a network there are neither features nor weights.

An open capture's atlas is in contracted coordinates, which the format does not have: "contracted" in
scene_params.json is our extension, and other viewers show such an atlas distorted.

The viewer's world has +y up, so x, y, z of the scene are -x, z, y there; worldspace_T_opengl is the inverse.

Pixels differ in one point: the viewer adds the network's output wherever a ray met anything, before compositing over
white, and its input is the colours over that white; ours adds it by opacity, and its input is the premultiplied
colours. They agree on opaque pixels, which are all but an object's outermost.
"""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from ..errors import LumigraphError
from ..files import claim_folder, from_json, replacing_folder
from ..files.ranges import Coordinate, Positive, Row, between, typed
from ..files.reading import reading, reads
from ..system.memory import free_memory, gigabytes
from ..system.progress import track
from .baked import Atlas, ViewNetwork
from .checks import Bundle

META, INDICES = "scene_params.json", "atlas_indices.png"
EMPTY_INDEX = 255  # in atlas_indices.png
LAYERS = 4  # of the atlas in one picture
NETWORK_INPUTS = 34  # of the network: the direction's encoding, three colours, four features
# The scene's axes in those of the viewer, and back: the same turn.
AXES = ((-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
READING_FACTOR = 4  # times the atlas, that reading takes

Blocks = Annotated[int, between(1, 254)]
Voxels = Annotated[int, between(1, 1 << 16)]
Weights = Annotated[tuple[tuple[Coordinate, ...], ...], msgspec.Meta(min_length=1, max_length=1024)]
Bias = Annotated[tuple[Coordinate, ...], msgspec.Meta(min_length=1, max_length=1024)]


@dataclass(frozen=True)
class Params:
    """Content of scene_params.json; "0_weights" is called weights_0 here."""

    voxel_size: Positive
    block_size: Blocks
    grid_width: Voxels
    grid_height: Voxels
    grid_depth: Voxels
    atlas_width: Voxels
    atlas_height: Voxels
    atlas_depth: Voxels
    num_slices: Voxels
    min_x: Coordinate
    min_y: Coordinate
    min_z: Coordinate
    atlas_blocks_x: Blocks
    atlas_blocks_y: Blocks
    atlas_blocks_z: Blocks
    worldspace_T_opengl: tuple[Row, Row, Row, Row]  # noqa: N815
    ndc: bool = False
    contracted: bool = False
    format: str = "png"
    weights_0: Weights | None = None
    weights_1: Weights | None = None
    weights_2: Weights | None = None
    bias_0: Bias | None = None
    bias_1: Bias | None = None
    bias_2: Bias | None = None

    def check(self) -> None:
        """Raise LumigraphError for inconsistent or unsupported numbers."""
        side = self.block_size + 2
        sizes = self.atlas_width, self.atlas_height, self.atlas_depth
        if sizes != tuple(side * n for n in self.atlas_blocks) or LAYERS * self.num_slices != self.atlas_depth:
            raise LumigraphError(
                f"An atlas of {sizes} voxels in {self.num_slices} slices does not hold {self.atlas_blocks} blocks of "
                f"{side}; write the folder anew"
            )
        if self.ndc:
            raise LumigraphError("Its scene lies in normalised device coordinates, which is not read; bake it without")
        if self.format != "png":
            raise LumigraphError(f"Its slices are {self.format!r}, of which only png is read; write them as that")
        to_scene = np.array(self.worldspace_T_opengl)
        if self.contracted and (
            len({self.grid_width, self.grid_height, self.grid_depth}) > 1
            or self.grid_width % self.block_size
            or abs(self.grid_width * self.voxel_size - 4) > 1e-3
            or max(abs(low + 2) for low in (self.min_x, self.min_y, self.min_z)) > 1e-3
            or to_scene[:3, 3].any()
        ):
            raise LumigraphError(
                "A contracted scene fills the cube of [-2, 2]^3, and its grid does not; export it anew"
            )
        turn = to_scene[:3, :3]
        if sorted(np.abs(turn).ravel()) != [0] * 6 + [1] * 3 or np.linalg.det(turn) < 0:
            raise LumigraphError("worldspace_T_opengl turns by something other than right angles; bake it upright")

    @property
    def atlas_blocks(self) -> tuple[int, int, int]:
        return self.atlas_blocks_x, self.atlas_blocks_y, self.atlas_blocks_z

    @property
    def grid_blocks(self) -> tuple[int, int, int]:
        x, y, z = (math.ceil(n / self.block_size) for n in (self.grid_width, self.grid_height, self.grid_depth))
        return x, y, z

    @property
    def network(self) -> ViewNetwork | None:
        """Network of the parameters. Raises LumigraphError for layers that do not fit."""
        if self.bias_0 is None:
            return None
        layers = (self.weights_0, self.bias_0), (self.weights_1, self.bias_1), (self.weights_2, self.bias_2)
        weights, biases, inputs = [], [], NETWORK_INPUTS
        for number, (rows, bias) in enumerate(layers):
            widths = {len(row) for row in rows or ()}
            if bias is None or len(rows or ()) != inputs or widths != {len(bias)} or (number == 2 and len(bias) != 3):
                raise LumigraphError(f"Layer {number} of its network does not fit the one before; write it anew")
            weights.append(torch.tensor(rows))
            biases.append(torch.tensor(bias))
            inputs = len(bias)
        return ViewNetwork((weights[0], weights[1], weights[2]), (biases[0], biases[1], biases[2]))


def recognises(folder: Path) -> bool:
    """True if a folder has a SNeRG scene."""
    return (folder / META).is_file() or (folder / INDICES).is_file()


# Writing


def write(folder: Path, atlas: Atlas) -> None:
    """Write an atlas as a SNeRG folder, atomically. Raises LumigraphError for more blocks than the format allows, and
    as `files.claim_folder` does."""
    claim_folder(folder, "atlas")
    atlas = turned(atlas, np.array(AXES)[:3, :3])
    side = atlas.block + 2
    packed, blocks = arranged(atlas.values.numpy())
    x, y, z = blocks
    if max(blocks) >= EMPTY_INDEX:
        raise LumigraphError(
            f"The atlas has {len(atlas.values):,} blocks of {side} voxels, more than the format counts; "
            "bake with a larger --block-size or a smaller --resolution"
        )
    with replacing_folder(folder, "atlas") as new:
        slices = packed.reshape(-1, LAYERS * y * side, x * side, 8)
        kinds = {"rgba": slice(0, 4)} | ({"feature": slice(4, 8)} if atlas.network else {})
        for number, layers in enumerate(track(slices, "Writing slices", len(slices))):
            for kind, channels in kinds.items():
                Image.fromarray(np.ascontiguousarray(layers[..., channels])).save(new / f"{kind}_{number:03d}.png")
        Image.fromarray(indices(atlas.index.numpy(), blocks)).save(new / INDICES)
        fields = params(atlas, blocks)
        (new / META).write_text(json.dumps(fields, allow_nan=False), "utf-8")


def arranged(
    values: UInt8[np.ndarray, "block side side side 8"],
) -> tuple[UInt8[np.ndarray, "depth height width 8"], tuple[int, int, int]]:
    """Blocks arranged in about a cube, padded to whole pictures of layers; and their number along x, y, z."""
    count, side = values.shape[:2]
    x = max(1, math.ceil(count ** (1 / 3) - 1e-9))
    y = max(1, math.ceil(math.sqrt(count / x) - 1e-9))
    z = max(1, math.ceil(count / (x * y)))
    z += -z % (LAYERS // math.gcd(LAYERS, side))
    full = np.zeros((x * y * z, *values.shape[1:]), np.uint8)
    full[:count] = values
    layers = full.reshape(z, y, x, side, side, side, 8).transpose(0, 5, 1, 4, 2, 3, 6)
    return layers.reshape(z * side, y * side, x * side, 8), (x, y, z)


def indices(index: np.ndarray, blocks: tuple[int, int, int]) -> UInt8[np.ndarray, "row column 3"]:
    """Position of each grid block in the atlas; rows are z, then y."""
    x, y, _ = blocks
    places = np.stack([index % x, index // x % y, index // (x * y)], -1)
    places = np.where(index[..., None] < 0, EMPTY_INDEX, places).astype(np.uint8)
    return np.ascontiguousarray(places.transpose(2, 1, 0, 3).reshape(-1, len(index), 3))


def params(atlas: Atlas, blocks: tuple[int, int, int]) -> dict[str, Any]:
    """scene_params.json of an atlas in the viewer's axes."""
    side = atlas.block + 2
    fields: dict[str, Any] = {"voxel_size": atlas.voxel, "block_size": atlas.block}
    names = "width", "height", "depth"
    fields |= {f"grid_{name}": n * atlas.block for name, n in zip(names, atlas.index.shape, strict=True)}
    fields |= {f"atlas_{name}": n * side for name, n in zip(names, blocks, strict=True)}
    fields |= {"num_slices": blocks[2] * side // LAYERS}
    fields |= {f"min_{axis}": low for axis, low in zip("xyz", atlas.low.tolist(), strict=True)}
    fields |= {f"atlas_blocks_{axis}": n for axis, n in zip("xyz", blocks, strict=True)}
    fields |= {"input_height": 800.0, "input_width": 800.0, "input_focal": 1111.0}  # of cameras, used for ndc only
    fields |= {"worldspace_T_opengl": AXES, "ndc": False, "format": "png"}
    if atlas.contracted:
        fields |= {"contracted": True}
    if atlas.network:
        for number, (weight, bias) in enumerate(zip(atlas.network.weights, atlas.network.biases, strict=True)):
            fields |= {f"{number}_weights": weight.tolist(), f"{number}_bias": bias.tolist()}
    return fields


# Reading


@reads("is damaged", "copy the whole folder again")
def read(folder: Path) -> Atlas:
    """Read the atlas of a SNeRG folder, in the scene's axes. Raises LumigraphError, in one sentence, for a slice that
    is missing, truncated or of another size, and for inconsistent numbers."""
    bundle = Bundle(folder)
    fields = from_json(bundle.read(META), f"{META} of {folder}")
    if isinstance(fields, dict):
        fields = {re.sub(r"^([012])_(weights|bias)$", r"\2_\1", name): value for name, value in fields.items()}
    about: Params = typed(Params, fields, f"{META} of {folder}")
    try:
        network = about.network
    except LumigraphError as fault:
        raise LumigraphError(f"{META} of {folder}: {str(fault)[:1].lower()}{str(fault)[1:]}") from fault
    x, y, z = about.atlas_blocks
    needed = READING_FACTOR * 8 * about.atlas_width * about.atlas_height * about.atlas_depth
    if needed > (free := free_memory()):
        raise LumigraphError(
            f"{folder} promises an atlas that takes {gigabytes(needed)} to read, and {gigabytes(free)} are free; "
            "take one with fewer voxels"
        )
    index = read_indices(bundle, about)
    layers = np.zeros((about.num_slices, LAYERS * about.atlas_height, about.atlas_width, 8), np.uint8)
    kinds = {"rgba": slice(0, 4)} | ({"feature": slice(4, 8)} if network else {})
    for number in track(iter(range(about.num_slices)), "Reading slices", about.num_slices):
        for kind, channels in kinds.items():
            size = about.atlas_width, LAYERS * about.atlas_height
            layers[number, ..., channels] = picture(bundle, f"{kind}_{number:03d}.png", size, "RGBA")
    side = about.block_size + 2
    values = layers.reshape(z, side, y, side, x, side, 8).transpose(0, 2, 4, 5, 3, 1, 6)
    used = np.unique(index[index >= 0])
    atlas = Atlas(
        torch.from_numpy(np.where(index < 0, -1, np.searchsorted(used, index))),
        torch.from_numpy(values.reshape(-1, side, side, side, 8)[used]),
        torch.tensor([about.min_x, about.min_y, about.min_z]),
        about.voxel_size,
        about.block_size,
        network,
        about.contracted,
    )
    to_scene = np.array(about.worldspace_T_opengl)
    moved = turned(atlas, to_scene[:3, :3])
    low = moved.low + torch.from_numpy(to_scene[:3, 3]).float()
    return replace(moved, low=low)


def read_indices(bundle: Bundle, about: Params) -> np.ndarray:
    """Each block's number in the atlas, -1 for empty ones."""
    gx, gy, gz = about.grid_blocks
    places = picture(bundle, INDICES, (gx, gz * gy), "RGB").reshape(gz, gy, gx, 3)
    places = places.transpose(2, 1, 0, 3).astype(np.int64)
    there = (places != EMPTY_INDEX).all(-1)
    if (places[there] >= np.array(about.atlas_blocks)).any():
        raise LumigraphError(f"{INDICES} of {bundle.path} names blocks beyond the atlas; copy the whole folder again")
    x, y, _ = about.atlas_blocks
    return np.where(there, (places[..., 2] * y + places[..., 1]) * x + places[..., 0], -1)


def picture(bundle: Bundle, name: str, size: tuple[int, int], mode: str) -> UInt8[np.ndarray, "row column channel"]:
    """Pixels of a PNG of a size. Raises LumigraphError if it is missing, truncated, or of another format."""
    data = bundle.read(name)
    remedy = "copy the whole folder again"
    with (
        reading(f"{bundle.path}: {name}", "is damaged", remedy),
        Image.open(io.BytesIO(data), formats=("PNG",)) as image,
    ):
        if image.size != size or image.mode != mode:
            raise LumigraphError(
                f"{bundle.path}: {name} is {image.width} x {image.height} {image.mode}, and should be "
                f"{size[0]} x {size[1]} {mode}; {remedy}"
            )
        return np.asarray(image)


def turned(atlas: Atlas, turn: np.ndarray) -> Atlas:
    """An atlas with its axes permuted and flipped: position x moves to `turn` x. View dependence is not rotated; it
    stays in the scene's directions."""
    axes = np.abs(turn).argmax(1).tolist()  # which axis of before each new one is
    flipped = [axis for axis in range(3) if turn[axis].sum() < 0]
    index, values = atlas.index.permute(axes), atlas.values.permute(0, *(1 + axis for axis in axes), 4)
    extent = atlas.voxel * atlas.block * torch.tensor(atlas.index.shape)
    low: Tensor = torch.where(torch.tensor(turn.sum(1)) < 0, -(atlas.low + extent)[axes], atlas.low[axes])
    index, values = index.flip(flipped), values.flip([1 + axis for axis in flipped])
    return replace(atlas, index=index.contiguous(), values=values.contiguous(), low=low)
