"""Waiting for another process, thread or page."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def until(told: Callable[[], Any], seconds: float = 30.0, pause: float = 0.02) -> Any:
    """Result of a function, as soon as it is true. Raises TimeoutError after so many seconds."""
    end = time.monotonic() + seconds
    while not (found := told()):
        if time.monotonic() > end:
            raise TimeoutError(f"it did not come within {seconds:.0f} s")
        time.sleep(pause)
    return found
