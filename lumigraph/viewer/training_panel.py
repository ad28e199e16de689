"""The tab `Training`, which all clients share: how far it has come, its curve, and a button to pause it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from jaxtyping import Float

from ..display import clock
from .turns import Turns

EVERY = 1.0  # seconds between updates
POINTS = 200  # of the curve
INK = "#5686d6"


class TrainingPanel:
    """Made inside the tab. rows: of metrics.jsonl, from earlier sittings."""

    def __init__(self, server: Any, turns: Turns, rows: list[dict[str, Any]]):
        self._gui, self._turns = server.gui, turns
        self._rows = [(row["seconds"], row["psnr"]) for row in rows if "psnr" in row]
        self._next, self._last = 0.0, ""
        last = rows[-1] if rows else None
        self._status = self._gui.add_markdown(
            "About to begin" if turns.training or not last else describe(last["step"], last)
        )
        self._plot = self._gui.add_uplot(
            curve(self._rows),
            ({"label": "seconds"}, {"label": "dB", "stroke": INK, "width": 2}),
            title="PSNR of training batches",
            scales={"x": {"time": False}},
            aspect=1.6,
            visible=len(self._rows) > 1,
        )
        self._button = self._gui.add_button("Pause", visible=turns.training)
        self._button.on_click(lambda _: self._toggle())

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        """A step is done; row is its line of metrics, if it has one."""
        if not row:
            return
        self._rows.append((row["seconds"], row["psnr"]))
        self._last = describe(step, row)
        if (now := time.perf_counter()) >= self._next:
            self._next = now + EVERY
            self._status.content = f"{100 * progress:.0f} % · {self._last}"
            self._draw()

    def end(self) -> None:
        """There will be no more steps."""
        self._button.visible = False
        self._status.content = f"Done · {self._last}" if self._last else "Done"
        self._draw()

    def _draw(self) -> None:
        self._plot.data = curve(self._rows)
        self._plot.visible = len(self._rows) > 1

    def _toggle(self) -> None:
        self._turns.paused = self._turns.training and not self._turns.paused
        self._button.label = "Resume" if self._turns.paused else "Pause"


def describe(step: int, row: dict[str, Any]) -> str:
    return f"step {step} · {row['psnr']:.2f} dB · {clock(row['seconds'])} trained"


def curve(rows: list[tuple[float, float]]) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
    """Seconds and PSNR: means over stretches of steps, so that it is a line and not a cloud."""
    if not rows:
        return np.zeros(1), np.zeros(1)
    table = np.array(rows)
    seconds, psnr = np.array([part.mean(0) for part in np.array_split(table, min(len(table), POINTS))]).T
    return seconds, psnr
