"""Layers from files beside photographs: one kind for all photographs, at the size in which they are used."""

from __future__ import annotations

import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from ..camera import Camera
from ..datasets.images import ImageStore, Layer, LayerSource, in_parallel, resized
from ..datasets.images.layer import known
from ..depth_maps import back_project
from ..errors import LumigraphError
from ..files.reading import reading
from ..geometry import evenly
from .capture import Capture, PixelPlane, Shot
from .exif import exposure
from .numbers import kind_of, read_numbers
from .pictures import HEIC_SUFFIXES, Chosen, read_image, readable, same_shape, stat

EXPOSURE_SUFFIXES = (".jpg", ".jpeg", *HEIC_SUFFIXES)  # files with an exposure time
UNIT_FACTORS = [10.0**power for power in (-3, -2, -1, 1, 2, 3)]  # between metres, centimetres and millimetres
MIN_COMPARED = 10  # sparse points
DEPTH_KINDS = ("distance", "z-depth")
DEPTH_VIEWS, POINTS_PER_VIEW = 64, 300  # depth maps that sparse points are drawn from at most, and points of each


def make_layers(
    shots: list[Shot], chosen: list[Chosen], images: ImageStore, scene_from_source: Float[np.ndarray, "4 4"]
) -> tuple[dict[str, Layer], list[str]]:
    """Layers by name, not yet read; and warnings for the user, one sentence each. Raises LumigraphError for values of
    different kinds under one name, and for unreadable file headers."""
    unit = float(np.cbrt(np.linalg.det(scene_from_source[:3, :3])))
    turn = scene_from_source[:3, :3] / unit
    found = [shot.planes | own_bits(c.plane) for shot, c in zip(shots, chosen, strict=True)]
    layers, told = {}, []
    for name in dict.fromkeys(name for planes in found for name in planes):
        planes = [None if (plane := each.get(name)) is None else settled(plane, name) for each in found]
        first = agreed(name, shots, planes)
        dtype = np.result_type(*(plane.dtype for plane in planes if plane is not None and plane.dtype is not None))
        lacking = planes.count(None)
        if lacking and not (first.unknown or first.encoding == "index" or dtype.kind == "f"):
            told.append(
                f"{name} is there for {len(shots) - lacking} of {len(shots)} photographs only and cannot say that it "
                f"is unknown, so it is left out"
            )
            continue
        sources = [
            None if plane is None else source_of(plane, name, dtype, c, turn)
            for plane, c in zip(planes, chosen, strict=True)
        ]
        scale = first.scale * unit if first.encoding in DEPTH_KINDS else first.scale
        about = first.unknown, first.empty, first.names
        layers[name] = Layer(images, sources, dtype, first.channels, first.encoding, scale, *about)
    return layers, told


def own_bits(plane: PixelPlane | None) -> dict[str, PixelPlane]:
    """Layers of a photograph of more than eight bits: `colours`, encoded, or `raw` light."""
    return {} if plane is None else {"colours" if plane.encoding == "sRGB" else "raw": plane}


def settled(plane: PixelPlane, name: str) -> PixelPlane:
    """The plane with dtype, number of channels and identity of its values."""
    dtype, channels, identity = plane.dtype, plane.channels, plane.identity
    if isinstance(plane.values, np.ndarray):
        dtype, channels = plane.values.dtype, 1 if plane.values.ndim == 2 else plane.values.shape[2]
        identity = f"{zlib.crc32(np.ascontiguousarray(plane.values).tobytes())}"
    elif isinstance(plane.values, Path):
        with readable(plane.values):
            kind = kind_of(plane.values, name)
        dtype, channels = kind.dtype, 1 if plane.encoding in (*DEPTH_KINDS, "index") else kind.channels
        identity = f"{plane.values.resolve()} {stat(plane.values)}"
    assert dtype is not None, f"{name} is made when asked, so its type must be said"
    if plane.encoding == "index":
        dtype = np.promote_types(dtype, np.int8)  # room for a number that names nothing
    return replace(plane, dtype=dtype, channels=channels, identity=identity)


def agreed(name: str, shots: list[Shot], planes: list[PixelPlane | None]) -> PixelPlane:
    """The first plane, after checking that all others are of its kind."""

    def meaning(plane: PixelPlane) -> tuple[Any, ...]:
        return plane.encoding, plane.scale, plane.channels, plane.unknown, plane.empty, plane.names

    (first, shot), *others = [(p, s) for p, s in zip(planes, shots, strict=True) if p is not None]
    for plane, other in others:
        if meaning(plane) != meaning(first):
            raise LumigraphError(
                f"{name} of {other.name} is of another kind than that of {shot.name}: {plane.encoding}, "
                f"{plane.channels} channels and a unit of {plane.scale:g}, not {first.encoding}, {first.channels} and "
                f"{first.scale:g}; store both alike"
            )
    return first


def source_of(
    plane: PixelPlane, name: str, dtype: np.dtype, chosen: Chosen, turn: Float[np.ndarray, "3 3"]
) -> LayerSource:
    size = chosen.picture.size
    identity = None if plane.identity is None else f"{plane.identity} {size} {dtype.str} {plane.encoding}"
    if identity is not None and plane.encoding == "direction":
        identity += f" {turn.tolist()}"
    return LayerSource(partial(read_plane, plane, name, dtype, size, turn), identity)


