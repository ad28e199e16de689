"""Proofs that are kept: skipped while nothing has changed, and run whenever something has."""

from __future__ import annotations

from pathlib import Path

import pytest
from proofs import sources

pytest_plugins = ["pytester"]

PROOF = """
from pathlib import Path
import pytest
from proofs import kept

@pytest.mark.parametrize("name", ["a", "b"])
@kept(lambda name: [Path(__file__).with_name(name + ".txt")])
def test_says_yes(name, tmp_path):
    assert Path(__file__).with_name(name + ".txt").read_text().strip() == "yes"
"""
NO_PROOF = """
from proofs import kept

@kept(lambda: None)
def test_always():
    pass
"""


@pytest.fixture
def outcomes(pytester, monkeypatch):
    """A function that writes two files, runs a proof of each, and says how many passed, were skipped and failed."""
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.syspath_prepend(Path(__file__).parent)
    pytester.makepyfile(PROOF)

    def run(a: str = "yes", b: str = "yes") -> tuple[int, int, int]:
        pytester.path.joinpath("a.txt").write_text(a)
        pytester.path.joinpath("b.txt").write_text(b)
        found = pytester.runpytest("-rs")
        found.stdout.no_fnmatch_line("*Error: fixture*")
        counts = found.parseoutcomes()
        if "skipped" in counts:
            found.stdout.fnmatch_lines("*proved before, unchanged*")
        return tuple(counts.get(outcome, 0) for outcome in ("passed", "skipped", "failed"))

    return run


def test_what_was_proved_is_skipped_until_its_own_file_changes(outcomes):
    assert outcomes() == (2, 0, 0)
    assert outcomes() == (0, 2, 0)
    assert outcomes(a="yes\n") == (1, 1, 0)
    assert outcomes(a="yes\n") == (0, 2, 0)


def test_a_failure_proves_nothing(outcomes):
    assert outcomes(b="no") == (1, 0, 1)
    assert outcomes(b="no") == (0, 1, 1)
    assert outcomes() == (1, 1, 0)
    assert outcomes(b="no") == (0, 1, 1)


def test_it_runs_again_when_the_test_itself_changes(outcomes, pytester):
    assert outcomes() == (2, 0, 0)
    pytester.makepyfile(PROOF + "# another word\n")
    assert outcomes() == (2, 0, 0)


def test_in_ci_every_proof_runs(outcomes, monkeypatch):
    assert outcomes() == (2, 0, 0)
    monkeypatch.setenv("CI", "true")
    assert outcomes() == (2, 0, 0)


def test_what_depends_on_no_files_is_no_proof(outcomes, pytester):
    pytester.makepyfile(NO_PROOF)
    assert outcomes() == (1, 0, 0)
    assert outcomes() == (1, 0, 0)


def test_sources_are_a_folder_and_all_that_it_imports(tmp_path):
    files = {
        "room/__init__.py": "from .one import x\nimport os",
        "room/one.py": "def later():\n    from ..shared import y\n    from .. import other",
        "room/unused.py": "",
        "shared.py": "from .deep.down import z",
        "other/__init__.py": "",
        "other/inner.py": "",
        "deep/__init__.py": "",
        "deep/down.py": "from .. import shared",
        "stranger.py": "from .room import one",
    }
    for name, source in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(source)
    found = {path.relative_to(tmp_path).as_posix() for path in sources(tmp_path / "room")}
    assert found == set(files) - {"other/inner.py", "deep/__init__.py", "stranger.py"}
