"""Common options of benchmarks that train methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from ... import methods
from ...budget import Budget
from ...errors import LumigraphError
from ...files.ranges import Count, Downscale, Scales, Seed
from ..capture import posed
from ..common import ReaderOption, choose_device, needed, option, say, show
from ..train import DEFAULT_SECONDS

if TYPE_CHECKING:
    from ...benchmark.cell import Cell, CellSettings


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Options of benchmarks that train methods and compare them."""

    methods: Annotated[tuple[str, ...], needed("METHOD ...")]
    """Methods to train, for example instant-ngp gaussian-splatting."""
    scenes: Annotated[tuple[str, ...], needed("SCENE ...")]
    """Scenes to train on, as for `lumigraph train`."""
    output: Annotated[Path, needed("OUTPUT")]
    """Folder for runs, table and charts."""
    seeds: Annotated[tuple[Seed, ...], option("N")] = (0,)
    """Seeds of all random choices; several give means with deviations."""
    eval_views: Annotated[Count | None, option("N", "all")] = None
    """Compare only this number of held-out views, evenly spread."""
    lpips: Annotated[tuple[Path, ...], option("FILE", "those in LUMIGRAPH_LPIPS, if any")] = ()
    """Files with the weights of LPIPS, as for `lumigraph eval`."""
    downscale: Annotated[Downscale | None, option("N", "to at most about 1000 pixels")] = None
    """Reduce photographs by this whole number; a larger one trains faster and loses detail."""
    reader: ReaderOption = None
    scales: Annotated[Scales, option("N")] = 1
    """Number of resolutions of every photograph, each half of the one before; scores average over all."""
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the methods' options: the papers', or those tuned for a CPU; auto decides by --device."""

    def checked(self) -> CellSettings:
        """Settings of all cells. Raises LumigraphError for impossible ones, before anything is opened or trained."""
        from ...benchmark.cell import CellSettings
        from ...metrics.lpips import load_lpips, named_files

        for name in self.methods:
            methods.check(name)
        choose_device(self.device)
        weights = tuple(path.resolve() for path in named_files(self.lpips))
        if weights:
            load_lpips(weights)
        return CellSettings(
            self.downscale, self.reader, self.scales, self.preset, self.device, self.eval_views, weights
        )

    def conduct(self, cells: Sequence[Cell], settings: CellSettings) -> int:
        """Train and compare all cells."""
        from ...benchmark.conduct import conduct

        code = conduct(cells, settings, self.output, say)
        if code:
            say("Stopped; what is done is kept, and the same command goes on")
            return code
        show({"table": str(self.output / "results.md"), "figures": str(self.output / "results.json")})
        return 0


def budgets(seconds: Sequence[float], steps: Sequence[int]) -> list[Budget]:
    """Budgets in seconds or steps, DEFAULT_SECONDS without either. Raises LumigraphError for both."""
    if seconds and steps:
        raise LumigraphError("--steps and --seconds are two ways to say how long; give one of them")
    return [Budget(n, None) for n in steps] or [Budget(None, s) for s in seconds or (DEFAULT_SECONDS,)]


def place_of(scene: str) -> str:
    """Source with poses for a scene that a user names, independent of the current folder."""
    return located(posed(scene))


def located(source: str) -> str:
    """A source independent of the current folder: paths become absolute."""
    path = Path(source).expanduser()
    return str(path.resolve()) if path.exists() else source
