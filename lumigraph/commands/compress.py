"""`lumigraph compress`: make a trained run smaller."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..budget import Quality
from ..errors import LumigraphError
from ..files.ranges import Codes, Count, Decibels, Seconds, Steps
from .common import choose_device, say, show, show_table, typed
from .options import DeviceOption, PhotographsOption, needed, option

LOSSES: Mapping[Quality, float] = {"draft": 1.0, "good": 0.3, "best": 0.1}  # dB that each quality may lose
DEFAULT: Quality = "good"
DEFAULT_SECONDS = 60.0
INVISIBLE_LOSS, VISIBLE_LOSS = 0.3, 1.0  # dB
UNITS = {"": 1, "k": 1e3, "m": 1e6, "g": 1e9, "ki": 2**10, "mi": 2**20, "gi": 2**30}
SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([kmg]?i?)b?\s*", re.IGNORECASE)
ABOUT = "PSNR that may be lost: " + ", ".join(f"{name} {dB:g} dB" for name, dB in LOSSES.items()) + "."


@dataclass(frozen=True)
class Compress:
    """Compress a trained run to a size, or to a loss of PSNR.

    Unimportant rows are pruned, features become rows of a codebook, numbers get 8 or 16 bits; the rest is tuned on the
    photographs and packed. NEW opens wherever RUN does, but cannot be resumed. NEW/compress.json has size and PSNR of
    held-out views before and after. Without its photographs a run is compared with its own renderings.
    """

    run_folder: Annotated[Positional[Path], needed("RUN")]
    """Folder of the run, which does not change."""
    output: Annotated[Path, needed("NEW")]
    """New folder for the smaller run."""
    to: Annotated[str | None, option("SIZE", "as --quality")] = None
    """Upper limit of the model's size: 5MB, 800kB, 2MiB. A smaller one loses more PSNR."""
    quality: Annotated[Quality | None, option("draft|good|best", DEFAULT, ABOUT)] = None
    max_loss: Annotated[Decibels | None, option("DB", "as --quality")] = None
    """Largest loss of PSNR on training photographs, in dB; the model becomes as small as it allows."""
    codebook: Annotated[Codes | None, option("N", "up to 4096, fewer for a larger loss")] = None
    """Rows of the codebook; more lose less PSNR and take more bytes."""
    seconds: Annotated[Seconds | None, option("S", f"{DEFAULT_SECONDS:.0f}")] = None
    """Total tuning time in seconds; longer recovers more PSNR."""
    steps: Annotated[Steps | None, option("N", "as long as --seconds")] = None
    """Tune for this number of steps instead."""
    views: Annotated[Count | None, option("N", "all")] = None
    """Compare only this number of held-out views, evenly spread."""
    scene: PhotographsOption = None
    device: DeviceOption = "auto"

    def run(self) -> int:
        from ..derive.compression import CompressionTarget, compress
        from ..run import Run

        if sum(given is not None for given in (self.to, self.quality, self.max_loss)) > 1:
            raise LumigraphError("--to, --quality and --max-loss are ways to say how small; give one of them")
        if self.steps is not None and self.seconds is not None:
            raise LumigraphError("--steps and --seconds are two ways to say how long; give one of them")
        size = None if self.to is None else bytes_in(self.to)
        loss = None if size is not None else LOSSES[self.quality or DEFAULT] if self.max_loss is None else self.max_loss
        seconds = None if self.steps is not None else self.seconds or DEFAULT_SECONDS
        aim = CompressionTarget(size, loss, self.codebook, self.steps, seconds, self.views)
        try:
            made = compress(Run(self.run_folder), self.output, aim, self.scene, choose_device(self.device), show=True)
        except KeyboardInterrupt:
            say(f"Stopped; {self.run_folder} is as it was and nothing else is kept, so the same command begins anew")
            raise
        show_table(table(made))
        against = str(made.compared_with)
        if made.psnr_before is None:
            against += ", for its photographs cannot be opened; --scene says where they are"
        rows = {"compared with": f"{made.views} held-out {against}", "saved": str(self.output)}
        show(rows | {"verdict": verdict(made, self.run_folder), "next": typed("view", self.output)})
        return 0


def verdict(made: Any, run: Path) -> str:
    """Gain in size and loss of quality in words; if nothing is gained, what to do."""
    lost = 0.0 if made.psnr_before is None else made.psnr_before - made.psnr_after
    if made.bytes_after >= made.bytes_before:
        if lost > 0:
            return f"worse in every row: keep {run}, or give a larger --max-loss, for example {2 * max(lost, 0.5):.1f}"
        return f"no smaller; give a larger --max-loss than the {max(lost, 0):.2f} dB that were lost"
    smaller = f"{made.times:.1f} times smaller"
    if made.psnr_before is None:
        return smaller
    if lost <= INVISIBLE_LOSS:
        return f"{smaller}, with no visible loss"
    if lost <= VISIBLE_LOSS:
        return f"{smaller}, with a loss that a comparison side by side shows"
    return f"{smaller}, with a visible loss; for a smaller one give --quality best, a larger --to or more --seconds"


def bytes_in(text: str) -> int:
    """Bytes of a size such as 5MB or 800 kB. Raises LumigraphError for invalid text."""
    found = SIZE.fullmatch(text)
    size = float(found[1][:20]) * UNITS[found[2].lower()] if found and found[2].lower() in UNITS else 0.0
    if not 1 <= size <= 1e15:
        raise LumigraphError(f"--to cannot be {text[:60]!r}; give it a size such as 5MB or 800kB")
    return int(size)


def table(made: Any) -> Any:
    """Table of figures before and after."""
    from rich.table import Table

    rows = Table("", "before", "after", "")
    rows.add_row("model", size(made.bytes_before), size(made.bytes_after), f"{made.times:.1f} times smaller")
    rows.add_row("whole run", size(made.folder_before), size(made.folder_after), "")
    before = "" if made.psnr_before is None else f"{made.psnr_before:.2f} dB"
    change = "" if made.psnr_before is None else f"{made.psnr_after - made.psnr_before:+.2f} dB"
    rows.add_row("PSNR", before, f"{made.psnr_after:.2f} dB", change)
    return rows


def size(count: int) -> str:
    return f"{count / 1e6:.2f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"
