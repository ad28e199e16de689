"""The plan of the house: which room may know which. Arrows point one way."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import PACKAGE, checked_modules, module_name

import lumigraph

# Each floor may know the floors above it in this list, and a room on it knows no other room of its own floor.
# A new room is a new name here, on the floor where it belongs.
FLOORS: list[set[str]] = [
    {"errors", "loops", "memory", "srgb"},
    {"files", "plain", "lens", "rays"},
    {"camera", "images", "kernels", "charts", "figures", "lpips", "metrics"},
    {"volume", "gaussians", "scene"},
    {"splatting"},
    {"components", "capture", "exchange", "method", "paths", "keyframes"},
    {"display"},
    {"methods", "export", "viewer"},
    {"run", "evaluate", "splat_file"},
    {"train", "report", "describe"},
    {"benchmark", "explain"},
    {"commands"},
    {"cli"},
    {"__main__"},
]
# What the floors alone would let through.
STRANGERS: list[tuple[str, str]] = [
    ("capture", "method"),  # capture makes Scenes and knows no method
    ("capture", "methods"),
    ("export", "methods"),  # export and viewer know Method.render and no particular method
    ("viewer", "methods"),
    ("method", "components"),  # the abstract classes stand on the nouns alone
    ("kernels", "scene"),
]


def room(module: str) -> str:
    """lumigraph.kernels.march.cpu lies in kernels, lumigraph.Camera in camera; the front door itself in no room."""
    name = ".".join(module.split(".")[1:2])
    return "" if name == "__version__" else lumigraph._homes.get(name, name)


def floor(name: str) -> int:
    found = [i for i, rooms in enumerate(FLOORS) if name in rooms]
    assert found, f"lumigraph/{name} has no floor: give it one in {Path(__file__).name}"
    return found[0]


def imported(source: str, module: str, is_package: bool) -> Iterator[str]:
    """Everything of the house that a source file imports, at its top or inside a function."""
    around = module.split(".") if is_package else module.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = around[: len(around) + 1 - node.level] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{origin}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] == "lumigraph")


def faults(source: str, module: str, is_package: bool = False) -> list[str]:
    """The arrows of one file that point the wrong way."""
    here = room(module)
    others = [(name, room(name)) for name in imported(source, module, is_package)]
    return [
        f"{module} imports {name}, but {here} may not know {there}"
        for name, there in others
        if there not in ("", here) and (floor(there) >= floor(here) or (here, there) in STRANGERS)
    ]


def test_arrows_point_one_way():
    found: list[str] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        module = module_name(path)
        if module != "lumigraph":  # the front door knows every room
            floor(room(module))
            found += faults(path.read_text(encoding="utf-8"), module, path.name == "__init__.py")
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("lumigraph.rays", "from .camera import Camera"),
        ("lumigraph.kernels.march.cpu", "from ...scene import Scene"),
        ("lumigraph.kernels.march.cpu", "from ... import scene"),
        ("lumigraph.capture.colmap", "import lumigraph.methods.instant_ngp"),
        ("lumigraph.capture.colmap", "from lumigraph import Method"),
        ("lumigraph.export.film", "def later():\n    from ..methods import find"),
        ("lumigraph.components.grid", "from ..train import fit"),
        ("lumigraph.method", "from .components import perceptron"),
    ],
)
def test_an_arrow_the_wrong_way_is_noticed(module, line):
    assert len(faults(line, module)) == 1


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("lumigraph.kernels.march.cpu", "from .._dispatch import differentiable"),
        ("lumigraph.kernels.march.cpu", "from ...rays import Samples"),
        ("lumigraph.methods.instant_ngp", "from .. import kernels\nfrom ..components import perceptron"),
        ("lumigraph.cli", "from lumigraph import Scene, __version__, fit"),
        ("lumigraph.volume", "import torch\nfrom os import path"),
    ],
)
def test_an_arrow_the_right_way_is_not(module, line):
    assert faults(line, module) == []


def test_every_kernel_has_a_meaning_and_three_engines():
    operations = [path for path in (PACKAGE / "kernels").iterdir() if path.is_dir() and not path.name.startswith("__")]
    assert operations
    for operation in operations:
        for file in ("__init__.py", "reference.py", "cpu.py", "gpu.py"):
            assert (operation / file).is_file(), f"{operation.name} lacks {file}"


def test_compiled_functions_stay_outside_the_shape_checks():
    """Numba and Triton read a function's source: checks wrapped around it would stop them."""
    checked = checked_modules()
    assert {"lumigraph.camera", "lumigraph.rays", "lumigraph.volume", "lumigraph.kernels.composite"} <= checked
    for path in PACKAGE.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        compiles = any(
            isinstance(node, ast.FunctionDef)
            and any("jit" in ast.unparse(decorator) for decorator in node.decorator_list)
            for node in ast.walk(ast.parse(source))
        )
        assert not (compiles and module_name(path) in checked), (
            f"{path.name} compiles functions but imports no compiler"
        )
