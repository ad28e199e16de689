"""Before any test: Triton interprets where there is no GPU, and the shapes written at every door are executed."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import lumigraph  # first, because it sets how OpenMP waits before PyTorch is loaded

import pytest  # isort: skip
import torch  # isort: skip
from browser import chromium, faults, page  # noqa: F401  # isort: skip
from jaxtyping import install_import_hook  # isort: skip

PACKAGE = Path(lumigraph.__file__).parent
JIT = re.compile(r"^\s*(import|from) (numba|triton)\b", re.MULTILINE)


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def checked_modules() -> set[str]:
    """All modules but those that hold compiled functions, which the compilers could not read with checks inside."""
    return {module_name(path) for path in PACKAGE.rglob("*.py") if not JIT.search(path.read_text(encoding="utf-8"))}


if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is imported

loaded = sorted(name for name in sys.modules if name.startswith("lumigraph."))
assert not loaded, f"loaded before their shapes could be checked: {loaded}"
checker = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"  # an int will do for a float
manager = install_import_hook(["lumigraph"], checker)
covered = checked_modules()
manager.hook.should_instrument = covered.__contains__  # type: ignore[method-assign, attr-defined]


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
