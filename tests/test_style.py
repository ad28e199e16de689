"""Counts of what the house has too much of. Each is at most its ceiling, and a ceiling may only be lowered."""

from __future__ import annotations

import ast
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, get_args, get_origin

import pytest
from budgets import budget
from shape_checks import PACKAGE, module_name, nodes, parsed
from test_house import forget_trees, imported  # noqa: F401

from lumigraph import methods
from lumigraph.files.ranges import hints
from lumigraph.method import BaseConfig

pytestmark = budget("house", 6)

ROOT = PACKAGE.parent
Sources = dict[str, str]  # module names, and the text of each
RIDDLES = {"what", "whatever", "that", "which", "those", "whether", "of", "as", "how", "whose", "where"}
READING_EDITION = "lumigraph.reading"  # counted by `test_reading_edition.py`, and not with the package
# Of the package: who lowers a number lowers its ceiling.
MAX_LINES = 120_598  # of Python
MAX_LONG_FUNCTIONS = 18  # of more than 60 lines; two have gsplat's signatures
MAX_ANY_METHODS = 42  # parameters `method: Any`
MAX_ROOMS = 39  # names at the top level; one is what gsplat calls its own
MAX_OPTIONS = 1_018  # of all methods, those of parts counted for each method that holds them
TO_BE_WRITTEN = {"lumigraph/methods/soft_colours.py"}  # by the reader of CONTRIBUTING.md


@pytest.fixture(scope="module")
def house() -> Sources:
    found = {module_name(path): path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
    return {name: text for name, text in found.items() if not name.startswith(READING_EDITION)}


def at_most(ceiling: int, found: list[str]) -> None:
    """Fail with the number and the places. Who lowers the number lowers the ceiling."""
    assert len(found) <= ceiling, "\n".join([f"{len(found)}, and at most {ceiling} may be:", *found])


# Docstrings name the thing


def public(tree: ast.Module) -> Iterator[tuple[str, ast.Module | ast.ClassDef | ast.FunctionDef]]:
    """A module, its public classes and functions and their public methods, each with its name."""
    yield "", tree
    ahead = [(node.name, node) for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)]
    for name, node in ahead:
        if not node.name.startswith("_"):
            yield name, node
            if isinstance(node, ast.ClassDef):
                ahead += [(f"{name}.{inner.name}", inner) for inner in node.body if isinstance(inner, ast.FunctionDef)]


def riddles(sources: Sources) -> list[str]:
    """Docstrings that begin with a word of RIDDLES."""
    found = []
    for module, source in sources.items():
        for name, node in public(parsed(source)):
            first = re.match(r"\w*", ast.get_docstring(node) or "")
            if first and first[0].lower() in RIDDLES:
                found.append(f"{module}.{name}: {first[0]} ...".replace(".:", ":"))
    return found


def test_docstrings_name_the_thing(house):
    at_most(0, riddles(house))


@pytest.mark.parametrize(
    "source",
    [
        '"""What a ray is."""',
        '"""How: by this."""',
        'class Ray:\n    """Those that meet."""',
        'def ray():\n    """Whether it meets."""',
        'class Ray:\n    @property\n    def end(self):\n        """Where it ends."""',
    ],
)
def test_a_riddle_is_noticed(source):
    assert len(riddles({"lumigraph.camera.rays": source})) == 1
    assert riddles({"lumigraph.camera.rays": re.sub('"""[A-Z]', '"""Rays w', source)}) == []
    assert riddles({"lumigraph.camera.rays": re.sub("(def|class) ", r"\1 _", source)}) == [] or source.startswith('"')


# A class name stands once


def namesakes(sources: Sources) -> list[str]:
    """Public classes of one name in several modules, but for Config of methods and Options of procedural scenes."""
    places: dict[str, list[str]] = {}
    for module, source in sources.items():
        for node in nodes(source):
            if isinstance(node, ast.ClassDef) and node.name not in ("Config", "Options") and node.name[0] != "_":
                places.setdefault(node.name, []).append(module)
    return [f"{name}: {', '.join(modules)}" for name, modules in sorted(places.items()) if len(modules) > 1]


def test_a_class_name_stands_once(house):
    at_most(0, namesakes(house))


def test_a_namesake_is_noticed():
    one, other = "class Ray:\n    pass\nclass Config:\n    pass", "def f():\n    class Ray:\n        pass"
    assert namesakes({"a": one, "b": "class Rays:\n    pass\nclass Config:\n    pass"}) == []
    assert namesakes({"a": one, "b": other}) == ["Ray: a, b"]


