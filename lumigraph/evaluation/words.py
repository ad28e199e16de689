"""Evaluate a text-to-3D scene: views not used in training, scored by the guidance."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from ..camera import ring
from ..components.guidance import open_guide
from ..datasets.words import Words
from ..errors import LumigraphError
from ..figures import Row, contact_sheet
from ..method import Method
from ..metrics import Score
from ..system.work import at_work

VIEWS = 8  # on a ring around the scene
SHEET_PIXELS = 256
SHOWN = 4  # views of the contact sheet


@dataclass(frozen=True)
class WordsEvaluation:
    """Agreement with the prompt. shown: some of the views; empty: agreement of the background alone"""

    prompt: str
    score: Score
    empty: float
    protocol: dict[str, Any]
    shown: list[Float[Tensor, "height width 3"]]

    @property
    def scores(self) -> list[Score]:
        return [self.score]

    @property
    def compared(self) -> str:
        return f"{self.protocol['renderings']} renderings"

    def to_json(self) -> dict[str, Any]:
        about = {"scores": [self.score.to_json()], "baselines": {"empty view": self.empty}}
        return about | {"protocol": self.protocol, "prompt": self.prompt}

    def contact_sheet(self, title: str) -> Image.Image:
        """Views from four sides."""
        return contact_sheet(title, ["view"] * len(self.shown), [Row(self.prompt, self.shown)])


@torch.no_grad()
@at_work()
def evaluate_words(method: Method, words: Words, views: int | None = None) -> WordsEvaluation:
    """Judge views on a ring by the model that guided training. Raises LumigraphError where it is not known."""
    if words.guidance is None:
        raise LumigraphError("The run names no guidance to judge its views by; train it with --guidance FOLDER")
    guide = open_guide(words.guidance, method.device)
    method.eval()
    count = views or VIEWS
    cameras = ring(words.frame.bounds, size=SHEET_PIXELS, count=count)
    pictures = [method.render(cameras[i]).rgb.clamp(0, 1) for i in range(count)]
    small = torch.nn.functional.interpolate(
        torch.stack(pictures).movedim(-1, 1), (guide.pixels, guide.pixels), mode="bilinear", antialias=True
    )
    protocol = {
        "split": "test",
        "renderings": count,
        "of": count,
        "cameras": "a ring, 15 degrees above the horizon, before the background of the run",
        "judge": str(words.guidance),
    }
    shown = [picture.cpu() for picture in pictures[:: max(1, count // SHOWN)][:SHOWN]]
    nothing = small.new_tensor(words.frame.background)[:, None, None].expand_as(small[:1])
    empty = guide.score(nothing, words.prompt).value
    return WordsEvaluation(words.prompt, guide.score(small, words.prompt), empty, protocol, shown)
