"""Training: the loop, its display, and the verdict on its outcome."""

import importlib
from typing import Any


def __getattr__(name: str) -> Any:
    """Name of the loop, which is loaded when it is first asked for: the options need no PyTorch."""
    return getattr(importlib.import_module(".loop", __name__), name)
