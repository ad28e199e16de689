"""Pictures without known poses, and the progress interface of long work on them."""

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
    """One picture, upright, with its metadata.

    name:      of the picture within the scene, unique, with "/" between folders
    path:      the file, stored upright (without EXIF rotation), readable by OpenCV and COLMAP
    size:      (width, height) in pixels
    device:    key of camera and lens: photographs with the same text may share a lens; None if unknown
    focal:     focal length in pixels, from EXIF; None if unknown
    gps:       latitude and longitude in degrees (WGS 84), altitude in metres
    time:      of exposure, in seconds; since 1970 for photographs, since the beginning for a video's frames
    sharpness: amount of fine detail, comparable among pictures of one subject
    mask:      beside it, black for ignored pixels; None without one
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
    """Input photographs of a reconstruction.

    photos:     sorted by name, or in the order of exposure where `in_order`
    in_order:   whether neighbours in the list overlap, as the frames of a video do
    blurred:    names of photos too blurred to trust, with the reason in a few words; `photos` includes them
    duplicates: names of exact or near duplicates; value: name of the other one. `photos` includes them
    unreadable: names of files that are no pictures, with the reason in a few words
    raw:        the raw files of developed photos, by the photos' names
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
    """The items, without a progress display."""
    yield from items
