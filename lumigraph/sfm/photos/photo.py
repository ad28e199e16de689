"""Pictures without known poses, and the interface by which long work on them reports its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...readers.raw import Developed
from .film import Tags

# (items, what is being done, how many there will be) -> the items one by one; display.track is one
Track = Callable[[Iterable[Any], str, int], Iterator[Any]]


@dataclass(frozen=True)
class Photo:
    """One picture, upright, and what its file says of how it was taken.

    name:      of the picture within the scene, unique, with "/" between folders
    path:      the file, upright as it lies on disk (no EXIF rotation is left to do), which OpenCV and COLMAP can read
    size:      (width, height) in pixels
    device:    what took it: photographs with the same text may share a lens; None where the file does not say
    focal:     focal length in pixels, from EXIF; None where it does not say
    gps:       latitude and longitude in degrees (WGS 84), altitude in metres
    time:      of exposure, in seconds; since 1970 for photographs, since the beginning for a video's frames
    sharpness: how much fine detail there is, comparable among pictures of one subject
    mask:      beside it, black where nothing is to be learnt; None where there is none
    brightness: mean of log2 of the linear luminance, so that one stop more is 1 more
    """

    name: str
    path: Path
    size: tuple[int, int]
    device: str | None = None
    focal: float | None = None
    gps: tuple[float, float, float] | None = None
    time: float | None = None
    sharpness: float = 0.0
    brightness: float = 0.0
    mask: Path | None = None


@dataclass(frozen=True)
class Intake:
    """Everything that there is to find cameras for.

    photos:     sorted by name, or in the order of exposure where `in_order`
    in_order:   whether neighbours in the list overlap, as the frames of a video do
    blurred:    names of photos too blurred to trust, with why in a few words; they are in `photos` all the same
    duplicates: names of photos that show what another one shows, pixel for pixel or nearly; value: that other one's
                name. They are in `photos` all the same
    unreadable: names of files that are no pictures, with why in a few words
    raw:        the raw files that photos were developed from, by the photos' names
    film:       what a video says of its pictures; None for photographs
    remarks:    sentences on how pictures were read or left out
    """

    source: str
    photos: list[Photo]
    in_order: bool = False
    blurred: dict[str, str] = field(default_factory=dict)
    duplicates: dict[str, str] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)
    raw: dict[str, Developed] = field(default_factory=dict)
    film: Tags | None = None
    remarks: tuple[str, ...] = ()


def untracked(items: Iterable[Any], description: str, total: int) -> Iterator[Any]:
    """The items, without a report."""
    yield from items
