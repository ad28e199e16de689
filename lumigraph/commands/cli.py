"""The command line. Exit code 0: done. 2: a fault in the input; one sentence on stderr gives the fault and its remedy.
130 and 143: Ctrl-C or SIGTERM ended the command.

Ranges of numbers, annotations of the options and of the methods' Configs, are in --help beside the defaults, and typed
values are checked against them.

LUMIGRAPH_DEBUG=1 shows the traceback of a fault.
"""

import contextlib
import functools
import importlib
import io
import operator
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_args

import tyro
from tyro.conf import Suppress, arg
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from .. import __version__, methods
from ..errors import LumigraphError, LumigraphWarning
from ..files import refusal
from ..files.names import meant
from ..files.options import option_name
from ..files.ranges import coherent, domain, format_value, groups_of, is_surprising, members, outside
from ..system.signals import exit_code, listening, number_of
from ..system.work import at_work
from .common import say, value_of
from .main_options import HELP_ALL, hidden_options
from .train import with_options_of

RULES = ConstructorRegistry()
beneath = False  # True while tyro applies its own rules only
groups: tuple[type, ...] = ()  # of a method's options: its Config and what it holds
hidden: frozenset[str] = frozenset()  # options of the method that --help leaves out


@RULES.struct_rule
def with_ranges(info: StructTypeInfo) -> StructConstructorSpec | None:
    """A dataclass for tyro, each number with its range behind its default: (default: 16; 1 to 32). A method's options
    are one list, without headings of their groups."""
    if beneath or not is_dataclass(info.type):
        return None
    with without_ranges():
        spec = ConstructorRegistry.get_struct_spec(info)
    if not isinstance(spec, StructConstructorSpec):
        return None
    shown = listed if info.type in groups else with_range
    return replace(spec, fields=tuple(replace(x, type=shown(x.type, x.name)) for x in spec.fields))


def listed(kind: Any, name: str) -> Any:
    """A method's option for --help, in the list of all of them."""
    if name in hidden:
        return Annotated[kind, Suppress]
    return Annotated[kind, arg(name="")] if next(members(kind)) in groups else with_range(kind)


@contextmanager
def without_ranges() -> Iterator[None]:
    """A block in which tyro applies its own rules only."""
    global beneath
    beneath = True
    try:
        yield
    finally:
        beneath = False


def with_range(kind: Any, name: str = "") -> Any:
    """An option's annotation with its range beside the default in --help; itself if the range is no surprise."""
    if not is_surprising(kind):
        return kind
    range = domain(kind)
    hints = [x.help_behavior_hint for x in get_args(kind)[1:] if getattr(x, "help_behavior_hint", None) is not None]

    def hint(default: str) -> str:
        said = hints[-1] if hints else f"(default: {default})"
        return f"{said[:-1]}; {range})" if said else f"({range})"

    return Annotated[kind, arg(help_behavior_hint=hint)]


def check_command(command: Any) -> Any:
    """Validate a parsed command. Raises LumigraphError for a number out of range, and for contradictory ones."""
    for name, kind, value in outside(command):
        called = option_name(name, kind).replace("_", "-")
        typed = " ".join(map(format_value, value)) if isinstance(value, tuple) else format_value(value)
        numbers = "numbers" if isinstance(value, tuple) else "a number"
        raise LumigraphError(f"--{called} cannot be {typed}; give it {numbers} from {domain(kind)}")
    coherent(command)
    return command


