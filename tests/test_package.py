"""The package as it is installed, and the documents as a site."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml
from budgets import budget

import lumigraph

pytestmark = budget("house", 12)

ROOT = Path(__file__).parent.parent


def of_project(folder: Path, *names: str) -> Path:
    """A copy of parts of the project, in which something may be built."""
    for name in names:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    project = of_project(tmp_path_factory.mktemp("project"), "lumigraph", "pyproject.toml", "README.md", "LICENSE")
    command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", project / "dist", project]
    subprocess.run(command, check=True, capture_output=True)
    (found,) = (project / "dist").glob("*.whl")
    return found


def test_the_wheel_holds_every_file_of_the_package(wheel):
    tracked = (path for path in (ROOT / "lumigraph").rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    expected = {path.relative_to(ROOT).as_posix() for path in tracked if not path.name.startswith(".")}
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if name.startswith("lumigraph/")}
    assert held == expected


def test_it_runs_from_the_wheel_alone(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "installed"), "LUMIGRAPH_CACHE": str(tmp_path / "cache")}
    program = "import lumigraph, sys; assert 'torch' not in sys.modules; print(lumigraph.__file__)"
    told = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=elsewhere, check=True, capture_output=True, text=True
    )
    assert told.stdout.strip().startswith(str(tmp_path / "installed"))
    command = [sys.executable, "-m", "lumigraph", "methods"]
    listed = subprocess.run(command, env=environment, cwd=elsewhere, check=True, capture_output=True, text=True).stdout
    assert "instant-ngp" in listed


def test_one_place_says_the_version(wheel):
    assert wheel.name.startswith(f"lumigraph-{lumigraph.__version__}-")
    assert f"## {lumigraph.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    page = (tmp_path / "site" / "api.html").read_text()
    missing = [name for name in lumigraph.__all__ if not re.search(rf'id="[\w.]*\b{name}"', page)]
    assert not missing


def test_every_page_is_in_the_menu():
    menu = yaml.load((ROOT / "mkdocs.yml").read_text(), yaml.SafeLoader)["nav"]
    named = {
        page
        for section in menu
        for pages in section.values()
        for page in ([pages] if isinstance(pages, str) else pages)
    }
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert {page for page in pages if not page.startswith("methods/")} == named - {"methods/*"}
