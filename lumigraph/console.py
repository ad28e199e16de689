"""The one door to the terminal: what is printed stands as it is. Style is given beside a text, never written in it.

So a folder may be called `[/bold]`, `:smile:` or `{0}`, and is printed by that name.
"""

from __future__ import annotations

import sys
from typing import Any

from rich.console import Console
from rich.text import Text


def console(errors: bool = False, **options: Any) -> Console:
    """A rich Console on standard output, or on standard error, that reads no markup in what it prints."""
    return Console(stderr=errors, markup=False, highlight=False, emoji=False, **options)


def is_live(errors: bool = True) -> bool:
    """Whether somebody watches who can be shown a line that changes: a terminal, and no log, however colourful."""
    stream = sys.stderr if errors else sys.stdout
    return stream.isatty() and not console(errors).is_dumb_terminal


def bold(text: object) -> Text:
    return Text(str(text), style="bold")


def dim(text: object) -> Text:
    return Text(str(text), style="dim")
