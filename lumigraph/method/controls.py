"""Controls: named settings of a trained method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from ..errors import LumigraphError

Value = float | str

AVERAGE = "average"  # the choice of the mean of all learnt codes
NAMED = 8  # choices in a sentence at most


@runtime_checkable
class Configured(Protocol):
    """Something with settings by the names of its controls, as a Method has."""

    settings: dict[str, Value]

    def control(self, name: str) -> Value: ...


@dataclass(frozen=True)
class Control:
    """One setting of `Method.given` by name: a number within a range, or one of several choices.

    name:    as typed: `--set NAME=VALUE`, `--animate NAME=A:B`; the viewer's label
    default: initial value
    range:   (least, most) of a number; None for choices
    choices: names to choose from; empty for a number
    unit:    of a number, as a user reads it: "stops", "degrees"
    about:   its effect, in one sentence
    of_photographs: whether choices beside the default are numbers of photographs, which commands also take by name
    blends:  whether a value may lie between two choices: "A:B:0.3" is three tenths of the way from A to B
    files:   suffixes of file names allowed beside the choices
    """

    name: str
    default: Value
    range: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    unit: str = ""
    about: str = ""
    of_photographs: bool = False
    blends: bool = False
    files: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        assert (self.range is None) != (not self.choices), f"{self.name} needs either a range or choices"

    def checked(self, value: Value) -> Value:
        """Value of this control, from a number or from text. Raises LumigraphError for any other."""
        if self.choices:
            if str(value) in self.choices or (self.blends and self._is_blend(str(value))):
                return str(value)
            if self.files and str(value).lower().endswith(self.files):
                return str(value)
            names = ", photographs' names" if self.of_photographs else ""
            between = ", and A:B:0.5 for halfway between two" if self.blends else ""
            file = f", a file that ends in {', '.join(self.files)}" if self.files else ""
            raise LumigraphError(f"{self.name}={value} is no choice; there are: {self.domain}{names}{between}{file}")
        assert self.range is not None
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not self.range[0] <= number <= self.range[1]:
            raise LumigraphError(f"{self.name}={value} cannot be; give a number from {self.domain}")
        return number

    @property
    def domain(self) -> str:
        """Range or choices as text: "-3 to 3 stops", "colour, grey"."""
        if self.range is not None:
            return " ".join([f"{self.range[0]:g} to {self.range[1]:g}", *([self.unit] if self.unit else [])])
        if len(self.choices) <= NAMED:
            return ", ".join(self.choices)
        return ", ".join([*self.choices[: NAMED - 1], "...", self.choices[-1]])

    def over(self, stations: Sequence[Value], frames: int) -> list[Value]:
        """Values of a film's frames: a number, and a choice that blends, is interpolated evenly between stations, ends
        included; any other choice holds each station for as many frames."""
        values = [self.checked(station) for station in stations]
        if self.choices and not self.blends:
            return [values[i * len(values) // frames] for i in range(frames)]
        legs = len(values) - 1
        found: list[Value] = []
        for i in range(frames):
            at = legs * i / max(frames - 1, 1)
            leg = min(int(at), max(legs - 1, 0))
            a, b, share = values[leg], values[min(leg + 1, legs)], at - leg
            if self.choices:
                found.append(a if a == b or share == 0 else b if share == 1 else f"{a}:{b}:{share:.6g}")
            else:
                found.append((1 - share) * float(a) + share * float(b))
        return found

    def _is_blend(self, value: str) -> bool:
        first, second, share = blend(value)
        return first in self.choices and second in self.choices and 0 <= share <= 1


def blend(value: str) -> tuple[str, str, float]:
    """Two choices of a blending control's value, and its position between them; 0 for one choice, NaN if missing."""
    first, *rest = value.split(":")
    if not rest:
        return first, first, 0.0
    try:
        second, share = rest
        return first, second, float(share)
    except ValueError:
        return first, rest[0], math.nan


def moment(times: tuple[float, float]) -> Control:
    """The control `time` of a method of dynamic scenes. times: `Frame.times`"""
    return Control("time", times[0], range=times, about="Which moment of the capture is shown.")
