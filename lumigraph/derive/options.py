"""Options of runs made of runs: converted, compressed, cleaned, cut by strokes. None needs PyTorch."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes

from ..budget import Limited, Quality, about_quality
from ..errors import LumigraphError
from ..export.options import Cropping
from ..files.options import PhotographsOption, SeedOption, StepsOption, option
from ..files.ranges import Codes, Coordinate, Count, Decibels, Seconds, Share, Steps, between

LOSSES: Mapping[Quality, float] = {"draft": 1.0, "good": 0.3, "best": 0.1}  # dB that each quality may lose
DEFAULT_LOSS: Quality = "good"
TUNING_SECONDS, CONVERSION_SECONDS = 60.0, 30.0  # by default
UNITS = {"": 1, "k": 1e3, "m": 1e6, "g": 1e9, "ki": 2**10, "mi": 2**20, "gi": 2**30}
SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([kmg]?i?)b?\s*", re.IGNORECASE)
ABOUT_LOSSES = "PSNR that may be lost: " + ", ".join(f"{name} {dB:g} dB" for name, dB in LOSSES.items()) + "."
ABOUT_STEPS = about_quality() + " A conversion from a field trains for half of these steps."


@dataclass(frozen=True)
class ConvertOptions(Limited):
    """Options of a conversion, which ends after steps, seconds or the steps of a quality."""

    seconds: Annotated[Seconds | None, option("S", f"{CONVERSION_SECONDS:.0f}, or the steps of the method")] = None
    """Training time in seconds after initialisation; longer improves the new method."""
    steps: StepsOption = None
    quality: Annotated[Quality | None, option("draft|good|best", "as long as --seconds", ABOUT_STEPS)] = None
    distil: bool = False
    """Train on renderings of the old method, even if photographs are available."""
    scene: PhotographsOption = None
    views: Annotated[Count, option("N")] = 8
    """Compare at most this number of held-out views, evenly spread."""
    seed: SeedOption = 0

    def limited(self, steps: int | None) -> ConvertOptions:
        """The same with a limit in time. steps: default number of the method; None for the default seconds"""
        if (self.steps, self.seconds, self.quality) != (None, None, None):
            return self
        return replace(self, steps=steps, seconds=CONVERSION_SECONDS if steps is None else None)


@dataclass(frozen=True)
class CompressOptions:
    """Options of a compression, to a size or to a loss of PSNR."""

    to: Annotated[str | None, option("SIZE", "as --quality")] = None
    """Upper limit of the model's size: 5MB, 800kB, 2MiB. A smaller one loses more PSNR."""
    quality: Annotated[Quality | None, option("draft|good|best", DEFAULT_LOSS, ABOUT_LOSSES)] = None
    max_loss: Annotated[Decibels | None, option("DB", "as --quality")] = None
    """Largest loss of PSNR on training photographs, in dB; the model becomes as small as it allows."""
    codebook: Annotated[Codes | None, option("N", "up to 4096, fewer for a larger loss")] = None
    """Rows of the codebook; more lose less PSNR and take more bytes."""
    seconds: Annotated[Seconds | None, option("S", f"{TUNING_SECONDS:.0f}")] = None
    """Total tuning time in seconds; longer recovers more PSNR."""
    steps: Annotated[Steps | None, option("N", "as long as --seconds")] = None
    """Tune for this number of steps instead."""
    views: Annotated[Count | None, option("N", "all")] = None
    """Compare only this number of held-out views, evenly spread."""
    scene: PhotographsOption = None

    def check(self) -> None:
        """Raises LumigraphError for options that contradict each other, and for what is no size."""
        if sum(given is not None for given in (self.to, self.quality, self.max_loss)) > 1:
            raise LumigraphError("--to, --quality and --max-loss are ways to say how small; give one of them")
        if self.steps is not None and self.seconds is not None:
            raise LumigraphError("--steps and --seconds are two ways to say how long; give one of them")
        _ = self.bytes

    @property
    def bytes(self) -> int | None:
        """Largest size of the model; None without one. Raises LumigraphError for what is no size."""
        if self.to is None:
            return None
        found = SIZE.fullmatch(self.to)
        size = float(found[1][:20]) * UNITS[found[2].lower()] if found and found[2].lower() in UNITS else 0.0
        if not 1 <= size <= 1e15:
            raise LumigraphError(f"--to cannot be {self.to[:60]!r}; give it a size such as 5MB or 800kB")
        return int(size)

    @property
    def loss(self) -> float:
        """PSNR on training photographs that may be lost, where no size is given, in dB."""
        return LOSSES[self.quality or DEFAULT_LOSS] if self.max_loss is None else self.max_loss

    @property
    def tuning_seconds(self) -> float | None:
        """Time of all tuning; None for a number of steps."""
        return None if self.steps is not None else self.seconds or TUNING_SECONDS

    def part(self, share: float) -> tuple[int | None, float | None]:
        """Steps or seconds of a share of all tuning."""
        seconds = self.tuning_seconds
        return self.steps and max(1, round(share * self.steps)), seconds and share * seconds


@dataclass(frozen=True)
class CleanOptions:
    """Options of cleaning a cloud of Gaussians."""

    strength: Annotated[Share | None, option("SHARE", "0.4")] = None
    """Remove Gaussians with a floater score above 1 - strength; a larger value removes more, 0 none."""
    part: OmitArgPrefixes[Cropping] = Cropping()


@dataclass(frozen=True)
class SegmentOptions:
    """Options of selecting a part by strokes."""

    action: Literal["extract", "delete", "recolour", "move", "masks"] = "extract"
    """extract: the part alone; delete: all else; recolour: the part in another colour; move: the part elsewhere;
    masks: a label picture for each photograph, 1 on the part, to train object-nerf on."""
    colour: Annotated[tuple[Share, Share, Share], option("R G B")] = (0.85, 0.15, 0.1)
    """New mean colour with --action recolour, each number in [0, 1]."""
    shift: Annotated[tuple[Coordinate, Coordinate, Coordinate], option("X Y Z")] = (0.0, 0.0, 0.0)
    """Displacement with --action move, in scene units."""
    turn: Annotated[float, between(-1e6, 1e6), option("DEGREES")] = 0.0
    """Rotation about the vertical with --action move, counterclockwise from above."""
    features: Annotated[Path | None, option("FILE", "the descriptors of Lumigraph")] = None
    """Feature network: .onnx, or .safetensors with the weights of a plain convolutional network."""
    masks: Annotated[Path | None, option("FOLDER", "none")] = None
    """Segments of a segmenter, a picture of whole numbers for each --view: a stroke takes the segments it crosses."""
    scene: PhotographsOption = None
