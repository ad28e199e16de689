"""Commands that another process of ours requests: names and values as JSON on standard input.

    {"command": "export mesh", "options": {"source": "/runs/a", "output": "/shared/a.glb"}}

The options are the fields of the command's dataclass, with the same types and ranges as on the command line. Text is a
value and never becomes another option, whatever it holds.
"""

from __future__ import annotations

import sys
from typing import Any, get_args

from ..errors import LumigraphError
from ..files import from_json
from ..files.ranges import typed
from ..system.children import Request
from ..system.signals import exit_code, listening, number_of

STDIN = "The request on standard input"


def command_of(data: bytes) -> Any:
    """The command of a request. Raises LumigraphError for one that does not exist, and for values that it refuses."""
    asked = typed(Request, from_json(data, STDIN), STDIN, closed=True)
    return typed(kind_of(asked), asked.options, f"A request of `lumigraph {asked.command}`", closed=True)


def kind_of(request: Request) -> type:
    """The dataclass of a command; of `train` with the method's own numbers."""
    from .cli import COMMANDS
    from .export import What
    from .train import with_options_of

    exports = {f"export {marks.name}": kind for kind, marks in map(get_args, get_args(What))}
    kinds = {**COMMANDS, **exports}
    if request.command not in kinds or request.command == "export":
        raise LumigraphError(f"There is no command {request.command[:60]!r}")
    if request.command == "train":
        return with_options_of(str(request.options.get("method")), ())
    return kinds[request.command]


def main() -> int:
    """Run the request on standard input. Returns the exit code."""
    try:
        with listening():
            from .cli import conduct

            return conduct(lambda: command_of(sys.stdin.buffer.read()))
    except KeyboardInterrupt as stopped:
        return exit_code(number_of(stopped))


if __name__ == "__main__":
    raise SystemExit(main())
