"""Assembly of a Scene from a Capture: checks, images, placement, held-out views."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Equirectangular, Lens, Pinhole
from ..datasets.images import ImageSource, in_parallel, load
from ..datasets.scene import Scene
from ..datasets.world import BlockWorld
from ..errors import LumigraphError, LumigraphWarning
from ..files.names import counted, natural
from ..files.ranges import typed
from ..geometry import Similarity
from ..system.progress import counting
from .beside import about_depth, make_about, make_layers
from .bones import scene_skeleton
from .capture import MAX_COORDINATE, Capture, Shot, checked_pose
from .normalise import find_forward, find_place, similarity
from .oddities import oddities
from .pictures import Chosen, check_downscale, choose
from .tracks import seen_tracks

HOLD_OUT = 8  # every 8th photograph by name, starting with the first, where nothing is published
MAX_NAMES = 20  # missing files in a warning; further ones are counted


@dataclass(frozen=True)
class Before:
    """Names and orientation of a run's photographs at its start, so that reopening keeps their numbers and orientation.

    names:   of the photographs, in order
    upright: the rotation from the source's frame to +z up
    """

    names: Sequence[str]
    upright: Float[np.ndarray, "3 3"]


def assemble(
    capture: Capture,
    downscale: int | None = None,
    memory: int | None = None,
    cache: Path | None = None,
    before: Before | None = None,
) -> Scene:
    """The Scene of a capture.

    before: names and orientation at the start of a run that is resumed or evaluated
    Raises LumigraphError for fewer than two photographs, invalid poses, images that are unreadable or contradict their
    lens, and published splits without held-out views. Missing or unusual data becomes a LumigraphWarning, also in
    `Scene.warnings`.
    """
    check_downscale(downscale)
    told = [about_missing(capture)] if capture.missing else []
    shots = in_order(capture.shots, before)
    if len(shots) < 2:
        raise LumigraphError(
            f"{capture.source} has {counted(len(shots), 'usable photograph')} with a pose, and two are the least; "
            f"{'restore the missing files' if capture.missing else 'add more'}"
        )
    splits = split(capture.source, shots, whole=capture.around is None)
    poses = np.stack([checked_pose(shot, capture.source) for shot in shots])
    for shot in shots:
        if (fault := shot.lens.fault()) is not None:
            raise LumigraphError(f"{capture.source}: the lens of {shot.name} has a fault: its {fault}; correct it")
    for extra in (*capture.tracks, capture.skeleton, capture.origin):
        if extra is not None:
            typed(type(extra), asdict(extra), capture.source)
    capture, lost = without_stray_points(capture)
    told += capture.notes + lost + oddities(capture, shots, poses) + about_depth(capture)
    with counting("Looking at photographs", len(shots)) as done:
        chosen = in_parallel(lambda i: choose(shots[i], downscale), range(len(shots)), done)
    told += about_small(capture.source, chosen) if downscale else []
    told += about_times(capture.source, shots)
    for warning in told:
        warnings.warn(warning, LumigraphWarning, stacklevel=3)
    lenses = [fitted_lens(shot, c) for shot, c in zip(shots, chosen, strict=True)]
    with counting(f"Reading {Path(capture.source).name}", len(shots)) as done:
        images = load(masked_by_lens([c.picture for c in chosen], lenses), memory, cache, done, capture.kept)
    for shot, pixels in zip(shots, images.trusted_pixels.tolist(), strict=True):
        if not pixels:
            raise LumigraphError(
                f"{capture.source}: the mask of {shot.name} trusts no pixel; correct it or remove the photograph"
            )

    # Single precision is for what is near the origin: maps may put a capture hundreds of kilometres away.
    away = poses[:, :, 3].mean(0)
    centred = similarity(np.eye(3), away, 1.0)
    cameras = make_cameras(shots, transform_poses(poses, centred), lenses, images.sizes)
    upright = None if before is None else before.upright
    with counting("Looking for what the cameras look at"):
        place = find_place(shifted(capture, -away), cameras, images, splits["train"].tolist(), upright)
    matrix = place.scene_from_source @ centred
    cameras = make_cameras(shots, transform_poses(poses, matrix), lenses, images.sizes)
    frame = replace(
        place.frame,
        has_alpha=images.has_alpha,
        image_count=len(images),
        train_count=len(splits["train"]),
        source_from_scene=tuple((a, b, c, d) for a, b, c, d in np.linalg.inv(matrix).tolist()),
        times=span(cameras.time),
        origin=capture.origin,
        metric=capture.metric,
    )
    tracks, unseen = seen_tracks(capture, Similarity(torch.from_numpy(matrix)), cameras[splits["train"]])
    frame = replace(
        frame, tracks=tracks, skeleton=scene_skeleton(capture, Similarity(torch.from_numpy(matrix)), cameras)
    )
    if frame.is_open and capture.around is None:
        train = splits["train"]
        seen = [shots[i] for i in train.tolist()]
        frame = replace(frame, forward=find_forward(capture, seen, cameras[train], matrix, frame.near))
    layers, left_out = make_layers(shots, chosen, images, matrix)
    left_out += unseen
    for warning in left_out:
        warnings.warn(warning, LumigraphWarning, stacklevel=3)
    points = None if capture.points is None else torch.from_numpy(capture.points @ matrix[:3, :3].T + matrix[:3, 3])
    scene = Scene(
        cameras,
        images,
        frame,
        splits,
        [shot.name for shot in shots],
        capture.source,
        None if points is None else points.float(),
        None if capture.point_colours is None else torch.from_numpy(np.ascontiguousarray(capture.point_colours)),
        told + left_out,
        layers,
        make_about(shots),
        torch.tensor([c.calibrated for c in chosen]),
        [c.digest for c in chosen],
    )
    return scene if capture.blocks is None else BlockWorld(**vars(scene), blocks=capture.blocks)


def in_order(shots: list[Shot], before: Before | None) -> list[Shot]:
    """Shots by name, 2 before 10; in their previous order, if known."""
    place = {} if before is None else {name: i for i, name in enumerate(before.names)}
    return sorted(shots, key=lambda shot: (place.get(shot.name, len(place)), natural(shot.name)))


def split(source: str, shots: list[Shot], whole: bool = True) -> dict[str, Int[Tensor, " image"]]:
    """Image numbers by purpose: as published, else every 8th held out. whole: False for a part, without held-out"""
    if any(shot.split for shot in shots):
        names = [shot.split for shot in shots]
    else:
        names = ["train" if i % HOLD_OUT else "test" for i in range(len(shots))]
    found = {s: torch.tensor([i for i, name in enumerate(names) if name == s]) for s in ("train", "test", "val")}
    for purpose, task in (("train", "learning"), ("test", "testing")):
        if not len(found[purpose]) and (whole or purpose == "train"):
            raise LumigraphError(
                f"{source} has no view for {task}: its own lists name none that exists; restore the photographs, "
                f"or remove those lists so that every {HOLD_OUT}th is held out"
            )
    return {purpose: images for purpose, images in found.items() if len(images)}


def without_stray_points(capture: Capture) -> tuple[Capture, list[str]]:
    """The capture without points that are not finite or implausibly far, and a sentence about them."""
    if capture.points is None:
        return capture, []
    near = (np.abs(capture.points) <= MAX_COORDINATE).all(-1)
    if near.all():
        return capture, []
    stray = counted(int((~near).sum()), "point")
    told = f"{capture.source} has {stray} that are not finite or {MAX_COORDINATE:g} units away; using the others"
    return capture.with_points(near), [told]


def fitted_lens(shot: Shot, chosen: Chosen) -> Lens:
    """The shot's lens for the picture's final size."""
    scale = torch.tensor([chosen.picture.size], dtype=torch.float64) / torch.tensor([chosen.calibrated])
    return shot.lens.resized(scale.float())


def make_cameras(
    shots: list[Shot], poses: Float[np.ndarray, "camera 3 4"], lenses: list[Lens], sizes: Int[Tensor, "camera 2"]
) -> Camera:
    """One batch of cameras, numbered as the shots. They have times only if all shots have one.

    poses: camera-to-world, in the target frame
    sizes: (width, height) in pixels of the final pictures
    """
    times = [shot.time for shot in shots]
    time = None if any(t is None for t in times) else torch.tensor(times, dtype=torch.float32)
    return Camera(torch.from_numpy(poses).float(), Lens.cat(lenses), sizes, time, torch.arange(len(shots)))


def span(times: Float[Tensor, " camera"] | None) -> tuple[float, float] | None:
    """First and last time; None for fewer than two."""
    found = None if times is None else (float(times.min()), float(times.max()))
    return None if found is None or found[0] == found[1] else found


def transform_poses(
    poses: Float[np.ndarray, "camera 3 4"], matrix: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "camera 3 4"]:
    """Poses transformed by a similarity: positions scale, rotations stay rotations."""
    rotation = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3])) @ poses[:, :, :3]
    position = poses[:, :, 3] @ matrix[:3, :3].T + matrix[:3, 3]
    return np.concatenate([rotation, position[:, :, None]], -1)


def shifted(capture: Capture, by: Float[np.ndarray, " 3"]) -> Capture:
    """The capture with its points and bounds shifted; poses are passed separately."""
    points = None if capture.points is None else capture.points + by
    if capture.around is not None:
        (x, y, z), half = capture.around
        capture = replace(capture, around=((x + by[0], y + by[1], z + by[2]), half))
    if capture.bounds is None:
        return replace(capture, points=points)
    low, high = (np.asarray(corner) + by for corner in capture.bounds)
    return replace(capture, points=points, bounds=(tuple(low.tolist()), tuple(high.tolist())))


def masked_by_lens(pictures: list[ImageSource], lenses: list[Lens]) -> list[ImageSource]:
    """Pictures with masks of their lens's valid region, such as a fisheye's circle."""
    known: dict[tuple[str, tuple[int, int]], np.ndarray | None] = {}
    masked = []
    for picture, lens in zip(pictures, lenses, strict=True):
        key = (str(lens.to_json()), picture.size)
        if key not in known:
            known[key] = within_reach(lens, picture.size)
        trusted = known[key]
        masked.append(picture if trusted is None else with_mask(picture, trusted, key[0]))
    return masked


def with_mask(picture: ImageSource, trusted: np.ndarray, why: str) -> ImageSource:
    """The picture with a further mask of trusted pixels. why: its part of the cache's key"""

    def read() -> tuple[np.ndarray, np.ndarray | None]:
        image, mask = picture.read()
        return image, trusted if mask is None else mask & trusted

    return replace(picture, read=read, identity=None if picture.identity is None else f"{picture.identity} {why}")


