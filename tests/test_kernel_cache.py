"""Compiled kernels: found again by another environment with the same files, compiled anew after any file changes."""

from __future__ import annotations

import importlib.util
import re

import pytest
from budgets import budget

from lumigraph.system.kernel_cache import PACKAGE, KernelLocator

pytestmark = budget("house", 8)
SOURCE = """
from numba import njit

@njit(cache=True)
def doubled(x):
    return 2 * x
"""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """A function of an installed package in a folder of that name."""
    monkeypatch.setenv("LUMIGRAPH_CACHE", str(tmp_path / "cache"))

    def loaded(environment: str, other: str = ""):
        package = tmp_path / environment / "site-packages" / "lumigraph"
        (package / "kernels").mkdir(parents=True, exist_ok=True)
        (package / "kernels" / "cpu.py").write_text(SOURCE)
        (package / "constants.py").write_text(other)
        monkeypatch.setattr(KernelLocator, "package", package)
        found = importlib.util.spec_from_file_location("lumigraph.kernels.cpu", package / "kernels" / "cpu.py")
        module = importlib.util.module_from_spec(found)
        found.loader.exec_module(module)
        assert module.doubled(3) == 6
        return sum(module.doubled.stats.cache_hits.values()), package

    return loaded


def test_another_environment_finds_the_kernels(load, tmp_path, monkeypatch):
    assert load("one")[0] == 0
    hits, package = load("two")
    assert hits == 1 and not list(package.rglob("*.nbi"))
    assert load("three", "FACTOR = 3")[0] == 0  # a file that a kernel may take a constant from
    monkeypatch.setenv("LUMIGRAPH_CACHE", str(tmp_path / "one" / "site-packages" / "lumigraph" / "constants.py"))
    hits, package = load("four")
    assert hits == 0 and list(package.rglob("*.nbi"))  # a folder that cannot be made: beside the source, as ever


def test_a_source_tree_keeps_its_kernels_itself(load, tmp_path):
    (tmp_path / "tree" / "site-packages").mkdir(parents=True)
    (tmp_path / "tree" / "site-packages" / "pyproject.toml").touch()
    assert list(load("tree")[1].rglob("*.nbi")) and not (tmp_path / "cache").exists()


def test_numba_asks_before_any_kernel_is_defined():
    """The room of a kernel imports the locator first, or the module or its package imports from such a room."""
    line = "from ..system import kernel_cache as kernel_cache"
    first = [file.parent.name for file in PACKAGE.glob("*/__init__.py") if line in file.read_text()]
    imports = re.compile(rf"^from \.+({'|'.join(first)})\b", re.MULTILINE)
    files = [file for file in PACKAGE.rglob("*.py") if "cache=True" in file.read_text()]
    assert len(files) > 20
    for file in files:
        room = file.relative_to(PACKAGE).parts[0]
        text = file.with_name("__init__.py").read_text() + file.read_text()
        assert room in (*first, "system") or imports.search(text), f"{room}/__init__.py needs: {line}"
