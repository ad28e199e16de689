"""The command line. Exit code 0: done. 2: a fault in the input; one sentence on stderr gives the fault and its remedy.
130 and 143: Ctrl-C or SIGTERM ended the command.

LUMIGRAPH_DEBUG=1 shows the traceback of a fault.
"""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from .. import __version__, methods
from ..errors import LumigraphError, LumigraphWarning
from ..files import refusal
from ..system.allocation import settle_memory
from ..system.signals import exit_code, listening, number_of
from ..system.threads import considerate
from .bench import Bench
from .canonicalise import Canonicalise
from .capture import CaptureCommand
from .clean import Clean
from .common import say
from .compose import Compose
from .compress import Compress
from .convert import Convert
from .demo import Demo
from .eval import Eval
from .explain import Explain
from .export import Export
from .infer import Infer
from .info import Info
from .methods import Methods
from .options import RULES, held
from .render import Render
from .report import Report
from .resume import Resume
from .train import Train, with_options_of
from .view import ViewCommand

COMMANDS: dict[str, type] = {
    "demo": Demo,
    "capture": CaptureCommand,
    "train": Train,
    "resume": Resume,
    "infer": Infer,
    "eval": Eval,
    "render": Render,
    "view": ViewCommand,
    "clean": Clean,
    "compose": Compose,
    "canonicalise": Canonicalise,
    "compress": Compress,
    "convert": Convert,
    "export": Export,
    "report": Report,
    "explain": Explain,
    "info": Info,
    "methods": Methods,
    "bench": Bench,
}
DESCRIPTION = """Train radiance fields from photographs, and render films, meshes and web pages from them.

  lumigraph demo                        run every step on a procedural scene, in a few minutes
  lumigraph capture PHOTOS_OR_VIDEO     find the camera poses of photographs
  lumigraph train instant-ngp PHOTOS    train on a folder of photographs or a video
  lumigraph eval runs/PHOTOS-instant-ngp-1     compare with held-out photographs"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments in (["--version"], ["-V"]):
        print(f"lumigraph {__version__}")
        return 0
    settle_memory()
    try:
        with listening(), told_warnings(), considerate():
            return parse(arguments).run()
    except LumigraphError as error:
        return refuse(str(error))
    except KeyboardInterrupt as stopped:
        code = exit_code(number_of(stopped))
        return refuse("Stopped", code) if code == 130 else code  # whoever sends SIGTERM does not wait for an answer
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # whoever read our output has left
        return 0
    except OSError as error:
        return refuse(refusal(Path(error.filename or "A file"), error))
    except (MemoryError, RuntimeError) as error:
        from ..system.memory import want_of_memory

        if (sentence := want_of_memory(error)) is None:
            raise
        return refuse(sentence)


@contextlib.contextmanager
def told_warnings() -> Iterator[None]:
    """Print each of our own warnings on one line; suppress those of libraries."""
    debugging = bool(os.environ.get("LUMIGRAPH_DEBUG"))
    with warnings.catch_warnings():
        if not debugging:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", LumigraphWarning)
            warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
        yield


def refuse(sentence: str, code: int = 2) -> int:
    if os.environ.get("LUMIGRAPH_DEBUG"):
        raise  # only called while a fault is handled
    say(f"lumigraph: {' '.join(sentence.split())}")
    return code


def parse(arguments: list[str]) -> Any:
    """The command with its options. Leaves with code 2 if they cannot be understood."""
    commands = dict(COMMANDS)
    for name in ("train", "convert"):
        if arguments[:1] == [name]:
            commands[name] = with_method(commands[name], arguments[1:])
    kinds = [
        Annotated[kind, tyro.conf.subcommand(name, description=None if arguments[:1] == [name] else brief(kind))]
        for name, kind in commands.items()
    ]
    union: Any = kinds[0]
    for kind in kinds[1:]:
        union |= kind
    return held(
        tyro.cli(union, prog="lumigraph", description=DESCRIPTION, args=arguments or ["--help"], registry=RULES)
    )


def brief(kind: type) -> str:
    """The first sentence of a command's help."""
    return (kind.__doc__ or "").strip().partition("\n")[0]


def with_method(command: type, arguments: list[str]) -> type:
    """`train` or `convert` with the options of the method that the arguments name, if they name one."""
    there = methods.available()
    named = [x for x in arguments if x.replace("_", "-") in there]
    return with_options_of(named[0], arguments, command) if named else command
