"""Options of training, without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from ..budget import Quality, about_quality, given_budget
from ..files.options import DeviceOption, ReaderOption, SeedOption, StepsOption, option
from ..files.ranges import Count, Downscale, Scales, Seconds, Steps

DEFAULT_SECONDS = 60.0


@dataclass(frozen=True)
class TrainOptions:
    """Options of training, which ends after steps, seconds or the steps of a quality."""

    seconds: Annotated[Seconds | None, option("S", f"{DEFAULT_SECONDS:.0f}")] = None
    """Training time in seconds; longer gives a higher PSNR. Compiling kernels on first use is not counted."""
    steps: StepsOption = None
    quality: Annotated[Quality | None, option("draft|good|best", "as long as --seconds", about_quality())] = None
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce photographs by this whole number; a larger one trains faster and loses detail."""
    reader: ReaderOption = None
    views: Annotated[Count | None, option("N", "all")] = None
    """Train on only this number of photographs, spread evenly over the cameras."""
    depth_from: Annotated[str | None, option("FILE", "depth beside the photographs")] = None
    """Cloud (.las, .laz, .e57, .ply) or mesh that gives the photographs their depth, in the frame of their poses."""
    guidance: Annotated[str | None, option("FILE", "")] = None
    """Model that judges pictures by words:PROMPT: CLIP or a diffusion model, in a folder or file of yours."""
    scales: Annotated[Scales, option("N")] = 1
    """Number of resolutions of every photograph, each half of the one before; evaluation averages over all."""
    seed: SeedOption = 0
    device: DeviceOption = "auto"
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the method's options: the paper's, or those tuned for a CPU; auto decides by --device."""
    pause_at: Annotated[Steps | None, option("STEP", "never")] = None
    """Stop at this step as if interrupted. The schedule still follows the whole budget."""

    def check(self) -> None:
        """Raises LumigraphError for more than one way to say how long."""
        given_budget(self.steps, self.seconds, self.quality)

    @property
    def of_dataset(self) -> dict[str, Any]:
        """Options of `open_dataset`."""
        found = {name: getattr(self, name) for name in ("downscale", "reader", "views", "scales")}
        if self.depth_from is not None:
            found["depth_from"] = str(Path(self.depth_from).resolve())
        if self.guidance is not None:
            found["guidance"] = str(Path(self.guidance).expanduser().resolve())
        return found


@dataclass(frozen=True)
class ResumeOptions:
    """Options of training that goes on."""

    seconds: Annotated[Seconds | None, option("S", "unchanged")] = None
    """New total training time in seconds, including the time already trained."""
    steps: Annotated[Steps | None, option("N", "unchanged")] = None
    """New total of steps, including the steps already done."""
    quality: Annotated[Quality | None, option("draft|good|best", "unchanged")] = None
    """New total of steps, as for `lumigraph train`."""
    scene: Annotated[str | None, option("SCENE", "the path used in training")] = None
    """Path of the training data, if it was moved since training."""
    device: Annotated[str, option("NAME", "the one of its training")] = "same"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""
    pause_at: Annotated[Steps | None, option("STEP", "never")] = None
    """Stop at this step as if interrupted. The schedule still follows the whole budget."""
