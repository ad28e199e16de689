"""`lumigraph canonicalise`: runs of one category in any poses, turned to stand as the others do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files import claim_folder
from ..ranges import Seed, Steps, between
from .common import choose_device, needed, option, show, typed


@dataclass(frozen=True)
class Canonicalise:
    """Find the rotation, place and size that make runs of one category stand alike, from their density alone.

    Nobody has to say which way any of them stands. Each run gets a file NAME.json in the new folder, which opens as
    that run in the frame that all of them share: `export`, `render`, `view` and `compose` take it in the run's place.
    The runs stay as they are. Beside the files lies a picture, before and after: look at it.
    """

    runs: Annotated[Positional[Path], needed("FOLDER")]
    """A folder in which each folder is a run, of a method that knows density: instant-ngp, tensorf, plenoxels ..."""
    output: Annotated[Path | None, option("NEW", "FOLDER-canonical")] = None
    """The new folder."""
    like: Annotated[str | None, option("NAME", "the first")] = None
    """The run that stays as it stands in its scene; all others are turned to stand like it."""
    preset: Literal["draft", "standard", "thorough"] = "standard"
    """How long to learn, and how large the network is: some seconds, a minute, or several."""
    cells: Annotated[Annotated[int, between(8, 256)], option("N")] = 40
    """Cells of the density grids along the longest side of each box of interest."""
    steps: Annotated[Steps | None, option("N", "those of the preset")] = None
    """Steps of learning."""
    seed: Seed = 0
    """Of all that is drawn at random."""
    device: Annotated[str, option("NAME")] = "auto"
    """Where fields are asked and pictures rendered: auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..canonical import PRESETS, canonicalise, found_in

        output = self.output or self.runs.resolve().with_name(f"{self.runs.resolve().name}-canonical")
        if output.resolve() == self.runs.resolve():
            raise LumigraphError(f"{output} holds the runs, which stay as they are; choose another --output")
        claim_folder(output, "canonical")
        config = replace(PRESETS[self.preset], seed=self.seed)
        config = config if self.steps is None else replace(config, steps=self.steps)
        found = found_in(self.runs, self.cells, choose_device(self.device))
        solution = canonicalise(found, config, output, self.like)
        least = int(solution.agreement.argmin())
        show(
            {
                "aligned": f"{len(found)} runs, each in a file of its own in {output}",
                "shared": f"{100 * solution.explained:.0f} % of what they are",
                "least alike": f"{found[least].name}, {float(solution.agreement[least]):.2f} of 1",
                "picture": str(output / "canonical.png"),
                "next": typed("view", output / f"{found[0].name}.json"),
            }
        )
        return 0