def read_plane(
    plane: PixelPlane, name: str, dtype: np.dtype, size: tuple[int, int], turn: Float[np.ndarray, "3 3"]
) -> np.ndarray:
    """Stored numbers at the size of the photograph; directions rotated to the scene's frame."""
    if isinstance(plane.values, Path):
        with readable(plane.values):
            values = read_numbers(plane.values, name)
            if plane.channels == 1 and values.ndim == 3:
                if (values[..., :1] != values[..., :3]).any():
                    raise ValueError(f"{name} is one number to a pixel, and this has colours")
                values = values[..., 0]
            if not same_shape((values.shape[1], values.shape[0]), size):
                raise ValueError(
                    f"its shape {values.shape[1]}x{values.shape[0]} is not the photograph's {size[0]}x{size[1]}"
                )
    else:
        with reading(f"{name} of a photograph"):
            values = plane.values if isinstance(plane.values, np.ndarray) else plane.values()
    values = values.astype(dtype)
    if plane.encoding == "direction":
        values = (values @ turn.T).astype(dtype)
    return resized(values, size, plane.encoding, known(values, plane.unknown, plane.channels))


def with_depth_points(capture: Capture) -> Capture:
    """An RGB-D capture with sparse points: random pixels of some photographs, back-projected by their depth, with their
    colours. Unchanged where there is no depth."""
    chosen = evenly([shot for shot in capture.shots if "depth" in shot.planes], DEPTH_VIEWS)
    if not chosen:
        return capture
    positions, colours, random = [], [], np.random.default_rng(0)
    for shot in chosen:
        assert shot.size is not None and isinstance(shot.image, dict)
        plane = settled(shot.planes["depth"], "depth")
        assert plane.dtype is not None and plane.encoding in DEPTH_KINDS
        stored = read_plane(plane, "depth", plane.dtype, shot.size, np.eye(3))
        rows, columns = np.nonzero(known(stored, plane.unknown, 1))
        some = random.permutation(len(rows))[:POINTS_PER_VIEW]
        y, x = rows[some], columns[some]
        camera = Camera(torch.from_numpy(shot.pose)[None].float(), shot.lens, torch.tensor([shot.size]))
        pixels = torch.from_numpy(np.stack([x, y], -1) + 0.5).float()
        depth = torch.from_numpy(plane.scale * stored[y, x]).float()
        along_axis = plane.encoding == "z-depth"
        positions.append(back_project(camera, pixels, depth, along_axis).double().numpy())
        colours.append(read_image(shot.image[1], False, shot.size)[y, x, :3])
    points = np.concatenate(positions)
    return replace(capture, points=points, point_colours=np.concatenate(colours), sightings=np.full(len(points), 2))


def about_depth(capture: Capture) -> list[str]:
    """A sentence where the depth of a photograph and the sparse points that it shows are of different units."""
    shot = next(
        (x for x in capture.shots if x.size and (y := x.planes.get("depth")) and isinstance(y.values, Path)), None
    )
    if shot is None or shot.size is None or capture.points is None:
        return []
    try:
        plane = settled(shot.planes["depth"], "depth")
        stored = read_plane(plane, "depth", np.dtype(np.float64), shot.size, np.eye(3))
    except LumigraphError:  # said where it is read
        return []
    points = torch.from_numpy((capture.points - shot.pose[:, 3]) @ shot.pose[:, :3]).float()
    pixels, seen = shot.lens.project(points)
    column, row = pixels.nan_to_num(-1).floor().long().unbind(-1)
    inside = seen & (points[:, 2] > 0) & (column >= 0) & (row >= 0) & (column < shot.size[0]) & (row < shot.size[1])
    away = points[:, 2] if plane.encoding == "z-depth" else points.norm(dim=-1)
    there = known(stored, plane.unknown, 1)[row[inside], column[inside]]
    if there.sum() < MIN_COMPARED:
        return []
    times = float(np.median(plane.scale * stored[row[inside], column[inside]][there] / away[inside].numpy()[there]))
    near = [x for x in UNIT_FACTORS if 0.5 < times / x < 2]
    text = f"{shot.planes['depth'].values} is {times:.3g} times the distance of the sparse points that it shows"
    return [f"{text}; its unit should be {plane.scale / x:g} of the poses' and not {plane.scale:g}" for x in near]


def make_about(shots: list[Shot]) -> dict[str, Tensor]:
    """Values per photograph by name; NaN for unknown. The first axis is the photograph."""
    found = in_parallel(lambda i: taken(shots[i]) | shots[i].about, range(len(shots)))
    about = {}
    for name in dict.fromkeys(name for facts in found for name in facts):
        values = [np.asarray(facts.get(name, np.nan), np.float64) for facts in found]
        axes = max(value.ndim for value in values)
        filled = [value.reshape((1,) * (axes - value.ndim) + value.shape) for value in values]
        shape = [max(sizes) for sizes in zip(*(value.shape for value in filled), strict=True)]
        table = np.full((len(shots), *shape), np.nan)
        for image, value in enumerate(filled):
            table[image : image + 1][(slice(1), *map(slice, value.shape))] = value
        about[name] = torch.from_numpy(table).float()
    return about


def taken(shot: Shot) -> dict[str, float]:
    """Time and duration of a photograph's exposure, if its reader or its file has them."""
    facts = {} if shot.time is None else {"time": shot.time}
    if isinstance(shot.image, dict) and (path := shot.image[min(shot.image)]).suffix.lower() in EXPOSURE_SUFFIXES:
        with readable(path), Image.open(path) as image:
            light = exposure(image.getexif())
        facts |= {} if light is None else {"exposure": light}
    return facts
