"""`lumigraph export points`: where a trained scene is solid, as coloured points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..common import needed


@dataclass(frozen=True)
class Points:
    """A cloud of coloured points."""

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, or a splat file."""
    output: Annotated[Positional[Path], needed("FILE.ply")]
    """The new file."""

    def run(self) -> int:
        raise NotImplementedError
