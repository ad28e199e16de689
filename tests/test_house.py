"""The rooms and which of them may import which. Run as a script, it writes the table of rooms into the documents."""

from __future__ import annotations

import ast
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import shape_checks
import torch
from budgets import budget
from jaxtyping import Bool, Float, Int
from shape_checks import JIT, PACKAGE, checked_modules, module_name, nodes, parsed
from torch import Tensor

import lumigraph
from lumigraph.geometry import to_quaternion
from lumigraph.kernels._operation import operations

ROOT = PACKAGE.parent
pytestmark = budget("house", 5)

# Each floor may know the floors above it in this list, and a room on it knows no other room of its own floor.
# A new room is a new name here, on the floor where it belongs.
FLOORS: list[set[str]] = [
    {"errors"},
    {"system"},
    {"color", "files"},
    {"budget"},
    {"figures", "geometry"},
    {"camera", "metrics"},
    {"kernels"},
    {"datasets", "volume"},
    {"depth_maps", "gaussians", "light"},
    {"exchange", "paths"},
    {"method"},
    {"components", "readers", "selection"},
    {"composition", "sfm", "synthetic"},
    {"methods", "opening", "viewer"},
    {"gsplat", "run"},
    {"export", "training"},
    {"evaluation", "large"},
    {"derive"},
    {"app", "lab"},
    {"commands"},
    {"api"},
    {"__main__", "reading"},
]
# What the floors alone would let through.
STRANGERS: list[tuple[str, str]] = [
    ("readers", "method"),  # readers make Scenes and know no method
    ("sfm", "method"),
    ("opening", "method"),
    ("methods", "synthetic"),  # which the tests and the demo draw, and no method needs
    ("export", "methods"),  # export and viewer know Method.render and no particular method
    ("viewer", "methods"),
    ("method", "components"),  # the abstract classes stand on the nouns alone
    ("kernels", "datasets"),
]


@pytest.fixture(scope="module", autouse=True)
def forget_trees():
    """Drop the package's syntax trees, 300 MB, when the file's tests are done."""
    yield
    parsed.cache_clear()
    nodes.cache_clear()


def room(module: str) -> str:
    """lumigraph.kernels.march.cpu lies in kernels, lumigraph.Camera in camera; the front door itself in no room."""
    name = ".".join(module.split(".")[1:2])
    return "" if name == "__version__" else lumigraph._homes.get(name, name).split(".")[0]


def floor(name: str) -> int:
    found = [i for i, rooms in enumerate(FLOORS) if name in rooms]
    assert found, f"lumigraph/{name} has no floor: give it one in {Path(__file__).name}"
    return found[0]


def imported(source: str, module: str, is_package: bool) -> Iterator[str]:
    """Everything of the house that a source file imports, at its top, inside a function, or by its name as text."""
    around = module.split(".") if is_package else module.split(".")[:-1]
    for node in nodes(source):
        if isinstance(node, ast.Call) and (text := named_import(node)):
            level = len(text) - len(text.lstrip("."))
            above = around[: len(around) + 1 - level] if level else []
            names = [".".join([*above, *filter(None, text.lstrip(".").split("."))])]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = around[: len(around) + 1 - node.level] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{origin}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] == "lumigraph")


def named_import(call: ast.Call) -> str:
    """Name of the module that a call imports: a literal, or the constant beginning of a formatted text."""
    function = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if function not in ("import_module", "__import__") or not call.args:
        return ""
    name = call.args[0].values[0] if isinstance(call.args[0], ast.JoinedStr) else call.args[0]
    return str(name.value) if isinstance(name, ast.Constant) else ""


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
        ("lumigraph.geometry", "from .camera import Camera"),
        ("lumigraph.kernels.march.cpu", "from ...datasets.scene import Scene"),
        ("lumigraph.kernels.march.cpu", "from ... import datasets"),
        ("lumigraph.readers.colmap", "import lumigraph.methods.instant_ngp"),
        ("lumigraph.readers.colmap", "from lumigraph import Method"),
        ("lumigraph.export.film", "def later():\n    from ..methods import find"),
        ("lumigraph.components.grid", "from ..training import fit"),
        ("lumigraph.method", "from .components import perceptron"),
        ("lumigraph.run.opened", "importlib.import_module('..commands.calls', __package__)"),
        ("lumigraph.run.opened", "import_module(f'..commands.{name}', __package__)"),
        ("lumigraph.volume", "__import__('lumigraph.methods')"),
    ],
)
def test_an_arrow_the_wrong_way_is_noticed(module, line):
    assert len(faults(line, module)) == 1


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("lumigraph.kernels.march.cpu", "from .._operation import differentiable"),
        ("lumigraph.kernels.march.cpu", "from ...camera.rays import Samples"),
        ("lumigraph.methods.instant_ngp", "from .. import kernels\nfrom ..components import perceptron"),
        ("lumigraph.commands.cli", "from lumigraph import Scene, __version__, fit"),
        ("lumigraph.volume", "import torch\nfrom os import path"),
        ("lumigraph.methods", "import_module(f'.{name}', __package__)\nimportlib.import_module('diffusers')"),
    ],
)
def test_an_arrow_the_right_way_is_not(module, line):
    assert faults(line, module) == []


