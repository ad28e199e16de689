"""Python in the documents: each block runs as it is written, on small scenes; CONTRIBUTING.md has a test of its own.
Commands in the documents: their options exist."""

from __future__ import annotations

import dataclasses
import pkgutil
import re
import runpy
import shlex
from functools import cache
from pathlib import Path
from textwrap import indent
from typing import Any

import pytest
import tiny
import torch
from budgets import budget
from shape_checks import PACKAGE
from test_cleaning import soiled
from test_probes import uniform

import lumigraph
from lumigraph import methods
from lumigraph.commands.cli import parse
from lumigraph.components.sampling.importance import importance
from lumigraph.exchange.packing import Stored, most_important
from lumigraph.light.probes import write_probes
from lumigraph.methods.instant_ngp import InstantNGP
from lumigraph.run import build

pytestmark = budget("runs", 24)

ROOT = PACKAGE.parent
SECONDS = {"seconds=30.0": "steps=2"}  # of the block of docs/convert.md
ELSEWHERE = {"CONTRIBUTING.md"}  # tests/test_contributing.py
NEEDS_DATA = {"docs/methods/gaussian_splatting.md"}  # seven minutes of structure from motion; its names are tested


def blocks() -> dict[str, list[str]]:
    """Blocks of Python by page."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found = {page.relative_to(ROOT).as_posix(): written(page.read_text("utf-8")) for page in pages}
    return {page: sources for page, sources in found.items() if sources}


def written(text: str) -> list[str]:
    return re.findall(r"(?ms)^```python\n(.*?)^```", text)


def execute(page: str, **given: Any) -> dict[str, Any]:
    """Names after the only block of a page, which finds these names."""
    (source,) = blocks()[page]
    for before, after in SECONDS.items():
        source = source.replace(before, after)
    exec(compile(source, page, "exec"), given)
    return given


@pytest.fixture
def in_folder_of_runs(ball_run, tmp_path, monkeypatch):
    """A working folder whose runs have the names that pages use."""
    (tmp_path / "runs").mkdir()
    for name in ("lego-instant-ngp-1", "lego-nerf"):
        (tmp_path / "runs" / name).symlink_to(Path(ball_run.path).resolve())
    monkeypatch.chdir(tmp_path)


FAMILIES = ("splats", "a hash grid", "a triplane", "a surface")


@pytest.mark.parametrize("family", FAMILIES)
def test_loops_of_ones_own_learn(family, monkeypatch):
    """Each block of docs/build.md in fewer steps, of at most 60 lines."""
    monkeypatch.setattr(lumigraph, "open_scene", lambda source: tiny.scene())
    source = blocks()["docs/build.md"][FAMILIES.index(family)]
    assert len([line for line in source.splitlines() if line]) <= 60
    fewer = re.sub(r"(?m)^(STEPS.*?) = \d+", r"\1 = 60", source, count=1)
    fewer = re.sub(r"(?m)^(STEPS, RAYS.* = 60), \d+, \d+", r"\1, 256, 32", fewer)
    fewer = fewer.replace("STEPS, COUNT = 60, 2000", "STEPS, COUNT = 60, 500")
    assert "= 60" in fewer
    names: dict[str, Any] = {}
    exec(compile(fewer, f"docs/build.md, {family}", "exec"), names)
    first, last = (sum(part) / 5 for part in (names["losses"][:5], names["losses"][-5:]))
    assert last < 0.6 * first
    assert family != "splats" or len(names["params"]["means"]) != 500  # density control changed the cloud


def test_every_block_has_a_test():
    tested = {
        "README.md",
        "docs/build.md",
        "docs/cleaning.md",
        "docs/compress.md",
        "docs/convert.md",
        "docs/datasets.md",
        "docs/layers.md",
        "docs/probes.md",
        "docs/python.md",
    }
    assert set(blocks()) == tested | ELSEWHERE | NEEDS_DATA
    assert written("```python\na = 1\n```\n```\nb\n```\n") == ["a = 1\n"]


def test_the_first_page_can_be_typed():
    """Each command is understood, opens what an earlier one wrote, and writes a name that is not there yet."""
    there = {"photos"}
    lines = re.findall(r"^lumigraph .*", (ROOT / "docs" / "start.md").read_text("utf-8"), re.MULTILINE)
    for line in lines:
        words = shlex.split(line, comments=True)[1:]
        parse(words)
        new = words[words.index("--output") + 1] if "--output" in words else words[-1] if words[0] == "export" else ""
        names = [word.rstrip("/") for word in words[1:] if word.rstrip("/") in there]
        assert names and new not in there, line
        there |= {new} - {""}
    assert len(lines) >= 7


def test_a_sample_renders():
    view = execute("README.md")["view"]
    assert view.rgb.shape == (800, 800, 3) and view.rgb.std() > 0.05


def test_from_python(in_folder_of_runs, ball_folder, monkeypatch):
    Path("photos").symlink_to(ball_folder)
    scale = {
        'lumigraph.capture("photos")': 'lumigraph.open_scene("photos")',
        "seconds=60": "steps=40, initial_gaussians=400",
        "frames=90": "frames=2, size=24",
        '"procedural:still-life", SparseNGP, steps=300': '"photos", SparseNGP, steps=2, log2_hashmap_size=10',
    }
    names: dict[str, Any] = {}
    for source in blocks()["docs/python.md"]:
        for before, after in scale.items():
            source = source.replace(before, after)
        exec(compile(source, "docs/python.md", "exec"), names)
    assert names["picture"].shape == (1, 48, 64, 3) and names["run"].method_name == "sparse-ngp"
    assert all(Path(name).stat().st_size for name in ("film.mp4", "page.html", "scene.spz", "still-life.html"))
    assert names["along_axis"].shape == (48, 64) and names["ranges"].shape == (16, 128)
    assert names["run"].metrics() is not None


def test_a_run_is_converted(in_folder_of_runs):
    made = execute("docs/convert.md")["made"]
    assert made.psnr > 10 and made.student.seconds > 0 and Path("runs/grid/config.json").exists()


def test_a_collection_opens():
    assert isinstance(execute("docs/datasets.md")["data"], lumigraph.Collection)


def test_layers_of_rays():
    after = execute("docs/layers.md")
    batch, scene = after["batch"], after["scene"]
    assert batch.extra["depth"].shape[0] == len(batch.rays.image_index) == 4096
    assert (after["exposure"] == scene.about["exposure"][batch.rays.image_index]).all()


def test_probes_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_probes(Path("lights"), uniform())
    assert (execute("docs/probes.md")["light"] - torch.pi).abs().max() < 1e-3


def test_a_cloud_is_cleaned():
    scene = tiny.scene()
    given = {"gaussians": soiled(), "cameras": scene.cameras, "frame": scene.frame}
    part = execute("docs/cleaning.md", **given)["part"]
    assert 0 < len(part) < len(given["gaussians"])


def test_a_method_is_thinned():
    names = {"InstantNGP": InstantNGP, "Stored": Stored, "importance": importance, "most_important": most_important}
    (source,) = blocks()["docs/compress.md"]
    exec(f"class Shown(InstantNGP):\n{indent(source, '    ')}", names)
    scene = tiny.scene()
    method = build(names["Shown"], scene.frame, InstantNGP.smallest(), torch.device("cpu"), 0)
    assert method.storage().keys() <= method.state_dict().keys()
    shares = method.importance(scene.cameras[0])
    with torch.no_grad():
        before = (method.network.table != 0).any(-1).sum()
        method.thin(shares, 0.5)
    assert (method.network.table != 0).any(-1).sum() < before


def test_structure_from_motion_has_the_names_it_is_called_by():
    sfm = pytest.importorskip("pycolmap")
    (source,) = blocks()["docs/methods/gaussian_splatting.md"]
    names = re.findall(r"\bsfm\.(\w+)(?:\.(\w+))?", source)
    assert len(names) > 5 and all(
        hasattr(sfm, one) and (not two or hasattr(getattr(sfm, one), two)) for one, two in names
    )
    settings = sfm.FeatureExtractionOptions()
    assert hasattr(settings.sift, "max_num_features") and hasattr(sfm.ImageReaderOptions(), "camera_params")


# Commands in the documents have options that are there


def commands(text: str) -> list[str]:
    """Commands of a page: lines of code blocks, and code in prose, which may run over the end of a line."""
    fences = re.findall(r"(?ms)^```(\w*)\n(.*?)^```", text)
    lines = [line for language, block in fences if not language for line in block.splitlines()]
    prose = re.sub(r"(?ms)^```.*?^```", "", text)
    lines += [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]
    parts = [part.strip() for line in lines for part in re.split(r"[;#]", line)]
    return [part for part in parts if part.startswith(("lumigraph ", "python benchmarks/"))]


def config_names(config: Any) -> set[str]:
    """Names of a config's numbers, and of those of its parts."""
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return set(values).union(*map(config_names, filter(dataclasses.is_dataclass, values.values())))


