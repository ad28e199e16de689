"""Work: training, rendering, evaluation and exports run inside `at_work`, from Python as from the command line."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from .allocation import settle_memory
from .threads import considerate

OPT_OUT = "LUMIGRAPH_AS_IS"  # environment variable: the process's memory and threads stay as they are


@contextlib.contextmanager
def at_work() -> Iterator[None]:
    """A block, or a function, of heavy work: memory that a step frees is kept for the next one, and threads do not look
    for work while other programs hold them up. The first is for the whole process, from then on.

    LUMIGRAPH_AS_IS=1 in the environment leaves both alone.
    """
    if os.environ.get(OPT_OUT):
        yield
        return
    settle_memory()
    with considerate():
        yield
