"""Commands that another process of ours requests: names and values as JSON on standard input.

    {"command": "export mesh", "options": {"source": "/runs/a", "output": "/shared/a.glb"}}

The options are the fields of the command's dataclass, with the same types and ranges as on the command line. Text is a
value and never becomes another option, whatever it holds.
"""

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
    """The dataclass of a command; with the numbers of the method that its options name, for those that train one."""
    from . import bench, explain, export
    from .cli import COMMANDS
    from .train import with_options_of

    groups = {"bench": bench.What, "explain": explain.What, "export": export.What}
    below = {f"{group} {marks.name}": x for group, what in groups.items() for x, marks in map(get_args, get_args(what))}
    kinds = {name: kind for name, kind in COMMANDS.items() if name not in groups} | below
    if (kind := kinds.get(request.command)) is None:
        raise LumigraphError(f"There is no command {request.command[:60]!r}")
    options, method = request.options, request.options.get("method")
    if request.command not in ("train", "convert", "track") or method is None:
        return kind
    if (request.command, method) == ("train", "captions"):
        from .train_captions import TrainCaptions

        return TrainCaptions
    named = {name: str(options[name]) for name in ("device", "preset", "field") if options.get(name)}
    return with_options_of(str(method), kind, **named)


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
