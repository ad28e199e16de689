"""Options of an evaluation, without PyTorch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from ..files.options import option
from ..files.ranges import Count


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of an evaluation."""

    split: Literal["test", "val", "train"] = "test"
    """Split of photographs, shapes or members of a collection to compare with."""
    views: Annotated[Count | None, option("N", "all")] = None
    """Compare only this number of views or shapes, evenly spread."""
    lpips: Annotated[tuple[Path, ...], option("FILE", "those in LUMIGRAPH_LPIPS, if any")] = ()
    """Files with the weights of LPIPS, .pth or .safetensors; adds LPIPS to the scores."""
    save_images: bool = False
    """Save every rendering as RUN/eval/NAME.png."""
    right_halves: bool = False
    """Compare only the right halves of photographs, as for methods that fit a code on the left halves."""