def within_reach(lens: Lens, size: tuple[int, int]) -> np.ndarray | None:
    """Mask of pixels that a lens unprojects and projects back; None if all, by a test of the edges."""
    if isinstance(lens, Pinhole | Equirectangular):
        return None
    width, height = size

    def returns(x: Tensor, y: Tensor) -> Tensor:
        pixels = torch.stack([x.reshape(-1), y.reshape(-1)], -1) + 0.5
        back, valid = lens.project(lens.unproject(pixels))
        return valid & ((back - pixels).norm(dim=-1) < 0.5)

    x, y = torch.arange(width).float(), torch.arange(height).float()
    left, top = torch.zeros(height), torch.zeros(width)
    edges = ((x, top), (x, top + height - 1), (left, y), (left + width - 1, y))
    if all(bool(returns(*edge).all()) for edge in edges):
        return None
    whole = returns(x.expand(height, width), y[:, None].expand(height, width))
    return whole.view(height, width).numpy()


def about_missing(capture: Capture) -> str:
    """One sentence with the names of all missing files."""
    names = sorted(capture.missing, key=natural)
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    verb = "does" if len(names) == 1 else "do"
    return (
        f"{capture.source} lists {counted(len(names), 'file')} that {verb} not exist; using the other "
        f"{len(capture.shots)} photographs without {', '.join(names[:MAX_NAMES])}{more}"
    )


def about_times(source: str, shots: list[Shot]) -> list[str]:
    """Warning of photographs without a time beside others with one."""
    without = [shot.name for shot in shots if shot.time is None]
    if not without or len(without) == len(shots):
        return []
    return [
        f"{source} has no time of {counted(len(without), 'photograph')}, such as {without[0]}, so nothing is taken to "
        f"move; add theirs, or remove them"
    ]


def about_small(source: str, chosen: list[Chosen]) -> list[str]:
    """Warning of photographs that are smaller than requested."""
    small = [c for c in chosen if max(c.picture.size) < 0.9 * max(c.wanted)]
    if not small:
        return []
    (width, height), (wide, high) = small[0].picture.size, small[0].wanted
    return [
        f"{source} holds {counted(len(small), 'photograph')} smaller than asked for, such as {width}x{height} "
        f"instead of {wide}x{high}; using them as they are"
    ]