def inner_arrows(sources: dict[str, str], packages: set[str]) -> dict[str, set[str]]:
    """The modules of its own room that each module imports.

    `from .x import name` in a package's `__init__` leads to x, as it does anywhere; a module that takes a name from its
    own package leads to that `__init__`. What is between rooms is left to the floors.
    """
    arrows: dict[str, set[str]] = {}
    for module, source in sources.items():
        found = set()
        for name in imported(source, module, module in packages):
            target = name if name in sources else name.rpartition(".")[0]
            if target in sources and target != module and room(target) == room(module):
                found.add(target)
        arrows[module] = found
    return arrows


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Sets of modules that import one another, whether directly or by way of others."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        ahead = [start]
        while ahead:
            fresh = arrows[ahead.pop()] - seen
            seen |= fresh
            ahead += fresh
        return seen

    reach = {module: reached(module) for module in arrows}
    found = {tuple(sorted(m for m in reach[module] if module in reach[m])) for module in arrows}
    return [list(circle) for circle in sorted(found) if circle]


def test_no_room_has_a_circle_of_imports():
    files = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
    del files["lumigraph"]  # the front door imports by name when asked
    sources = {module: path.read_text(encoding="utf-8") for module, path in files.items()}
    packages = {module for module, path in files.items() if path.name == "__init__.py"}
    arrows = inner_arrows(sources, packages)
    assert sum(map(len, arrows.values())) > 200  # it sees most imports
    assert circles(arrows) == []
    families: dict[str, set[str]] = {}
    for module, others in arrows.items():
        if module.startswith(COMPONENTS):
            families.setdefault(family(module), set()).update({family(other) for other in others} - {family(module)})
    assert len(families) > 8 and circles(families) == [], "folders of components import one way"


COMPONENTS = "lumigraph.components."


def family(module: str) -> str:
    """Folder of components that a module lies in; a module beside the folders itself."""
    return ".".join(module.split(".")[:3])


@pytest.mark.parametrize(
    ("sources", "members"),
    [
        ({"a": "from .b import B", "b": "def later():\n    from .a import A"}, {"a", "b"}),
        ({"a": "from .b import B", "b": "if TYPE_CHECKING:\n    from .a import A"}, {"a", "b"}),
        ({"a": "from . import b", "b": "from .c import C", "c": "import lumigraph.viewer.a"}, {"a", "b", "c"}),
        ({"": "from .a import A as A", "a": "from . import NAME", "b": "from .a import A"}, {"", "a"}),
        ({"": "from .a import A as A", "a": "from ..viewer import NAME"}, {"", "a"}),
        ({"": "from .b.a import A", "b": "", "b.a": "from .. import NAME"}, {"", "b.a"}),
    ],
)
def test_a_circle_is_noticed(sources, members):
    assert circles(room_arrows(sources)) == [sorted(f"lumigraph.viewer.{name}".rstrip(".") for name in members)]


@pytest.mark.parametrize(
    "sources",
    [
        {"": "from .a import A as A\nfrom .b import B as B", "a": "from .b import B", "b": "from ..scene import Scene"},
        {"": "from . import a, b", "a": "from . import b", "b": "import torch"},
        {"": "NAME = 1", "a": "from . import NAME", "b": "from .a import A\nfrom . import NAME"},
        {"a": "from .b import B\nfrom .c import C", "b": "from .d import D", "c": "from .d import D", "d": ""},
    ],
)
def test_what_is_no_circle_is_not(sources):
    assert circles(room_arrows(sources)) == []


def room_arrows(sources: dict[str, str]) -> dict[str, set[str]]:
    """Arrows of a made-up room, its modules by their names inside it."""
    named = {f"lumigraph.viewer.{name}".rstrip("."): source for name, source in sources.items()}
    return inner_arrows(named, {module for module in named if any(m.startswith(module + ".") for m in named)})


