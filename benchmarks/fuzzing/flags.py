"""The options of every command, by looking at the commands themselves, and which of them may ask for long work."""

from __future__ import annotations

import dataclasses
import random
import typing
from typing import Any

import tyro

from lumigraph import methods

from . import nasty
from .templates import SCENE, SMALL

LONG = {
    "--steps",
    "--seconds",
    "--frames",
    "--count",
    "--views",
    "--scales",
    "--smooth",
    "--fps",
    "--quality",
    "--port",
}
LONG |= {
    "--seeds",
    "--eval-views",
    "--size",
    "--max-size",
    "--cell-size",
    "--faces",
    "--downscale",
    "--pause-at",
    "--view",
}
CLOUD, GRID = "given/gaussian-splatting", "given/instant-ngp"
# A command that goes well and quickly, by its name.
COMMANDS: dict[str, list[str]] = {
    "info": ["info", "given/scene"],
    "train": ["train", "instant-ngp", SCENE, "--steps", "1", "--output", "out/new", *SMALL["instant-ngp"]],
    "resume": ["resume", CLOUD, "--steps", "4"],
    "eval": ["eval", CLOUD, "--views", "1"],
    "render": ["render", CLOUD, "--frames", "2", "--size", "16", "--output", "out/new.mp4"],
    "clean": ["clean", "given/cloud.ply", "--output", "out/new.ply"],
    "compose": ["compose", CLOUD, "given/cloud.ply", "--output", "out/new.json"],
    "compress": ["compress", CLOUD, "--output", "out/new", "--steps", "1", "--views", "1"],
    "convert": ["convert", CLOUD, "gaussian-splatting", "--output", "out/new", "--steps", "1", "--views", "1"],
    "report": ["report", CLOUD],
    "capture": ["capture", "given/photographs", "--output", "out/new"],
    "demo": ["demo", "--seconds", "0", "--output", "out/new", "--scene", SCENE],
    "export mesh": ["export", "mesh", CLOUD, "out/new.ply", "--size", "16", "--views", "2", "--cell-size", "0.2"],
    "export panorama": ["export", "panorama", CLOUD, "out/new.png", "--size", "64"],
    "export points": ["export", "points", CLOUD, "out/new.ply", "--size", "16", "--views", "2"],
    "export splats": ["export", "splats", CLOUD, "out/new.spz"],
    "export stereo": ["export", "stereo", CLOUD, "out/new.png", "--size", "64"],
    "export web": ["export", "web", GRID, "out/new.html", "--as", "views", "--views", "2", "--size", "16"],
    "explain ray": ["explain", "ray", GRID, "--output", "out/new.svg"],
    "explain encodings": [
        "explain",
        "encodings",
        "given/pictures/picture.png",
        "--steps",
        "1",
        "--scales",
        "1",
        "--output",
        "out/new",
    ],
    "bench kernels": ["bench", "kernels", "--device", "nowhere"],
    "bench methods": ["bench", "methods", "--methods", "nowhere", "--scenes", SCENE, "--output", "out/new"],
    "bench views": ["bench", "views", "--methods", "nowhere", "--scenes", SCENE, "--output", "out/new"],
    "view": ["view", CLOUD, "--host", "256.0.0.1"],
}


def options(kind: Any) -> dict[str, int]:
    """The flags of a dataclass of options, and how many values each takes."""
    found: dict[str, int] = {}
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, about = hints[field.name], []
        while typing.get_origin(hint) is typing.Annotated:
            hint, *more = typing.get_args(hint)
            about += more
        if any(mark is tyro.conf.Positional or mark is tyro.conf.Fixed for mark in about):
            continue
        if dataclasses.is_dataclass(hint):
            found |= options(hint)
            continue
        named = [mark.name for mark in about if getattr(mark, "name", None) and isinstance(mark.name, str)]
        found[f"--{named[0] if named else field.name.replace('_', '-')}"] = width(hint)
    return found


def width(hint: Any) -> int:
    """How many words an option takes; none if it is there or not."""
    if hint is bool:
        return 0
    parts = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        return 1 if Ellipsis in parts else sum(map(width, parts))
    return max([1, *map(width, parts)]) if parts and typing.get_origin(hint) is not typing.Literal else 1


def of_command(name: str) -> dict[str, int]:
    from lumigraph.commands.cli import COMMANDS as KINDS

    first, _, second = name.partition(" ")
    kind = KINDS[first]
    if not second:
        return options(kind)
    (what,) = dataclasses.fields(kind)
    hint = typing.get_type_hints(kind, include_extras=True)[what.name]
    return next(options(found) for marked, found in subcommands(hint) if marked == second)


def subcommands(hint: Any) -> list[tuple[str, Any]]:
    """The names and dataclasses in a union of subcommands."""
    while typing.get_origin(hint) is typing.Annotated:
        inner, *about = typing.get_args(hint)
        named = [mark.name for mark in about if isinstance(getattr(mark, "name", None), str)]
        if named and dataclasses.is_dataclass(inner):
            return [(named[0], inner)]
        hint = inner
    return [pair for part in typing.get_args(hint) for pair in subcommands(part)]


def command(chance: random.Random) -> tuple[list[str], bool]:
    """A command of any kind with a nasty option or argument; and whether what it asks for may take long."""
    name = chance.choice(list(COMMANDS))
    words = list(COMMANDS[name])
    places = [i for i, word in enumerate(words) if "/" in word]
    if places and chance.random() < 0.15:
        words[chance.choice(places)] = chance.choice(nasty.FLAGS)
        return words, False
    words, long = with_nasty(words, of_command(name), chance)
    return words, long or words[0] in ("bench", "demo", "view")


def method_command(chance: random.Random) -> tuple[list[str], bool]:
    """`train` with one or two of a method's own numbers wrong."""
    from .warm import guests

    name = chance.choice([name for name in methods.available() if name not in guests()])
    scene = "given/pictures/picture.png" if name == "fourier-features" else SCENE
    if name not in SMALL:
        scene = scene_for(name)
    words = ["train", name, scene, "--steps", "1", "--output", "out/new", "--device", "cpu", *SMALL.get(name, [])]
    return with_nasty(words, options(methods.find(name).Config), chance)


def scene_for(name: str) -> str:
    return "given/shapes" if methods.find(name).learns_from.__name__ == "Shapes" else SCENE


def with_nasty(words: list[str], known: dict[str, int], chance: random.Random) -> tuple[list[str], bool]:
    """A command whose options are as before but for one or two."""
    long = False
    for _ in range(chance.choice((1, 1, 1, 2))):
        flag = chance.choice([*known, "--nothing"])
        values = [chance.choice(nasty.FLAGS) for _ in range(known.get(flag, 1))]
        if flag == "--output" and values[:1] in (["out"], ["."], ["given"]):
            values = ["out/holiday.jpg"]
        if len(values) > 1:  # most of several are right
            values = [value if chance.random() < 0.4 else str(i + 1) for i, value in enumerate(values)]
        words = without(words, flag) + ([f"{flag}={values[0]}"] if len(values) == 1 else [flag, *values])
        long = long or flag in LONG
    return words, long


def without(words: list[str], flag: str) -> list[str]:
    """A command without an option and its value."""
    if flag not in words:
        return words
    at = words.index(flag)
    return words[:at] + words[at + 2 :]
