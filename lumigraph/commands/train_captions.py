"""`lumigraph train captions`: train a small text-and-image model on captions of procedural scenes.

Imported where it is typed, because the numbers of the model need the trainer."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional

from ..components.guidance.clip_files import write_clip
from ..files import claim_folder, replacing_folder
from ..files.options import needed, option
from ..training.captions import CaptionNumbers, learn_captions
from .common import next_free, show, typed


@dataclass(frozen=True)
class TrainCaptions:
    """Train a small text-and-image model on captions of procedural scenes.

    The captions are those of `lumigraph train dream-fields "words:a red cube beside a blue ball"`: one to three balls,
    cubes and cones in five colours. The new folder has open_clip's layout and is a model for --guidance.
    """

    method: Annotated[Positional[Literal["captions"]], needed("captions")]
    """The model."""
    output: Annotated[Path | None, option("FOLDER", "runs/captions-N")] = None
    """New folder for the model."""
    numbers: Annotated[CaptionNumbers, OmitArgPrefixes] = CaptionNumbers()

    def run(self) -> int:
        output = self.output or next_free(f"runs/{self.method}")
        claim_folder(output, "guidance")
        learned = learn_captions(self.numbers)
        with replacing_folder(output, "guidance") as new:
            write_clip(new, learned.network, learned.tokenizer)
        then = typed("train", "dream-fields", "words:a red cube beside a blue ball", "--guidance", output)
        recognised = f"{100 * learned.held_out:.0f} % of pictures of held-out pairs, among the captions of all pairs"
        show({"model": str(output), "recognised": recognised, "next": then})
        return 0
