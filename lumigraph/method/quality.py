"""Quality: how long to train, in words that mean something for every method and every size of capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

Quality = Literal["draft", "good", "best"]
QUALITIES: tuple[Quality, ...] = get_args(Quality)
MEANS: Mapping[Quality, str] = {
    "draft": "to check the capture",
    "good": "for most of the possible PSNR",
    "best": "until PSNR stops improving (hours on a CPU)",
}


@dataclass(frozen=True)
class Effort:
    """What a quality asks of a method.

    passes:   how often everything is learnt from, on average: each photograph, or each of their pixels
    at_least: steps, however small the capture
    """

    passes: float
    at_least: int

    def steps(self, steps_per_pass: float) -> int:
        """Steps in all. steps_per_pass: after how many everything was seen once, see `Method.steps_per_pass`."""
        return max(self.at_least, round(self.passes * steps_per_pass))


Efforts = Mapping[Quality, Effort]

# Of methods that learn from a whole photograph a step: 200 passes over 150 photographs are Kerbl 2023's 30 000 steps.
BY_PHOTOGRAPH: Efforts = {"draft": Effort(10, 500), "good": Effort(60, 3000), "best": Effort(200, 10_000)}
# Of methods that learn from single rays: Müller 2022 and Mildenhall 2020 see each pixel some 5 to 13 times.
BY_RAY: Efforts = {"draft": Effort(0.05, 500), "good": Effort(0.5, 3000), "best": Effort(5.0, 10_000)}
