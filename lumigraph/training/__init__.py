"""Training: the loop, its display, and the verdict on its outcome."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .loop import Clock as Clock
    from .loop import Descent as Descent
    from .loop import advance as advance
    from .loop import finite as finite
    from .loop import fit as fit
    from .loop import rehearse as rehearse
    from .loop import set_learning_rate as set_learning_rate


def __getattr__(name: str) -> Any:
    """Name of the loop, which is loaded when it is first asked for: the options need no PyTorch."""
    return getattr(importlib.import_module(".loop", __name__), name)
