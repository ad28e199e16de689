"""Options of training, whole or in blocks, without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from ..budget import Limited, Quality, about_quality
from ..files.options import DeviceOption, Log, ReaderOption, SeedOption, StepsOption, option
from ..files.ranges import Count, Downscale, Positive, Scales, Seconds, Steps

DEFAULT_SECONDS = 60.0
TRACKED_SIDE = 320  # pixels along the longer side of a frame, about, where the user says nothing


@dataclass(frozen=True)
class TrainOptions(Limited):
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
    log: Log = ()

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
class ResumeOptions(Limited):
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
    log: Log = ()


@dataclass(frozen=True)
class TrackOptions:
    """Options of tracking a depth camera."""

    frames: Annotated[Count | None, option("N", "all")] = None
    """Track only the first frames."""
    downscale: Annotated[Downscale | None, option("N", f"to about {TRACKED_SIDE} pixels")] = None
    """Reduce frames by this whole number; a larger one is faster, and maps less detail."""
    extent: Annotated[Positive | None, option("M", "1.5 times the farthest depth of the first frame")] = None
    """Half-size of the mapped box around the first camera, in metres; larger holds more, and less detail."""
    steps_after: Annotated[Steps | None, option("N", "none")] = None
    """Steps of mapping after the last frame; more give a better map."""
    reader: ReaderOption = None
    seed: SeedOption = 0
    device: DeviceOption = "auto"
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the method's options: the paper's, or those tuned for a CPU; auto decides by --device."""
    pause_at: Annotated[Steps | None, option("STEP", "never")] = None
    """Stop after this number of frames as if interrupted."""


@dataclass(frozen=True)
class BlockOptions:
    """A large scene is trained in blocks, each a run of its own; from few photographs one block, an ordinary run.

    --steps and --seconds are for all blocks together and divided evenly; the default is a minute for each block. After
    Ctrl-C, a crash or a lost machine the same command continues; finished blocks are kept. RUN/blocks.png shows the
    plan. `eval`, `render`, `view` and `export` open the run as one scene. --field METHOD, such as gaussian-splatting,
    trains each block with another method; for clouds, RUN/cloud.ply joins each block's own cell.
    """

    blocks: Annotated[str | None, option("auto|N|FILE", "auto from 200 photographs on, else one block")] = None
    """Positions of blocks: auto (street crossings, or evenly spread), a number of evenly spread ones, or a JSON file in
    the frame of the photographs: {"blocks": [{"centre": [x, y, z], "radius": r}, ...]}. With --into, a block's name."""
    workers: Annotated[Count | None, option("N", "1, in this process")] = None
    """Number of blocks to train at a time on this machine, with Ray."""
    address: Annotated[str | None, option("HOST:PORT", "this machine")] = None
    """Train blocks on an existing Ray cluster; --output must be on storage that all its machines share."""
    into: Annotated[Path | None, option("RUN", "a new run")] = None
    """Learn one block of this run again, from other photographs, as the run's own were learnt; the rest stays."""
    field: Annotated[str, arg(metavar="METHOD", help="The method that learns each block.")] = ""
