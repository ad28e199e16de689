"""Options of structure from motion, without PyTorch."""

from dataclasses import dataclass
from typing import Annotated, Literal

from ..files.options import option
from ..files.ranges import Count, between


@dataclass(frozen=True)
class MotionOptions:
    """Options of a reconstruction."""

    frames: Annotated[Count | None, option("N", "by the video's length")] = None
    """Number of frames to take from a video; more cover it better and take longer."""
    mapper: Literal["incremental", "global"] = "incremental"
    """Structure from motion: incremental, one photograph after the other, or global, quicker for hundreds."""
    matching: Literal["auto", "sequential", "exhaustive", "retrieval"] = "auto"
    """Pairs to match: neighbours in order, all, or those that look alike; auto decides by kind and number."""
    camera: Literal["auto", "single", "per-device", "per-image", "spherical"] = "auto"
    """Photographs that share a lens model: all, those of one device, or none; auto decides by the metadata. spherical:
    a 360-degree film or panoramas, twice as wide as high; the scene gets flat views of them."""
    max_size: Annotated[int, between(200, 65_536), option("PIXELS")] = 1600
    """Longer side of photographs for feature detection; larger finds more features and is slower."""
    moving: bool = False
    """Things move: leave them out of matching, and give each photograph its time, so that methods of moving scenes
    train on it. A folder of videos is a rig: one standing camera each, filmed at once."""
