"""Ages of the results behind the tables of README.md and docs/, and the share of figures that stand in such tables.

A file of results is stale where code that it measures (MEASURED) differs from that of its commit in more than comments,
docstrings and the layout of lines. `python benchmarks/tables.py --check` prints all of this.
"""

from __future__ import annotations

import ast
import functools
import json
import re
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
FIELDS = "commit", "date", "machine", "threads", "load", "versions", "steps", "command"  # that each result has
LEARNING = tuple(f"lumigraph/{x}" for x in ("methods", "components", "kernels", "training", "method", "gaussians"))
CLOUDS = (
    "lumigraph/methods/gaussian_splatting",
    "lumigraph/components/clouds",
    "lumigraph/kernels",
    "lumigraph/training",
)
MEASURED: dict[str, tuple[str, ...]] = {  # code that each file of results measures
    "methods-cpu.json": (*LEARNING, "lumigraph/evaluation"),
    "gallery-cpu.json": (*LEARNING, "lumigraph/evaluation", "lumigraph/synthetic"),
    "strangers-cpu.json": (*LEARNING, "lumigraph/synthetic"),
    "paper-presets-cpu.json": ("lumigraph/methods", "lumigraph/components"),
    "constants-cpu.json": tuple(f"lumigraph/methods/{x}" for x in ("nerf_w.py", "rawnerf.py", "regnerf", "block_nerf")),
    "one-minute-cpu.json": CLOUDS,
    "gsplat-cpu.json": ("lumigraph/gsplat", "lumigraph/kernels/project", "lumigraph/kernels/rasterize"),
    "reading-cpu.json": ("lumigraph/reading",),
    "interchange.json": ("lumigraph/exchange",),
    "compositing.json": ("lumigraph/volume.py", "lumigraph/kernels/composite"),
    "mesh-cpu.json": ("lumigraph/export/mesh.py", "lumigraph/export/surface.py"),
    "nerf-skipping-cpu.json": ("lumigraph/methods/nerf.py", "lumigraph/components/sampling"),
    "nerf-speed-cpu.json": ("lumigraph/methods/nerf.py", "lumigraph/kernels/perceptron"),
}
MADE = re.compile(r"<!-- (?:table: [^>]*|interchange) -->.*?<!-- end of [a-z]+ -->", re.DOTALL)  # of results
OF_CODE = re.compile(r"<!-- (?:options|sources|rooms) -->.*?<!-- end of [a-z]+ -->", re.DOTALL)  # no measurements
TABLE = re.compile(r"(?:^ *\|.*\n)+", re.MULTILINE)
NO_FIGURES = re.compile(  # code, equations, links' targets, years, arXiv's numbers, numbers of sections and equations
    r"```.*?```|`[^`\n]*`|\$[^$\n]*\$|\]\([^)]*\)|<[^>\n]*>|https?:\S+|arXiv:? *\d{4}\.\d+|\b(?:19|20)\d\d[a-z]?\b"
    r"|\b(?:sections?|sec\.|eqs?\.|equations?|figures?|fig\.|tables?|appendix|chapter|steps?) \(?\d[\d.]*",
    re.DOTALL | re.IGNORECASE,
)
FIGURE = re.compile(r"(?<![\w.])[−-]?\d[\d,. ]*\d(?!\w)|(?<![\w.])\d(?!\w)")


@dataclass(frozen=True)
class Count:
    """Figures of pages: all, those in generated tables, and tables with figures that no file of results makes."""

    figures: int
    made: int
    by_hand: dict[str, int]  # by page

    @property
    def share(self) -> float:
        return self.made / max(self.figures, 1)


