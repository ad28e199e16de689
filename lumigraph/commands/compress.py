"""`lumigraph compress`: make a trained run smaller."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..derive.options import CompressOptions
from ..files.options import DeviceOption, needed
from .common import choose_device, say, show_table, typed
from .results import Output, Reports, Result

INVISIBLE_LOSS, VISIBLE_LOSS = 0.3, 1.0  # dB


@dataclass(frozen=True, kw_only=True)
class Compress(Reports, CompressOptions, Output):
    """Compress a trained run to a size, or to a loss of PSNR.

    Unimportant rows are pruned, features become rows of a codebook, numbers get 8 or 16 bits; the rest is tuned on the
    photographs and packed. NEW opens wherever RUN does, but cannot be resumed. NEW/compress.json has size and PSNR of
    held-out views before and after. Without its photographs a run is compared with its own renderings.
    """

    run_folder: Annotated[Positional[Path], needed("RUN")]
    """Folder of the run, which does not change."""
    output: Annotated[Path, needed("NEW")]
    """New folder for the smaller run."""
    device: DeviceOption = "auto"

    def of(self, opened: Any) -> Result:
        from ..derive.compression import compress
        from ..run import Run

        try:
            made = compress(
                opened if isinstance(opened, Run) else Run(self.run_folder),
                self.output,
                self,
                choose_device(self.device),
                show=True,
            )
        except KeyboardInterrupt:
            say(f"Stopped; {self.run_folder} is as it was and nothing else is kept, so the same command begins anew")
            raise
        show_table(table(made))
        against = str(made.compared_with)
        if made.psnr_before is None:
            against += ", for its photographs cannot be opened; --scene says where they are"
        rows = {"compared with": f"{made.views} held-out {against}", "saved": str(self.output)}
        rows |= {"verdict": verdict(made, self.run_folder), "next": typed("view", self.output)}
        return Result(self.output, rows=rows)


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