@cache
def names_in(*sources: Path) -> set[str]:
    """Names of fields, and words in quotes, of Python files."""
    text = "".join(path.read_text("utf-8") for path in sources)
    return {
        word.replace("-", "_") for pair in re.findall(r"(?m)^ +(\w+):|\"(?:--)?(\w[\w-]*)\"", text) for word in pair
    }


@cache
def names_of(method: str) -> set[str]:
    return config_names(methods.find(method).Config())


def lost_options(command: str) -> list[str]:
    """Options of a command that neither commands, nor the method that it names, nor its script have."""
    words = command.split()
    if words[0] == "python":
        known = names_in(ROOT / words[1])
    else:
        known = names_in(*(PACKAGE / "commands").glob("*.py"), *PACKAGE.glob("*/options.py")) | {"help", "method_file"}
    if words[1] in ("train", "track", "convert"):  # METHOD is any
        available = methods.available()
        known = known.union(*map(names_of, [word for word in words[2:] if word in available] or available))
    options = [name.replace("-", "_") for name in re.findall(r"--([a-z][\w-]*)", command)]
    return [name for name in options if name not in known and name.removeprefix("no_") not in known]


def test_documents_name_options_that_are_there():
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    wrong = [
        f"{page.name}: {command}: {name}"
        for page in pages
        for command in commands(page.read_text("utf-8"))
        for name in lost_options(command)
    ]
    assert not wrong, "\n".join(wrong)


