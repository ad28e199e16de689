"""Mutants: small faults put into modules that matter, and whether the narrow tests of each module see them.

    python benchmarks/mutants.py --count 60 --seed 0       a random sample, the same for the same seed

A mutant has one change: + for -, < for <=, 0 for 1 (each also the other way), a minus dropped, or a number a tenth
larger. It runs in memory, in place of its module, in a process of its own; no file changes. A mutant survives if all
tests pass; one that takes longer than `seconds` counts as killed.
"""

from __future__ import annotations

import ast
import multiprocessing
import os
import random
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

ROOT = Path(__file__).parent.parent
TESTS = {  # narrow tests of modules: losses, samplers, projections, readers, rotations
    "volume.py": "volume rays compositing_physics",
    "components/sampling/sampling.py": "sampling",
    "components/fields/encodings.py": "encodings",
    "components/training/regularizers.py": "regnerf open_grids",
    "components/training/photometric.py": "metrics gaussian_splatting",
    "camera/lens.py": "lens",
    "camera/camera.py": "camera",
    "camera/rays.py": "rays volume",
    "geometry.py": "camera up georeference light",
    "metrics/__init__.py": "metrics",
    "metrics/trajectory.py": "tracking",
    "gaussians/projection.py": "gaussians rasterization",
    "readers/colmap.py": "dialects scene",
    "readers/transforms.py": "dialects scene",
}
SWAPS: dict[type, type] = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE}
SWAPS |= {ast.GtE: ast.Gt}


@dataclass(frozen=True)
class Options:
    count: int = 60
    seed: int = 0
    seconds: int = 300  # of a mutant's tests
    modules: tuple[str, ...] = ()  # below lumigraph/; all of TESTS by default


def faults(tree: ast.AST) -> Iterator[tuple[ast.AST, str, object, str]]:
    """Places that can change: a node, its field, the field's new value, and the change in words."""
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and type(node.op) in SWAPS and not is_text(node):
            yield node, "op", SWAPS[type(node.op)](), type(node.op).__name__
        elif isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
            yield node, "ops", [SWAPS[type(node.ops[0])](), *node.ops[1:]], type(node.ops[0]).__name__
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield node, "op", ast.UAdd(), "dropped minus"
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            number = {0: 1, 1: 0}.get(node.value, node.value * 1.1 if isinstance(node.value, float) else node.value + 1)
            yield node, "value", number, f"{node.value} to {number}"


def is_text(node: ast.BinOp) -> bool:
    """True for sums of text and of types, whose change no test of numbers is about."""
    sides = node.left, node.right
    return any(isinstance(side, ast.JoinedStr) or isinstance(getattr(side, "value", None), str) for side in sides)


def mutant(source: str, number: int) -> tuple[str, str]:
    """The source with its fault of a number, and where that is."""
    tree = ast.parse(source)
    node, field, value, change = list(faults(tree))[number]
    setattr(node, field, value)
    return ast.unparse(tree), f"line {node.lineno}, {change}"  # type: ignore[attr-defined]


def put(module: str, text: str) -> None:
    """Run a module's new text in its place; what others had imported from it becomes the new one too."""
    name = "lumigraph." + module.removesuffix("/__init__.py").removesuffix(".py").replace("/", ".")
    own = vars(sys.modules[name])
    before = {key: value for key, value in own.items() if getattr(value, "__module__", None) == name}
    exec(compile(text, own["__file__"], "exec"), own)
    new = {id(value): own[key] for key, value in before.items()}
    for other in list(sys.modules.values()):
        for key, value in list(getattr(other, "__dict__", {}).items()):
            if id(value) in new and other.__name__.startswith(("lumigraph", "test_")):
                setattr(other, key, new[id(value)])


def judge(session: Any, module: str, text: str) -> None:
    """Run the narrow tests of a module, quietly, with another text in its place."""
    from _pytest.main import pytest_runtestloop

    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    put(module, text)
    session.items = [item for item in session.items if item.path.name in files_of([module])]
    session.config.option.maxfail = 1
    try:
        pytest_runtestloop(session)
    finally:
        os._exit(int(session.testsfailed > 0))


def files_of(modules: Iterable[str]) -> list[str]:
    return sorted({f"test_{name}.py" for module in modules for name in TESTS[module].split()})


def survives(session: Any, module: str, text: str, seconds: int) -> bool:
    """True if all tests of a module pass with another text in its place, in a process that ends after seconds."""
    child = multiprocessing.get_context("fork").Process(target=judge, args=(session, module, text))
    child.start()
    child.join(seconds)
    child.kill()
    child.join()
    return child.exitcode == 0


@dataclass
class Trial:
    """Plugin of pytest that tries mutants in place of the tests, once these are collected."""

    options: Options
    modules: list[str]

    def pytest_runtestloop(self, session: Any) -> bool:
        o, sources = self.options, {m: (ROOT / "lumigraph" / m).read_text("utf-8") for m in self.modules}
        for module in [m for m in self.modules if not survives(session, m, sources[m], 2 * o.seconds)]:
            print(f"{module}: left out, its tests fail where the module itself is run in its place", flush=True)
            self.modules.remove(module)
        places = [(m, i) for m in self.modules for i, _ in enumerate(faults(ast.parse(sources[m])))]
        chosen, alive = random.Random(o.seed).sample(places, min(o.count, len(places))), 0
        for tried, (module, place) in enumerate(chosen, 1):
            text, where = mutant(sources[module], place)
            lives = survives(session, module, text, o.seconds)
            alive += lives
            about = f"{tried - alive} killed of {tried}, {len(places)} places"
            print(f"{module}, {where}: {'SURVIVES' if lives else 'killed'} ({about})", flush=True)
        return True


def main(options: Options) -> None:
    import pytest

    os.chdir(ROOT)
    modules = list(options.modules or TESTS)
    files = [f"tests/{name}" for name in files_of(modules)]
    pytest.main(["-q", "-s", "-p", "no:cacheprovider", *files], plugins=[Trial(options, modules)])


if __name__ == "__main__":
    main(tyro.cli(Options))
