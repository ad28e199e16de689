"""Terminal output: text is printed literally, without markup. Style is an argument, never part of a text.

So a folder may be called `[/bold]`, `:smile:` or `{0}`, and is printed by that name.
"""

import sys
from typing import Any

# Rich is imported where it is needed: help, which prints through tyro, comes sooner without it.


def console(errors: bool = False, **options: Any) -> Any:
    """A rich Console on standard output, or on standard error, that reads no markup in what it prints."""
    from rich.console import Console

    return Console(stderr=errors, markup=False, highlight=False, emoji=False, **options)


def is_live(errors: bool = True) -> bool:
    """True for an interactive terminal that can redraw a line; False for a log, even with colours."""
    stream = sys.stderr if errors else sys.stdout
    return stream.isatty() and not console(errors).is_dumb_terminal


def bold(text: object) -> Any:
    return styled(text, "bold")


def dim(text: object) -> Any:
    return styled(text, "dim")


def styled(text: object, style: str) -> Any:
    """A literal rich Text in one style."""
    from rich.text import Text

    return Text(str(text), style=style)
