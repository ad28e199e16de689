"""Progress of training in a notebook: a bar and its figures, redrawn in place."""

import sys
import time
from collections.abc import Mapping
from typing import Any

REDRAW_SECONDS = 0.5


def in_notebook() -> bool:
    """True in a kernel of Jupyter, whose front end shows HTML."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return getattr(shell, "kernel", None) is not None


class NotebookBar:
    """A progress function of `train` that draws a bar below the cell."""

    def __init__(self) -> None:
        self._handle: Any = None
        self._begin, self._next = time.monotonic(), 0.0
        self._step, self._figures = 0, ""

    def __call__(self, step: int, share: float, row: Mapping[str, Any]) -> None:
        if row:
            names = {"psnr": "PSNR of training photographs {:.2f} dB", "loss": "loss {:.3g}"}
            self._figures = next((" · " + text.format(row[name]) for name, text in names.items() if name in row), "")
        self._step, now = step, time.monotonic()
        if now >= self._next:
            self._next = now + REDRAW_SECONDS
            self._draw(share)

    def end(self) -> None:
        """Draw the bar of a training that is done."""
        self._draw(1.0)

    def _draw(self, share: float) -> None:
        from IPython.display import HTML, display

        text = f"step {self._step:,}{self._figures} · {time.monotonic() - self._begin:.0f} s"
        bar = f'<progress max="1" value="{share:.3f}" style="width: 24em" aria-label="Training"></progress>'
        shown = HTML(f"{bar} {100 * share:.0f} % · {text}")
        if self._handle is None:
            self._handle = display(shown, display_id=True)
        else:
            self._handle.update(shown)
