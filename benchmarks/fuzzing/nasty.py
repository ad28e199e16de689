"""Values that nobody expects where a number, a text, a name or a list is looked for."""

from __future__ import annotations

import json
import random
from typing import Any

DIGITS = 10_000  # of an integer that Python refuses to read
DEEP = 100_000  # brackets, more than any parser's stack
MANY = 300_000  # numbers in a row
RAW = {  # JSON that `json.dumps` does not write, by what stands for it meanwhile
    "\x01many digits": "9" * DIGITS,
    "\x01minus many digits": "-" + "9" * DIGITS,
    "\x01power": "1e99999",
    "\x01deep list": "[" * DEEP + "]" * DEEP,
    "\x01deep object": '{"a":' * DEEP + "1" + "}" * DEEP,
    "\x01not closed": "[" * 5000,
    "\x01long list": "[" + "0," * MANY + "0]",
    "\x01surrogate": '"\\ud800.png"',
    "\x01not UTF-8": '"\udcff\udcfe"',
    "\x01twice": '{"a": 1, "a": 2}',
    "\x01bare word": "undefined",
}
NUMBERS: list[Any] = [0, -1, 1, 2, -0.0, 0.5, 1e-300, 1e30, 1e300, -1e300, float("nan"), float("inf"), -float("inf")]
NUMBERS += [2**31 - 1, 2**31, 2**32, 2**53, 2**63, 2**64, -(2**63), 10**12, 10**400, 3.999, -7, 255, 256, 65536, 10**6]
TEXTS = [
    "",
    " ",
    "text",
    "nan",
    "1",
    "None",
    "\0",
    "a\0b.png",
    "[red]bold[/red]",
    "[/]",
    "a:\"b' c",
    "\n\nlumigraph: x",
]
TEXTS += ["é😀\u202e", "%s%n{0}", "$(touch pwned)", "x" * 5000, "-", "--help", "\x1b[31m"]
PATHS = ["../outside/theirs.json", "/etc/passwd", "/dev/zero", "/dev/null", "/", ".", "..", "a/" * 3000, "~", "C:\\x"]
PATHS += ["../" * 40 + "etc/hostname", "nowhere/to/be.seen", "/proc/self/mem", "\\\\host\\share", "x" * 300 + ".png"]
OTHERS: list[Any] = [
    None,
    True,
    False,
    [],
    {},
    [[]],
    [None],
    {"": None},
    [[], []],
    [1, 2, 3],
    [[1, 2, 3]] * 3,
    {"x": 1},
]
# For options and arguments. None leads out of the folders that an input is made in, for some are written to.
FLAGS = ["0", "-1", "1", "2", "-0.0", "0.5", "1e-300", "1e30", "1e300", "-1e300", "nan", "inf", "-inf", "1_0", "1e3"]
FLAGS += ["2147483648", "9223372036854775807", "9223372036854775808", "1000000", "1000000000000", "9" * 5000, "-7"]
FLAGS += [
    "",
    " ",
    "text",
    "None",
    "true",
    "[red]x[/red]",
    "x" * 5000,
    "é😀",
    "--help",
    "a\nb",
    "a=b",
    "a=1:2",
    "\udcff",
]
FLAGS += ["../outside/theirs.json", ".", "..", "../outside", "nowhere/x.json", "given", "out", "out/new"]
FLAGS += [
    "theirs/holiday.jpg",
    "procedural:nothing",
    "procedural:still-life,size=-1",
    "cpu",
    "cpu:7",
    "cuda:99",
    "meta",
]


def value(chance: random.Random, like: Any = None) -> Any:
    """Something in the place of a value of JSON: of another kind, beyond its range, or a little off."""
    way = chance.random()
    if way < 0.12:
        return chance.choice(list(RAW))
    if isinstance(like, int | float) and not isinstance(like, bool):
        if way < 0.75:
            return chance.choice(NUMBERS)
        if way < 0.85:
            return chance.choice([-like, like + 1, like * 1e6, like + 0.5, str(like), [like]])
    if isinstance(like, str) and way < 0.6:
        return chance.choice(TEXTS + PATHS)
    if isinstance(like, list) and way < 0.4:
        return chance.choice([like + like, like[:-1], like[::-1], [like], like[:1] * 1000])
    return chance.choice([*NUMBERS, *TEXTS, *PATHS, *OTHERS])


def dumped(data: Any) -> bytes:
    """JSON with what cannot be said in Python."""
    text = json.dumps(data, ensure_ascii=False, skipkeys=True)
    for name, raw in RAW.items():
        text = text.replace(json.dumps(name, ensure_ascii=False), raw)
    return text.encode("utf-8", errors="surrogateescape" if "\udcff" in text else "surrogatepass")