def value_protocols(source: str) -> set[str]:
    """Names of the protocols of a source file that have values beside functions: annotations or properties."""
    found = set()
    for node in nodes(source):
        if isinstance(node, ast.ClassDef) and any(ast.unparse(base).startswith("Protocol") for base in node.bases):
            properties = [x for x in node.body if isinstance(x, ast.FunctionDef) and x.decorator_list]
            if properties or any(isinstance(x, ast.AnnAssign) for x in node.body):
                found.add(node.name)
    return found


def asked_by_isinstance(source: str, names: set[str]) -> set[str]:
    """The names among these that a source file gives to `isinstance` or `issubclass`."""
    calls = [node for node in nodes(source) if isinstance(node, ast.Call) and len(node.args) == 2]
    kinds = [x.args[1] for x in calls if isinstance(x.func, ast.Name) and x.func.id in ("isinstance", "issubclass")]
    return {x.id if isinstance(x, ast.Name) else x.attr for kind in kinds for x in ast.walk(kind)
            if isinstance(x, ast.Name | ast.Attribute)} & names  # fmt: skip


def test_no_protocol_with_values_is_asked_by_isinstance():
    """From Python 3.12 on, `isinstance` looks for a protocol's values by `inspect.getattr_static`, which does not see
    an `nn.Module`'s submodules and parameters."""
    sources = [path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")]
    names = set().union(*(value_protocols(source) for source in sources if "Protocol" in source))
    assert {"RefinesPoses", "HasExposure", "HasAppearance", "Dataset", "Lesson"} <= names
    places = [path for folder in ("lumigraph", "tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    texts = {
        path.relative_to(ROOT).as_posix(): text
        for path in places
        if any(name in (text := path.read_text("utf-8")) for name in names)
    }
    found = {name: asked for name, text in texts.items() if (asked := asked_by_isinstance(text, names))}
    assert not found, f"{found}: `capabilities.can` sees submodules too"


def test_a_protocol_with_values_is_noticed():
    source = """
class Plain(Protocol):
    def go(self): ...
class Valued(Protocol[T]):
    poses: int
class Lazy(Protocol):
    @property
    def poses(self): ...
class Data:
    poses: int
"""
    assert value_protocols(source) == {"Valued", "Lazy"}
    names = {"Valued", "Lazy"}
    assert asked_by_isinstance("isinstance(x, (int, m.Valued)) or issubclass(y, Lazy | None)", names) == names
    assert asked_by_isinstance("can(x, Valued); isinstance(Lazy, type)", names) == set()


def test_capabilities_refuse_isinstance():
    from lumigraph.method import capabilities

    protocols = {
        x
        for x in vars(capabilities).values()
        if getattr(x, "_is_protocol", False) and x.__module__ == capabilities.__name__
    }
    assert not protocols ^ {*capabilities.LACKING}, "each has its sentence"
    for capability in capabilities.LACKING:
        with pytest.raises(TypeError, match="runtime_checkable"):
            isinstance(object(), capability)


KERNEL = {  # what each file of a kernel's folder defines
    "__init__.py": {
        "FACTS": "its unit, its outputs, its differentiable inputs, its typical case",
        "cases": "what the engines are compared on",
        "benchmark_case": "what they are timed on",
    },
    "reference.py": {"run": "what the operation means"},
    "cpu.py": {"run": "the Numba engine"},
    "gpu.py": {"run": "the Triton engine"},
    "faults.py": {"FAULTS": "faults for its engines", "ASTRAY": "indices that leave their arrays"},
}


def definitions(path: Path) -> dict[str, ast.AST]:
    """What a file defines, assigns or imports at its top."""
    found: dict[str, ast.AST] = {}
    for node in parsed(path.read_text(encoding="utf-8")).body if path.is_file() else []:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign):
            found |= {x.id: node.value for target in node.targets for x in ast.walk(target) if isinstance(x, ast.Name)}
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name: node for alias in node.names}
    return found


def literal(node: ast.AST | None) -> dict:
    return ast.literal_eval(node) if node else {}


