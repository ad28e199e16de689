"""The ladder: how hard a run can be pressed, rung by rung, from what nobody sees to what anybody would."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ...exchange.packing import Recipe


@dataclass(frozen=True)
class Rung:
    """pruned: share of all importance whose rows go, the least important ones first"""

    pruned: float
    recipe: Recipe


# The second is VQRF's: it prunes 0.1 % of importance and keeps 60 % out of a codebook of 4096.
LADDER: tuple[Rung, ...] = (
    Rung(0.0, Recipe(apart=1.0)),
    Rung(0.001, Recipe(apart=0.6)),
    Rung(0.003, Recipe(apart=0.3, coarser=1)),
    Rung(0.01, Recipe(apart=0.1, coarser=2)),
    Rung(0.02, Recipe(apart=0.02, coarser=2)),
    Rung(0.03, Recipe(apart=0.005, coarser=2)),
    Rung(0.04, Recipe(2048, apart=0.0, coarser=3)),
    Rung(0.08, Recipe(1024, apart=0.0, coarser=3)),
    Rung(0.15, Recipe(256, apart=0.0, coarser=4)),
)

STEPS_BETWEEN_RUNGS = 4  # interpolated settings from one rung to the next
RUNG_POSITIONS = [i / STEPS_BETWEEN_RUNGS for i in range(STEPS_BETWEEN_RUNGS * (len(LADDER) - 1) + 1)]


def rung_at(place: float) -> Rung:
    """A rung, or what lies between two: the lower one's recipe, with more pruned and fewer rows kept apart."""
    low, high = LADDER[int(place)], LADDER[min(int(place) + 1, len(LADDER) - 1)]
    share = place - int(place)
    pruned = low.pruned + share * (high.pruned - low.pruned)
    apart = low.recipe.apart + share * (high.recipe.apart - low.recipe.apart)
    return Rung(pruned, replace(low.recipe, apart=apart))
