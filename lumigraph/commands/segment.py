"""`lumigraph segment`: select a part of a scene by strokes on a photograph; extract, delete, recolour or move it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, UseAppendAction

from ..derive.options import SegmentOptions
from ..errors import LumigraphError
from ..files.options import DeviceOption, Overwrite, needed
from .common import choose_device
from .results import Reports, Result


@dataclass(frozen=True)
class SegmentFiles:
    """Source, strokes and output of a selection."""

    source: Annotated[Positional[Path], needed("RUN")]
    """Folder of a run that was trained on photographs."""
    strokes: UseAppendAction[Annotated[tuple[Path, ...], needed("PNG")]]
    """Picture of strokes: green is wanted, red unwanted. Can be given several times, each with its --view."""
    view: UseAppendAction[Annotated[tuple[str, ...], needed("NAME")]]
    """Photograph that the strokes were drawn on, by its name."""
    output: Annotated[Path, needed("NEW")]
    """The new file: for Gaussians a splat file such as .ply (with extract and delete also a folder, a run), for a field
    a composition (.json); with --action masks a folder."""


@dataclass(frozen=True)
class Segment(Reports, SegmentOptions, SegmentFiles):
    """Select a part of a trained scene by strokes, and extract, delete, recolour or move it.

    A stroke is drawn on a photograph of the run, in a PNG of its size: plain green is wanted, plain red unwanted, and
    all else says nothing. Surfaces that no photograph shows are grey in the result. A picture beside it shows the
    selection and the result.
    """

    overwrite: Overwrite = False
    device: DeviceOption = "auto"

    def of(self, opened: Any) -> Result:
        from ..derive.parts import segment

        strokes = list(zip(self.strokes, self.view, strict=True))
        device = choose_device(self.device)
        chosen, kind, picture = segment(opened, strokes, self.output, self, self.overwrite, device)
        rows = {kind: f"{int(chosen.sum()):,} of {len(chosen):,} selected", "saved": str(self.output)}
        return Result(self.output, rows=rows | {"picture": str(picture)})

    def check(self) -> None:
        """Raises LumigraphError unless each picture of strokes has its photograph."""
        if len(self.strokes) != len(self.view) or not self.strokes:
            raise LumigraphError(
                "Each --strokes needs the --view that it was drawn on; give as many of one as the other"
            )