def lacks(operation: Path) -> list[str]:
    """What the folder of a kernel does not say of it, one sentence each."""
    name, files = operation.name, {file: definitions(operation / file) for file in KERNEL}
    wanted = {file: dict(meanings) for file, meanings in KERNEL.items()}
    wanted["__init__.py"][name] = "the operation itself"
    found = [
        f"kernels/{name}/{file} lacks {statement}: {meaning}"
        for file, meanings in wanted.items()
        for statement, meaning in meanings.items()
        if statement not in files[file]
    ]
    faults, astray = (literal(files["faults.py"].get(statement)) for statement in ("FAULTS", "ASTRAY"))
    for engine in ("cpu", "gpu"):
        path = operation / f"{engine}.py"
        compiles = path.is_file() and JIT.search(path.read_text(encoding="utf-8"))
        if compiles and engine not in [fault[0] for fault in faults.values()]:
            found.append(f"kernels/{name}/faults.py lacks a fault for {engine}.py in FAULTS")
    if "cpu" not in [fault[0] for fault in astray.values()]:
        found.append(f"kernels/{name}/faults.py lacks an index for cpu.py in ASTRAY")
    if name not in definitions(operation.parent / "__init__.py"):
        found.append(f"kernels/__init__.py lacks a line: from .{name} import {name} as {name}")
    return found


def test_every_kernel_says_what_it_is():
    folders = [path for path in (PACKAGE / "kernels").iterdir() if path.is_dir() and not path.name.startswith("__")]
    assert folders
    found = [sentence for path in folders for sentence in lacks(path)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("file", "before", "after", "sentence"),
    [
        ("__init__.py", "FACTS = ", "TRUTHS = ", "composite/__init__.py lacks FACTS: its unit,"),
        ("__init__.py", "def cases(", "def instances(", "composite/__init__.py lacks cases:"),
        ("__init__.py", "def benchmark_case(", "def race(", "composite/__init__.py lacks benchmark_case:"),
        ("__init__.py", "def composite(", "def composed(", "composite/__init__.py lacks composite: the operation"),
        ("reference.py", "def run(", "def go(", "composite/reference.py lacks run: what the operation means"),
        ("gpu.py", "run = ", "go = ", "composite/gpu.py lacks run: the Triton engine"),
        ("faults.py", "FAULTS = ", "ERRORS = ", "composite/faults.py lacks FAULTS:"),
        ("faults.py", '("cpu",', '("gpu",', "composite/faults.py lacks a fault for cpu.py in FAULTS"),
        ("faults.py", '("cpu",', '("gpu",', "composite/faults.py lacks an index for cpu.py in ASTRAY"),
        ("../__init__.py", "composite", "composed", "kernels/__init__.py lacks a line: from .composite import"),
    ],
)
def test_a_kernel_that_does_not_is_noticed(file, before, after, sentence, tmp_path):
    operation = tmp_path / "kernels" / "composite"
    shutil.copytree(PACKAGE / "kernels" / "composite", operation)
    shutil.copy(PACKAGE / "kernels" / "__init__.py", operation.parent)
    assert lacks(operation) == []
    path = operation / file
    path.write_text(path.read_text(encoding="utf-8").replace(before, after), encoding="utf-8")
    assert any(sentence in found for found in lacks(operation)), lacks(operation)


def test_the_page_of_kernels_names_every_operation():
    """Each has a row, and the row says "none" exactly where no gradient passes."""
    text = (ROOT / "docs" / "kernels.md").read_text(encoding="utf-8")
    named = {name: gradients != "none" for name, gradients in re.findall(r"^\| `(\w+)` \|.*\| (.*) \|$", text, re.M)}
    packages = {name: import_module(f"lumigraph.kernels.{name}") for name in operations()}
    assert named == {name: bool(package.FACTS.differentiable) for name, package in packages.items()}


def test_compiled_functions_stay_outside_the_shape_checks():
    """Numba and Triton read a function's source: checks wrapped around it would stop them."""
    checked = checked_modules()
    assert {"lumigraph.camera.rays", "lumigraph.volume", "lumigraph.kernels.composite"} <= checked
    for path in PACKAGE.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        compiles = "jit" in source and any(
            isinstance(node, ast.FunctionDef)
            and any("jit" in ast.unparse(decorator) for decorator in node.decorator_list)
            for node in nodes(source)
        )
        assert not (compiles and module_name(path) in checked), (
            f"{path.name} compiles functions but imports no compiler"
        )


@jaxtyping.jaxtyped(typechecker=None)
def double(x: Float[torch.Tensor, "row 3"]) -> Float[torch.Tensor, "row 3"]:
    return 2 * x


@jaxtyping.jaxtyped(typechecker=None)
@dataclass
class Pairs:
    left: Float[torch.Tensor, "row 3"]
    right: Float[torch.Tensor, "row 3"] | float


