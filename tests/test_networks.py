"""The papers' networks learn, in methods whose `smallest()`, which the contract trains, has a hash table instead."""

from __future__ import annotations

from typing import Any

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.files.ranges import changed, holds, value_of
from lumigraph.run import build
from lumigraph.training import fit

STEPS, SHARE = 40, 6  # steps, and how many of the first and of the last are compared
TINY = {
    "field": "network", "depth": 3, "skip_layer": 2, "hidden_width": 32, "hidden_layers": 3,
    "position_frequencies": 4, "coarse_samples": 12, "fine_samples": 12,
    "rays_per_step": 128, "learning_rate": 5e-3, "final_learning_rate": 1e-3, "bfloat16": False,
    "teacher_share": 1.0, "deferred_share": 0.99, "frequency_deviation": 4.0,
}  # fmt: skip
# The ball's photographs are too far apart to be tracked: keyframes stay where the first steps put them.
OWN = {"imap": {"learning_rate": 1e-3, "keyframe_pose_rate": 0.0, "mapping_iterations": 5}}


def by_table(name: str) -> bool:
    """True if a method's smallest Config has a hash table where its paper has a network."""
    kind = methods.find(name)
    config = kind.smallest()
    return holds(config, "field") and value_of(config, "field") == "hash"


NAMES = [name for name in methods.available() if by_table(name)]
pytestmark = budget("methods", 1.5 * len(NAMES))


class Notes:
    """Losses of all steps, by the trainer's protocol of a watch."""

    asked = False

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def give_way(self, stopping) -> None:
        pass

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        self.rows.append(row)


@pytest.mark.parametrize("name", NAMES)
def test_the_network_learns(name):
    kind, data, notes = methods.find(name), tiny.dataset(methods.find(name).learns_from), Notes()
    config, numbers = kind.smallest(), TINY | OWN.get(name, {})
    config = changed(config, **{key: value for key, value in numbers.items() if holds(config, key)})
    method = build(kind, data.frame, config, torch.device("cpu"), 0, learning=True)
    fit(method, data, steps=STEPS, show=False, rehearsal=False, log_every=1, watch=notes)
    first, last = (sum(row["loss"] for row in part) for part in (notes.rows[:SHARE], notes.rows[-SHARE:]))
    assert last < 0.8 * first  # measured: 0.3 (imap) to 0.68 (neural-scene-graph)
