"""Numbers and their ranges: every one has one, and what is beyond it ends in one sentence, from flags as from files."""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from typing import Annotated, Any, Literal

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.commands.cli import COMMANDS, main
from lumigraph.errors import LumigraphError
from lumigraph.files import write_json
from lumigraph.files.ranges import Count, Share, between, changed, check, domain, hints, numbers, outside, typed
from lumigraph.run import Run, build
from lumigraph.training import fit

pytestmark = budget("methods", 20)

OURS = list(methods.COLOURED)


def dataclasses_of(kind: Any) -> set[type]:
    """A dataclass, and all that its annotations lead to."""
    found, fresh = set(), [kind]
    while fresh:
        kind = fresh.pop()
        if isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind not in found:
            found.add(kind)
            fresh += hints(kind).values()
        fresh += typing.get_args(kind)
    return found


def nested(kind: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Values by name as config.json holds them: each in the dataclass that has it."""
    inner = {name: held for name, held in hints(kind).items() if dataclasses.is_dataclass(held)}
    below = {name: {x: v for x, v in values.items() if x in hints(held)} for name, held in inner.items()}
    own = {name: value for name, value in values.items() if not any(name in held for held in below.values())}
    return own | {name: held for name, held in below.items() if held}


def flat_hints(kind: Any) -> dict[str, Any]:
    """The annotations of a Config and of the dataclasses that it holds, by name."""
    found = {}
    for name, annotation in hints(kind).items():
        found |= flat_hints(annotation) if dataclasses.is_dataclass(annotation) else {name: annotation}
    return found


@pytest.mark.parametrize("name", [*OURS, *COMMANDS])
def test_every_number_has_a_range(name):
    kinds = dataclasses_of(COMMANDS[name] if name in COMMANDS else methods.find(name).Config)
    without = [
        f"{kind.__name__}.{field}"
        for kind in kinds
        for field, annotation in hints(kind).items()
        if any(range is None or not range.ge < range.le < math.inf for _, range in numbers(annotation))
    ]
    assert kinds and not without


@pytest.mark.parametrize("name", OURS)
def test_presets_are_within_their_ranges(name):
    kind = methods.find(name)
    for config in (kind.Config(), kind.smallest(), *(kind.preset(torch.device(on)) for on in ("cpu", "cuda"))):
        check(config, name)


@pytest.mark.parametrize("name", OURS)
def test_the_least_of_each_number_learns(name):
    """Each number at the least that its range allows: a step is taken, or a sentence says what it disagrees with."""
    kind = methods.find(name)
    frame = dataclasses.replace(tiny.scene().frame, reach=2.0)  # beyond an object, so that no hull is carved
    scene = dataclasses.replace(tiny.scene(), frame=frame)
    for field, annotation in flat_hints(kind.Config).items():
        for number, range in numbers(annotation):
            config = changed(kind.smallest(), **{field: number(range.ge)})
            try:
                method = build(kind, frame, config, torch.device("cpu"), 0)
            except LumigraphError as told:
                assert f"--{field.replace('_', '-')}" in str(told)
                continue
            assert fit(method, scene, steps=1, show=False, rehearsal=False).finished, field


# Method, flag, value, and what the sentence says beside the flag. Names of version 0.1 where the attack used them.
ABSURD = [
    ("instant-ngp", "log2_hashmap_size", 0, "1 to 28"),
    ("instant-ngp", "base_resolution", -1, "1 to 4,096"),
    ("instant-ngp", "sh_bands", 0, "1 to 4"),
    ("instant-ngp", "max_resolution", 10**12, "1 to 1,048,576"),
    ("instant-ngp", "max_resolution", -1, "1 to 1,048,576"),
    ("instant-ngp", "steps_per_diagonal", -1, "4 to 16,384"),
    ("instant-ngp", "levels", 1_000_000, "1 to 32"),
    ("imap", "colour_layers", 1_000_000, "1 to 64"),
    ("instant-ngp", "learning_rate", math.nan, "0 to 10"),
    ("nerf", "depth", 1_000_000, "2 to 64"),
    ("nerf", "warmup", math.inf, "0 to 1"),
    ("mip-nerf", "coarse_samples", 0, "4 to 4,096"),
    ("fourier-features", "layers", 1, "2 to 64"),
    ("gaussian-splatting", "sh_degree", 4, "0 to 3"),
    ("gaussian-splatting", "seed", -1, "0 to 4,294,967,295"),
]


@pytest.mark.parametrize(("method", "field", "value", "range"), ABSURD)
def test_an_absurd_number_ends_in_a_sentence(method, field, value, range, ball_folder, tmp_path, capsys):
    flag = f"--{field.replace('_', '-')}"
    assert main(["train", method, str(ball_folder), flag, str(value), "--output", str(tmp_path / "run")]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"lumigraph: {flag} cannot be {value}") and range in told and told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("method", "field", "value", "range"), ABSURD)
def test_an_absurd_number_in_a_run_ends_in_a_sentence(method, field, value, range, tmp_path):
    run = tiny.new_run(tmp_path / "run")
    config = nested(methods.find(method).Config, {field: value})
    settings = run.settings.to_json() | {"method": method, "config": config}
    (run.folder / "config.json").write_text(json.dumps(settings))
    with pytest.raises(LumigraphError) as refused:
        Run(run.folder).new_method()
    told = str(refused.value)
    assert "config.json" in told and "\n" not in told
    if math.isfinite(value):
        assert f"{field} is {value}" in told and range in told
    else:
        assert "cannot be read as JSON" in told  # which knows no such numbers


@pytest.mark.parametrize("value", ["16", 16.0, True, None, [16], {"n": 16}, 10**400])
def test_what_is_no_number_is_refused(value, tmp_path):
    run = tiny.new_run(tmp_path / "run")
    config = nested(methods.find("nerf").Config, {"depth": value})
    settings = dataclasses.replace(run.settings, method="nerf", config=config)
    with pytest.raises(LumigraphError, match=r"config\.json does not hold what it should: \w+\.depth is "):
        settings.method_config(methods.find("nerf"), run.folder / "config.json")


def test_a_number_that_no_method_has_is_refused(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    write_json(run.folder / "config.json", run.settings.to_json() | {"config": {"hidden_wdith": 3}}, ours=True)
    with pytest.raises(LumigraphError, match=r"config\.json does not hold .* 'hidden_wdith'"):
        Run(run.folder).new_method()


@pytest.mark.parametrize("number", ["size=0", "size=100000", "views=0", "seed=99999999999", "size=-1", "size=9..."])
def test_numbers_of_procedural_scenes_have_ranges(number, capsys):
    number = number.replace("...", "9" * 5000)
    assert main(["info", f"procedural:still-life,{number}"]) == 2
    told = capsys.readouterr().err
    assert number.partition("=")[0] in told and told.count("\n") == 1


@pytest.mark.parametrize(
    "words",
    [
        ["render", "x", "--size", "1000000"],
        ["render", "x", "--fps", "nan"],
        ["export", "mesh", "x", "y.ply", "--keep", "2"],
        ["export", "mesh", "x", "y.ply", "--sphere", "0", "0", "0", "-1"],
        ["export", "panorama", "x", "y.png", "--from", "0", "inf", "0"],
        ["bench", "methods", "--methods", "nerf", "--scenes", "x", "--output", "y", "--seeds", "0", "-3"],
        ["explain", "encodings", "x", "--scales", "1", "0"],
        ["view", "x", "--port", "70000"],
    ],
)
def test_numbers_of_commands_have_ranges(words, capsys):
    assert main(words) == 2
    told = capsys.readouterr().err
    flag = next(word for word in reversed(words) if word.startswith("--"))
    assert told.startswith(f"lumigraph: {flag} cannot be ") and " from " in told and told.count("\n") == 1


@pytest.mark.parametrize(
    "words",
    [
        ["instant-ngp", "--base-resolution", "4096", "--max-resolution", "8"],
        ["instant-ngp", "--levels", "32", "--log2-hashmap-size", "28"],
        ["nerf", "--networks", "2", "--coarse-loss-weight", "0"],
    ],
)
def test_numbers_that_disagree_are_told(words, ball_folder, tmp_path, capsys):
    method, *flags = words
    assert main(["train", method, str(ball_folder), *flags, "--output", str(tmp_path / "run")]) == 2
    told = capsys.readouterr().err
    assert flags[0] in told and told.count("\n") == 1 and list(tmp_path.iterdir()) == []
    values = {flag[2:].replace("-", "_"): int(value) for flag, value in zip(flags[::2], flags[1::2], strict=True)}
    with pytest.raises(LumigraphError, match=flags[0]):
        typed(methods.find(method).Config, nested(methods.find(method).Config, values), "config.json")


def test_help_shows_ranges_that_surprise(capsys):
    for words in (["train", "instant-ngp", "--help-all"], ["export", "mesh", "--help"]):
        with pytest.raises(SystemExit):
            main(words)
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "(default: 16; 1 to 4,096)" in told  # a Config's
    assert "1 to 1,000,000" not in told  # any count
    assert "(default: 0.01, of own meshes 0; 0 to 1)" in told


@dataclasses.dataclass(frozen=True)
class Inner:
    counts: tuple[Annotated[int, between(1, 3)], ...] = (1,)


@dataclasses.dataclass(frozen=True)
class Outer:
    share: Share = 0.5
    some: Count | Literal["all"] | None = None
    inner: Inner = Inner()


def test_ranges_are_found_at_any_depth():
    assert domain(hints(Outer)["some"]) == "1 to 1,000,000" and domain(hints(Inner)["counts"]) == "1 to 3"
    assert [name for name, *_ in outside(Outer(2.0, 0, Inner((1, 9))))] == ["share", "some", "counts"]
    assert not list(outside(Outer(1.0, "all", Inner((1, 3)))))
    with pytest.raises(LumigraphError, match=r"^f does not hold what it should: inner\.counts\[1\] is 9, .* 1 to 3$"):
        typed(Outer, {"inner": {"counts": [1, 9]}}, "f")
    assert typed(Outer, {"inner": {"counts": [1, 2]}, "share": 1}, "f") == Outer(1.0, None, Inner((1, 2)))