def test_first_calls_of_each_test_have_their_shapes_checked():
    for function in (double, to_quaternion):
        with pytest.raises(shape_checks.ShapeError, match=r"float32 \(2, 2\), not Float\[.*Tensor, "):
            function(torch.zeros(2, 2))
    for _ in range(shape_checks.CHECKED_CALLS):
        double(torch.zeros(4, 3))
    assert double(torch.zeros(2, 2)).shape == (2, 2)
    shape_checks.next_test()
    with pytest.raises(shape_checks.ShapeError):
        double(torch.zeros(2, 2))
    Pairs(torch.zeros(4, 3), right=2), Pairs(torch.zeros(4, 3), torch.zeros(4, 3))
    with pytest.raises(shape_checks.ShapeError, match="row=4"):
        Pairs(torch.zeros(4, 3), torch.zeros(2, 3))


Rows = Float[torch.Tensor, "row 3"]


@jaxtyping.jaxtyped(typechecker=None)
def tripled(x: Rows | None) -> Rows:
    return 3 * x


def test_a_name_for_a_shape_is_checked():
    assert tripled(torch.ones(2, 3)).shape == (2, 3)
    with pytest.raises(shape_checks.ShapeError, match=r"x is torch.float32 \(3, 2\), not Rows"):
        tripled(torch.ones(3, 2))


@pytest.mark.parametrize(
    ("annotation", "right", "wrong"),
    [
        (Float[Tensor, "n 3"] | None, None, np.zeros((2, 3))),
        (tuple[Int[Tensor, "n"], ...], (torch.arange(2), torch.arange(3)), (torch.arange(2), torch.zeros(3))),
        (tuple[Float[Tensor, "n"], int], (torch.zeros(2), 1), (torch.zeros(2, 1), 1)),
        (Sequence[Float[Tensor, "n"]], [torch.zeros(2), torch.zeros(3)], [torch.zeros(2), torch.zeros(3, 1)]),
        (dict[str, Bool[Tensor, "n"]], {"a": torch.zeros(2).bool()}, {"a": torch.zeros(2)}),
        (Float[Tensor, "{count}"], torch.zeros(7), torch.zeros(6)),
    ],
)
def test_shapes_are_found_within(annotation, right, wrong):
    def taken(x, count=7):
        return x

    taken.__annotations__["x"] = annotation
    checked = shape_checks.first_calls(taken)
    assert checked(right) is right
    with pytest.raises(shape_checks.ShapeError, match="x is "):
        checked(wrong)


# The table of rooms in the documents follows FLOORS and docstrings.

PAGE = ROOT / "docs" / "architecture.md"
TABLE = re.compile(r"(?<=<!-- rooms -->\n).*?(?=<!-- end of rooms -->)", re.DOTALL)


def rooms_table() -> str:
    """FLOORS as a Markdown table, each room with the first line of its docstring."""
    rows = ["| floor | room | contents |", "|---|---|---|"]
    for number, rooms in enumerate(FLOORS, 1):
        for name in sorted(rooms):
            path = PACKAGE / name / "__init__.py"
            source = (path if path.is_file() else PACKAGE / f"{name}.py").read_text(encoding="utf-8")
            rows.append(f"| {number} | `{name}` | {(ast.get_docstring(parsed(source)) or '').partition(chr(10))[0]} |")
    return "\n".join(rows) + "\n"


EXTRAS = {
    "coacd",
    "fourdgs",
    "laspy",
    "liblzfse",
    "diffusers",
    "onnxruntime",
    "pye57",
    "rawpy",
    "ray",
    "triton",
}  # modules of no plain install


def test_what_only_an_extra_installs_is_imported_where_it_is_used():
    """A module that a plain installation lacks would break every command that imports all methods."""
    needed = []
    for path in PACKAGE.rglob("*.py"):
        for node in parsed(path.read_text("utf-8")).body:
            names = [x.name for x in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            needed += [f"{path.relative_to(PACKAGE)}: {x}" for x in names if x.partition(".")[0] in EXTRAS]
    assert not [x for x in needed if not x.startswith("kernels/")], needed  # engines for GPUs are loaded on GPUs


def test_the_table_of_rooms_is_up_to_date():
    written = TABLE.search(PAGE.read_text(encoding="utf-8"))
    assert written and written[0] == rooms_table(), "docs/architecture.md is stale; run `python tests/test_house.py`"
    for row in rooms_table().splitlines()[2:]:
        assert row.endswith(". |"), f"the first line of a room's docstring must be a sentence: {row}"


if __name__ == "__main__":
    PAGE.write_text(TABLE.sub(lambda _: rooms_table(), PAGE.read_text(encoding="utf-8")), encoding="utf-8")
