"""compress.json: what compressing a run came to."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from .. import files
from ..files.ranges import Count, Lasted, Share, Tally

COMPRESS_FILE = "compress.json"


@dataclass(frozen=True)
class Compressed:
    """Before and after.

    source:       the run it was made of
    bytes_before, bytes_after: of the model's weights
    folder_before, folder_after: of the whole runs
    psnr_before, psnr_after: of held-out views in dB; before is None where there are renderings alone to compare with
    compared_with: what held-out views were compared with, and what the model was tuned on
    views:        how many
    pruned:       share of importance that went;  codebook, apart, coarser: see `packing.Recipe`
    steps, seconds: of tuning
    """

    source: str
    method: str
    bytes_before: Tally
    bytes_after: Tally
    folder_before: Tally
    folder_after: Tally
    psnr_after: float
    compared_with: Literal["photographs", "renderings of the run"]
    views: Count
    pruned: Share
    codebook: Tally
    apart: Share
    coarser: Tally
    steps: Tally
    seconds: Lasted
    psnr_before: float | None = None

    @property
    def times(self) -> float:
        """Compression ratio of the model."""
        return self.bytes_before / max(self.bytes_after, 1)

    def write(self, folder: Path) -> None:
        files.write_json(folder / COMPRESS_FILE, asdict(self), ours=True)

    @staticmethod
    def read(folder: Path) -> Compressed | None:
        """Read the record of a compressed run; None for other runs. Raises LumigraphError for a damaged record."""
        return files.read_json(folder / COMPRESS_FILE, Compressed) if files.is_file(folder / COMPRESS_FILE) else None


def bytes_in(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
