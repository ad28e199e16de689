"""Mutants: small faults put into modules that matter, and whether the narrow tests of each module see them.

    python benchmarks/mutants.py --count 60 --seed 0       a random sample, the same for the same seed

A mutant has one change: + for -, < for <=, 0 for 1 (each also the other way), a minus dropped, or a number a tenth
larger. The file is changed in place, the tests run in a process of their own, and the file is put back. A mutant
survives if all tests pass; one that takes longer than `seconds` counts as killed.
"""

from __future__ import annotations

import ast
import multiprocessing
import os
import random
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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


def judge(files: list[str]) -> None:
    """Run tests quietly, from a process that has PyTorch and pytest but nothing of the package."""
    import pytest

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    sys.stdout = sys.stderr = open(os.devnull, "w")
    os._exit(int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *files])))


def survives(module: str, text: str, seconds: int) -> bool:
    """Whether all tests of a module pass with another text in place of it."""
    path, files = ROOT / "lumigraph" / module, [f"tests/test_{name}.py" for name in TESTS[module].split()]
    kept = path.read_bytes()
    child = multiprocessing.get_context("fork").Process(target=judge, args=(files,))
    try:
        path.write_text(text, "utf-8")
        child.start()
        child.join(seconds)
        return child.exitcode == 0
    finally:
        path.write_bytes(kept)
        child.kill()


def main(options: Options) -> None:
    import torch  # noqa: F401  children share it

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # the file is put back
    os.chdir(ROOT)
    sys.dont_write_bytecode = True
    modules = options.modules or tuple(TESTS)
    sources = {module: (ROOT / "lumigraph" / module).read_text("utf-8") for module in modules}
    places = [(m, i) for m, source in sources.items() for i, _ in enumerate(faults(ast.parse(source)))]
    chosen = random.Random(options.seed).sample(places, min(options.count, len(places)))
    for module in {module for module, _ in chosen}:
        if not survives(module, sources[module], 2 * options.seconds):
            raise SystemExit(f"The tests of {module} fail without a fault: tests/test_({TESTS[module]}).py")
    alive = 0
    for tried, (module, number) in enumerate(chosen, 1):
        text, where = mutant(sources[module], number)
        lives = survives(module, text, options.seconds)
        alive += lives
        print(f"{tried}: {module}, {where}: {'SURVIVES' if lives else 'killed'}", flush=True)
    print(f"{len(chosen)} of {len(places)} places tried, {len(chosen) - alive} killed, {alive} survive")


if __name__ == "__main__":
    main(tyro.cli(Options))