# A component serves two methods or rooms


def users(sources: Sources) -> dict[str, set[str]]:
    """Methods and rooms that import each component, directly or by way of other components."""

    def user(module: str) -> str:
        parts = module.split(".")
        return ".".join(parts[1:3] if parts[1:2] == ["methods"] else parts[1:2])

    importers: dict[str, set[str]] = {module: set() for module in sources if module.startswith("lumigraph.components.")}
    packages = {module.rpartition(".")[0] for module in sources}
    for module, source in sources.items():
        for name in imported(source, module, module in packages):
            target = name if name in importers else name.rpartition(".")[0]
            if target in importers and target != module:
                importers[target].add(module)
    found = {}
    for component in importers:
        reached, ahead = {component}, [component]
        while ahead:
            fresh = importers.get(ahead.pop(), set()) - reached
            reached |= fresh
            ahead += fresh
        found[component] = {user(module) for module in reached if module not in importers} - {"components", ""}
    return {name: some for name, some in found.items() if name not in packages}


def test_a_component_serves_two(house):
    lonely = {name: found for name, found in users(house).items() if len(found) < 2}
    at_most(0, [f"{name}: {', '.join(found) or 'nobody'}" for name, found in sorted(lonely.items())])


def test_a_component_of_one_method_is_noticed():
    made = {
        "components.fields": "",
        "components.fields.grid": "",
        "components.fields.hash": "from .grid import Grid",
        "components.fields.factors": "from . import grid",
        "methods.ngp": "from ..components.fields.hash import Hash",
        "methods.vm": "from ..components.fields import factors",
        "export.mesh": "import lumigraph.components.fields.factors",
        "export.film": "import lumigraph.components.fields.hash",
        "methods.paper": "",
        "methods.paper.one": "from ...components.fields.late import Late",
        "methods.paper.two": "from ...components.fields.late import Late",
        "components.fields.late": "",
    }
    found = users({f"lumigraph.{name}": source for name, source in made.items()})
    assert {name.rpartition(".")[2]: some for name, some in found.items()} == {
        "grid": {"methods.ngp", "methods.vm", "export"},
        "hash": {"methods.ngp", "export"},
        "factors": {"methods.vm", "export"},
        "late": {"methods.paper"},
    }


# Configs hold, none inherits


def heirs(sources: Sources) -> list[str]:
    """Configs with a base class other than BaseConfig, which has the numbers of them all."""
    return [
        f"{module}.{node.name}({bases})"
        for module, source in sources.items()
        for node in nodes(source)
        if isinstance(node, ast.ClassDef) and node.name.endswith(("Config", "Numbers"))
        if (bases := ", ".join(map(ast.unparse, node.bases))) not in ("", "BaseConfig")
    ]


def test_no_config_inherits(house):
    at_most(1, heirs(house))


def test_a_config_that_inherits_is_noticed():
    assert heirs({"a": "class Config:\n    pass\nclass NGP(RayMethod):\n    Config = Config"}) == []
    assert heirs({"a": "class Config(BaseConfig):\n    pass"}) == []
    assert heirs({"a": "class Config(HashNumbers, b.C):\n    pass"}) == ["a.Config(HashNumbers, b.C)"]


# Sizes, which may only fall


def long_functions(sources: Sources, lines: int = 60) -> list[str]:
    return [
        f"{module}.{node.name}: {length}"
        for module, source in sources.items()
        for node in nodes(source)
        if isinstance(node, ast.FunctionDef) and (length := (node.end_lineno or 0) - node.lineno + 1) > lines
    ]


def options_of(config: type) -> int:
    """Numbers of a Config and of what it holds, without those of every Config."""
    own = (held(kind) for name, kind in hints(config).items() if name not in hints(BaseConfig))
    return sum(options_of(kind) if is_dataclass(kind) else 1 for kind in own)


def held(kind: object) -> object:
    """An annotation without what is said about it."""
    return held(get_args(kind)[0]) if get_origin(kind) is Annotated else kind


def test_the_house_does_not_grow(house):
    lines = sum(source.count("\n") for source in house.values())
    assert lines <= MAX_LINES, f"{lines} lines, and at most {MAX_LINES:,} may be"
    at_most(MAX_LONG_FUNCTIONS, long_functions(house))
    at_most(MAX_ANY_METHODS, [name for name, text in house.items() for _ in re.findall(r"\bmethod: Any\b", text)])
    at_most(MAX_ROOMS, sorted({name.split(".")[1] for name in house if "." in name}))
    kinds = [kind for name in methods.available() if (kind := methods.find(name)).__module__ in house]  # no guests
    at_most(MAX_OPTIONS, [kind.__name__ for kind in kinds for _ in range(options_of(kind.Config))])


