"""Training: the loop, its display, and the verdict on its outcome."""

from typing import TYPE_CHECKING

from ..system.lazy import lazily

if TYPE_CHECKING:
    from .loop import Clock as Clock
    from .loop import Descent as Descent
    from .loop import advance as advance
    from .loop import finite as finite
    from .loop import fit as fit
    from .loop import rehearse as rehearse
    from .loop import set_learning_rate as set_learning_rate

NAMES = "Clock", "Descent", "advance", "finite", "fit", "rehearse", "set_learning_rate"
__getattr__ = lazily(__name__, dict.fromkeys(NAMES, "loop"))