def count(pages: dict[str, str]) -> Count:
    """Count figures in Markdown pages, given by name."""
    figures = made = 0
    by_hand: dict[str, int] = {}
    for name, text in pages.items():
        plain = NO_FIGURES.sub(" ", OF_CODE.sub(" ", MADE.sub(" ", text)))
        own = sum(len(FIGURE.findall(NO_FIGURES.sub(" ", block[0]))) for block in MADE.finditer(text))
        figures, made = figures + own + len(FIGURE.findall(plain)), made + own
        if tables := sum(len(FIGURE.findall(table)) > 2 for table in TABLE.findall(plain)):
            by_hand[name] = tables
    return Count(figures, made, by_hand)


@functools.cache
def code_of(source: str) -> str:
    """Code without comments, docstrings, layout, and the sources of a method's numbers."""
    tree = ast.parse(source)
    tree.body = [x for x in tree.body if not (isinstance(x, ast.Assign) and ast.unparse(x.targets[0]) == "SOURCES")]
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if (
            isinstance(body, list)
            and body
            and isinstance(body[0], ast.Expr)
            and isinstance(body[0].value, ast.Constant)
        ):
            node.body = body[1:]  # type: ignore[attr-defined]
    return ast.dump(tree)


def git(*words: str, root: Path = ROOT) -> str:
    """Output of git; empty where it fails, as for a file that a commit lacks."""
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False).stdout


def changed_since(commit: str, paths: Iterable[str], root: Path = ROOT) -> list[str]:
    """Python files below some paths whose code differs from that of a commit."""
    names = git("diff", "--name-only", commit, "--", *paths, root=root).splitlines()
    return [name for name in names if name.endswith(".py") and not same_code(commit, name, root)]


def same_code(commit: str, name: str, root: Path) -> bool:
    now, before = root / name, git("show", f"{commit}:{name}", root=root)
    return now.exists() and code_of(before) == code_of(now.read_text("utf-8"))


def lacking(found: dict[str, Any]) -> list[str]:
    """Fields that neither a file of results nor all of its rows have. A plural counts as its singular."""
    rows: list[dict[str, Any]] = next(
        (found[name] for name in ("cells", "rows", "trainings") if isinstance(found.get(name), list)), []
    )
    return [x for x in FIELDS if not {x, f"{x}s"} & {*found} and not (rows and all({x, f"{x}s"} & {*r} for r in rows))]


def commits(path: Path) -> set[str]:
    """Commits that a file of results names; without one the commit that wrote it."""
    found = json.loads(path.read_text("utf-8"))
    named = {row["commit"] for row in found.get("cells", []) if "commit" in row} or {found.get("commit")} - {None}
    return named or {git("log", "-1", "--format=%h", "--", str(path)).strip()}


def report(pages: dict[str, str]) -> Iterator[str]:
    """Lines of `--check`: stale files of results, fields that they lack, tables made by hand, shares of figures."""
    paths = sorted(RESULTS.glob("*.json"))
    stale = {}
    for path in paths:
        names = {commit: changed_since(commit, MEASURED[path.name]) for commit in sorted(commits(path))}
        if any(names.values()):
            commit, files = max(names.items(), key=lambda item: len(item[1]))
            last = git("log", "-1", "--format=%h of %cs", "--", *files).strip()
            stale[path.name] = f"{len(files)} files of code differ from commit {commit}; the last change is {last}"
    yield f"{len(stale)} of {len(paths)} files of results are older than the code they measure"
    yield from (f"  {name}: {fault}" for name, fault in stale.items())
    lacks = {path.name: lacking(json.loads(path.read_text("utf-8"))) for path in paths}
    yield f"{sum(map(bool, lacks.values()))} files of results lack fields"
    yield from (f"  {name}: {', '.join(fields)}" for name, fields in lacks.items() if fields)
    found = count(pages)
    yield f"{sum(found.by_hand.values())} tables on {len(found.by_hand)} pages have figures that no result makes"
    yield from (f"  {name}: {number}" for name, number in found.by_hand.items())
    yield f"{found.made:,} of {found.figures:,} figures ({found.share:.0%}) stand in generated tables"