def test_what_is_too_much_is_counted():
    assert long_functions({"a": "def f():\n" + "    f()\n" * 60}) == ["a.f: 61"]
    assert options_of(Outer) == 3


@dataclass
class Inner:
    width: Annotated[int, "pixels"] = 1
    depth: int = 2


@dataclass
class Outer:
    inner: Annotated[Inner, "flat"]
    rate: float = 0.1


# Documents name files that are there


ROOTS = (PACKAGE, ROOT / "tests", ROOT / "benchmarks", ROOT / "docs", ROOT / "web", ROOT / "examples")
SOURCE = re.compile(r"[\w./-]+\.(py|pyi|js|mjs|md|svg|toml|cu|css)\b")
NOT_OURS = {"node_modules", "__pycache__"}
KERNEL_FILES = {"__init__.py", "reference.py", "cpu.py", "gpu.py", "faults.py"}  # of every kernel's folder


def repository() -> list[Path]:
    """Files of the repository, relative to it."""
    inside = [path.relative_to(ROOT) for root in ROOTS for path in root.rglob("*") if path.is_file()]
    here = [path.relative_to(ROOT) for path in ROOT.iterdir() if path.is_file()]
    return [path for path in (*here, *inside) if not NOT_OURS & set(path.parts)]


def lost(text: str, page: Path, files: Iterable[Path]) -> list[str]:
    """Paths that a page names and that are missing, or that name several files.

    These are: source files and paths below the repository's own folders in back-ticks, scripts that `python` runs, and
    the targets of relative links.
    """
    named = [path for path in files if path.parts[:2] != ("lumigraph", "reading")]  # has the names of whom it explains
    tails = Counter("/".join(path.parts[-count:]) for path in named for count in range(1, len(path.parts) + 1))
    folders = {path.as_posix() for file in files for path in file.parents}
    own = {folder.split("/")[0] for folder in folders} - {"."}
    below = folders | {folder.removeprefix("lumigraph/") for folder in folders}
    found, prose = list[str](), re.sub(r"(?ms)^```.*?^```", "", text)
    for span in re.findall(r"`([^`\n]+)`", prose):
        match = SOURCE.match(span) or re.match(r"[\w.-]+/[\w./-]*(?![\w./<*{-])", span)
        path = match[0].removesuffix("/") if match else ""
        if (
            not match
            or path in TO_BE_WRITTEN | KERNEL_FILES
            or (match.re is not SOURCE and path.split("/")[0] not in own)
        ):
            continue
        if path not in below and tails[path] != 1 and not any(path == file.as_posix() for file in files):
            found.append(path)
    found += [path for path in re.findall(r"\bpython ([\w./-]+\.py)\b", text) if Path(path) not in files]
    for target in re.findall(r"\]\(([^)#\s]+)", prose):
        path = Path(os.path.normpath(page.parent / target))
        if "://" not in target and path not in files and path.as_posix() not in folders:
            found.append(target)
    return found


def test_documents_name_files_that_are_there():
    files = repository()
    pages = [
        path for path in files if path.suffix == ".md" and path.parts[0] in ("README.md", "CONTRIBUTING.md", "docs")
    ]
    at_most(0, [f"{page}: {path}" for page in pages for path in lost((ROOT / page).read_text("utf-8"), page, files)])


def test_a_lost_file_is_noticed():
    files = [
        Path(path) for path in ("lumigraph/metrics/lpips.py", "tests/tiny.py", "tests/a.py", "docs/a.py", "docs/x.md")
    ]
    fine = "`metrics/lpips.py`, `lumigraph/metrics/lpips.py: Lpips`, `<x>.py`, [`x`](a.py) `tiny.py` `docs/a.py`"
    page = Path("docs/x.md")
    fine += "\n`tests/`, `metrics/`, `tests/tiny_<x>.py`, `w/h` `eval.json`, `python tests/tiny.py`\n```\n`a.py`\n```"
    assert lost(fine, page, files) == []
    assert lost("`lumigraph/lpips.py`, `pips.py` and `lumigraph/metrics/x.py: X`", page, files) == [
        *("lumigraph/lpips.py", "pips.py", "lumigraph/metrics/x.py")
    ]
    assert lost("`a.py`, `tests/data/x.json`\n```\npython tests/b.py\n```\n[b](b.md)", page, files) == [
        *("a.py", "tests/data/x.json", "tests/b.py", "b.md")
    ]