def test_the_ten_ideas_have_a_command_an_equation_and_a_function():
    ideas = re.split(r"(?m)^## ", (ROOT / "docs" / "from-light-fields.md").read_text("utf-8"))[1:]
    assert len(ideas) == 10
    for idea in ideas:
        names = re.findall(r"`(lumigraph\.[\w.]+)`", idea)
        assert names and idea.count("```math") == 1 and any(commands(idea)), idea.splitlines()[0]
        assert all(pkgutil.resolve_name(name) for name in names)
        own = [name for name in names if not name.startswith("lumigraph.reading.")]
        assert own and all(callable(pkgutil.resolve_name(name)) for name in own), names


def test_a_lost_option_is_noticed():
    script = "```\npython benchmarks/mesh.py --exact A; lumigraph eval\n```"
    text = f"`lumigraph train nerf a --steps 1 --hidden-width\n8`\n{script}"
    *others, first = commands(text)
    assert first == "lumigraph train nerf a --steps 1 --hidden-width 8" and len(others) == 2
    assert not any(map(lost_options, (first, *others)))
    assert lost_options("lumigraph train nerf a --log2-hashmap-size 8 --no-warmth") == [
        "log2_hashmap_size",
        "no_warmth",
    ]
    assert lost_options("lumigraph train METHOD a --log2-hashmap-size 8") == []
    assert lost_options("python benchmarks/mesh.py --exact A --wievs 2") == ["wievs"]
    behind = "```math\na\n```\n\n```\nlumigraph eval RUN\n```"
    assert commands(behind) == ["lumigraph eval RUN"]


# Equations in the documents become MathML on the site


@cache
def site_math() -> dict[str, Any]:
    """Definitions of the site's hook that makes equations."""
    return runpy.run_path(str(ROOT / "docs" / "site_math.py"))


def test_equations_are_readable():
    equation = site_math()["equation"]
    pages = sorted((ROOT / "docs").rglob("*.md"))
    sources = [
        source for page in pages for source in re.findall(r"(?ms)^ *```math\n(.*?)^ *```", page.read_text("utf-8"))
    ]
    assert len(sources) > 100
    for source in sources:
        assert equation(source).startswith('<div class="equation"><math display="block">')


@pytest.mark.parametrize("source", [r"\unknown{x}", r"\frac{a}{b", "a & b", "a_", r"\left( a", r"\text{\alpha}"])
def test_an_unreadable_equation_is_an_error(source):
    with pytest.raises(site_math()["SuperFencesException"], match="in this equation"):
        site_math()["equation"](source)


def test_the_minus_of_one_operand_has_no_space():
    mathml = site_math()["mathml"]
    assert '<mo form="prefix">−</mo>' in mathml("f(-x)") and "prefix" not in mathml("a - x")
    assert mathml(r"\sum_i").count("<munder>") == 1