NAMES = (
    "app demo capture depth photo3d jump train track resume infer draw eval render view clean segment georeference "
    "compose canonicalise compress convert export report explain info methods bench gallery"
).split()
OTHER_KINDS = {
    "app": "AppCommand",
    "capture": "CaptureCommand",
    "georeference": "GeoreferenceCommand",
    "photo3d": "Photo3DCommand",
    "view": "ViewCommand",
}
COMMANDS: dict[str, type] = {
    name: getattr(importlib.import_module(f".{name}", __package__), OTHER_KINDS.get(name, name.capitalize()))
    for name in NAMES
}  # each in the module of its name
DECISIVE = {"device": "auto", "preset": "auto", "field": ""}  # options on which defaults of others depend
DESCRIPTION = """Train radiance fields from photographs, and render films, meshes and web pages from them.

  lumigraph app                         photographs in and scene out, in a browser
  lumigraph demo                        run every step on a procedural scene, in a few minutes
  lumigraph capture PHOTOS_OR_VIDEO     find the camera poses of photographs
  lumigraph train instant-ngp PHOTOS    train on a folder of photographs or a video
  lumigraph train surface PHOTOS        train the default method for meshes; then `lumigraph export mesh`
  lumigraph track imap RECORDING        find the poses of a depth camera's frames, and map what it sees
  lumigraph eval runs/PHOTOS-instant-ngp-1     compare with held-out photographs
  lumigraph train my-method PHOTOS --method-file my.py    train a method of your own; all commands take the option"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments in (["--version"], ["-V"]):
        print(f"lumigraph {__version__}")
        return 0
    return conduct(lambda: parse(arguments))


def conduct(understand: Callable[[], Any]) -> int:
    """Run the command that a function understands. Returns the exit code; a fault is one sentence on stderr."""
    try:
        with listening(), printed_warnings(), at_work():
            return understand().run()
    except LumigraphError as error:
        return refuse(str(error))
    except KeyboardInterrupt as stopped:
        code = exit_code(number_of(stopped))
        return refuse("Stopped", code) if code == 130 else code  # no message after SIGTERM
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader of our output has ended
        return 0
    except OSError as error:
        return refuse(refusal(Path(error.filename or "A file"), error))
    except (MemoryError, RuntimeError) as error:
        from ..system.memory import want_of_memory

        if (sentence := want_of_memory(error)) is None:
            raise
        return refuse(sentence)


@contextlib.contextmanager
def printed_warnings() -> Iterator[None]:
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


def without_method_files(arguments: list[str]) -> list[str]:
    """The arguments without each --method-file, whose methods are registered."""
    rest, words = list[str](), iter(arguments)
    for word in words:
        name, equals, file = word.partition("=")
        if name != methods.METHOD_FILE:
            rest.append(word)
        elif not (path := file if equals else next(words, "")):
            raise LumigraphError(f"{methods.METHOD_FILE} names no file; give it the Python file of a method")
        else:
            methods.load(path)
    return rest


def parse(arguments: list[str]) -> Any:
    """The command with its options. Leaves with code 2 if they cannot be understood."""
    global groups, hidden
    arguments = without_method_files(arguments)
    commands, first, rest = dict(COMMANDS), "".join(arguments[:1]), arguments[1:]
    there = {*methods.available(), *(methods.ALIASES if first == "train" else ())}
    named = [x for x in rest if x.replace("_", "-") in there] if first in ("train", "convert", "track") else []
    if named:  # the options of the method too
        given = {name: value_of(f"--{name}", rest, default) for name, default in DECISIVE.items()}
        commands[first] = with_options_of(named[0], commands[first], **given)
        config = fields(commands[first])[-1].default
        groups = tuple(type(group) for group in groups_of(config))
        hidden = hidden_options(config) if {"--help", "-h"} & {*rest} and HELP_ALL not in rest else frozenset()
    if first == "train" and rest[:1] == ["captions"]:  # a model and no method
        commands[first] = importlib.import_module(".train_captions", __package__).TrainCaptions
    if first == "train" and not named and len(rest) == 1 and Path(rest[0]).expanduser().exists():
        raise LumigraphError(f"Name a method before {rest[0]}, as in `lumigraph train gaussian-splatting {rest[0]}`")
    if first in commands:  # alone: a wrong word is compared with its own options
        return check_command(understood(commands[first], f"lumigraph {first}", rest))
    if first and not first.startswith("-"):
        near = meant(first, NAMES)
        hint = f"did you mean {near}?" if near else "`lumigraph --help` lists the commands"
        raise LumigraphError(f"There is no command {first!r}; {hint}")
    summaries = ((name, (kind.__doc__ or "").strip().partition("\n")[0]) for name, kind in commands.items())
    kinds = [Annotated[commands[name], tyro.conf.subcommand(name, description=x)] for name, x in summaries]
    union: Any = functools.reduce(operator.or_, kinds)
    return tyro.cli(union, prog="lumigraph", description=DESCRIPTION, args=arguments or ["--help"], registry=RULES)


def understood(kind: type, program: str, words: Sequence[str]) -> Any:
    """The words as a command of a kind. Raises LumigraphError for words that cannot be understood; leaves with code 2,
    and tyro's explanation, where tyro gives a reason that `sentence_of` does not know."""
    words = ["--help" if x == HELP_ALL else x for x in words]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(kind, prog=program, args=words, registry=RULES)
    except SystemExit:
        if sentence := sentence_of(" ".join(re.sub("[│╭╮╰╯─]|-{5,}", " ", said.getvalue()).split()), program):
            raise LumigraphError(sentence) from None
        sys.stderr.write(said.getvalue())
        raise


def sentence_of(said: str, program: str) -> str | None:
    """One sentence for tyro's explanation of words that it cannot understand; None for a reason not known here."""
    help_of = f"`{program} --help` lists what it takes"
    if found := re.search(r"Error parsing (\S+): .*?(?:from \[|to float: )(.*?)(?:\]| Argument helptext)", said):
        wanted = "a whole number" if "invalid literal for int" in said else "a number"
        wanted = wanted if "could not convert" in said or "invalid literal" in said else "what --help says of it"
        return f"{found[1]} cannot be {found[2]}; give it {wanted}"
    if found := re.search(r"invalid choice (.*?) for argument '(.*?)'\. Expected one of \((.*?)\)", said):
        choices = sorted(set(re.findall("'(.*?)'", found[3])) - {"None"})
        return f"{found[2].split('/')[-1]} cannot be {found[1]}; choose one of {', '.join(choices)}"
    if found := re.search(r"Missing from (.*?): (.*\(required\))", said):
        names = [part.split()[0] for part in found[2].split("(required)") if part.strip()]
        return f"`{found[1]}` needs {' and '.join(names)}; `{found[1]} --help` lists what it takes"
    if found := re.search(r"Missing subcommand Expected one of \{(.*?)\}", said):
        return f"`{program}` needs one of {found[1]} behind it; {help_of}"
    if not (found := re.search(r"Unrecognized options: (\S+?)(?:,? |$)", said)):
        return None
    near = re.search("Perhaps you meant: (--[a-z0-9-]+)", said)
    guess = near[1] if near else None
    if there := re.search("Available subcommands: (.*?) For full helptext", said):
        guess, help_of = meant(found[1], there[1].split(", ")), f"there are {there[1]}"
    return f"`{program}` does not know {found[1]}; {f'did you mean {guess}?' if guess else help_of}"
