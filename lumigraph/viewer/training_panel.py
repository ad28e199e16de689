"""The tab `Training`, which all clients share: progress, a curve of the PSNR, and a button that pauses."""

from __future__ import annotations

import time
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..system.progress import clock, short
from .turns import Turns

UPDATE_SECONDS = 1.0  # seconds between updates
CURVE_POINTS = 200  # of the curve
INK = "#5686d6"
Measure = Literal["psnr", "loss"]
TITLES: dict[Measure, str] = {"psnr": "PSNR of training batches", "loss": "Loss of training batches"}


class TrainingPanel:
    """The panel, made inside its tab. rows: of metrics.jsonl, from earlier sittings."""

    def __init__(self, server: Any, turns: Turns, rows: list[dict[str, Any]]):
        self._gui, self._turns = server.gui, turns
        self._measure = measure_of(rows)
        self._rows = [(row["seconds"], row[self._measure]) for row in rows if self._measure in row]
        self._next, self._last = 0.0, ""
        begins = turns.training or not rows
        self._status = self._gui.add_markdown("About to begin" if begins else describe(rows[-1]["step"], rows[-1]))
        self._plot = self._gui.add_uplot(
            curve(self._rows),
            series(self._measure),
            title=TITLES[self._measure],
            scales={"x": {"time": False}},
            aspect=1.6,
            visible=len(self._rows) > 1,
        )
        self._button = self._gui.add_button("Pause", visible=turns.training)
        self._button.on_click(lambda _: self._toggle())

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        """Take note of a step that is done. row: its line of metrics.jsonl, empty if it has none."""
        if not row:
            return
        if not self._rows and self._measure != (measure := measure_of([row])):
            self._measure = measure
            self._plot.title, self._plot.series = TITLES[measure], series(measure)
        if self._measure in row:
            self._rows.append((row["seconds"], row[self._measure]))
        self._last = describe(step, row)
        if (now := time.perf_counter()) >= self._next:
            self._next = now + UPDATE_SECONDS
            self._status.content = f"{100 * progress:.0f} % · {self._last}"
            self._draw()

    def end(self) -> None:
        """Show that training is over."""
        self._button.visible = False
        self._status.content = f"Done · {self._last}" if self._last else "Done"
        self._draw()

    def _draw(self) -> None:
        self._plot.data = curve(self._rows)
        self._plot.visible = len(self._rows) > 1

    def _toggle(self) -> None:
        self._turns.paused = self._turns.training and not self._turns.paused
        self._button.label = "Resume" if self._turns.paused else "Pause"


def measure_of(rows: list[dict[str, Any]]) -> Measure:
    """Name of the plotted measure: the PSNR, or the loss for methods without one."""
    return "psnr" if not rows or any("psnr" in row for row in rows) else "loss"


def series(measure: Measure) -> tuple[dict[str, Any], dict[str, Any]]:
    """The axes of the plot, as uPlot takes them."""
    return {"label": "seconds"}, {"label": "dB" if measure == "psnr" else "loss", "stroke": INK, "width": 2}


def describe(step: int, row: dict[str, Any]) -> str:
    quality = f"{row['psnr']:.2f} dB" if "psnr" in row else f"loss {short(row['loss'])}" if "loss" in row else ""
    return " · ".join(part for part in (f"step {step}", quality, f"{clock(row['seconds'])} trained") if part)


def curve(rows: list[tuple[float, float]]) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
    """Seconds and PSNR or loss of the curve: means over stretches of steps, at most CURVE_POINTS of them."""
    if not rows:
        return np.zeros(1), np.zeros(1)
    table = np.array(rows)
    seconds, psnr = np.array([part.mean(0) for part in np.array_split(table, min(len(table), CURVE_POINTS))]).T
    return seconds, psnr
