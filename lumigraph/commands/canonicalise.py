"""`lumigraph canonicalise`: align runs of one category."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files import claim_folder
from ..files.options import needed, option
from ..files.ranges import Seed, Steps, between
from .common import choose_device, show, typed


@dataclass(frozen=True)
class Canonicalise:
    """Align runs of one category (rotation, position, scale) from their density fields.

    No orientation labels are needed. The new folder gets a file NAME.json for each run. It opens as that run in the
    common frame: `export`, `render`, `view` and `compose` accept it in place of the run. The runs do not change.
    canonical.png in the folder shows some runs before and after; check it.
    """

    runs: Annotated[Positional[Path], needed("FOLDER")]
    """Folder of runs whose methods have density: instant-ngp, tensorf, plenoxels ..."""
    output: Annotated[Path | None, option("NEW", "FOLDER-canonical")] = None
    """The new folder."""
    like: Annotated[str | None, option("NAME", "the first")] = None
    """Name of the reference run, whose orientation the canonical frame has; all others are aligned with it."""
    preset: Literal["draft", "standard", "thorough"] = "standard"
    """Training steps and network size: draft takes seconds, standard a minute, thorough several and aligns better."""
    cells: Annotated[Annotated[int, between(8, 256)], option("N")] = 40
    """Cells of the density grids along the longest side of each box of interest; more are finer and slower."""
    steps: Annotated[Steps | None, option("N", "those of the preset")] = None
    """Training steps of the network, in place of the preset's."""
    seed: Seed = 0
    """Seed of all random choices."""
    device: Annotated[str, option("NAME")] = "auto"
    """Device for density and pictures: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..derive.canonical import PRESETS, canonicalise, found_in

        output = self.output or self.runs.resolve().with_name(f"{self.runs.resolve().name}-canonical")
        if output.resolve() == self.runs.resolve():
            raise LumigraphError(f"{output} holds the runs, which stay as they are; choose another --output")
        claim_folder(output, "canonical")
        config = replace(PRESETS[self.preset], seed=self.seed)
        config = config if self.steps is None else replace(config, steps=self.steps)
        found = found_in(self.runs, self.cells, choose_device(self.device))
        solution = canonicalise(found, config, output, self.like)
        least = int(solution.agreement.argmin())
        rows = {
            "aligned": f"{len(found)} runs, each in a file of its own in {output}",
            "shared": f"{100 * solution.explained:.0f} % of what they are",
            "least alike": f"{found[least].name}, {float(solution.agreement[least]):.2f} of 1",
            "picture": str(output / "canonical.png"),
            "next": typed("view", output / f"{found[0].name}.json"),
        }
        show(rows)
        return 0
