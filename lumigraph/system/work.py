"""Work: context of training, rendering, evaluation and exports, from Python as from the command line."""

import contextlib
import os
from collections.abc import Iterator

from .allocation import settle_memory
from .threads import considerate

OPT_OUT = "LUMIGRAPH_AS_IS"  # environment variable: the process's memory and threads stay as they are


@contextlib.contextmanager
def at_work() -> Iterator[None]:
    """Block, or decorated function, of heavy work: freed memory is kept for the next step, and threads hardly spin
    under contention. The first is for the whole process, from then on.

    LUMIGRAPH_AS_IS=1 in the environment disables both.
    """
    if os.environ.get(OPT_OUT):
        yield
        return
    settle_memory()
    with considerate():
        yield
