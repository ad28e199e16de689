"""Budget: when training ends, what share of it is over, and what becomes of that share when it is extended."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from .errors import LumigraphError
from .files.ranges import Lasted, Seconds, Share, Steps, typed

# Where schedules go on, at the earliest, once a run is extended. Coarse beginnings (small photographs, few cells,
# warm-up) lie before it in every method, and are not repeated on what has become fine.
REJOIN_PROGRESS = 0.3


@dataclass(frozen=True)
class Budget:
    """A number of steps, or of seconds; exactly one of them.

    quality: the word that the steps stand for; see `Method.steps_for`
    joined:  of a budget that was extended: how much was spent by then, in its own unit, and the share from which
             schedules went on
    """

    steps: Steps | None = None
    seconds: Seconds | None = None
    quality: str | None = None
    joined: tuple[Lasted, Share] | None = None

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.seconds is None):
            raise LumigraphError("Training needs either steps or seconds, and not both; give one of them")
        if not 0 < self.total < math.inf:
            raise LumigraphError(f"Training cannot last {self.total}; give a number above 0")

    @property
    def total(self) -> float:
        """Steps or seconds, whichever it counts."""
        return self.seconds if self.steps is None else self.steps  # type: ignore[return-value]

    def spent(self, step: int, seconds: float) -> float:
        """Amount used so far, in the budget's unit."""
        return seconds if self.steps is None else step

    def progress(self, step: int, seconds: float) -> float:
        """The share that is over, in [0, 1], which all schedules follow. It rises evenly, from where it was joined."""
        spent, (since, share) = self.spent(step, seconds), self.joined or (0.0, 0.0)
        if spent >= self.total:
            return 1.0
        return share + (1 - share) * max(spent - since, 0.0) / (self.total - since)

    def extended(self, to: Budget, step: int, seconds: float) -> Budget:
        """Another total, for a run that has come to a step by this one.

        Schedules follow the new total. They go back to REJOIN_PROGRESS at most, and never forward.
        """
        if (to.steps, to.seconds) == (self.steps, self.seconds):
            return replace(self, quality=to.quality or self.quality)
        share = min(self.progress(step, seconds), REJOIN_PROGRESS)
        return to if to.progress(step, seconds) >= share else replace(to, joined=(to.spent(step, seconds), share))

    def to_json(self) -> dict[str, Any]:
        """JSON of a run's file: {"seconds": 60.0}, {"steps": 500, "quality": "draft"}."""
        said = {x.name: getattr(self, x.name) for x in fields(self) if getattr(self, x.name) is not None}
        return said | ({"joined": list(self.joined)} if self.joined else {})

    @staticmethod
    def from_json(said: dict[str, Any], where: Path | str = "a run's budget") -> Budget:
        """Read a budget from a run's JSON. Raises LumigraphError, naming `where`, if it is missing or invalid."""
        return typed(Budget, said, where)

    def __str__(self) -> str:
        """For people: "60 s of training", "3,720 steps (quality: good)"."""
        if self.steps is None:
            return f"{lasting(self.total)} of training"
        return f"{self.steps:,} steps" + (f" (quality: {self.quality})" if self.quality else "")


def lasting(seconds: float) -> str:
    """Duration as text: 0.5 is "0.5 s", 90 "90 s", 600 "10 min", 5400 "1 h 30 min"."""
    if seconds < 120:
        return f"{seconds:.3g} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return " ".join(f"{n} {unit}" for n, unit in ((hours, "h"), (minutes, "min")) if n)


# Quality: a budget in words that mean something for every method and every size of capture.

Quality = Literal["draft", "good", "best"]
QUALITIES: tuple[Quality, ...] = get_args(Quality)
MEANS: Mapping[Quality, str] = {
    "draft": "to check the capture",
    "good": "for most of the possible PSNR",
    "best": "until PSNR stops improving (hours on a CPU)",
}


@dataclass(frozen=True)
class Effort:
    """Training effort of a quality.

    passes:   mean number of uses of each photograph, or of each pixel
    at_least: smallest number of steps, for small captures
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


class Limited:
    """Options that end training after steps, after seconds or after the steps of a quality."""

    def check(self) -> None:
        """Raises LumigraphError for more than one of them."""
        if sum(getattr(self, name) is not None for name in ("steps", "seconds", "quality")) > 1:
            raise LumigraphError("--steps, --seconds and --quality are ways to say how long; give one of them")

    @property
    def budget(self) -> Budget | None:
        """Budget of the steps or the seconds; None without them."""
        steps, seconds = getattr(self, "steps", None), getattr(self, "seconds", None)
        return None if steps is None and seconds is None else Budget(steps, seconds)


def about_quality(numbers: Mapping[str, str] = {}) -> str:
    """Help text of --quality. numbers: further words on each quality"""
    about = "Choose the steps by method, number of photographs and their size. "
    return about + "; ".join(f"{name}, {means}{numbers.get(name, '')}" for name, means in MEANS.items()) + "."
